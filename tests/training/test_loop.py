"""The training loop: deterministic, and the baseline is the program without components."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable

import pytest
import torch

from xrgs.capture.dataset import USES, Dataset
from xrgs.config import CONF_DIR, Conf
from xrgs.errors import XrgsError
from xrgs.splat.gaussians import PARAMETERS, ActivatedGaussians, Gaussians
from xrgs.splat.settings import RasterSettings
from xrgs.training import components
from xrgs.training import loop as train
from xrgs.training.components import Step
from xrgs.training.loop import EpochSampler

#: All of `conf/ablation` that changes how training goes, and not what is trained on.
ABLATIONS = sorted(
    {path.stem for path in (CONF_DIR / "ablation").glob("*.yaml")} - {"baseline"} - set(USES)
)


def test_the_same_seed_gives_the_same_bits_and_another_does_not(
    data: Dataset, baseline: Conf
) -> None:
    first, second = train.train(data, baseline), train.train(data, baseline)
    assert same(first.gaussians, second.gaussians)
    assert first.history == second.history
    other = train.train(data, dataclasses.replace(baseline, seed=1))
    assert not same(first.gaussians, other.gaussians)


def test_training_lowers_the_loss(data: Dataset, baseline: Conf) -> None:
    baseline.train.steps = 80
    baseline.splat.densify.stop = 0  # the optimizer alone
    losses = [row["loss"] for row in train.train(data, baseline).history]
    assert sum(losses[-8:]) < 0.5 * sum(losses[:8])


def test_the_history_balances_what_densification_did(data: Dataset, baseline: Conf) -> None:
    trained = train.train(data, baseline)
    last = trained.history[-1]
    assert last["step"] == baseline.train.steps - 1
    grown = last["duplicated"] + last["split"]
    removed = last["pruned_opacity"] + last["pruned_scale"] + last["pruned_non_finite"]
    assert grown > 0
    # The last refinement comes before the last logged step, so the ledger must balance.
    assert last["gaussians"] == 60 + grown - removed == len(trained.gaussians)
    assert trained.evaluations > 0
    model = sum(trained.gaussians[name].nbytes for name in PARAMETERS)
    assert trained.memory_bytes > 4 * model  # parameters, gradients, two moments, and buffers


def test_components_that_change_nothing_change_no_bit(
    data: Dataset, baseline: Conf, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = train.train(data, baseline)
    idle = components.Components([components.Component()])
    monkeypatch.setattr(components, "build", lambda *_: idle)
    assert same(plain.gaussians, train.train(data, baseline).gaussians)


class Recorder(components.Component):
    """Writes down which hook was called, at which step, over how many Gaussians."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, int | None]] = []
        self.sizes: list[int] = []

    def before_render(self, activated: ActivatedGaussians, step: Step) -> ActivatedGaussians:
        self.calls.append(("activated", step.number))
        assert len(activated.means) == self.sizes[-1]
        return activated

    def pixel_weights(self, step: Step) -> torch.Tensor:
        self.calls.append(("pixel_weight", step.number))
        return torch.ones(step.view.image.shape[:2])

    def modify_loss(
        self, loss: torch.Tensor, image: torch.Tensor, gaussians: Gaussians, step: Step
    ) -> torch.Tensor:
        del gaussians
        self.calls.append(("loss", step.number))
        assert image.shape == step.view.image.shape
        return loss

    def after_backward(self, gaussians: Gaussians, step: Step) -> None:
        self.calls.append(("after_backward", step.number))
        assert gaussians.scales.grad is not None

    def densification_grad2d(self, gradient: torch.Tensor, step: Step) -> torch.Tensor:
        self.calls.append(("statistic", step.number))
        assert len(gradient) == self.sizes[-1]
        return gradient

    def on_gaussians_changed(self, gaussians: Gaussians) -> None:
        self.calls.append(("refined", None))
        self.sizes.append(len(gaussians))

    def after_training(self, gaussians: Gaussians) -> None:
        self.calls.append(("finish", None))
        gaussians.sh0.data.zero_()


def test_hooks_are_called_in_the_order_of_a_step(
    data: Dataset, baseline: Conf, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = Recorder()
    monkeypatch.setattr(components, "build", lambda *_: components.Components([recorder]))
    trained = train.train(data, baseline)
    each = ("activated", "pixel_weight", "loss", "after_backward", "statistic")
    steps = baseline.train.steps
    in_steps = [call for call in recorder.calls if call[1] is not None]
    assert in_steps == [(name, number) for number in range(steps) for name in each]
    assert recorder.calls[0] == ("refined", None)
    assert recorder.calls[-1] == ("finish", None)
    assert len(set(recorder.sizes)) > 3  # told of every refinement, or the sizes above are wrong
    assert (trained.gaussians.sh0 == 0).all()  # what `finish` makes is what is kept


def test_the_history_has_the_mean_of_what_components_note(
    data: Dataset, baseline: Conf, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Noting(components.Component):
        def modify_loss(
            self, loss: torch.Tensor, image: torch.Tensor, gaussians: Gaussians, step: Step
        ) -> torch.Tensor:
            del image, gaussians
            if step.number >= 300 and step.view.tag == "LR":
                step.log["noting.number"] = step.number
            return loss

    monkeypatch.setattr(components, "build", lambda *_: components.Components([Noting()]))
    baseline.train.steps, baseline.splat.densify.stop = 400, 0
    baseline.splat.backend = "auto"
    history = train.train(data, baseline).history
    assert len({tuple(row) for row in history}) == 1
    lr = {view.name for view in data.train if view.tag == "LR"}
    drawn = EpochSampler(data.train, baseline.seed, 400, lambda _: True)
    noted = [step.number for step in drawn if step.view.name in lr and step.number >= 300]
    for last, row in itertools.pairwise(history):
        numbers = [number for number in noted if last["step"] < number <= row["step"]]
        mean = sum(numbers) / len(numbers) if numbers else None
        assert row["noting.number"] == mean
    assert history[-1]["steps_HR"] == history[-1]["steps_LR"] == 200


def test_the_threshold_that_gives_a_count_is_found_and_kept(data: Dataset, baseline: Conf) -> None:
    plain = train.train(data, baseline)
    wanted = round(0.8 * len(plain.gaussians))
    baseline.components.count_matched.gaussians = wanted
    matched = train.train(data, baseline)
    assert abs(len(matched.gaussians) / wanted - 1) <= 0.05
    assert matched.grow_grad2d > plain.grow_grad2d == baseline.splat.densify.grow_grad2d
    baseline.components.count_matched.gaussians = 0
    baseline.splat.densify.grow_grad2d = matched.grow_grad2d
    assert same(train.train(data, baseline).gaussians, matched.gaussians)


def test_the_history_counts_by_group(data: Dataset, compose: Callable[..., Conf]) -> None:
    history = train.train(data, compose("train.steps=40", "+ablation=densify")).history
    assert len({tuple(row) for row in history}) == 1
    last = history[-1]
    assert last["grown_HR"] > 0
    assert last["grown_LR"] > 0
    grown = last["duplicated"] + last["split"]
    assert max(last["grown_HR"], last["grown_LR"]) <= grown <= last["grown_HR"] + last["grown_LR"]
    assert last["pruned_opacity_HR"] + last["pruned_opacity_LR"] == last["pruned_opacity"]


def test_a_statistic_of_nothing_grows_nothing(
    data: Dataset, baseline: Conf, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Blind(components.Component):
        def densification_grad2d(self, gradient: torch.Tensor, step: Step) -> torch.Tensor:
            del step
            return torch.zeros_like(gradient)

    monkeypatch.setattr(components, "build", lambda *_: components.Components([Blind()]))
    last = train.train(data, baseline).history[-1]
    assert last["duplicated"] == last["split"] == 0


@pytest.mark.parametrize("ablation", ABLATIONS)
def test_each_ablation_changes_the_result(
    data: Dataset, compose: Callable[..., Conf], ablation: str
) -> None:
    short = ["train.steps=20", "splat.backend=auto"]
    plain = train.train(data, compose(*short))
    conf = compose(*short, f"+ablation={ablation}")
    if conf.matched_to is not None:  # as a sweep would
        conf.components.count_matched.gaussians = round(0.8 * len(plain.gaussians))
    changed = train.train(data, conf)
    assert not same(plain.gaussians, changed.gaussians)


@pytest.mark.parametrize(
    "relief",
    ["adaptive_weighting.texture=0.3", "region_weighting.texture=0.3", "hybrid_schedule.ramp=5000"],
)
def test_each_relief_changes_what_weighting_does(
    data: Dataset, compose: Callable[..., Conf], relief: str
) -> None:
    short = ["train.steps=20", "splat.backend=auto", "components.loss_weighting.lr_weight=0.25"]
    weighted = train.train(data, compose(*short))
    relieved = train.train(data, compose(*short, f"components.{relief}"))
    assert not same(weighted.gaussians, relieved.gaussians)


def test_what_is_kept_is_no_smaller_than_its_filter(
    data: Dataset, compose: Callable[..., Conf]
) -> None:
    smallest = {}
    for variance in (0.0, 2.0):
        conf = compose(
            "train.steps=20", "splat.backend=auto", f"components.mip.variance={variance}"
        )
        smallest[variance] = train.train(data, conf).gaussians.activated().scales.min().item()
    # The finest view has a focal length of 72 px, and sees none nearer than 1.
    assert smallest[0.0] < 2**0.5 / 72 < smallest[2.0]


@pytest.mark.parametrize(
    "changes",
    [
        ["+ablation=loss_gradient", "components.loss_weighting.stat_from=unweighted"],
        ["+ablation=densify", "components.densify.lr_prune=1"],
        [
            "+ablation=densify",
            "components.densify.decide=current_view",
            "components.densify.lr_prune=1",
        ],
        ["+ablation=render_scale"],
    ],
    ids=["loss_gradient", "per_class", "current_view", "render_scale"],
)
def test_what_is_for_lr_views_leaves_hr_views_alone(
    data: Dataset, compose: Callable[..., Conf], changes: list[str]
) -> None:
    # With lr_prune 1: else what no HR view draws is pruned sooner, and the reset is higher.
    views = tuple(view for view in data.train if view.tag == "HR")
    data = dataclasses.replace(data, train=views)
    short = ["train.steps=20", "splat.backend=auto"]
    plain = train.train(data, compose(*short))
    assert same(plain.gaussians, train.train(data, compose(*short, *changes)).gaussians)


def test_training_goes_on_when_every_gaussian_is_pruned(data: Dataset, baseline: Conf) -> None:
    baseline.splat.densify.prune_opacity = 2.0
    trained = train.train(data, baseline)
    assert len(trained.gaussians) == 0
    assert trained.history[-1]["step"] == baseline.train.steps - 1


def test_the_sh_bands_come_on_in_turn(
    data: Dataset, baseline: Conf, monkeypatch: pytest.MonkeyPatch
) -> None:
    degrees = []
    real = train.rasterize

    def spy(*arguments: object, sh_degree: int, **rest: object) -> object:
        degrees.append(sh_degree)
        return real(*arguments, sh_degree=sh_degree, **rest)

    monkeypatch.setattr(train, "rasterize", spy)
    baseline.train.steps = 60
    train.train(data, baseline)
    assert degrees == [min(step // 2, 3) for step in range(60)]


def names_of(data: Dataset, steps: int, trains_on: Callable[[Step], bool]) -> list[str]:
    drawn = list(EpochSampler(data.train, 0, steps, trains_on))
    assert [(step.number, step.total) for step in drawn] == [(n, steps) for n in range(steps)]
    return [step.view.name for step in drawn]


def test_every_view_is_seen_once_before_any_is_seen_twice(data: Dataset) -> None:
    names = names_of(data, 40, lambda _: True)
    rounds = [tuple(names[start : start + 4]) for start in range(0, 40, 4)]
    assert all(sorted(r) == ["v0", "v1", "v2", "v3"] for r in rounds)
    assert len(set(rounds)) > 1


def test_a_view_that_is_refused_is_not_drawn(data: Dataset) -> None:
    names = names_of(data, 40, lambda step: step.number >= 20 or step.view.name in {"v1", "v3"})
    assert all(sorted(names[start : start + 2]) == ["v1", "v3"] for start in range(0, 20, 2))
    assert all(sorted(names[s : s + 4]) == ["v0", "v1", "v2", "v3"] for s in range(20, 40, 4))


def test_a_view_refused_in_the_middle_of_a_round_is_passed_over(data: Dataset) -> None:
    names = names_of(data, 40, lambda step: step.number < 2 or step.view.name != "v2")
    assert "v2" not in names[2:]
    assert len(set(names[:5])) >= 3


def test_where_every_view_is_refused_it_is_an_error(data: Dataset) -> None:
    with pytest.raises(XrgsError, match=r"step 7: the components leave no view to train on"):
        names_of(data, 40, lambda step: step.number < 7)


def test_a_splat_keeps_its_activated_ranges(data: Dataset, baseline: Conf) -> None:
    _, _, scales, opacities, _, _ = train.train(data, baseline).gaussians.activated()
    assert (scales > 0).all()
    assert ((opacities >= 0) & (opacities <= 1)).all()
    assert RasterSettings().sh_degree == 3


def same(first: Gaussians, second: Gaussians) -> bool:
    return all(torch.equal(first[name], second[name]) for name in PARAMETERS)
