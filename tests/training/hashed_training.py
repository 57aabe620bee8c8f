"""A short training on the native backend, and the SHA-256 of all that it computes.

A program, because `XRGS_ISA` and `ATEN_CPU_CAPABILITY` are read when a process starts. Its
arguments are numbers of threads. For each strategy of densification and each number it prints a
line with the strategy and the hash.
"""

from __future__ import annotations

import hashlib
import json
import sys

import torch
from torch import Tensor

from xrgs import composing
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import PARAMETERS
from xrgs.training.dataset import Dataset, LoadedView
from xrgs.training.loop import train

GAUSSIANS = 33_001
"""Above 32,768, from which on torch divides a tensor among its threads; of no round number, so that
the parts have tails."""
_BOTH = (
    "preset=laptop",
    "splat.backend=native",
    "splat.sh_every=6000",
    # 9 steps stand for 30,000: Gaussians are refined at steps 1 to 6, and reset at 3 and 6.
    "train.steps=9",
    "splat.densify.start=0",
    "splat.densify.every=3000",
)
_DEFAULT = (
    "splat.densify.reset_every=12000",
    "splat.densify.stop=24000",
    # Thresholds that some Gaussians are on either side of.
    "splat.densify.grow_grad2d=2e-3",
    "splat.densify.grow_scale3d=0.018",
    "splat.densify.prune_opacity=0.0935",
    "splat.densify.prune_scale3d=0.03",
    "splat.densify.reset_opacity=1.08",
    # Every component whose own code computes more than single products.
    "components.loss_weighting.lr_weight=0.5",
    "components.adaptive_weighting.texture=0.9",
    "components.region_weighting.texture=0.5",
    "components.gradient_scaling.lr_scale=0.3",
    "components.render_scale.gamma=0.25",
    "components.consistency.weight=0.1",
    "components.consistency.lr_mode=fold",
    "components.mip.variance=0.2",
    "components.formation.widths=tag",
    "components.exposure.mode=affine",
    "components.floaters.near_share=0.95",
    "components.densify.decide=per_class",
    "components.densify.lr_prune=1.01",
)
_MCMC = (
    "+ablation=mcmc",
    # Opacities begin where some die and many move by noise.
    "splat.init_opacity=0.05",
    "splat.densify.prune_opacity=0.045",
    "splat.densify.budget=16",  # 36,864 Gaussians
)
#: What each strategy is trained with, and the counts of a refinement that must not be 0.
_CASES = {
    "default": (_DEFAULT, ("split", "duplicated", "pruned_opacity", "pruned_scale", "reset")),
    "mcmc": (_MCMC, ("relocated", "added")),
}


def training_hash(strategy: str) -> str:
    """Train, and return the SHA-256 of the Gaussians and of the history, in hexadecimal digits."""
    overrides, rules = _CASES[strategy]
    data, conf = _dataset(), composing.compose(*_BOTH, *overrides)
    result = train(data, conf)
    counts = result.history[-1]
    if not all(counts[rule] for rule in rules):
        raise AssertionError(f"the training does not go through every rule: {counts}")
    digest = hashlib.sha256()
    for name in PARAMETERS:
        digest.update(result.gaussians[name].detach().contiguous().numpy().tobytes())
    digest.update(json.dumps(result.history).encode())
    return digest.hexdigest()


def _dataset() -> Dataset:
    """Two HR and two LR views of points in a box, in noise that is as smooth as a photograph."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(GAUSSIANS, 3, generator=generator) - 0.5
    views = []
    for number, (tag, size) in enumerate([("HR", 48), ("LR", 24), ("HR", 48), ("LR", 24)]):
        # Turned about the vertical axis, by angles with rational sines.
        sine, cosine = ((0.0, 1.0), (0.6, 0.8), (-0.28, 0.96), (0.8, 0.6))[number]
        viewmat = torch.tensor(
            [[cosine, 0, sine, 0.1], [0, 1, 0, -0.1], [-sine, 0, cosine, 2], [0, 0, 0, 1]]
        )
        focal = 1.1 * size
        K = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
        camera = Camera(viewmat, K, size, size)
        image = _smooth(torch.rand(size, size, 3, generator=generator))
        views.append(
            LoadedView(
                f"v{number}", tag, camera, image, sampling_rate=size / 48, supersampling=48 / size
            )
        )
    colors = torch.rand(GAUSSIANS, 3, generator=generator)
    return Dataset(tuple(views), tuple(views[:1]), points, colors, scene_scale=1.0, factor=2)


def _smooth(image: Tensor) -> Tensor:
    return (image + image.roll(1, 0) + image.roll(1, 1) + image.roll((1, 1), (0, 1))) / 4


if __name__ == "__main__":
    for strategy in _CASES:
        for threads in sys.argv[1:]:
            torch.set_num_threads(int(threads))
            sys.stdout.write(f"{strategy} {training_hash(strategy)}\n")
