"""The arguments of `gsplat_api.rasterization`: gsplat's signature, and what is refused by name."""

from __future__ import annotations

import inspect
from typing import Any

import gsplat
import pytest
import torch

from xrgs.formats.gsplat_api import rasterization


def arguments(**changes: Any) -> dict[str, Any]:
    """Arguments of 80 Gaussians and two cameras, some of them changed."""
    generator = torch.Generator().manual_seed(0)
    shapes = {"means": (80, 3), "quats": (80, 4), "scales": (80, 3), "opacities": (80,)}
    tensors = {name: torch.rand(shape, generator=generator) for name, shape in shapes.items()} | {
        "colors": torch.rand(80, 3, generator=generator)
    }
    Ks = torch.tensor([[40.0, 0, 18], [0, 38, 15], [0, 0, 1]]).repeat(2, 1, 1)
    views = {"viewmats": torch.eye(4).repeat(2, 1, 1), "Ks": Ks, "width": 37, "height": 29}
    return {**tensors, **views, "backgrounds": torch.zeros(2, 3), **changes}


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
    assert torch.equal(image[..., :3], background[:, None, None].expand(2, 29, 37, 3))
    assert not image[..., 3:].any()
    assert not alpha.any()
    assert meta["radii"].numel() == 0


@pytest.mark.parametrize(("backend", "dtype"), [("native", "bfloat16"), ("torch", "float16")])
def test_autocast_changes_nothing(backend: str, dtype: str) -> None:
    """Autocast rounds matrix products to 8 or 11 bits; gsplat's kernels compute in float32."""
    scene = arguments(backend=backend, render_mode="RGB+ED")
    scene["means"][:, 2] += 2
    trained = scene["means"].requires_grad_()

    wanted = rasterization(**scene)
    with torch.autocast("cpu", dtype=getattr(torch, dtype)):
        assert (trained.detach() @ torch.eye(3)).dtype is getattr(torch, dtype)
        got = rasterization(**scene)
    # The backward pass belongs outside, by torch's documentation.
    gradients = [torch.autograd.grad(image.sum(), trained)[0] for image, _, _ in (got, wanted)]
    values = [[image, alpha, meta["means2d"]] for image, alpha, meta in (got, wanted)]
    for value, usual in [*zip(*values, strict=True), gradients]:
        assert usual.std() > 0.01
        assert torch.equal(value, usual)


@pytest.mark.parametrize(("backend", "sh_degree"), [("native", 1), ("torch", None)])
def test_tensors_that_are_not_contiguous(backend: str, sh_degree: int | None) -> None:
    usual = arguments(sh_degree=sh_degree, backend=backend)
    usual["means"][:, 2] += 2
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
        ({"viewmats": 2 * torch.eye(4).repeat(2, 1, 1)}, "camera 0: viewmat must be a rotation"),
        ({"backgrounds": torch.full((2, 3), torch.inf)}, "backgrounds has values that are not"),
        ({"far_plane": 1.0, "near_plane": 2.0}, "far_plane must be above near_plane"),
        ({"Ks": torch.diag(torch.tensor([40.0, 40, 2])).repeat(2, 1, 1)}, "the last row of K"),
        (
            {"viewmats": torch.diag(torch.tensor([1.0, 1, 1, 2])).repeat(2, 1, 1)},
            "camera 0: the last row of viewmat must be",
        ),
        ({"scales": torch.full((80, 3), 1e19)}, "scales: a Gaussian is larger than"),
        ({"means": torch.zeros(80, 3, device="meta")}, "means is on meta: xrgs renders on the CPU"),
    ],
)
def test_wrong_values_are_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        rasterization(**arguments(**changes))
