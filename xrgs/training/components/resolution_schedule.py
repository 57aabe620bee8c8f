"""HR views at a reduced resolution early in training [chen2025dash]."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Self

import torch
from torch import Tensor

from xrgs.errors import XrgsError
from xrgs.photos import masks
from xrgs.splat.loss import WINDOW
from xrgs.splat.resample import resize
from xrgs.training.components.base import Component, Step, TrainingSetup, TrainingView

if TYPE_CHECKING:
    from xrgs.config import ResolutionScheduleConf

_LARGEST_FACTOR = 8
"""Largest factor of downsampling, as in the authors' code."""


class ResolutionSchedule(Component):
    """Trains HR views at a resolution that grows with the step, according to their frequencies.

    DashGaussian [chen2025dash] trains on photographs downsampled by a factor r, which falls to 1
    during training. With F_n the discrete Fourier transform of photograph n, the fraction of the
    spectrum that remains after downsampling by r is

        kept(r) = X(1 / (2 r)) / X(1 / 2)
        X(f) = sum_n sum_{|fx| <= f, |fy| <= f} |F_n(fx, fy)|

    with fx and fy in cycles per px of each photograph; the sum is over channels and HR views n. In
    the authors' code the step at which r is reached is proportional to the logarithm of kept(r),
    from step 0 for the r with kept(r) = 1/4 to `until`, the end of densification, for r = 1. r is
    rounded down to a whole number, at most 8. So at step t the photographs are downsampled by the
    largest whole number k with

        kept(k) >= start_share^(1 - t / until)

    and from `until` on they have full size. The camera has the reduced size, round(W / k) x
    round(H / k) px. Densification is not affected: its normalised device units do not depend on
    the size.

    Our choice:

    - LR views are not downsampled.
    - Photographs are downsampled with the antialiased bicubic kernel, not in the frequency domain.
    - Every HR view remains at least as large as the SSIM window.
    - The growth of Gaussians, which the authors schedule too, is not changed.

    In the authors' code the learning rate of means decays only after k has reached 1; here
    `splat.optimizer.means_decay_from` sets this.
    """

    def __init__(
        self,
        settings: ResolutionScheduleConf,
        views: Sequence[TrainingView],
        backend: str = "torch",
    ) -> None:
        high = [view for view in views if view.tag == "HR"]
        if not high:
            raise XrgsError(
                "components.resolution_schedule: there is no HR view to reduce; set start_share to"
                " 1, or train on the mixed views (train.views=mixed)"
            )
        self.settings, self.backend = settings, backend
        shortest = min(min(view.camera.width, view.camera.height) for view in high)
        largest = min(_LARGEST_FACTOR, max(1, shortest // WINDOW))
        self.kept = kept_shares((view.image for view in high), range(1, largest + 1))
        self.factor = 1
        self.reduced: Mapping[str, TrainingView] = {}
        """Name -> HR view downsampled by the present factor; empty if the factor is 1."""

    @classmethod
    def from_settings(cls, settings: ResolutionScheduleConf, setup: TrainingSetup) -> Self:
        """Build the component; XrgsError if there is no HR view."""
        return cls(settings, setup.data.train, setup.backend)

    def training_views(
        self, views: Mapping[str, TrainingView], step: Step
    ) -> Mapping[str, TrainingView]:
        """Return the HR views at their size at this step, and the LR views unchanged.

        A step on an HR view records k as `resolution_schedule.factor`.
        """
        factor = self.factor_at(step)
        if step.view.tag == "HR":
            step.log["resolution_schedule.factor"] = factor
        if factor == 1:
            self.factor, self.reduced = 1, {}
            return views
        if factor != self.factor:
            self.factor = factor
            self.reduced = {
                name: self._reduce(view, factor) if view.tag == "HR" else view
                for name, view in views.items()
            }
        return self.reduced

    def factor_at(self, step: Step) -> int:
        """Return the factor k at a step."""
        left = max(0.0, 1 - step.nominal / self.settings.until)
        needed = self.settings.start_share**left
        return max(factor for factor, kept in self.kept.items() if kept >= needed)

    def _reduce(self, view: TrainingView, factor: int) -> TrainingView:
        """Downsample an HR view; its `supersampling` remains that of the full size."""
        width, height = round(view.camera.width / factor), round(view.camera.height / factor)
        image = resize(view.image, height, width, backend=self.backend)
        camera = view.camera.resized(width, height)
        mask = None
        if view.mask is not None:
            resized = masks.resized(view.mask.cpu().numpy(), width, height)
            mask = torch.from_numpy(resized).to(view.mask.device)
        return replace(view, camera=camera, pixels=image, mask=mask)


def kept_shares(images: Iterable[Tensor], factors: Iterable[int]) -> dict[int, float]:
    """Compute the fraction of the spectra's magnitude that remains after downsampling.

    Args:
        images: Photographs [H, W, 3] of any sizes.
        factors: Whole factors of downsampling, at least 1.

    Returns:
        Factor -> fraction in 0..1: the sum of magnitudes over all images at frequencies of at most
        1 / (2 factor) cycles per px on both axes, over the sum at all frequencies; 6 digits.
    """
    total, sums = 0.0, dict.fromkeys(factors, 0.0)
    for image in images:
        spectrum = torch.fft.fft2(image.cpu().double(), dim=(0, 1)).abs().sum(dim=2)  # [H, W]
        total += spectrum.sum().item()
        fy, fx = (torch.fft.fftfreq(size, dtype=torch.float64).abs() for size in spectrum.shape)
        for factor in sums:
            rows, columns = fy <= 0.5 / factor, fx <= 0.5 / factor
            sums[factor] += spectrum[rows][:, columns].sum().item()
    # Rounded to 6 digits: the last digits of the Fourier transforms depend on the processor.
    return {factor: round(value / total, 6) if total else 1.0 for factor, value in sums.items()}
