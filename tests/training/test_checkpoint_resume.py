"""A killed run continues from its checkpoint, and ends with the result of one never killed."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.conftest import composed as compose
from tests.training.conftest import Losses, comparable, killed_and_not, train_with_checkpoints
from xrgs.training.dataset import Dataset
from xrgs.training.loop import train

#: Densification every fourth step: every single step, as the schedule of so few steps has it, would
#: leave no statistics to be restored.
SHORT = ("train.steps=16", "splat.densify.every=7500", "splat.densify.stop=25000")
CASES = {
    # 60 Gaussians of at most 180: a limit that began with those at the restart would be another.
    "xrgs": (
        "+ablation=[xrgs_per_class,curriculum,harmonics_every,budget]",
        "splat.densify.budget=0.05",
    ),
    # The rates of `mip` are found anew between refinements too, or they would be new at every
    # restart.
    "photographs": (
        "+ablation=[mip,resolution_schedule,formation,exposure,near_limit,hr_share]",
        "components.mip.every=7",
        "components.floaters.near_share=1",
    ),
    "natural_selection": (
        "+ablation=natural_selection",
        "components.natural_selection.budget=0.003",
        "splat.densify.stop=10000",
    ),
    "mcmc": ("+ablation=mcmc", "splat.densify.budget=0.03"),
    # Without the reset, after which too few Gaussians are left for numbers to be matched.
    "count_matched": ("splat.densify.reset_every=50000",),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "backend",
    ["native", pytest.param("torch", marks=[pytest.mark.slow, pytest.mark.exhaustive])],
)
@pytest.mark.parametrize("case", CASES)
def test_a_killed_run_ends_as_one_never_killed(
    case: str, backend: str, data: Dataset, losses: Losses, tmp_path: Path
) -> None:
    if backend == "native":
        pytest.importorskip("xrgs._native")
    conf = compose(*SHORT, f"splat.backend={backend}", *CASES[case])
    if case == "count_matched":
        count = len(train(data, conf).gaussians)
        conf.components.count_matched.gaussians = round(0.8 * count)
        losses.restart()
    killed_and_not(data, conf, losses, tmp_path)


def test_a_run_killed_after_its_last_step_trains_no_step_again(
    data: Dataset, losses: Losses, tmp_path: Path
) -> None:
    file, conf = tmp_path / "checkpoint.npz", compose(*SHORT, "splat.backend=auto")
    first = train_with_checkpoints(file, 1, losses, data, conf)
    losses.restart()
    again = train_with_checkpoints(file, 1, losses, data, conf)
    assert losses.count == 0
    assert comparable(again) == comparable(first)
