"""Training with `splat.backend=gsplat`: as on the native backend, and with nothing on the CPU.

gsplat's kernels need a GPU. `gsplat_api.rasterization` stands in for them, and a device that has a
GPU's rules for the GPU (`tests/fake_gpu.py`).
"""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from tests.conftest import composed as compose
from tests.fake_gpu import DEVICE, fake_gpu
from tests.gsplat_stand_in import ALPHA_MAX, stand_in
from tests.training.conftest import Losses, killed_and_not, masked
from xrgs.config import Conf
from xrgs.evaluation import protocol
from xrgs.splat.gaussians import PARAMETERS
from xrgs.training.components import Step
from xrgs.training.dataset import Dataset
from xrgs.training.loop import train
from xrgs.training.memory import TrainingMemory

pytest.importorskip("xrgs._native", reason="the kernels were not built")

#: Trainings on the GPU that have every component and strategy between them.
TRAININGS = {
    "plus": (
        "+ablation=[plus,exposure,region_weighting,continuous_weighting,densify_own_threshold]",
        "splat.densify.budget=0.22",
        "components.floaters.near_share=1",
        "components.natural_selection.budget=0.003",
        "splat.densify.stop=10000",
    ),
    "xrgs": (
        "+ablation=[xrgs_per_class,curriculum,adaptive_weighting,hybrid_schedule,render_scale,mip]",
        "components.exposure.mode=gain",
        "splat.densify.split=long_axis",
    ),
    "mcmc": ("+ablation=mcmc", "splat.densify.budget=0.03"),
}


def config(ablation: str, *changes: str, backend: str = "gsplat") -> Conf:
    return compose(f"+ablation={ablation}", f"splat.backend={backend}", ALPHA_MAX, *changes)


@pytest.mark.slow
@pytest.mark.parametrize("ablation", ["xrgs", "plus"])
def test_steps_are_those_of_the_native_backend(data: Dataset, ablation: str) -> None:
    # The first Gaussians are round, and the gradients of their rotations are rounding only. With
    # gsplat's eps of 1e-15, Adam would make whole steps of it. Rates that fit so few steps are many
    # times gsplat's, and so is what rounding then moves.
    changes = (
        *("train.steps=25", "splat.densify.every=5000", "splat.optimizer.eps=1e-5"),
        "splat.optimizer.length_power=0",
    )
    native = train(data, config(ablation, *changes, backend="native"))
    with stand_in():
        theirs = train(data, config(ablation, *changes))
    assert len(native.gaussians) == len(theirs.gaussians) != 60  # densification took part
    for name in PARAMETERS:
        torch.testing.assert_close(
            theirs.gaussians[name], native.gaussians[name], rtol=1e-4, atol=2e-5
        )
    for row, expected in zip(theirs.history, native.history, strict=True):
        assert row == {
            name: pytest.approx(value, rel=1e-3, abs=1e-5) if isinstance(value, float) else value
            for name, value in expected.items()
        }


@pytest.mark.slow
@pytest.mark.parametrize("training", TRAININGS)
def test_training_leaves_no_tensor_on_the_processor_and_a_killed_run_continues(
    data: Dataset, training: str, losses: Losses, tmp_path: Path
) -> None:
    conf = compose(
        *("splat.backend=gsplat", ALPHA_MAX, "train.steps=4", "splat.densify.every=7500"),
        *TRAININGS[training],
    )
    with stand_in(DEVICE.type), fake_gpu():
        if training == "plus":
            result, _ = killed_and_not(masked(data), conf, losses, tmp_path)
        else:
            result = train(masked(data), conf)
    assert {result.gaussians[name].device.type for name in PARAMETERS} == {"cpu"}
    assert all(torch.isfinite(result.gaussians[name]).all() for name in PARAMETERS)


@pytest.mark.slow
def test_evaluation_renders_on_the_gpu_and_scores_on_the_processor(
    data: Dataset, tmp_path: Path
) -> None:
    gaussians = train(data, config("baseline", "train.steps=3", backend="native")).gaussians
    ours = protocol.mean_scores(gaussians, data.test, config("baseline", backend="native").splat)
    conf = config("baseline").splat
    with stand_in(DEVICE.type), fake_gpu():
        rows = protocol.score_views(gaussians, data.test, conf, tmp_path / "renders")
        means = protocol.mean_scores(gaussians, data.test, conf)
        assert protocol.render_time(gaussians, data.test, conf) > 0
    assert means["psnr"] == rows[0]["psnr"] == pytest.approx(ours["psnr"], rel=1e-5)
    assert (tmp_path / "renders" / "v0.png").stat().st_size


def test_memory_of_a_gpu_is_what_torch_has_allocated(
    data: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    peak = [7]
    monkeypatch.setattr(torch.cuda, "reset_peak_memory_stats", lambda: peak.__setitem__(0, 0))
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda: peak[0])
    memory = TrainingMemory(device="cuda")
    assert peak == [0]
    step = Step(0, 1, data.train[0])
    # The hooks would hide the tensor on which gsplat 1.5.3 stores `absgrad`.
    saved = torch.ones(3, requires_grad=True)
    with memory.of_forward(step, 3, 0):
        product = saved * saved
    assert product.grad_fn is not None
    assert product.grad_fn._saved_self is saved  # type: ignore[attr-defined]
    for allocated in (50, 30):
        peak[0] = allocated
        memory.record(None)  # type: ignore[arg-type]
    assert memory.largest_bytes == 50
