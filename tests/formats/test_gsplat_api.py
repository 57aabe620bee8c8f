"""`gsplat_api.rasterization` against gsplat 1.5.3: its torch code and its strategy."""

from __future__ import annotations

import inspect
from functools import cache
from typing import Any, NamedTuple

import gsplat
import pytest
import torch
from gsplat.cuda import _torch_impl
from scipy.spatial.transform import Rotation
from torch import Tensor

from xrgs.formats.gsplat_api import RenderMode, rasterization

WIDTH, HEIGHT = 37, 29
MODES: tuple[RenderMode, ...] = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
PARAMETERS = ("means", "quats", "scales", "opacities", "colors")


class Scene(NamedTuple):
    """Arguments of `rasterization`, float64; some Gaussians lie behind the cameras or outside."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    viewmats: Tensor
    Ks: Tensor
    backgrounds: Tensor

    def to(self, dtype: torch.dtype) -> Scene:
        return Scene(*(value.to(dtype) for value in self))

    def arguments(self) -> dict[str, Any]:
        return self._asdict() | {"width": WIDTH, "height": HEIGHT}


def scene(count: int = 80, *, per_camera: bool = False, sh_degree: int | None = None) -> Scene:
    generator = torch.Generator().manual_seed(0)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    means = (uniform(count, 3) - 0.5) * torch.tensor([6.0, 5.0, 5.0]) + torch.tensor([0, 0, 2.0])
    viewmats = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    turn = Rotation.from_rotvec([0.1, 0.33, 0.066])
    viewmats[1, :3, :3] = torch.from_numpy(turn.as_matrix())
    viewmats[1, :3, 3] = torch.tensor([0.1, -0.2, 0.4])
    Ks = torch.tensor(
        [[[40.0, 0, 18], [0, 38.0, 15], [0, 0, 1]], [[33.0, 0, 20], [0, 35.0, 13], [0, 0, 1]]],
        dtype=torch.float64,
    )
    prefix = (2, count) if per_camera else (count,)
    colors = uniform(*prefix, 3)
    if sh_degree is not None:
        colors = uniform(*prefix, 16, 3) - 0.5
    return Scene(
        means=means.double(),
        quats=torch.randn(count, 4, generator=generator, dtype=torch.float64),
        scales=0.02 + 0.4 * uniform(count, 3),
        opacities=uniform(count).clamp(0.001, 1.0).index_fill(0, torch.arange(5), 1.0),
        colors=colors,
        viewmats=viewmats,
        Ks=Ks,
        backgrounds=uniform(2, 3),
    )


def composite(
    means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, depths: Tensor
) -> tuple[Tensor, Tensor]:
    """One image of gsplat's `RasterizeToPixels3DGSFwd.cu`, Gaussian after Gaussian.

    Returns [H, W, D] without background and alpha [H, W, 1].
    """
    y, x = torch.meshgrid(
        torch.arange(HEIGHT, dtype=torch.float64) + 0.5,
        torch.arange(WIDTH, dtype=torch.float64) + 0.5,
        indexing="ij",
    )
    image = torch.zeros(HEIGHT, WIDTH, colors.shape[-1], dtype=torch.float64)
    transmittance = torch.ones(HEIGHT, WIDTH, dtype=torch.float64)
    done = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    for i in torch.argsort(depths, stable=True).tolist():
        dx, dy = means2d[i, 0] - x, means2d[i, 1] - y
        a, b, c = conics[i]
        sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
        alpha = (opacities[i] * torch.exp(-sigma)).clamp_max(0.999)
        drawn = (sigma >= 0) & (alpha >= 1 / 255) & ~done
        after = transmittance * (1 - alpha)
        done = done | (drawn & (after <= 1e-4))
        drawn = drawn & ~done
        image = image + torch.where(drawn, alpha * transmittance, 0.0)[..., None] * colors[i]
        transmittance = torch.where(drawn, after, transmittance)
    return image, (1 - transmittance)[..., None]


def reference(
    scene: Scene, mode: RenderMode, *, sh_degree: int | None, antialiased: bool = False
) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """gsplat's own torch code up to the image plane, and the loop above from there on."""
    covars, _ = _torch_impl._quat_scale_to_covar_preci(scene.quats, scene.scales, True, False)
    radii, means2d, depths, conics, compensations = _torch_impl._fully_fused_projection(
        scene.means,
        covars,
        scene.viewmats,
        scene.Ks,
        WIDTH,
        HEIGHT,
        calc_compensations=antialiased,
    )
    cameras = len(scene.viewmats)
    opacities = scene.opacities.expand(cameras, -1)
    if antialiased:
        opacities = opacities * compensations
    colors = scene.colors
    if colors.ndim == (2 if sh_degree is None else 3):
        colors = colors.expand(cameras, *colors.shape)
    if sh_degree is not None:
        centres = torch.inverse(scene.viewmats)[:, None, :3, 3]
        directions = scene.means - centres
        colors = _torch_impl._spherical_harmonics(sh_degree, directions, colors) + 0.5
        colors = colors.clamp_min(0)
    images, alphas = [], []
    for i in range(cameras):
        chosen = (radii[i] > 0).all(-1)
        values = torch.cat([colors[i], depths[i][:, None]], dim=-1)[chosen]
        flat = (means2d[i][chosen], conics[i][chosen], opacities[i][chosen])
        image, alpha = composite(*flat, values, depths[i][chosen])
        color, depth = image[..., :-1] + (1 - alpha) * scene.backgrounds[i], image[..., -1:]
        if "ED" in mode:
            depth = depth / alpha.clamp(min=1e-10)
        parts = [color] * ("RGB" in mode) + [depth] * ("D" in mode)
        images.append(torch.cat(parts, dim=-1))
        alphas.append(alpha)
    projected = {"radii": radii, "means2d": means2d, "depths": depths, "conics": conics}
    return torch.stack(images), torch.stack(alphas), projected | {"opacities": opacities}


def gradients(scene: Scene, colors: Tensor, alphas: Tensor) -> list[Tensor]:
    """Gradients of one scalar of all channels in the five parameters and the backgrounds."""
    generator = torch.Generator().manual_seed(1)
    weights = [
        torch.rand(x.shape, generator=generator, dtype=torch.float64) for x in (colors, alphas)
    ]
    total = (colors * weights[0].to(colors)).sum() + (alphas * weights[1].to(alphas)).sum()
    inputs = [getattr(scene, name) for name in (*PARAMETERS, "backgrounds")]
    found = torch.autograd.grad(total, inputs, allow_unused=True)
    return [torch.zeros_like(x) if g is None else g for x, g in zip(inputs, found, strict=True)]


def tracked(scene: Scene) -> Scene:
    names = (*PARAMETERS, "backgrounds")
    return scene._replace(**{n: getattr(scene, n).detach().requires_grad_() for n in names})


@cache
def expected_of(
    dtype: torch.dtype, mode: RenderMode, antialiased: bool, sh_degree: int | None, per_camera: bool
) -> tuple[Tensor, Tensor, list[Tensor]]:
    """Image, alpha and gradients of `reference` of the scene in numbers of a type, in float64."""
    made = scene(per_camera=per_camera, sh_degree=None if sh_degree is None else 3)
    theirs = tracked(made.to(dtype).to(torch.float64))
    image, alpha, _ = reference(theirs, mode, sh_degree=sh_degree, antialiased=antialiased)
    return image.detach(), alpha.detach(), gradients(theirs, image, alpha)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mode", "antialiased", "sh_degree", "per_camera"),
    [
        *((mode, mode in ("RGB", "RGB+ED"), None, False) for mode in MODES),
        *(("RGB", False, 0, False), ("RGB+ED", False, 2, True), ("RGB+D", True, 3, False)),
    ],
)
def test_images_alphas_and_gradients_are_gsplats(
    backend: str, mode: RenderMode, antialiased: bool, sh_degree: int | None, per_camera: bool
) -> None:
    made = scene(per_camera=per_camera, sh_degree=None if sh_degree is None else 3)
    dtype = torch.float32 if backend == "native" else torch.float64
    ours = tracked(made.to(dtype))
    colors, alphas, _ = rasterization(
        **ours.arguments(),
        sh_degree=sh_degree,
        render_mode=mode,
        rasterize_mode="antialiased" if antialiased else "classic",
        backend=backend,
    )
    *expected, true_gradients = expected_of(dtype, mode, antialiased, sh_degree, per_camera)
    relative, absolute = (2e-5, 2e-5) if backend == "native" else (0, 1e-10)
    for mine, true in zip((colors, alphas), expected, strict=True):
        torch.testing.assert_close(mine, true.to(mine.dtype), rtol=relative, atol=absolute)
    for mine, true in zip(gradients(ours, colors, alphas), true_gradients, strict=True):
        if backend == "native":
            assert (mine - true).norm() <= 1e-4 * true.norm()
        else:
            torch.testing.assert_close(mine, true, rtol=1e-7, atol=1e-8)


def test_the_projections_in_meta_are_gsplats() -> None:
    made = scene()
    _, _, meta = rasterization(
        **made.arguments(), packed=False, rasterize_mode="antialiased", radius_clip=2.0
    )
    _, _, expected = reference(made, "RGB", sh_degree=None, antialiased=True)
    # gsplat's torch code leaves the opacity out of the radii; its kernels, as of
    # `ProjectionEWA3DGSFused.cu`, do not.
    reach = (2 * torch.log(expected["opacities"] * 255)).clamp_min(0).sqrt().clamp_max(3.33)
    xx, xy, yy = expected["conics"].unbind(-1)
    variances = torch.stack([yy, xx], dim=-1) / (xx * yy - xy * xy)[..., None]
    radii = (reach[..., None] * variances.sqrt()).ceil()
    size = torch.tensor([WIDTH, HEIGHT])
    means2d = expected["means2d"]
    drawn = ((means2d + radii > 0) & (means2d - radii < size)).all(-1)
    drawn &= (expected["depths"] > 0.01) & (radii > 2).any(-1)
    assert 10 < drawn.sum() < drawn.numel() - 10
    assert torch.equal(meta["radii"], torch.where(drawn[..., None], radii, 0).int())
    for name in ("means2d", "depths", "conics", "opacities"):
        torch.testing.assert_close(meta[name][drawn], expected[name][drawn])
    assert (meta["width"], meta["height"], meta["n_cameras"]) == (WIDTH, HEIGHT, 2)


def test_packed_meta_lists_the_drawn_gaussians_camera_by_camera() -> None:
    arguments = scene().arguments()
    dense, packed = (rasterization(**arguments, packed=p)[2] for p in (False, True))
    cameras, gaussians = torch.nonzero((dense["radii"] > 0).all(-1), as_tuple=True)
    assert torch.equal(packed["camera_ids"], cameras)
    assert torch.equal(packed["gaussian_ids"], gaussians)
    assert dense["gaussian_ids"] is None
    for name in ("radii", "means2d", "depths", "conics", "opacities"):
        assert torch.equal(packed[name], dense[name][cameras, gaussians])


@pytest.mark.parametrize("packed", [False, True])
def test_means2d_has_the_image_plane_gradient(packed: bool) -> None:
    made = scene()
    _, _, projected = reference(made, "RGB", sh_degree=None)
    ours = tracked(made)
    colors, _, meta = rasterization(**ours.arguments(), packed=packed)
    meta["means2d"].retain_grad()
    torch.autograd.backward(colors.square().sum())
    found = meta["means2d"].grad
    if packed:
        dense = torch.zeros_like(projected["means2d"])
        dense[meta["camera_ids"], meta["gaussian_ids"]] = found
        found = dense

    flat = projected["means2d"].detach().requires_grad_()
    total = torch.zeros((), dtype=torch.float64)
    for i in range(2):
        chosen = (projected["radii"][i] > 0).all(-1)
        conics, opacities, depths = (
            projected[name][i][chosen].detach() for name in ("conics", "opacities", "depths")
        )
        image, alpha = composite(flat[i][chosen], conics, opacities, made.colors[chosen], depths)
        total = total + (image + (1 - alpha) * made.backgrounds[i]).square().sum()
    (expected,) = torch.autograd.grad(total, flat)
    torch.testing.assert_close(found, expected, rtol=1e-7, atol=1e-9)


def test_absgrad_is_no_less_than_the_gradient() -> None:
    meta = {}
    for absgrad in (False, True):
        ours = tracked(scene())
        colors, _, meta[absgrad] = rasterization(**ours.arguments(), packed=False, absgrad=absgrad)
        torch.autograd.backward(colors.square().sum())
    plain, absolute = meta[False]["means2d"].grad, meta[True]["means2d"].absgrad
    assert meta[True]["means2d"].grad is None
    assert (absolute >= plain.abs() - 1e-12).all()
    assert (absolute > plain.abs() + 1e-6).any()
    with pytest.raises(NotImplementedError, match="absgrad"):
        rasterization(**scene().arguments(), absgrad=True, render_mode="RGB+D")


def test_far_plane_hides_what_lies_behind_it() -> None:
    made = scene()
    near = made.means[:, 2] < 2.0
    arguments = made.arguments() | {"viewmats": made.viewmats[:1], "Ks": made.Ks[:1]}
    arguments["backgrounds"] = None
    chosen = {name: arguments[name][near] for name in PARAMETERS}
    found, _, _ = rasterization(**arguments, far_plane=2.0, render_mode="RGB+D")
    expected, _, _ = rasterization(**(arguments | chosen), render_mode="RGB+D")
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize(("dtype", "size"), [(torch.float32, 1e-6), (torch.float64, 1e6)])
def test_features_of_any_sign_size_and_number_are_composited(
    size: float, dtype: torch.dtype
) -> None:
    """Five channels are two passes; the rasterizer itself cuts colors off at 0."""
    made = scene().to(dtype)
    features = (torch.linspace(-1, 1, 80 * 5, dtype=dtype).reshape(80, 5).sin()) * size
    arguments = made.arguments() | {"colors": features, "backgrounds": None}
    found, _, _ = rasterization(**arguments)
    wide = made.to(torch.float64)._replace(
        colors=features.double(), backgrounds=torch.zeros(2, 5, dtype=torch.float64)
    )
    expected, _, _ = reference(wide, "RGB", sh_degree=None)
    error = (found - expected).abs().max() / size
    assert error < (2e-5 if dtype == torch.float32 else 1e-12)


def test_gsplats_default_strategy_runs_on_it() -> None:
    """A few steps with gsplat's own densification, in which Gaussians are grown and pruned."""
    made = scene(60).to(torch.float32)
    target, _, _ = rasterization(**made.arguments())
    generator = torch.Generator().manual_seed(2)
    moved = made.means + 0.2 * torch.randn(made.means.shape, generator=generator)
    params = {
        "means": moved,
        "quats": made.quats,
        "scales": made.scales.log(),
        "opacities": torch.logit(made.opacities.clamp(0.01, 0.95)),
        "colors": made.colors,
    }
    params = {name: torch.nn.Parameter(value.clone()) for name, value in params.items()}
    optimizers = {name: torch.optim.Adam([p], lr=5e-3) for name, p in params.items()}
    strategy = gsplat.DefaultStrategy(
        refine_start_iter=2, refine_every=4, reset_every=1000, grow_grad2d=1e-3, prune_opa=0.02
    )
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state(scene_scale=1.0)
    losses, counts = [], []
    for step in range(12):
        colors, _, info = rasterization(
            params["means"],
            params["quats"],
            params["scales"].exp(),
            params["opacities"].sigmoid(),
            params["colors"],
            made.viewmats,
            made.Ks,
            WIDTH,
            HEIGHT,
            backgrounds=made.backgrounds,
            packed=False,
        )
        strategy.step_pre_backward(params, optimizers, state, step, info)
        loss = (colors - target).square().mean()
        torch.autograd.backward(loss)
        if step == 0:
            seen = (info["radii"] > 0).all(-1)
            size = torch.tensor([WIDTH, HEIGHT]) / 2 * 2  # half the image, times two cameras
            norms = (info["means2d"].grad * size).norm(dim=-1)
            expected = torch.where(seen, norms, 0).sum(0), seen.sum(0)
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad()
        strategy.step_post_backward(params, optimizers, state, step, info, packed=False)
        if step == 0:
            torch.testing.assert_close(state["grad2d"], expected[0])
            torch.testing.assert_close(state["count"], expected[1].float())
        losses.append(loss.item())
        counts.append(len(params["means"]))
    assert losses[4] < 0.95 * losses[0]  # before the strategy changes any Gaussian
    assert counts[:4] == [60] * 4
    assert len({*counts}) >= 3, "Gaussians are grown and pruned at steps 4 and 8"


def test_black_gaussians_have_gradients() -> None:
    """At the value where the rasterizer clamps."""
    made = scene()
    ours = tracked(made._replace(colors=torch.zeros_like(made.colors)))
    colors, _, meta = rasterization(**ours.arguments(), packed=False)
    torch.autograd.backward(colors.sum())
    drawn = (meta["radii"] > 0).all(-1).any(0)
    assert ours.colors.grad is not None
    assert (ours.colors.grad[drawn] > 0).any(-1).sum() > 10


def arguments(**changes: Any) -> dict[str, Any]:
    """Arguments of 80 Gaussians and two cameras in float32, some of them changed."""
    return scene().to(torch.float32).arguments() | changes


def test_the_signature_is_gsplats() -> None:
    ours = inspect.signature(rasterization).parameters
    theirs = inspect.signature(gsplat.rasterization).parameters
    assert list(ours) == [*theirs, "backend"]
    for name, parameter in theirs.items():
        if name != "rolling_shutter":
            assert ours[name].default == parameter.default, name


UNSERVED: dict[str, Any] = {
    "sparse_grad": True,
    "distributed": True,
    "camera_model": "fisheye",
    "covars": torch.eye(3).repeat(80, 1, 1),
    "with_ut": True,
    "with_eval3d": True,
    "radial_coeffs": torch.zeros(2, 6),
    "tangential_coeffs": torch.zeros(2, 2),
    "thin_prism_coeffs": torch.zeros(2, 4),
    "ftheta_coeffs": object(),
    "rolling_shutter": 1,
    "viewmats_rs": torch.eye(4),
}


@pytest.mark.parametrize("name", UNSERVED)
def test_what_is_not_served_is_refused_by_name(name: str) -> None:
    with pytest.raises(NotImplementedError, match=f"^{name}: "):
        rasterization(**arguments(**{name: UNSERVED[name]}))


def test_gradients_of_cameras_are_refused() -> None:
    for name in ("viewmats", "Ks"):
        wrong = arguments(**{name: arguments()[name].requires_grad_()})
        with pytest.raises(NotImplementedError, match=rf"^{name}: .*{name}\.detach"):
            rasterization(**wrong)
        with torch.no_grad():
            rasterization(**wrong)


TENSORS = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "backgrounds")


@pytest.mark.parametrize("name", TENSORS)
def test_a_tensor_of_a_wrong_type_is_named(name: str) -> None:
    given = arguments()[name]
    for wrong, message in (
        (given.numpy(), f"^{name} must be a torch.Tensor, got ndarray$"),
        (given.half(), f"^{name} must be float32 or float64, got torch.float16"),
        (given.long(), f"^{name} must be float32 or float64, got torch.int64"),
    ):
        with pytest.raises((TypeError, ValueError), match=message):
            rasterization(**arguments(**{name: wrong}))
    if name in {"quats", "scales", "opacities", "colors", "backgrounds"}:
        message = f"^{name} must be of the type of means, torch.float32"
        with pytest.raises(ValueError, match=message):
            rasterization(**arguments(**{name: given.double()}))


@pytest.mark.parametrize(("name", "value"), [("width", 2.0), ("height", "2"), ("sh_degree", 2.0)])
def test_what_is_no_whole_number_is_named(name: str, value: object) -> None:
    with pytest.raises(TypeError, match=f"^{name} must be a whole number, got {value!r}"):
        rasterization(**arguments(**{name: value}))


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        *((name, torch.nan, f"{name} has values that are not finite") for name in TENSORS[:5]),
        ("opacities", 1.5, "opacities has values outside 0..1; are these logits"),
        ("opacities", -0.1, "opacities has values outside 0..1"),
        ("scales", -1.0, "scales has values below 0"),
    ],
)
def test_one_wrong_value_is_named_even_of_what_is_not_drawn(
    name: str, value: float, message: str
) -> None:
    wrong = arguments()
    wrong["means"][-1, 2] = -5.0  # behind the cameras
    wrong[name].view(80, -1)[-1] = value
    with pytest.raises(ValueError, match=message):
        rasterization(**wrong)


@pytest.mark.parametrize(("backend", "packed"), [("native", True), ("torch", False)])
def test_no_gaussians_give_the_background(backend: str, packed: bool) -> None:
    empty = {name: arguments()[name][:0] for name in TENSORS[:5]}
    background = torch.tensor([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    image, alpha, meta = rasterization(
        **arguments(**empty, backgrounds=background),
        packed=packed,
        render_mode="RGB+ED",
        backend=backend,
    )
    assert torch.equal(image[..., :3], background[:, None, None].expand(2, HEIGHT, WIDTH, 3))
    assert not image[..., 3:].any()
    assert not alpha.any()
    assert meta["radii"].numel() == 0


@pytest.mark.parametrize(("backend", "dtype"), [("native", "bfloat16"), ("torch", "float16")])
def test_autocast_changes_nothing(backend: str, dtype: str) -> None:
    """Autocast rounds matrix products to 8 or 11 bits; gsplat's kernels compute in float32."""
    given = arguments(backend=backend, render_mode="RGB+ED")
    trained = given["means"].requires_grad_()
    wanted = rasterization(**given)
    with torch.autocast("cpu", dtype=getattr(torch, dtype)):
        assert (trained.detach() @ torch.eye(3)).dtype is getattr(torch, dtype)
        got = rasterization(**given)
    # The backward pass belongs outside, by torch's documentation.
    gradients = [torch.autograd.grad(image.sum(), trained)[0] for image, _, _ in (got, wanted)]
    values = [[image, alpha, meta["means2d"]] for image, alpha, meta in (got, wanted)]
    for value, usual in [*zip(*values, strict=True), gradients]:
        assert usual.std() > 0.01
        assert torch.equal(value, usual)


@pytest.mark.parametrize(("backend", "sh_degree"), [("native", 1), ("torch", None)])
def test_tensors_that_are_not_contiguous(backend: str, sh_degree: int | None) -> None:
    usual = arguments(sh_degree=sh_degree, backend=backend)
    if sh_degree:
        usual["colors"] = torch.rand(80, 4, 3, generator=torch.Generator().manual_seed(1))
    strided = dict(usual)
    for name in TENSORS:
        wide = torch.stack([usual[name], torch.full_like(usual[name], torch.nan)], dim=-1)
        strided[name] = wide[..., 0]
        assert not strided[name].is_contiguous()
    for got, wanted in zip(rasterization(**strided)[:2], rasterization(**usual)[:2], strict=True):
        assert wanted.std() > 0.01
        assert torch.equal(got, wanted)


@pytest.mark.parametrize("size", [1e8, 1e15])
@pytest.mark.parametrize("backend", ["native", "torch"])
def test_a_gaussian_far_larger_than_the_image_covers_it(backend: str, size: float) -> None:
    """Its alpha is its opacity everywhere; int32 holds radii of 2e9 px, and float32 overflows."""
    viewmats, Ks = torch.eye(4)[None], torch.diag(torch.tensor([60.0, 60, 1]))[None]
    _, alpha, meta = rasterization(
        torch.tensor([[0.0, 0, 4]]), torch.tensor([[1.0, 0, 0, 0]]),
        torch.tensor([[size, size, 1]]), torch.tensor([0.5]), torch.ones(1, 3),
        viewmats, Ks, 32, 24, backend=backend,
    )  # fmt: skip
    torch.testing.assert_close(alpha, torch.full((1, 24, 32, 1), 0.5))
    assert (meta["radii"] > 1e6).all()
    assert meta["conics"].dtype == torch.float32


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"render_mode": "N"}, "render_mode must be one of RGB, D, ED, RGB"),
        ({"colors": torch.zeros(7, 3)}, r"colors must be \[N, D\].*N = 80, C = 2, got \[7, 3\]"),
        ({"sh_degree": 4}, "sh_degree must be 0 to 3, or None, got 4"),
        ({"backgrounds": torch.zeros(3)}, r"backgrounds must be \[2, 3\], got \[3\]"),
        ({"means": torch.zeros(1, 80, 3)}, r"means must be \[N, 3\], .* got \[1, 80, 3\]"),
        ({"quats": torch.zeros(80, 3)}, r"quats must be \[80, 4\], got \[80, 3\]"),
        ({"Ks": torch.eye(4).repeat(2, 1, 1)}, r"Ks, camera 0: K must be \[3, 3\]"),
        ({"viewmats": torch.eye(4)}, r"viewmats must be \[C, 4, 4\]"),
        ({"width": 0}, "width and height must be at least 1"),
        ({"opacities": torch.zeros(80, 1)}, "opacities"),
        ({"backgrounds": torch.full((2, 3), torch.inf)}, "backgrounds has values that are not"),
        ({"far_plane": 1.0, "near_plane": 2.0}, "far_plane must be above near_plane"),
        ({"scales": torch.full((80, 3), 1e19)}, "scales: a Gaussian is larger than"),
        ({"means": torch.zeros(80, 3, device="meta")}, "means is on meta: xrgs renders on the CPU"),
    ],
)
def test_wrong_values_are_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        rasterization(**arguments(**changes))
