"""Costs are learned from the finished cells of a store, and scaled to cells of other sizes."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from xrgs.config import Conf
from xrgs.experiment.identity import cell_identity
from xrgs.experiment.store import Store
from xrgs.safeio.atomic import write_json
from xrgs.sweep import estimate
from xrgs.sweep.estimate import TORCH_SLOWDOWN, CostEstimator

VARIANT = "v{}-0123456789abcdef"


class Past:
    """Writes the finished cells of a store whose costs follow a law."""

    def __init__(self, path: Path, conf: Conf) -> None:
        self.store = Store(path)
        self.store.prepare()
        self.conf = conf
        self.written = 0

    def variant(self, number: int, side: int = 300) -> str:
        """Freeze the manifest of a variant with views of so many px a side."""
        name = VARIANT.format(number)
        folder = self.store.variants / name
        folder.make_folder()
        view = {"name": "a", "split": "train", "tag": "HR", "width": side, "height": side}
        test = view | {"name": "b", "split": "test"}
        write_json(folder / "variant.json", {"views": [view, test]})
        write_json(folder / "report.json", {"points": 3000})
        return name

    def identity(
        self, variant: str, steps: int, weight: float = 0.0, budget: float = 0.0, every: int = 0
    ) -> dict[str, Any]:
        given = self.conf.components
        parts = replace(
            given,
            consistency=replace(given.consistency, weight=weight),
            natural_selection=replace(given.natural_selection, budget=budget),
        )
        train = replace(self.conf.train, steps=steps, evaluate_every=every)
        return cell_identity(replace(self.conf, train=train, components=parts), variant)

    def add(
        self,
        identity: dict[str, Any],
        seconds: float,
        *,
        threads: int = 1,
        rss: float = 1e9,
        disk: int = 1000,
        gaussians: int = 100_000,
        overhead: float | None = None,
        **provenance: Any,
    ) -> None:
        folder = self.store.cell(f"cell{self.written:04d}").folder
        self.written += 1
        folder.make_folder()
        summary = {"training_time_s": seconds, "peak_rss_bytes": rss, "gaussians": gaussians}
        started = datetime(2026, 1, 1, tzinfo=UTC)
        write_json(folder / "identity.json", identity)
        write_json(folder / "summary.json", summary)
        provenance |= {"threads": threads, "started": started.isoformat()}
        write_json(folder / "provenance.json", provenance)
        write_json(folder / "status.json", {"files": {"splats.ply": {"bytes": disk}}})
        if overhead is not None:
            end = started.timestamp() + seconds + overhead
            os.utime(folder.path / "status.json", (end, end))


@pytest.fixture
def past(tmp_path: Path, compose: Callable[..., Conf]) -> Past:
    return Past(tmp_path / "s", compose("splat.backend=torch", "train.steps=100"))


def cost(past: Past, identity: dict[str, Any], threads: int = 1) -> Any:
    steps, every = identity["train"]["steps"], identity["train"]["evaluate_every"]
    train = replace(past.conf.train, steps=steps, evaluate_every=every)
    conf = replace(past.conf, train=train)
    found = CostEstimator(past.store).cost(conf, identity["variant"], identity, threads)
    assert found is not None
    return found


def test_cells_like_it_decide(past: Past) -> None:
    variant = past.variant(0)
    for _ in range(8):
        past.add(past.identity(variant, 100), 40.0, rss=2e9, disk=5_000_000, overhead=9.0)
    found = cost(past, past.identity(variant, 100))
    assert found.training_s == pytest.approx(40.0, rel=0.05)
    assert found.seconds == pytest.approx(49.0, rel=0.1)
    assert found.memory_bytes == pytest.approx(2e9, rel=0.1)
    assert found.disk_bytes == pytest.approx(5e6, rel=0.15)


@pytest.mark.parametrize("left_out", range(4))
def test_a_new_variant_is_within_a_factor_of_1_5(past: Past, left_out: int) -> None:
    """Four scenes, that differ in size and by themselves, and two programs: one scene is new."""
    own = (0.9, 1.1, 0.95, 1.05)
    sides = (200, 300, 400, 500)

    def truth(scene: int, weight: float) -> float:
        return (
            10.0 * own[scene] * float((sides[scene] ** 2 / 6e4) ** 0.9) * (1.6 if weight else 1.0)
        )

    variants = [past.variant(number, side) for number, side in enumerate(sides)]
    for scene, variant in enumerate(variants):
        for weight in (0.0, 0.5):
            if scene != left_out:
                past.add(past.identity(variant, 100, weight=weight), truth(scene, weight))
    for weight in (0.0, 0.5):
        found = cost(past, past.identity(variants[left_out], 100, weight=weight)).training_s
        assert 1 / 1.5 < found / truth(left_out, weight) < 1.5


def test_a_cell_on_more_threads_or_with_more_steps_is_scaled(past: Past) -> None:
    variant = past.variant(0)
    past.add(past.identity(variant, 1000), 100.0, threads=1)
    one = cost(past, past.identity(variant, 1000)).training_s
    assert 0.5 < cost(past, past.identity(variant, 1000), threads=2).training_s / one < 0.7
    assert 2 < cost(past, past.identity(variant, 2000)).training_s / one < 2.4


def test_times_are_those_of_this_processor(past: Past, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twenty cells of a slow processor, the newest ones, and four of a fast one."""
    identity = past.identity(past.variant(0), 100)
    for number in range(24):
        here = number < 4
        cpu, seconds = ("fast", 10.0) if here else ("slow", 30.0)
        past.add(identity, seconds, rss=2e9, cpu=cpu, instruction_set="avx2")
    for _ in range(20):  # of both in turn: they tell nothing of either
        past.add(identity, 30.0, rss=2e9, cpu="fast", machines_in_turn=["fast", "slow"])
    for cpu, seconds in (("fast", 10.0), ("slow", 30.0)):
        monkeypatch.setattr(estimate, "this_processor", lambda _, cpu=cpu: f"{cpu}, avx2")
        found = cost(past, identity)
        assert found.training_s == pytest.approx(seconds, rel=0.2)
        assert found.memory_bytes == pytest.approx(2e9, rel=0.05)


def test_a_budget_that_no_cell_had_limits_the_disk(past: Past) -> None:
    """Files of 250 bytes for a Gaussian, in cells that a budget limited and in one that none did.

    The views have 90,000 pixels.
    """
    variant = past.variant(0)
    for budget, count in ((0.0, 160_000), (0.5, 45_000)):
        identity = past.identity(variant, 100, budget=budget)
        past.add(identity, 40.0, gaussians=count, disk=250 * count)
    found = cost(past, past.identity(variant, 100, budget=0.2)).disk_bytes
    assert found == pytest.approx(250 * 18_000, rel=0.2)
    free = cost(past, past.identity(variant, 100, weight=1.0)).disk_bytes
    assert free == pytest.approx(250 * 160_000, rel=0.2)


def test_evaluations_amid_training_take_time_beside_it(past: Past) -> None:
    variant = past.variant(0)
    for _ in range(3):
        past.add(past.identity(variant, 100), 40.0, overhead=5.0)
        past.add(past.identity(variant, 100, every=10), 40.0, overhead=50.0)
    few, many = (cost(past, past.identity(variant, 100, every=every)) for every in (50, 10))
    assert 40 < many.seconds - many.training_s < 60
    assert 5 < few.seconds - few.training_s < 14  # two of them
    assert 2 < many.scoring_s < 10


def test_an_empty_store_gives_the_prior_and_torch_is_slower(
    past: Past, compose: Callable[..., Conf]
) -> None:
    nothing = CostEstimator(past.store)
    assert nothing.known == 0
    torch = nothing.cost(past.conf, None, None, 1)
    assert torch is not None
    assert 10 < torch.training_s < 1000  # 100 steps of 504 px, at about a second each
    native = compose("train.steps=100")
    if cell_identity(native, "")["splat"]["backend"] == "native":
        found = nothing.cost(native, None, None, 1)
        assert found is not None
        assert torch.training_s / found.training_s == pytest.approx(TORCH_SLOWDOWN)


def test_before_the_variant_is_built_the_config_tells_the_size(
    past: Past, compose: Callable[..., Conf]
) -> None:
    nothing = CostEstimator(past.store)

    def seconds(*overrides: str) -> float:
        given = compose("splat.backend=torch", "train.steps=100", *overrides)
        found = nothing.cost(given, None, None, 1)
        return math.nan if found is None else found.training_s

    mixed = 0.3 + 0.7 / 25  # of the pixels of an HR view, in the mean
    base = seconds("variant.long_side=400")
    assert seconds("variant.long_side=800") / base == pytest.approx(4**0.8)
    assert seconds("variant.long_side=400", "train.views=all_hr") / base == pytest.approx(
        (1 / mixed) ** 0.8
    )
    assert seconds("variant.long_side=400", "variant.degradation=jpeg") / base == pytest.approx(
        (1 / mixed) ** 0.8
    )
    assert math.isnan(seconds("variant.long_side=0"))


@pytest.mark.parametrize("spoilt", ["identity.json", "summary.json", "provenance.json"])
def test_malformed_cells_are_left_out(past: Past, spoilt: str) -> None:
    variant = past.variant(0)
    past.add(past.identity(variant, 100), 40.0)
    past.add(past.identity(variant, 100), 40.0)
    file = past.store.cell("cell0001").folder / spoilt
    file.unlink()
    write_json(file, {"training_time_s": "soon", "started": 3, "splat": []})
    estimator = CostEstimator(past.store)
    assert estimator.known == 1
    assert cost(past, past.identity(variant, 100)).training_s == pytest.approx(40, rel=0.1)


def test_a_store_of_a_stranger_costs_neither_memory_nor_time(past: Past) -> None:
    variant = past.variant(0)
    for number in range(3):
        identity = past.identity(variant, 100)
        identity["splat"] |= {f"{number}-{key}": key for key in range(6000)}
        identity["train"] |= {"steps": 10**18}
        past.add(identity, 1e30)
    estimator = CostEstimator(past.store)
    assert estimator.known <= 1
    assert math.isfinite(cost(past, past.identity(variant, 100)).training_s)


def test_a_store_that_was_copied_does_not_tell_the_time_beside_training(past: Past) -> None:
    variant = past.variant(0)
    past.add(past.identity(variant, 100), 40.0)  # its status is dated now, years after its start
    found = cost(past, past.identity(variant, 100))
    assert found.seconds - found.training_s < 60
