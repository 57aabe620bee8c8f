"""The training loop: deterministic, and the baseline is the program without components."""

from __future__ import annotations

import dataclasses
import inspect
import math
import re
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from tests.conftest import composed as compose
from tests.conftest import ramps
from tests.training.conftest import masked, same
from xrgs.config import CONF_DIR, TRAINING_VIEWS, Conf
from xrgs.splat.gaussians import ActivatedGaussians, Gaussians
from xrgs.splat.loss import photometric_loss, prepare_target
from xrgs.splat.optimizer import SplatOptimizer
from xrgs.splat.rendering import rasterize_parameters
from xrgs.splat.settings import DensifySettings, OptimizerSettings, RasterSettings
from xrgs.splat.strategy.default import DefaultStrategy
from xrgs.training import components, recorder
from xrgs.training.checkpoint import Checkpoint
from xrgs.training.components import Step, base
from xrgs.training.count_matching import train_cell
from xrgs.training.dataset import Dataset
from xrgs.training.loop import train
from xrgs.training.recorder import TrainingResult
from xrgs.training.sampler import EpochSampler
from xrgs.training.seeding import seeded_generator

#: Ablations that do only what others do, or change no more than what others weigh. A dense start
#: is off by itself on views of 12 px; tests/training/dense has its scenes.
COVERED = {
    *("baseline", "dense", "fast", "lean", "plus", "tuned_baseline"),
    *("xrgs", "xrgs_own_threshold", "xrgs_per_class", "densify_per_class", "exposure_gain"),
    *("adaptive_weighting", "continuous_weighting", "hybrid_schedule", "loss_weighting"),
}
#: Every other file of `conf/ablation` that changes how training goes, not what is trained on.
ABLATIONS = sorted(
    {path.stem for path in (CONF_DIR / "ablation").glob("*.yaml")} - COVERED - set(TRAINING_VIEWS)
)
#: The ablations that `plus` is made of.
IN_PLUS = set(OmegaConf.load(CONF_DIR / "ablation" / "plus.yaml").defaults)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bits_and_another_does_not(
    data: Dataset, backend: str
) -> None:
    conf = compose("train.steps=6", "splat.densify.every=5000", f"splat.backend={backend}")
    first, second = train(data, conf), train(data, conf)
    assert len(first.gaussians) != 60  # densification took part
    assert same(first.gaussians, second.gaussians)
    assert first.history == second.history
    other = train(data, dataclasses.replace(conf, seed=1))
    assert not same(first.gaussians, other.gaussians)


def plain_loop(data: Dataset, conf: Conf) -> Gaussians:
    """gsplat's training written out for a config without components, densified every fifth step."""
    steps, seed = conf.train.steps, conf.seed
    gaussians = Gaussians.from_points(
        data.points,
        data.colors,
        init_opacity=0.1,
        sh_degree=3,
        generator=seeded_generator(seed, "init"),
    )
    optimizer = SplatOptimizer(
        gaussians, OptimizerSettings(), scene_scale=data.scene_scale, steps=steps, backend="auto"
    )
    strategy = DefaultStrategy(
        optimizer,
        DensifySettings(start=0, stop=steps // 2, every=5, reset_every=steps // 3),
        scene_scale=data.scene_scale,
        generator=seeded_generator(seed, "densify"),
    )
    for step in EpochSampler(data.train, seed, steps, lambda _: True):
        camera, degree = step.view.camera, min(step.number, 3)
        offset = torch.zeros(len(gaussians), 2, requires_grad=True)
        render = rasterize_parameters(
            *gaussians.activated(backend="auto"),
            camera,
            RasterSettings(),
            sh_degree=degree,
            means2d_offset=offset,
            backend="auto",
        )
        target = prepare_target(step.view.image)
        loss = photometric_loss(render.image, target, l1=0.8, ssim=0.2, backend="auto")
        optimizer.zero_grad()
        torch.autograd.backward(loss)
        optimizer.step(camera, sh_degree=degree)
        strategy.after_step(
            step.number, offset.grad, render.visible, width=camera.width, height=camera.height
        )
    return gaussians


def test_the_baseline_is_a_plain_loop(data: Dataset) -> None:
    schedule = ["splat.densify.every=5000", "splat.densify.reset_every=10000"]
    conf = compose("preset=paper", "train.steps=30", "seed=3", "splat.backend=auto", *schedule)
    expected = plain_loop(data, conf)
    assert len(expected) > 100  # densification took part
    assert same(train(data, conf).gaussians, expected)


class HookRecorder(components.Component):
    """Asserts that it knows the number of Gaussians, and bakes black ones."""

    def __init__(self) -> None:
        self.sizes: list[int] = []

    def before_render(self, activated: ActivatedGaussians, step: Step) -> ActivatedGaussians:
        assert len(activated.means) == self.sizes[-1]
        return activated

    def on_gaussians_changed(self, gaussians: Gaussians) -> None:
        self.sizes.append(len(gaussians))

    def bake(self, gaussians: Gaussians) -> None:
        gaussians.sh0.data.zero_()

    def after_training(self, gaussians: Gaussians) -> None:
        assert (gaussians.sh0 == 0).all()


class CallRecorder(components.Component):
    """Records the calls of every hook, and the number of the step; removes a Gaussian a step."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, int | None]] = []

    def to_prune(self, gaussians: Gaussians, step: Step) -> torch.Tensor:
        self.calls.append(("to_prune", step.number))
        return torch.arange(len(gaussians)) == 0


def _recording(name: str, hook: Callable[..., Any]) -> Callable[..., Any]:
    def record(self: CallRecorder, *arguments: Any) -> Any:
        numbers = [value.number for value in arguments if isinstance(value, Step)]
        self.calls.append((name, numbers[0] if numbers else None))
        return hook(self, *arguments)

    return record


for _name, _hook in vars(components.Component).items():
    if inspect.isfunction(_hook) and _name not in vars(CallRecorder):
        setattr(CallRecorder, _name, _recording(_name, _hook))


def test_hooks_are_called_in_the_documented_order(data: Dataset) -> None:
    """At a step that refines within a budget, resets opacities and prunes for a component."""
    conf = compose("train.steps=2", "splat.densify.start=0", "splat.densify.grow_grad2d=0")
    densify = conf.splat.densify
    densify.every = densify.reset_every = 1
    densify.stop, densify.budget = 30_000, 0.02  # 72 Gaussians, of 120 that would be there
    recorder = CallRecorder()
    train(data, conf, extra_components=[recorder])
    names = [name for name, _ in recorder.calls]
    assert names[:3] == ["densification_groups", "before_training", "on_gaussians_changed"]
    assert names[-2:] == ["bake", "after_training"]
    begin = next(place for place, (_, number) in enumerate(recorder.calls) if number == 1)
    documented = re.findall(r"^\d+\. `(\w+)`", inspect.getdoc(base) or "", re.MULTILINE)
    assert names[begin:-2] == documented


@pytest.mark.slow
def test_evaluation_changes_no_bit_takes_no_time_and_sees_what_would_be_saved(
    data: Dataset, short: Conf, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Hooks see the Gaussians of the step, with an evaluation or without one."""
    hooks = HookRecorder()
    plain = train(data, short, extra_components=[hooks])
    # The hook was called after every refinement, or the sizes would not agree.
    assert len(set(hooks.sizes)) > 3
    assert (plain.gaussians.sh0 == 0).all()  # the result is what `bake` made of the Gaussians
    now, seen = [0.0], list[int]()
    monkeypatch.setattr(recorder, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    short.train.evaluate_every = 10

    class Clock(components.Component):
        def after_backward(self, gaussians: Gaussians, step: Step) -> None:
            now[0] += 1.0

    def evaluate(gaussians: Gaussians) -> dict[str, float | None]:
        now[0] += 1000.0
        seen.append(len(gaussians))
        assert (gaussians.sh0 == 0).all()  # `bake` was called
        gaussians.means.fill_(torch.nan)  # a copy: training does not notice
        return {"psnr": float(len(seen)), "lpips": None}

    class Written(Checkpoint):
        def save_if_due(self, step: int) -> float:
            now[0] += 100.0
            return 100.0

    result = train(data, short, Written(), [HookRecorder(), Clock()], evaluate)
    assert same(result.gaussians, plain.gaussians)
    assert plain.scores == []
    columns = ("step", "seconds", "gaussians", "psnr", "lpips")
    assert [tuple(row[name] for name in columns) for row in result.scores] == [
        (step, step, count, number, None)  # not after the last step, 40
        for number, (step, count) in enumerate(zip((10, 20, 30), seen, strict=True), 1)
    ]
    assert result.seconds == 40.0  # nor is the time of writing a checkpoint
    work = [row["evaluations"] for row in result.scores]
    assert 0 < work[0] < work[1] < work[2] < result.evaluations


class Choosing(components.Component):
    """Lets every second Gaussian grow, and removes the last three of them at some steps."""

    def __init__(self, prune_at: tuple[int, ...] = ()) -> None:
        self.prune_at = prune_at
        self.size = 0
        self.asked: list[int] = []

    def on_gaussians_changed(self, gaussians: Gaussians) -> None:
        self.size = len(gaussians)

    def may_grow(self, gaussians: Gaussians, step: Step) -> torch.Tensor:
        self.asked.append(step.number)
        assert len(gaussians) == self.size
        return torch.arange(len(gaussians)) % 2 == 0

    def to_prune(self, gaussians: Gaussians, step: Step) -> torch.Tensor | None:
        assert len(gaussians) == self.size
        if step.number not in self.prune_at:
            return None
        return torch.arange(len(gaussians)) >= len(gaussians) - 3


def test_components_choose_what_grows_and_what_goes_at_any_step(data: Dataset) -> None:
    conf = compose("train.steps=30", "splat.densify.every=5000", "splat.densify.grow_grad2d=0")
    conf.splat.densify.start, conf.splat.densify.stop = 0, 6000  # one refinement, at step 5
    conf.splat.densify.reset_every = 50_000  # never; large Gaussians would go after it
    choosing = Choosing(prune_at=(7, 10, 23))
    result = train(data, conf, extra_components=[choosing])
    last = result.history[-1]
    assert choosing.asked == [5]
    assert last["duplicated"] + last["split"] == 30  # of 60, all of them above the threshold
    assert next(row["step"] for row in result.history if row["pruned_by_components"] == 6) == 11
    rules = last["pruned_opacity"] + last["pruned_scale"] + last["pruned_non_finite"]
    assert len(result.gaussians) == 60 + 30 - rules - 9 == last["gaussians"]


def test_the_budget_counts_by_pixels_of_the_largest_view(data: Dataset) -> None:
    schedule = ("splat.densify.every=3000", "splat.densify.start=0", "splat.densify.stop=13000")
    conf = compose("train.steps=30", "splat.densify.grow_grad2d=0", *schedule)
    conf.splat.densify.budget, conf.splat.densify.prune_opacity = 0.05, 0.0
    conf.splat.densify.reset_every = 50_000  # never
    history = train(data, conf).history
    # 60 x 60 px allow 180; the refinements are at steps 3, 6, 9 and 12.
    counts = [row["gaussians"] for row in history if row["step"] in (3, 4, 7, 10, 13, 29)]
    assert counts == [60, 120, 144, 163, 180, 180]


#: Settings with which an ablation acts on few Gaussians, none of which is close to a camera.
ACTS_HERE = {
    "natural_selection": ("components.natural_selection.budget=0.01",),
    "near_limit": ("components.floaters.near_share=1.2",),
    "hr_share": ("train.hr_share=0.8",),  # half of the views are HR already
}


SHORT = ("train.steps=12", "splat.backend=auto")


@pytest.fixture(scope="module")
def plain() -> Gaussians:
    """What the baseline makes of `data` in 12 steps."""
    return train_cell(ramps(), compose(*SHORT)).gaussians


@pytest.mark.slow
@pytest.mark.parametrize("ablation", ABLATIONS)
def test_each_ablation_changes_the_result(data: Dataset, plain: Gaussians, ablation: str) -> None:
    conf = compose(*SHORT, f"+ablation={ablation}", *ACTS_HERE.get(ablation, ()))
    if conf.matched_to is not None:  # as a sweep does
        conf.components.count_matched.gaussians = round(0.8 * len(plain))
    assert not same(plain, train_cell(data, conf).gaussians)


def test_every_ablation_trains_with_plus_exposure_and_masks(data: Dataset) -> None:
    """Their 12 steps go through densification, selection and the late factor of `supersampled`."""
    others = ",".join(sorted({*ABLATIONS} - IN_PLUS - {"mcmc", "count_matched", "exposure_gain"}))
    conf = compose(*SHORT, f"+ablation=[plus,{others},xrgs_per_class,hybrid_schedule]")
    result = train(masked(data), conf)
    assert all(math.isfinite(row["loss"]) for row in result.history)
    assert len({row["exposure.gain"] for row in result.history}) > 1


class Skipping(CallRecorder):
    """Answers that no backward pass is needed at some steps, and removes no Gaussian."""

    def __init__(self, *skipped: int) -> None:
        super().__init__()
        self.skipped = skipped

    def needs_backward(self, loss: torch.Tensor, step: Step) -> bool:
        return super().needs_backward(loss, step) and step.number not in self.skipped

    def to_prune(self, gaussians: Gaussians, step: Step) -> None:  # type: ignore[override]
        return None

    def steps_of(self, hook: str) -> list[int | None]:
        return [number for name, number in self.calls if name == hook]


def test_a_skipped_step_has_no_update_and_every_component_is_asked(
    data: Dataset, short: Conf, trained: TrainingResult
) -> None:
    first, second = Skipping(3, 4), Skipping(4, 7)
    result = train(data, short, extra_components=[first, second])
    for hooks in (first, second):
        assert hooks.steps_of("needs_backward") == list(range(40))
        done = [step for step in range(40) if step not in {3, 4, 7}]
        assert hooks.steps_of("after_backward") == hooks.steps_of("densification_grad2d") == done
    totals = [row["skipped_backward"] for row in result.history[:9]]
    assert totals == [0, 0, 0, 1, 2, 2, 2, 3, 3]
    assert "skipped_backward" not in trained.history[-1]


@pytest.mark.parametrize("decide", ["per_class", "current_view"])
def test_what_changes_lr_views_alone_does_not_change_training_on_hr_views(
    data: Dataset, plain: Gaussians, decide: str
) -> None:
    # With lr_prune at 1: another value raises the reset opacity and prunes Gaussians that no HR
    # view shows.
    views = tuple(view for view in data.train if view.tag == "HR")
    data = dataclasses.replace(data, train=views)
    changes = (
        "+ablation=[loss_gradient,densify,render_scale]",
        "components.loss_weighting.stat_from=unweighted",
        f"components.densify.decide={decide}",
        "components.densify.lr_prune=1",
    )
    found = train(data, compose(*SHORT, *changes)).gaussians
    assert same(train(data, compose(*SHORT)).gaussians, found)


def test_training_continues_when_every_gaussian_is_pruned(data: Dataset, short: Conf) -> None:
    short.splat.densify.prune_opacity = 2.0
    result = train(data, short)
    assert len(result.gaussians) == 0
    assert result.history[-1]["step"] == short.train.steps - 1
