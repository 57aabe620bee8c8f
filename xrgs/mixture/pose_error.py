"""Measures the pose errors of a reconstruction against exact cameras, up to a similarity."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from xrgs.splat.normalize import camera_positions

Matrix = NDArray[np.float64]


def fit_similarity(source: Matrix, target: Matrix) -> tuple[float, Matrix, Matrix]:
    """Fit the similarity that minimises the sum over points [N, 3] of |s R source + t - target|².

    Source: Umeyama 1991, "Least-squares estimation of transformation parameters between two point
    patterns".

    Returns:
        The scale s, the rotation R [3, 3] with det R = +1, and the translation t [3].
    """
    source_mean, target_mean = source.mean(0), target.mean(0)
    source_centred, target_centred = source - source_mean, target - target_mean
    U, singular_values, Vt = np.linalg.svd(target_centred.T @ source_centred)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])  # rules out reflections
    rotation = U * sign @ Vt
    scale = float((singular_values * sign).sum() / (source_centred**2).sum())
    return scale, rotation, target_mean - scale * rotation @ source_mean


def pose_error(estimated: Mapping[str, Matrix], exact: Mapping[str, Matrix]) -> dict[str, float]:
    """Compare world-to-camera matrices [4, 4] with exact matrices of the same names.

    Returns:
        - `position_percent` (mean) and `position_percent_max`: distances between camera centres
          after the best similarity, in % of the largest distance between two exact centres. Missing
          for fewer than three cameras, which a similarity always fits.
        - `rotation_degrees` (mean) and `rotation_degrees_max`: angles after removing the rotation
          common to all cameras. Missing for fewer than two cameras.
    """
    names = sorted(estimated.keys() & exact.keys())
    if len(names) < 2:
        return {}
    a, b = np.stack([estimated[n] for n in names]), np.stack([exact[n] for n in names])
    rotations = b[:, :3, :3].transpose(0, 2, 1) @ a[:, :3, :3]  # [N, 3, 3] estimated to exact world
    U, _, Vt = np.linalg.svd(rotations.sum(0))
    common = U * np.array([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    residual = rotations @ common.T
    # |R - 1|_F = 2 sqrt(2) sin(angle / 2) is accurate near 0; the arccosine of the trace is not.
    chord = np.linalg.norm(residual - np.eye(3), axis=(1, 2)) / (2 * np.sqrt(2))
    angles = np.degrees(2 * np.arcsin(np.minimum(chord, 1)))
    error = {
        "rotation_degrees": float(angles.mean()),
        "rotation_degrees_max": float(angles.max()),
    }
    if len(names) < 3:
        return error
    centres, exact_centres = camera_positions(a), camera_positions(b)
    scale, rotation, shift = fit_similarity(centres, exact_centres)
    distance = np.linalg.norm(scale * centres @ rotation.T + shift - exact_centres, axis=1)
    extent = np.linalg.norm(exact_centres[:, None] - exact_centres[None], axis=-1).max()
    percent = 100 * distance / extent
    return error | {
        "position_percent": float(percent.mean()),
        "position_percent_max": float(percent.max()),
    }
