"""The training step that the benchmark measures, its shortcuts and its memory."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from xrgs.bench import training
from xrgs.bench.loads import Load
from xrgs.splat.backend import resolve_backend

BACKEND = resolve_backend("auto")


def test_a_step_trains_and_keeps_its_gaussians(load: Load) -> None:
    step = training.TrainingStep(load, "torch", 1)
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


@pytest.mark.slow
def test_a_process_grows_by_the_counted_bytes_and_not_by_the_imports() -> None:
    row = training.measure_memory(BACKEND, 20_000, 64, 48, threads=1)
    assert (row["gaussians"], row["width"], row["height"]) == (20_000, 64, 48)
    model = 4 * 20_000 * (3 + 4 + 3 + 1 + 48) / 2**20
    assert row["counted_mib"] > 4 * model  # parameters, gradients, two moments
    if Path("/proc/self/status").exists():
        assert row["base_rss_mib"] > 50  # torch alone
        assert row["growth_mib"] == row["peak_rss_mib"] - row["base_rss_mib"] > 3 * model
