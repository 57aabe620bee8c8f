"""The training loop: gsplat's default training, with the hooks of the XR-GS components."""

from __future__ import annotations

import dataclasses
import time
from collections import Counter, defaultdict
from dataclasses import dataclass
from statistics import fmean
from typing import TYPE_CHECKING, Any

import torch

from xrgs.errors import XrgsError
from xrgs.runtime.progress import progress
from xrgs.safeio.hashing import digest
from xrgs.splat import gaussians as splats
from xrgs.splat.backend import resolve_backend
from xrgs.splat.densify import Densifier, Refinement
from xrgs.splat.loss import photometric_loss, prepare_target
from xrgs.splat.optimizer import SplatOptimizer
from xrgs.splat.rasterize import rasterize
from xrgs.splat.settings import NOMINAL_STEPS
from xrgs.training import components
from xrgs.training.checkpoint import Checkpoint, State
from xrgs.training.components import Step
from xrgs.training.components.count_matched import Search

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from xrgs.capture.dataset import Dataset, LoadedView
    from xrgs.config import Conf
    from xrgs.splat.gaussians import Gaussians
    from xrgs.splat.rasterize import Render
    from xrgs.training.components import Components

_LOGGED_ROWS = 200


@dataclass(frozen=True)
class Trained:
    """What training gave, and what it took."""

    gaussians: Gaussians
    history: list[dict[str, Any]]
    """One row a logged step: the step done, its view and loss, Gaussians; since the start, the
    steps on views of each tag and what each rule of densification did; since the row before, the
    mean of what components noted, None where none did. Every row has every column."""
    seconds: float
    """Of training alone: no loading, no evaluation."""
    memory_bytes: int
    """Model, gradients, optimizer and renderer buffers at the step where they were largest."""
    evaluations: int
    """Alpha evaluations of all forward passes: the work done, whatever the machine."""
    grow_grad2d: float
    """The threshold of growth that it was trained with."""


def train(data: Dataset, conf: Conf, checkpoint: Checkpoint | None = None) -> Trained:
    """Train one cell. The same dataset, config and seed give the same Gaussians, bit for bit.

    Args:
        data: What to train on.
        conf: The cell's config.
        checkpoint: Where the run keeps its state; it goes on from what was read there.

    Raises:
        CheckpointError: what was read there does not fit this cell.
        XrgsError: a component's value is out of range, or a view is too small for it.
    """
    checkpoint = checkpoint or Checkpoint()
    wanted = conf.components.count_matched.gaussians
    if not wanted:
        return _run(data, conf, checkpoint)

    def run(threshold: float) -> Trained:
        densify = dataclasses.replace(conf.splat.densify, grow_grad2d=threshold)
        splat = dataclasses.replace(conf.splat, densify=densify)
        return _run(data, dataclasses.replace(conf, splat=splat), checkpoint)

    search = Search(conf.splat.densify.grow_grad2d, wanted)
    checkpoint.keep(search=search)
    return search(run)


def _run(data: Dataset, conf: Conf, checkpoint: Checkpoint) -> Trained:
    """One run from its first step to its last."""
    steps, splat, ssim = conf.train.steps, conf.splat, conf.splat.ssim_weight
    backend = resolve_backend(splat.backend)
    optimizer, densifier, parts = _built(data, conf, backend)
    gaussians = optimizer.gaussians
    targets = {view.name: prepare_target(view.image) for view in data.train}
    sh_every = max(1, int(splat.sh_every * steps / NOMINAL_STEPS))
    drawn = EpochSampler(data.train, conf.seed, steps, parts.allows_view)

    ledger = TrainingRecorder(steps, splat.densify.grow_grad2d)
    parts.on_gaussians_changed(gaussians)
    # All that a step changes. The optimizer has the Gaussians, so it is the first to take its own.
    checkpoint.keep(
        optimizer=optimizer, densifier=densifier, components=parts, drawn=drawn, ledger=ledger
    )
    for step in progress(drawn, "training", "step", steps, done=drawn.number):
        view, camera = step.view, step.view.camera
        degree = min(step.number // sh_every, splat.raster.sh_degree)
        offset = torch.zeros(len(gaussians), 2, requires_grad=True)
        render = rasterize(
            *parts.before_render(gaussians.activated(), step),
            camera,
            splat.raster,
            sh_degree=degree,
            means2d_offset=offset,
            backend=backend,
        )
        target, weights = targets[view.name], parts.pixel_weights(step)
        loss = photometric_loss(
            render.image, target, l1=1 - ssim, ssim=ssim, pixel_weight=weights, backend=backend
        )
        loss = parts.modify_loss(loss, render.image, gaussians, step)
        optimizer.zero_grad()
        torch.autograd.backward(loss)
        parts.after_backward(gaussians, step)
        optimizer.step(camera, sh_degree=degree)
        ledger.note(step, loss, render, optimizer)
        statistic = None if offset.grad is None else parts.densification_grad2d(offset.grad, step)
        size = {"width": camera.width, "height": camera.height}
        done = densifier.after_step(step.number, statistic, render.visible, **size, group=view.tag)
        ledger.refined(done)
        if done != Refinement():
            parts.on_gaussians_changed(gaussians)
        ledger.leave_out(checkpoint.after_step(step.number))
    parts.after_training(gaussians)
    return ledger.close(gaussians)


def _built(data: Dataset, conf: Conf, backend: str) -> tuple[SplatOptimizer, Densifier, Components]:
    """What trains a cell, before its first step; the optimizer has the Gaussians."""
    splat, steps = conf.splat, conf.train.steps
    gaussians = splats.from_points(
        data.points,
        data.colors,
        init_opacity=splat.init_opacity,
        sh_degree=splat.raster.sh_degree,
        generator=stream(conf.seed, "init"),
    )
    optimizer = SplatOptimizer(
        gaussians, splat.optimizer, scene_scale=data.scene_scale, steps=steps, backend=backend
    )
    parts = components.build(conf.components, data, splat, backend)
    densifier = Densifier(
        optimizer,
        splat.densify.scaled(steps),
        scene_scale=data.scene_scale,
        generator=stream(conf.seed, "densify"),
        groups=parts.densification_groups(splat.densify),
    )
    return optimizer, densifier, parts


def stream(seed: int, axis: str) -> torch.Generator:
    """A generator of its own for each use of chance, so that what one draws moves no other."""
    return torch.Generator().manual_seed(int(digest([seed, axis])[:15], 16))


class EpochSampler:
    """`steps` steps, each time round all views in a new order.

    A view that `trains_on` refuses is passed over; one that it newly allows joins the next round.
    """

    def __init__(
        self,
        views: tuple[LoadedView, ...],
        seed: int,
        steps: int,
        trains_on: Callable[[Step], bool],
    ) -> None:
        self.views = views
        self.steps = steps
        self.trains_on = trains_on
        self.number = 0
        """Of the next step."""
        self.generator = stream(seed, "views")
        self.order: list[LoadedView] = []
        """What is left of the round, last first."""

    def __iter__(self) -> Iterator[Step]:
        return self

    def __next__(self) -> Step:
        """The next step.

        Raises:
            XrgsError: `trains_on` refuses every view.
        """
        if self.number >= self.steps:
            raise StopIteration
        while self.order and not self._allows(self.order[-1]):
            self.order.pop()
        if not self.order:
            allowed = [view for view in self.views if self._allows(view)]
            if not allowed:
                raise XrgsError(f"step {self.number}: the components leave no view to train on")
            order = torch.randperm(len(allowed), generator=self.generator).tolist()
            self.order = [allowed[i] for i in order]
        self.number += 1
        return Step(self.number - 1, self.steps, self.order.pop())

    def _allows(self, view: LoadedView) -> bool:
        return self.trains_on(Step(self.number, self.steps, view))

    def state_dict(self) -> State:
        """The next step's number, the rest of the round, and where chance stands."""
        order = [view.name for view in self.order]
        return {"number": self.number, "order": order, "generator": self.generator.get_state()}

    def load_state_dict(self, state: State) -> None:
        """Go on where `state_dict` was asked."""
        by_name = {view.name: view for view in self.views}
        self.number, self.order = int(state["number"]), [by_name[name] for name in state["order"]]
        self.generator.set_state(state["generator"])


class TrainingRecorder:
    """Keeps what a report wants to know of a run; its clock runs from the moment it is made."""

    def __init__(self, steps: int, grow_grad2d: float) -> None:
        self.started = time.perf_counter()
        self.grow_grad2d = grow_grad2d
        self.every = max(1, steps // _LOGGED_ROWS)
        self.last = steps - 1
        self.counts = Counter({"steps_HR": 0, "steps_LR": 0} | Refinement().counts())
        self.notes: defaultdict[str, list[float]] = defaultdict(list)
        self.history: list[dict[str, Any]] = []
        self.memory_bytes = 0
        self.evaluations = 0

    def note(
        self,
        step: Step,
        loss: torch.Tensor,
        render: Render,
        optimizer: SplatOptimizer,
    ) -> None:
        gaussians = optimizer.gaussians
        model = [gaussians[name] for name in splats.PARAMETERS]
        gradients = [value.grad for value in model if value.grad is not None]
        used = sum(value.nbytes for value in model + gradients)
        used += optimizer.state_bytes() + render.buffer_bytes
        self.memory_bytes = max(self.memory_bytes, used)
        self.evaluations += render.evaluations
        self.counts[f"steps_{step.view.tag}"] += 1
        for name, value in step.log.items():
            self.notes[name].append(value)
        if step.number % self.every == 0 or step.number == self.last:
            row = {"step": step.number, "view": step.view.name, "loss": loss.item()}
            means = {name: fmean(values) for name, values in self.notes.items()}
            self.history.append(row | {"gaussians": len(gaussians)} | self.counts | means)
            self.notes.clear()

    def refined(self, done: Refinement) -> None:
        self.counts.update(done.counts())

    def leave_out(self, seconds: float) -> None:
        """Just now, something else than training took so long."""
        self.started += seconds

    def state_dict(self) -> State:
        """All of it, with the seconds of training so far."""
        return {
            "seconds": time.perf_counter() - self.started,
            "counts": dict(self.counts),
            "notes": dict(self.notes),
            "history": self.history,
            "memory_bytes": self.memory_bytes,
            "evaluations": self.evaluations,
        }

    def load_state_dict(self, state: State) -> None:
        """Go on where `state_dict` was asked: the time between doesn't count."""
        self.started = time.perf_counter() - float(state["seconds"])
        self.counts = Counter(state["counts"])
        self.notes = defaultdict(list, state["notes"])
        self.history = list(state["history"])
        self.memory_bytes = int(state["memory_bytes"])
        self.evaluations = int(state["evaluations"])

    def close(self, gaussians: Gaussians) -> Trained:
        seconds = time.perf_counter() - self.started
        blank = {name: None for row in self.history for name in row} | dict.fromkeys(self.counts, 0)
        history = [blank | row for row in self.history]
        return Trained(
            gaussians,
            history,
            seconds,
            self.memory_bytes,
            self.evaluations,
            self.grow_grad2d,
        )
