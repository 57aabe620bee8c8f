"""gsplat's `rasterization` on the CPU: the signature and the results of gsplat 1.5.3.

To run code that calls `gsplat.rasterization` on a GPU, import the function from this module
instead. Unsupported arguments raise an error that names them.
"""

from __future__ import annotations

import operator
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor
from torch.nn.functional import pad

import xrgs
from xrgs.splat.cameras import Camera
from xrgs.splat.rendering import backend_for, rasterize_parameters
from xrgs.splat.settings import RasterSettings
from xrgs.splat.sh import C0, MAX_DEGREE, bases
from xrgs.splat.torch.projection import depths as camera_depths
from xrgs.splat.torch.projection import project
from xrgs.splat.torch_defaults import on_cpu_in_float32

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]
RasterizeMode = Literal["classic", "antialiased"]

#: Constants of gsplat 1.5.3's kernels (`RasterizeToPixels3DGSFwd.cu`, `ProjectionEWA3DGSFused.cu`).
ALPHA_MIN, ALPHA_MAX, TRANSMITTANCE_MIN = 1.0 / 255.0, 0.999, 1e-4
MAX_RADIUS_SIGMAS = 3.33
MAX_RADIUS = 2.0**31 - 128
"""Largest radius in `meta`, px: the largest int32 that float32 can represent."""
MIN_DEPTH_ALPHA = 1e-10
"""Lower limit of the alpha in the denominator of the expected depth."""


class _Shapes(NamedTuple):
    """The parameters of shape, position and opacity."""

    means: Tensor  # [N, 3]
    quats: Tensor  # [N, 4]
    scales: Tensor  # [N, 3]
    opacities: Tensor  # [N]


class _Projections(NamedTuple):
    """All Gaussians on the image planes of C cameras; zeros for Gaussians that are not drawn."""

    radii: Tensor  # [C, N, 2] int32, px
    means2d: Tensor  # [C, N, 2] px
    depths: Tensor  # [C, N] world units
    conics: Tensor  # [C, N, 3] xx, xy, yy of the inverse covariance, 1 / px^2
    opacities: Tensor  # [C, N], compensated if antialiased


@on_cpu_in_float32
def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,
    render_mode: RenderMode = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: RasterizeMode = "classic",
    channel_chunk: int = 32,  # noqa: ARG001 - changes only gsplat's speed
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,  # noqa: ARG001 - changes only gsplat's speed
    covars: Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: object = None,
    rolling_shutter: object = None,
    viewmats_rs: Tensor | None = None,
    *,
    backend: str = "auto",
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render Gaussians into C cameras as `gsplat.rasterization` of gsplat 1.5.3 does.

    The results are differentiable in means, quats, scales, opacities, colors and backgrounds.
    Each camera is rendered separately, three channels at a time: RGB+D and RGB+ED take two passes
    for each camera, D channels take D / 3 passes, rounded up.

    Args:
        means: [N, 3] world units.
        quats: [N, 4] wxyz, any length.
        scales: [N, 3] world units (not logarithms).
        opacities: [N] in 0..1 (not logits).
        colors: With `sh_degree`, coefficients of spherical harmonics [N, K, 3] or [C, N, K, 3];
            without `sh_degree`, colours or other features after activation, [N, D] or [C, N, D].
        viewmats: [C, 4, 4] world to camera, rigid; without gradients.
        Ks: [C, 3, 3] intrinsics in px, without skew; without gradients.
        width: Width of the images, px.
        height: Height of the images, px.
        near_plane: Gaussians nearer than this are not drawn, world units along z.
        far_plane: Gaussians farther than this are not drawn, world units along z.
        radius_clip: Gaussians with radii of this or less are not drawn, px.
        eps2d: Variance added to each projected covariance, px^2.
        sh_degree: Highest evaluated band of the spherical harmonics, 0 to 3; None if `colors` are
            not harmonics.
        packed: Whether `meta` holds one entry for each drawn Gaussian, or all [C, N].
        tile_size: Only returned in `meta`: it does not change the image.
        backgrounds: [C, D] colour behind the last Gaussian; None is black. Depth ignores it.
        render_mode: `RGB` colours, `D` the accumulated z-depth, `ED` the expected z-depth (`D` over
            alpha), or colours with either as the last channel.
        sparse_grad: Not supported.
        absgrad: In the backward pass, store the sums of absolute image-plane gradients in
            `meta["means2d"].absgrad`; `meta["means2d"].grad` then stays None. Supported only for up
            to three channels (one pass for each camera).
        rasterize_mode: `antialiased` compensates opacities for `eps2d`, as Mip-Splatting does.
        channel_chunk: Ignored.
        distributed: Not supported.
        camera_model: Only `pinhole` is supported.
        segmented: Ignored.
        covars: Not supported; use quats and scales.
        with_ut: Not supported.
        with_eval3d: Not supported.
        radial_coeffs: Not supported.
        tangential_coeffs: Not supported.
        thin_prism_coeffs: Not supported.
        ftheta_coeffs: Not supported.
        rolling_shutter: None, or gsplat's `RollingShutterType.GLOBAL`.
        viewmats_rs: Not supported.
        backend: `native`, `torch`, or `auto`: native for float32 if the extension was built, else
            torch. gsplat has no such argument.

    Returns:
        Colours [C, H, W, X] for the X channels of the render mode, alpha [C, H, W, 1], and `meta`.
        `meta` has `radii` (int32, px; 0 if not drawn), `means2d` (px), `depths`, `conics` and
        `opacities`, with `camera_ids`, `gaussian_ids` and `batch_ids` if packed (else None), and
        `width`, `height`, `tile_size`, `n_cameras`, `n_batches`. It lacks the intersections with
        tiles (`isect_ids`, `isect_offsets`, `flatten_ids`, `tiles_per_gauss`).

        `meta["means2d"]` is a leaf: after the backward pass its `.grad` is the image-plane gradient
        for gsplat's `DefaultStrategy`, so the strategy works with this function. Gradients do not
        flow from `meta` to the Gaussians: a loss on `meta` is not supported.

    Raises:
        NotImplementedError: An argument has an unsupported value; the message names the argument.
        TypeError: An argument is not a tensor (a numpy array or None, for example), or `width`,
            `height` or `sh_degree` is not a whole number. The message names the argument.
        ValueError: A tensor has a wrong shape, is not float32 or float64, or has values that are
            not finite; opacities are outside 0..1; a camera is not rigid or has skew. The message
            names the argument.

    Examples:
        >>> means, quats = torch.rand(50, 3) + torch.tensor([0.0, 0.0, 2.0]), torch.rand(50, 4)
        >>> scales, opacities, colors = torch.full((50, 3), 0.1), torch.rand(50), torch.rand(50, 3)
        >>> image, alpha, meta = rasterization(
        ...     means, quats, scales, opacities, colors,
        ...     viewmats=camera.viewmat[None], Ks=camera.K[None], width=48, height=32,
        ... )
        >>> image.shape, alpha.shape
        (torch.Size([1, 32, 48, 3]), torch.Size([1, 32, 48, 1]))
    """
    xrgs.warn_of_spinning()
    _refuse(
        sparse_grad=sparse_grad,
        distributed=distributed,
        camera_model=camera_model != "pinhole",
        covars=covars is not None,
        with_ut=with_ut,
        with_eval3d=with_eval3d,
        radial_coeffs=radial_coeffs is not None,
        tangential_coeffs=tangential_coeffs is not None,
        thin_prism_coeffs=thin_prism_coeffs is not None,
        ftheta_coeffs=ftheta_coeffs is not None,
        rolling_shutter=getattr(rolling_shutter, "name", rolling_shutter) not in {None, "GLOBAL"},
        viewmats_rs=viewmats_rs is not None,
    )
    _check_choice("render_mode", render_mode, get_args(RenderMode))
    _check_choice("rasterize_mode", rasterize_mode, get_args(RasterizeMode))
    shapes = _Shapes(means, quats, scales, opacities)
    _check_tensors({**shapes._asdict(), "colors": colors, "viewmats": viewmats, "Ks": Ks})
    if backgrounds is not None:
        _check_tensors({"means": means, "backgrounds": backgrounds})
    width, height = _whole("width", width), _whole("height", height)
    sh_degree = None if sh_degree is None else _whole("sh_degree", sh_degree)
    backend = backend_for(means, backend)
    cameras = _cameras(viewmats, Ks, width, height)
    _check_shapes(shapes, colors, len(cameras), sh_degree, backgrounds)
    _check_values(shapes, colors, backgrounds)
    if not (near_plane < far_plane and eps2d >= 0):
        raise ValueError(
            "far_plane must be above near_plane, and eps2d at least 0, got "
            f"far_plane={far_plane}, near_plane={near_plane}, eps2d={eps2d}"
        )
    settings = RasterSettings(
        near=near_plane,
        eps2d=eps2d,
        alpha_min=ALPHA_MIN,
        alpha_max=ALPHA_MAX,
        transmittance_min=TRANSMITTANCE_MIN,
        antialiased=rasterize_mode == "antialiased",
        absgrad=absgrad,
    )
    projections = _project(shapes, cameras, settings, far_plane, radius_clip)
    requires_grad = any(value.requires_grad for value in (*shapes, colors))
    meta, offsets = _meta(projections, packed, requires_grad, absgrad)
    meta |= {"width": width, "height": height, "tile_size": tile_size}
    renderer = _Renderer(shapes, settings, render_mode, sh_degree, backend)
    per_camera = colors.ndim == (3 if sh_degree is None else 4)
    images, alphas = [], []
    for index, camera in enumerate(cameras):
        image, alpha = renderer.render(
            camera,
            colors[index] if per_camera else colors,
            offsets[index],
            (projections.radii[index] > 0).all(dim=-1),
            None if backgrounds is None else backgrounds[index],
        )
        images.append(image)
        alphas.append(alpha)
    return torch.stack(images), torch.stack(alphas), meta


def _refuse(**given: bool) -> None:
    for name, is_given in given.items():
        if is_given:
            raise NotImplementedError(
                f"{name}: rasterization supports only its default; leave it out"
            )


def _check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(choices)}, got {value!r}")


def _check_tensors(values: dict[str, Tensor]) -> None:
    """Check that values are float tensors on the CPU, and Gaussians' values of the means' dtype."""
    for name, value in values.items():
        if not isinstance(value, torch.Tensor):
            got = "None" if value is None else type(value).__name__
            raise TypeError(f"{name} must be a torch.Tensor, got {got}")
        if value.device.type != "cpu":
            raise ValueError(
                f"{name} is on {value.device}: xrgs renders on the CPU, use {name}.cpu()"
            )
        if value.dtype not in {torch.float32, torch.float64}:
            raise ValueError(
                f"{name} must be float32 or float64, got {value.dtype}; use {name}.float()"
            )
        of_camera = name in {"viewmats", "Ks"}
        if not of_camera and value.dtype != values["means"].dtype:
            raise ValueError(
                f"{name} must be of the type of means, {values['means'].dtype}, got {value.dtype}"
            )


def _whole(name: str, value: int) -> int:
    try:
        return operator.index(value)
    except TypeError:
        raise TypeError(f"{name} must be a whole number, got {value!r}") from None


def _check_values(shapes: _Shapes, colors: Tensor, backgrounds: Tensor | None) -> None:
    """Check the values of all Gaussians; the rasterizer would check only those that are drawn."""
    named = {**shapes._asdict(), "colors": colors, "backgrounds": backgrounds}
    for name, value in named.items():
        if value is not None and not torch.isfinite(value).all():
            raise ValueError(f"{name} has values that are not finite")
    if (shapes.scales < 0).any():
        raise ValueError(
            "scales has values below 0; gsplat takes them as positive, use scales.abs()"
        )
    if ((shapes.opacities < 0) | (shapes.opacities > 1)).any():
        raise ValueError("opacities has values outside 0..1; are these logits? use .sigmoid()")


def _check_shapes(
    shapes: _Shapes, colors: Tensor, cameras: int, sh_degree: int | None, backgrounds: Tensor | None
) -> None:
    """Check the shapes of all tensors."""
    if shapes.means.ndim != 2:
        raise ValueError(
            f"means must be [N, 3], without a batch before it, got {list(shapes.means.shape)}"
        )
    count = len(shapes.means)
    for (name, value), tail in zip(shapes._asdict().items(), ((3,), (4,), (3,), ()), strict=True):
        if value.shape != (count, *tail):
            raise ValueError(f"{name} must be {[count, *tail]}, got {list(value.shape)}")
    if sh_degree is None:
        tail_ndim, expected = 1, "[N, D] or [C, N, D]"
        is_wide_enough = True
    else:
        if not 0 <= sh_degree <= MAX_DEGREE:
            raise ValueError(f"sh_degree must be 0 to {MAX_DEGREE}, or None, got {sh_degree}")
        tail_ndim, expected = 2, f"[N, K, 3] or [C, N, K, 3] with K of at least {bases(sh_degree)}"
        is_wide_enough = (
            colors.ndim > 2 and colors.shape[-1] == 3 and colors.shape[-2] >= bases(sh_degree)
        )
    prefix = colors.shape[: max(0, colors.ndim - tail_ndim)]
    if prefix not in {(count,), (cameras, count)} or not is_wide_enough:
        raise ValueError(
            f"colors must be {expected}, N = {count}, C = {cameras}, got {list(colors.shape)}"
        )
    channels = 3 if sh_degree is not None else int(colors.shape[-1])
    if backgrounds is not None and backgrounds.shape != (cameras, channels):
        raise ValueError(
            f"backgrounds must be [{cameras}, {channels}], got {list(backgrounds.shape)}"
        )


def _cameras(viewmats: Tensor, Ks: Tensor, width: int, height: int) -> list[Camera]:
    if viewmats.ndim != 3 or Ks.ndim != 3 or len(viewmats) != len(Ks) or len(Ks) == 0:
        raise ValueError(
            "viewmats must be [C, 4, 4] and Ks [C, 3, 3] with one C of at least 1, "
            f"got {list(viewmats.shape)} and {list(Ks.shape)}"
        )
    for name, matrices in (("viewmats", viewmats), ("Ks", Ks)):
        if matrices.requires_grad and torch.is_grad_enabled():
            raise NotImplementedError(
                f"{name}: rasterization gives no gradients of cameras; use {name}.detach()"
            )
    cameras = []
    for index, (viewmat, K) in enumerate(zip(viewmats.detach(), Ks.detach(), strict=True)):
        try:
            cameras.append(Camera(viewmat, K, width, height))
        except ValueError as error:
            raise ValueError(f"viewmats, Ks, camera {index}: {error}") from error
    return cameras


@torch.no_grad()
def _project(
    shapes: _Shapes,
    cameras: list[Camera],
    settings: RasterSettings,
    far_plane: float,
    radius_clip: float,
) -> _Projections:
    """Project every Gaussian into every camera, and compute its radii as gsplat's kernels do."""
    views = []
    for camera in cameras:
        z = camera_depths(shapes.means, camera)
        chosen = torch.nonzero((z > settings.near) & (z < far_plane))[:, 0]  # [M]
        means, quats, scales, opacities = (value[chosen] for value in shapes)
        flat = project(means, quats, scales, opacities, camera, settings)
        xx, xy, yy = flat.cov.unbind(-1)
        # A box around the ellipse of alpha >= alpha_min (StopThePop, section B.2).
        reach = (2 * torch.log(flat.opacities / settings.alpha_min)).clamp_min(0).sqrt()
        reach = reach.clamp_max(MAX_RADIUS_SIGMAS)[:, None]  # [M, 1] standard deviations
        radii = (reach * torch.stack([xx, yy], dim=-1).sqrt()).ceil()  # [M, 2]
        size = radii.new_tensor([camera.width, camera.height])
        inside = ((flat.means2d + radii > 0) & (flat.means2d - radii < size)).all(-1)
        usable = (flat.det > 0) & torch.isfinite(flat.det) & (flat.opacities >= settings.alpha_min)
        drawn = inside & usable & (radii > radius_clip).any(-1) & (radii > 0).all(-1)
        conics = (torch.stack([yy, -xy, xx], dim=-1) / flat.det[:, None]).to(flat.cov)
        values = (
            radii.clamp_max(MAX_RADIUS).int(),
            flat.means2d,
            flat.depths,
            conics,
            flat.opacities,
        )
        views.append([_scatter(value, chosen, drawn, len(z)) for value in values])
    return _Projections(*(torch.stack(column) for column in zip(*views, strict=True)))


def _scatter(values: Tensor, chosen: Tensor, drawn: Tensor, count: int) -> Tensor:
    """Scatter the values [M, ...] of drawn Gaussians into zeros [N, ...]."""
    placed = values.new_zeros((count, *values.shape[1:]))
    placed[chosen[drawn]] = values[drawn]
    return placed


def _meta(
    projections: _Projections, packed: bool, requires_grad: bool, absgrad: bool
) -> tuple[dict[str, Any], Tensor]:
    """Make gsplat's `meta`, and zero offsets [C, N, 2] whose gradients go to its `means2d`.

    The rasterizer adds the offsets to the projected means, so that the gradient of an offset is the
    gradient of a projected mean.
    """
    drawn = (projections.radii > 0).all(dim=-1)  # [C, N]
    camera_ids, gaussian_ids = torch.nonzero(drawn, as_tuple=True)
    values = projections._asdict()
    ids: dict[str, Tensor | None] = dict.fromkeys(("batch_ids", "camera_ids", "gaussian_ids"))
    if packed:
        values = {name: value[camera_ids, gaussian_ids] for name, value in values.items()}
        ids = {
            "batch_ids": torch.zeros_like(camera_ids),
            "camera_ids": camera_ids,
            "gaussian_ids": gaussian_ids,
        }
    means2d = values["means2d"].clone().requires_grad_(requires_grad and torch.is_grad_enabled())
    zeros: Tensor = (
        _AbsoluteGradient.apply(means2d) if absgrad else means2d - means2d.detach()
    )  # as means2d
    if packed:
        placed = torch.zeros_like(projections.means2d)
        zeros = placed.index_put((camera_ids, gaussian_ids), zeros)
    counts = {"n_cameras": len(drawn), "n_batches": 1}
    return {**ids, **values, "means2d": means2d, **counts}, zeros


class _AbsoluteGradient(torch.autograd.Function):
    """Return zeros of the shape of means2d, whose gradient is stored in `means2d.absgrad`."""

    @staticmethod
    def forward(ctx: Any, means2d: Tensor) -> Tensor:
        ctx.means2d = means2d
        return torch.zeros_like(means2d)

    @staticmethod
    def backward(ctx: Any, v_offsets: Tensor) -> None:
        ctx.means2d.absgrad = v_offsets


class _Renderer(NamedTuple):
    """Renders one camera after another; the fields are the arguments common to all cameras."""

    shapes: _Shapes
    settings: RasterSettings
    render_mode: RenderMode
    sh_degree: int | None
    backend: str

    def render(
        self,
        camera: Camera,
        colors: Tensor,
        offset: Tensor,
        drawn: Tensor,
        background: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        """Render the channels [H, W, X] and alpha [H, W, 1] of one camera.

        `colors` are coefficients [N, K, 3] or colours [N, D], `offset` zeros [N, 2] for the
        gradients of the projected means, and `drawn` [N] bool. `background` is the colour [D]
        behind the last Gaussian; None is black.
        """
        hidden = torch.where(drawn, self.shapes.opacities, 0.0)
        shapes = self.shapes._replace(opacities=hidden)
        features, layers = [], []
        if "RGB" in self.render_mode and self.sh_degree is not None:
            coefficients = colors[:, : bases(self.sh_degree)]
            layers.append(self._pass(shapes, coefficients, self.sh_degree, camera, offset))
        elif "RGB" in self.render_mode:
            features.append(colors)
        if "D" in self.render_mode:
            features.append(camera_depths(shapes.means, camera)[:, None])
        if features:
            values = torch.where(drawn[:, None], torch.cat(features, dim=1), 0.0)
            layers += self._features(shapes, values, camera, offset)
        if self.settings.absgrad and len(layers) > 1:
            raise NotImplementedError(
                f"absgrad: rasterization supports it for up to three channels, "
                f"not for this render_mode={self.render_mode!r} and colors"
            )
        image = torch.cat([layer for layer, _ in layers], dim=-1)
        alpha = layers[0][1]
        return self._finished(image, alpha, background), alpha

    def _pass(
        self, shapes: _Shapes, coefficients: Tensor, degree: int, camera: Camera, offset: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Render three channels, given as spherical harmonics, and alpha [H, W, 1]."""
        render = rasterize_parameters(
            *shapes,
            coefficients[:, :1],
            coefficients[:, 1:],
            camera,
            self.settings,
            sh_degree=degree,
            means2d_offset=offset,
            backend=self.backend,
        )
        return render.image, render.alpha[..., None]

    def _features(
        self, shapes: _Shapes, features: Tensor, camera: Camera, offset: Tensor
    ) -> list[tuple[Tensor, Tensor]]:
        """Render features [N, D] of any sign and size, three channels in each pass.

        The rasterizer draws max(C0 sh0 + 1/2, 0). So that no feature is clamped, features are
        scaled to -1..1 by a power of two, which is exact, and increased by a constant. Compositing
        is linear, so the constant times alpha is subtracted from the result.
        """
        layers = []
        for group in features.split(3, dim=1):
            values = pad(group, (0, 3 - group.shape[1]))  # [N, 3]
            largest = values.detach().abs().amax(dim=0) if len(values) else values.new_ones(3)
            scale = torch.ldexp(torch.ones_like(largest), torch.frexp(largest).exponent)
            values = values / scale
            negative = (values < 0).any(dim=0)
            raised = torch.where(negative, 1.5, 0.5).to(values)  # [3]
            coefficients = (values + (raised - 0.5)) / C0
            image, alpha = self._pass(shapes, coefficients[:, None], 0, camera, offset)
            image = (image - raised * alpha) * scale
            layers.append((image[..., : group.shape[1]], alpha))
        return layers

    def _finished(self, image: Tensor, alpha: Tensor, background: Tensor | None) -> Tensor:
        """Add the background to the colours, and divide an expected depth by alpha."""
        channels = image.shape[-1] - ("D" in self.render_mode)
        colors, depth = image[..., :channels], image[..., channels:]
        if background is not None:
            colors = colors + (1.0 - alpha) * background[:channels]
        if "ED" in self.render_mode:
            depth = depth / alpha.clamp_min(MIN_DEPTH_ALPHA)
        return torch.cat([colors, depth], dim=-1)
