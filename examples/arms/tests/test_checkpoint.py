"""A killed and resumed run ends like one that was never killed, with all arms that have a state."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from examples.arms.tests.conftest import with_arms
from tests.training.conftest import comparable
from xrgs.splat.loss import photometric_loss
from xrgs.training import loop
from xrgs.training.checkpoint import Checkpoint
from xrgs.training.dataset import Dataset
from xrgs.training.loop import train


class Kill(BaseException):
    """Raised to end a run as a kill does."""


def test_a_killed_run_continues(
    data: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    conf = with_arms(
        *("train.steps=24", "splat.backend=auto", "splat.densify.every=5000"),
        "+ablation=[mip_off_late,noise_weighting,skip_backward,multiview_score,near_gradients]",
        "components.plugins.noise_weighting.begin=8000",
        "components.plugins.skip_backward.begin=3000",
        "+components.plugins.mip_off_late.every=7",
    )
    whole, kills, calls = train(data, conf), [7, 22], [0]

    def mortal(*arguments: Any, **named: Any) -> Any:
        calls[0] += 1
        if calls[0] in kills:
            raise Kill
        return photometric_loss(*arguments, **named)

    def checkpoint() -> Checkpoint:
        return Checkpoint(tmp_path / "checkpoint.npz", "cell", every_s=1e-9)

    monkeypatch.setattr(loop, "photometric_loss", mortal)
    with pytest.raises(Kill):
        train(data, conf, checkpoint())
    for done in (6, 20):  # the step that was killed is begun again
        continued = checkpoint()
        assert continued.load() == done
        if done == 6:
            with pytest.raises(Kill):
                train(data, conf, continued)
    assert comparable(train(data, conf, continued)) == comparable(whole)
