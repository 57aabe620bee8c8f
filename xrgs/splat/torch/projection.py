"""Gaussians in space to ellipses on the image plane, and which of them are seen.

Elliptical weighted averaging as in gsplat 1.5's `_torch_impl.py`. The one difference is that the
determinant and the quadratic form are written so that nothing cancels in float32.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from xrgs.splat.cameras import Camera
from xrgs.splat.settings import RasterSettings

CLAMP_MARGIN = 0.3
"""Share of the half field of view that the Jacobian may look beyond the image (gsplat's 1.3)."""


class Projected(NamedTuple):
    """Gaussians in the image plane."""

    means2d: Tensor  # [M, 2] px
    cov: Tensor  # [M, 3] xx, xy, yy of the dilated covariance, px^2
    det: Tensor  # [M] of that covariance
    opacities: Tensor  # [M], compensated if antialiased
    depths: Tensor  # [M] world units


def depths(means: Tensor, camera: Camera) -> Tensor:
    """Distance of means [N, 3] along the camera's axis: [N], world units."""
    forward = camera.viewmat[2].to(means)
    return means @ forward[:3] + forward[3]


def project(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    camera: Camera,
    settings: RasterSettings,
) -> Projected:
    """Project Gaussians in front of the camera: EWA, the covariance through the local Jacobian.

    Args:
        means: [M, 3], all in front of the near plane.
        quats: [M, 4]
        scales: [M, 3]
        opacities: [M]
        camera: the view.
        settings: `eps2d` and `antialiased` are read.
    """
    viewmat, K = camera.viewmat.to(means), camera.K.to(means)
    x, y, z = (means @ viewmat[:3, :3].T + viewmat[:3, 3]).unbind(-1)  # [M] each
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], dim=-1)

    # Far outside the image the affine approximation blows up: hold its point at the border.
    slope_x = _clamp_slope(x / z, cx / fx, (camera.width - cx) / fx)
    slope_y = _clamp_slope(y / z, cy / fy, (camera.height - cy) / fy)
    axes = viewmat[:3, :3] @ (rotations(quats) * scales[:, None, :])  # [M, 3, 3] camera axes
    m1 = (fx / z)[:, None] * (axes[:, 0] - slope_x[:, None] * axes[:, 2])  # [M, 3]
    m2 = (fy / z)[:, None] * (axes[:, 1] - slope_y[:, None] * axes[:, 2])

    # det([m1; m2] [m1; m2]^T + eps I), expanded so that nothing cancels: ac - b^2 does in float32.
    eps = settings.eps2d
    xx, xy, yy = (m1 * m1).sum(-1), (m1 * m2).sum(-1), (m2 * m2).sum(-1)
    area = torch.linalg.vector_norm(torch.linalg.cross(m1, m2), dim=-1)  # sqrt(det), undilated
    det = area * area + eps * (xx + yy) + eps * eps
    if settings.antialiased:
        opacities = opacities * area / det.sqrt()
    cov = torch.stack([xx + eps, xy, yy + eps], dim=-1)
    return Projected(means2d, cov, det, opacities, z)


def _clamp_slope(slope: Tensor, before: Tensor, after: Tensor) -> Tensor:
    """Hold x/z within the image, whose borders are at -before and after, and a margin."""
    margin = CLAMP_MARGIN * 0.5 * (before + after)
    return torch.minimum(torch.maximum(slope, -before - margin), after + margin)


def rotations(quats: Tensor) -> Tensor:
    """Rotation matrices [M, 3, 3] of quaternions [M, 4] wxyz of any length; zero is the identity.

    The gradient of a zero quaternion is zero.
    """
    # Scaled by its largest part first, a tiny or huge quaternion has a norm. As the rotation does
    # not depend on the length, the scale needs no gradient.
    largest = quats.detach().abs().amax(dim=-1, keepdim=True)  # [M, 1]
    zero = largest < torch.finfo(quats.dtype).tiny ** 0.5
    identity = quats.new_tensor([1.0, 0.0, 0.0, 0.0])
    scaled = torch.where(zero, identity, quats / largest.masked_fill(zero, 1.0))
    w, x, y, z = normalize(scaled, dim=-1).unbind(-1)
    matrix = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(matrix, dim=-1).reshape(-1, 3, 3)


def squared_radius(opacities: Tensor, settings: RasterSettings) -> Tensor:
    """How far a Gaussian reaches, in sigmas squared: where opacity exp(-r^2 / 2) is alpha_min.

    float64, [M]. Negative where the opacity itself is below the cut.
    """
    # Without a cut-off the reach ends where float64 has no normal numbers left.
    smallest = max(settings.alpha_min, torch.finfo(torch.float64).tiny)
    return 2 * torch.log(opacities.double() / smallest)


def visible_in_order(flat: Projected, camera: Camera, settings: RasterSettings) -> Tensor:
    """The Gaussians whose box of reach overlaps the image, front to back: [M] indices.

    Equal depths keep the order of their indices.
    """
    r2 = squared_radius(flat.opacities, settings)
    extent = (r2.clamp_min(0)[:, None] * flat.cov[:, [0, 2]]).sqrt()  # [N, 2] px
    low, high = flat.means2d - extent, flat.means2d + extent
    size = torch.tensor([camera.width, camera.height])
    # A covariance that overflows, or is singular for want of dilation, has no inverse.
    usable = torch.isfinite(flat.det) & (flat.det > 0) & torch.isfinite(extent).all(-1)
    visible = usable & (r2 >= 0) & ((high > 0) & (low < size)).all(-1)
    order = torch.argsort(flat.depths, stable=True)
    return order[visible[order]]


def whitened(flat: Projected) -> Tensor:
    """What a pixel needs to know of a Gaussian's shape: [M, 6] x, y, p, s, q, log(opacity).

    With d the pixel's centre less the mean, u = p dx - s dy and v = q dy are normal deviates over
    sqrt(2), so alpha = opacity exp(-u^2 - v^2): the inverse covariance as a sum of squares.
    """
    _, xy, yy = flat.cov.unbind(-1)
    p = (yy / flat.det / 2).sqrt()
    s = p * xy / yy
    q = (0.5 / yy).sqrt()
    shape = torch.stack([p, s, q, torch.log(flat.opacities)], dim=-1)
    return torch.cat([flat.means2d, shape], dim=-1)
