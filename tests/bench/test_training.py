"""The training step that the benchmark measures, and its shortcuts."""

from __future__ import annotations

import torch

from xrgs.bench import training
from xrgs.bench.loads import Load
from xrgs.splat.backend import resolve_backend

BACKEND = resolve_backend("auto")


def test_a_step_trains_and_keeps_its_gaussians(load: Load) -> None:
    step = training.TrainingStep(load, "torch")
    losses = []
    for _ in range(2):
        before = step.gaussians.means.detach().clone()
        for part in step.parts():
            part()
        losses.append(step.value.item())
        assert len(step.gaussians) == len(load)
        assert not torch.equal(step.gaussians.means, before)
    assert losses[0] > losses[-1]


def test_a_prepared_target_changes_no_bit(load: Load) -> None:
    prepared, computed = (gradient() for gradient in training.loss_gradients(load, BACKEND))
    assert torch.equal(prepared, computed)


def test_the_optimizer_leaves_zero_moments_alone(load: Load) -> None:
    degree_0, degree_3 = training.steps_of_sh_degrees(load, BACKEND)
    for step, moves in ((degree_0, False), (degree_3, True)):
        before = step.gaussians.shN.detach().clone()
        step.optimize()
        assert torch.equal(step.gaussians.shN, before) != moves
