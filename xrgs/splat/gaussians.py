"""The Gaussians of a scene, as the raw parameters that the optimizer trains."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor

from xrgs.splat.backend import implementation
from xrgs.splat.sh import bases, check_degree, colors_to_sh0

PARAMETERS = ("means", "quats", "scales", "opacities", "sh0", "shN")
"""Names of the parameters, as in gsplat, in the order of all functions' arguments."""

MIN_SPACING = 1e-7
"""Smallest initial scale, world units. Without it, coinciding points would get a log scale of
-inf."""


class ActivatedGaussians(NamedTuple):
    """Gaussians after the activation functions; the fields are in the order of `PARAMETERS`."""

    means: Tensor  # [N, 3] world units
    quats: Tensor  # [N, 4] wxyz, any length
    scales: Tensor  # [N, 3] world units
    opacities: Tensor  # [N] 0..1
    sh0: Tensor  # [N, 1, 3]
    shN: Tensor  # [N, K - 1, 3]  # noqa: N815 - the field's name


@dataclass
class Gaussians:
    """N Gaussians as raw parameters: leaf tensors that accumulate gradients.

    `gaussians["means"]` is the same as `gaussians.means`, also for assignment.

    Examples:
        >>> points = torch.rand(50, 3) + torch.tensor([0.0, 0.0, 2.0])
        >>> gaussians = Gaussians.from_points(points, colors=torch.rand(50, 3))
        >>> len(gaussians), gaussians.shN.shape
        (50, torch.Size([50, 15, 3]))
    """

    means: Tensor
    """[N, 3] world units."""
    quats: Tensor
    """[N, 4] wxyz, any length."""
    scales: Tensor
    """[N, 3] natural logarithms of world units."""
    opacities: Tensor
    """[N] logits."""
    sh0: Tensor
    """[N, 1, 3] coefficients of band 0 of the spherical harmonics."""
    shN: Tensor  # noqa: N815 - the field's name
    """[N, K - 1, 3] coefficients of the higher bands, K = (degree + 1)^2."""

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return int(self.means.shape[0])

    def __getitem__(self, name: str) -> Tensor:
        if name not in PARAMETERS:
            raise KeyError(name)
        value: Tensor = getattr(self, name)
        return value

    def __setitem__(self, name: str, value: Tensor) -> None:
        if name not in PARAMETERS:
            raise KeyError(name)
        setattr(self, name, value)

    @classmethod
    def from_points(
        cls,
        points: Tensor | NDArray[np.float64],
        colors: Tensor | NDArray[np.uint8],
        *,
        init_opacity: float = 0.1,
        init_scale: float = 1.0,
        sh_degree: int = 3,
        generator: torch.Generator | None = None,
    ) -> Gaussians:
        """Place one Gaussian on each point of a point cloud.

        As `create_splats_with_optimizers` of gsplat's trainer: each Gaussian is isotropic, its
        quaternion is random, band 0 of the harmonics is the point's colour, and the other bands
        are 0.

        Args:
            points: [P, 3] world units, at least 4 points.
            colors: [P, 3], 8-bit, or floats in 0..1.
            init_opacity: Opacity of each Gaussian, above 0 and below 1; 0.1 is gsplat's default.
            init_scale: Scale of each Gaussian, above 0, as a multiple of the RMS distance to the
                three nearest points.
            sh_degree: Highest stored band of the spherical harmonics, 0 to 3.
            generator: Draws the quaternions; None takes a generator with seed 0.

        Returns:
            P Gaussians, float32 leaf tensors that require gradients.

        Raises:
            ValueError: There are fewer than 4 points, shapes do not fit, values are not finite, or
                `init_opacity`, `init_scale` or `sh_degree` is out of range.
        """
        check_degree(sh_degree)
        means = torch.as_tensor(points, dtype=torch.float32)
        rgb = torch.as_tensor(colors)
        rgb = rgb.float() / 255.0 if rgb.dtype == torch.uint8 else rgb.float()
        _check_points(means, rgb)
        if not 0.0 < init_opacity < 1.0:
            raise ValueError(f"init_opacity must be between 0 and 1, got {init_opacity}")
        if not (math.isfinite(init_scale) and init_scale > 0.0):
            raise ValueError(f"init_scale must be finite and above 0, got {init_scale}")
        count = len(means)
        generator = generator or torch.Generator().manual_seed(0)
        log_scales = torch.from_numpy(np.log(_spacing(means) * init_scale)).float()  # [P]
        tensors = {
            "means": means.clone(),
            "quats": torch.rand((count, 4), generator=generator),
            "scales": log_scales[:, None].repeat(1, 3),
            "opacities": torch.full((count,), math.log(init_opacity / (1 - init_opacity))),
            "sh0": colors_to_sh0(rgb),
            "shN": torch.zeros((count, bases(sh_degree) - 1, 3)),
        }
        return cls(**{name: value.requires_grad_() for name, value in tensors.items()})

    def to(self, device: str) -> Gaussians:
        """Return the Gaussians on a device: themselves if they are there, else new leaf tensors."""
        if self.means.device.type == device:
            return self
        moved = {name: self[name].detach().to(device) for name in PARAMETERS}
        return Gaussians(**{name: value.requires_grad_() for name, value in moved.items()})

    def raw(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Return the parameters in the order of `PARAMETERS`, with shN detached.

        So autograd never computes the gradient of shN, three quarters of all gradients. The
        optimizer derives it from the gradient of sh0 (`SplatOptimizer.step`).
        """
        return self.means, self.quats, self.scales, self.opacities, self.sh0, self.shN.detach()

    def activated(self, *, backend: str = "torch") -> ActivatedGaussians:
        """Apply the activation functions: exp to scales, the logistic function to opacities.

        shN is detached as in `raw`.

        Args:
            backend: `torch`, `native` or `auto` (`resolve_backend`). The native backend takes
                float32 on the CPU only, gives the same bits for any number of threads, and is once
                differentiable.

        Raises:
            ValueError: The parameters are not float32 on the CPU for the native backend.
        """
        functions = implementation("elementwise", backend)
        return ActivatedGaussians(*self.raw())._replace(
            scales=functions.exp(self.scales), opacities=functions.logistic(self.opacities)
        )


def _check_points(means: Tensor, rgb: Tensor) -> None:
    if means.ndim != 2 or means.shape[1] != 3 or rgb.shape != means.shape:
        raise ValueError(
            f"points and colors must both be [P, 3], got {list(means.shape)} and {list(rgb.shape)}"
        )
    if len(means) < 4:
        raise ValueError(
            f"points: at least 4 are needed to measure their spacing, got {len(means)}"
        )
    for name, values in (("points", means), ("colors", rgb)):
        if not torch.isfinite(values).all():
            raise ValueError(f"{name} has values that are not finite")


def _spacing(points: Tensor) -> NDArray[np.float64]:
    """Return the RMS distance of each point [P, 3] to its three nearest neighbours: [P]."""
    distances, _ = KDTree(points.numpy()).query(points.numpy(), k=4)  # [P, 4], itself first
    spacing: NDArray[np.float64] = np.sqrt(np.square(distances[:, 1:]).mean(axis=1))
    return np.maximum(spacing, MIN_SPACING)
