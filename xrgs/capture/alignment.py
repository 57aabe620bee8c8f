"""How far a reconstruction's cameras are from exact ones, up to a similarity."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]


def similarity(source: Matrix, target: Matrix) -> tuple[float, Matrix, Matrix]:
    """Scale s, rotation R [3, 3] and shift t [3] that minimise |s R source + t - target|².

    Args:
        source: [N, 3].
        target: [N, 3].

    Umeyama (1991), "Least-squares estimation of transformation parameters between two point
    patterns".
    """
    mean_s, mean_t = source.mean(0), target.mean(0)
    s0, t0 = source - mean_s, target - mean_t
    left, sizes, right = np.linalg.svd(t0.T @ s0)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = left * sign @ right
    scale = float((sizes * sign).sum() / (s0**2).sum())
    return scale, rotation, mean_t - scale * rotation @ mean_s


def pose_error(found: Mapping[str, Matrix], exact: Mapping[str, Matrix]) -> dict[str, float]:
    """Errors of world-to-camera matrices [4, 4] against exact ones, over the names of both.

    Returns:
        `position_percent` (mean) and `position_percent_max`, after the best similarity, in % of the
        largest distance between two exact cameras; `rotation_degrees` and `rotation_degrees_max`,
        after removing the rotation all have in common. Positions are left out below three cameras,
        which a similarity fits whatever they are; all of it below two.
    """
    names = sorted(found.keys() & exact.keys())
    if len(names) < 2:
        return {}
    a, b = np.stack([found[n] for n in names]), np.stack([exact[n] for n in names])
    turns = b[:, :3, :3].transpose(0, 2, 1) @ a[:, :3, :3]  # [N, 3, 3] found world to exact world
    left, _, right = np.linalg.svd(turns.sum(0))
    common = left * np.array([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    rest = turns @ common.T
    # |R - 1|_F = 2 sqrt(2) sin(angle / 2): exact near 0, where the trace's arccosine is not.
    chord = np.linalg.norm(rest - np.eye(3), axis=(1, 2)) / (2 * np.sqrt(2))
    angles = np.degrees(2 * np.arcsin(np.minimum(chord, 1)))
    error = {
        "rotation_degrees": float(angles.mean()),
        "rotation_degrees_max": float(angles.max()),
    }
    if len(names) < 3:
        return error
    centres, wanted = _centres(a), _centres(b)
    scale, rotation, shift = similarity(centres, wanted)
    distance = np.linalg.norm(scale * centres @ rotation.T + shift - wanted, axis=1)
    extent = np.linalg.norm(wanted[:, None] - wanted[None], axis=-1).max()
    percent = 100 * distance / extent
    return error | {
        "position_percent": float(percent.mean()),
        "position_percent_max": float(percent.max()),
    }


def _centres(viewmats: Matrix) -> Matrix:
    """Camera positions [N, 3] of world-to-camera matrices [N, 4, 4]."""
    centres: Matrix = -np.einsum("nji,nj->ni", viewmats[:, :3, :3], viewmats[:, :3, 3])
    return centres
