"""Projection of Gaussians to ellipses on the image plane, and culling.

Elliptical weighted averaging [zwicker2001], as in 3D Gaussian Splatting [kerbl2023, section 4,
equations 5 and 6] and in gsplat 1.5 (`_fully_fused_projection` of `cuda/_torch_impl.py`). Only the
formulas of the determinant and the quadratic form differ, to avoid cancellation in float32.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from xrgs.splat.cameras import Camera
from xrgs.splat.quaternions import rotation_matrices
from xrgs.splat.settings import RasterSettings

CLAMP_MARGIN = 0.3
"""How far outside the image the Jacobian's point may lie, as a fraction of half the field of view
(gsplat clamps to 1.3 tan(fov / 2))."""

LARGEST = 1e18
"""Limit of half a side of a Gaussian's bounding box, px."""


class ProjectedGaussians(NamedTuple):
    """Gaussians in the image plane."""

    means2d: Tensor  # [M, 2] px
    cov: Tensor  # [M, 3] xx, xy, yy of the dilated covariance, px^2
    det: Tensor  # [M] determinants of these covariances, px^4; float64 if float32 overflows
    opacities: Tensor  # [M], compensated for the dilation if antialiased
    depths: Tensor  # [M] world units


def depths(means: Tensor, camera: Camera) -> Tensor:
    """Return the depths [N] of means [N, 3] along the optical axis, negative behind the camera."""
    forward = camera.viewmat[2].to(means)  # [4]
    return means @ forward[:3] + forward[3]


def project(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    camera: Camera,
    settings: RasterSettings,
) -> ProjectedGaussians:
    """Project Gaussians in front of the camera to ellipses on the image plane.

    With M = J W R S (equations 5 and 6 of 3D Gaussian Splatting), a [2, 3] matrix, the covariance
    on the image plane is M M^T + eps2d I. With `settings.antialiased` the opacity is multiplied by
    sqrt(det(M M^T) / det(M M^T + eps2d I)), the 2D Mip filter of Mip-Splatting [yu2024] as in
    gsplat (`calc_compensations`).

    The parameters are those of `rasterize_parameters`, of M Gaussians in front of the near plane.
    """
    viewmat, K = camera.viewmat.to(means), camera.K.to(means)
    x, y, z = (means @ viewmat[:3, :3].T + viewmat[:3, 3]).unbind(-1)  # [M] each
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], dim=-1)  # [M, 2]

    # Far outside the image the affine approximation diverges: clamp its point near the border.
    tan_x = _clamp_tangent(x / z, cx / fx, (camera.width - cx) / fx)  # [M]
    tan_y = _clamp_tangent(y / z, cy / fy, (camera.height - cy) / fy)
    # W R S: the Gaussian's axes in camera coordinates.
    axes = viewmat[:3, :3] @ (rotation_matrices(quats) * scales[:, None, :])  # [M, 3, 3]
    row_x = (fx / z)[:, None] * (axes[:, 0] - tan_x[:, None] * axes[:, 2])  # [M, 3], first row of M
    row_y = (fy / z)[:, None] * (axes[:, 1] - tan_y[:, None] * axes[:, 2])  # [M, 3], second row

    eps = settings.eps2d
    xx, xy, yy = (row_x * row_x).sum(-1), (row_x * row_y).sum(-1), (row_y * row_y).sum(-1)  # [M]
    area, det = _area_and_determinant(row_x, row_y, eps)
    if not torch.isfinite(det).all():  # float32 overflows for a Gaussian larger than 4e9 px
        area, det = _area_and_determinant(row_x.double(), row_y.double(), eps)
        overflows = ~torch.isfinite(det)  # `visible_by_depth` refuses visible ones
        area, det = area.masked_fill(overflows, 1.0), det.masked_fill(overflows, 1.0)
    if settings.antialiased:
        opacities = (opacities * area / det.sqrt()).to(opacities)
    cov = torch.stack([xx + eps, xy, yy + eps], dim=-1)  # [M, 3]
    return ProjectedGaussians(means2d, cov, det, opacities, z)


def _area_and_determinant(row_x: Tensor, row_y: Tensor, eps: float) -> tuple[Tensor, Tensor]:
    """Return sqrt(det(M M^T)) and det(M M^T + eps I), for the rows of M.

    The formula avoids xx yy - xy^2, which cancels in float32.
    """
    xx, yy = (row_x * row_x).sum(-1), (row_y * row_y).sum(-1)  # [M]
    area = torch.linalg.vector_norm(torch.linalg.cross(row_x, row_y), dim=-1)
    return area, area * area + eps * (xx + yy) + eps * eps


def _clamp_tangent(tangent: Tensor, before: Tensor, after: Tensor) -> Tensor:
    """Clamp x/z to the image, whose borders are at -before and after, plus a margin."""
    margin = CLAMP_MARGIN * 0.5 * (before + after)
    return torch.minimum(torch.maximum(tangent, -before - margin), after + margin)


def cutoff_radius_sq(opacities: Tensor, settings: RasterSettings) -> Tensor:
    """Return the squared radius, in standard deviations, at which alpha falls to alpha_min.

    The radius r solves opacity exp(-r^2 / 2) = alpha_min. The result [M] is float64, and negative
    if the opacity is below alpha_min.
    """
    # For an alpha_min of 0 the radius ends at the smallest normal float64.
    smallest = max(settings.alpha_min, torch.finfo(torch.float64).tiny)
    return 2 * torch.log(opacities.double() / smallest)


def visible_by_depth(
    projected: ProjectedGaussians, camera: Camera, settings: RasterSettings
) -> Tensor:
    """Return the Gaussians whose bounding box at the cutoff radius overlaps the image.

    Returns:
        [M] indices, front to back; equal depths in ascending order.

    Raises:
        ValueError: A Gaussian is larger than `LARGEST`.
    """
    radius_sq = cutoff_radius_sq(projected.opacities, settings)  # [N]
    # Half the bounding box of the ellipse: the radius times the standard deviation of each axis.
    extent = (radius_sq.clamp_min(0)[:, None] * projected.cov[:, [0, 2]]).sqrt()  # [N, 2] px
    low, high = projected.means2d - extent, projected.means2d + extent
    size = torch.tensor([camera.width, camera.height])
    is_drawn = (radius_sq >= 0) & torch.isfinite(projected.means2d).all(-1)
    if not (extent[is_drawn] < LARGEST).all():
        raise ValueError(f"scales: a Gaussian is larger than {LARGEST:.0e} px in the image")
    # Without dilation a covariance may be singular, and has no inverse then.
    visible = is_drawn & (projected.det > 0) & ((high > 0) & (low < size)).all(-1)  # [N]
    order = torch.argsort(projected.depths, stable=True)
    return order[visible[order]]


def conic_cholesky(projected: ProjectedGaussians) -> Tensor:
    """Return the Cholesky factor of half the conic (the inverse covariance) of each Gaussian.

    The factor [[c_xx, c_xy], [0, c_yy]] makes the exponent a sum of squares. For d, a pixel's
    centre minus the mean, u = c_xx dx + c_xy dy and v = c_yy dy: alpha = opacity exp(-u^2 - v^2).

    Returns:
        [M, 3] c_xx, c_xy, c_yy in 1/px, differentiable.
    """
    _, xy, yy = projected.cov.unbind(-1)  # [M] each
    c_xx = (yy / projected.det / 2).sqrt()
    c_xy = -(c_xx * xy / yy)
    c_yy = (0.5 / yy).sqrt()
    return torch.stack([c_xx.to(c_yy), c_xy.to(c_yy), c_yy], dim=-1)
