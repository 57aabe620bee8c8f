"""Rotations from quaternions."""

from __future__ import annotations

import torch
from torch import Tensor

from xrgs.splat.rounding import rounded_sqrt


def rotation_matrices(quats: Tensor) -> Tensor:
    """Convert quaternions of any length to rotation matrices.

    As gsplat's `_quat_to_rotmat` (`cuda/_torch_impl.py`), and defined in two more cases: a zero
    quaternion is the identity, with a gradient of zero, and the squares of components may overflow
    or underflow.

    Args:
        quats: [M, 4] w, x, y, z.

    Returns:
        [M, 3, 3], differentiable.
    """
    # Divided by the largest component, the norm is finite. The rotation does not depend on the
    # quaternion's length, so this factor needs no gradient.
    largest = quats.detach().abs().amax(dim=-1, keepdim=True)  # [M, 1]
    zero = largest == 0
    identity = quats.new_tensor([1.0, 0.0, 0.0, 0.0])
    scaled = torch.where(zero, identity, quats / largest.masked_fill(zero, 1.0))  # [M, 4]
    w, x, y, z = scaled.unbind(-1)  # [M] each
    # Not torch's norm: the order in which it adds depends on the processor.
    length = rounded_sqrt(w * w + x * x + y * y + z * z)  # at least 1
    w, x, y, z = w / length, x / length, y / length, z / length
    entries = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(entries, dim=-1).reshape(-1, 3, 3)


def rotate(quats: Tensor, vectors: Tensor) -> Tensor:
    """Rotate vectors [..., M, 3] by quaternions [M, 4] of any length."""
    # Not a sum over an axis: the order in which torch adds depends on the processor.
    first, second, third = (rotation_matrices(quats) * vectors[..., None, :]).unbind(-1)
    return first + second + third
