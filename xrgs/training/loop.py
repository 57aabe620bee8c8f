"""The training loop: gsplat's default training, with the hooks of the XR-GS components."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import torch

from xrgs.runtime.progress import progress
from xrgs.splat.backend import device, resolve_backend
from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.splat.loss import Target, photometric_loss, prepare_target
from xrgs.splat.optimizer import SplatOptimizer
from xrgs.splat.rendering import zero_means2d_offset
from xrgs.splat.settings import NOMINAL_STEPS
from xrgs.splat.strategy.base import Refinement
from xrgs.splat.strategy.default import DefaultStrategy
from xrgs.splat.strategy.mcmc import MCMCStrategy
from xrgs.training.checkpoint import Checkpoint
from xrgs.training.components import Components
from xrgs.training.components import build as build_components
from xrgs.training.memory import OnDemand, TrainingMemory
from xrgs.training.recorder import TrainingRecorder, TrainingResult
from xrgs.training.rendering import StepRenderer, inside_mask
from xrgs.training.sampler import EpochSampler
from xrgs.training.seeding import seeded_generator

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from torch import Tensor

    from xrgs.config import Conf
    from xrgs.splat.cameras import Camera
    from xrgs.splat.rendering import Render
    from xrgs.splat.strategy.base import Strategy
    from xrgs.training.components import Component, Step, TrainingView
    from xrgs.training.dataset import Dataset

    #: Function: Gaussians -> name of a score -> its value, None if not available.
    Evaluate = Callable[[Gaussians], Mapping[str, float | None]]

#: Name in `xrgs.splat.settings.STRATEGIES` -> strategy of densification.
STRATEGIES: Mapping[str, type[Strategy]] = {"default": DefaultStrategy, "mcmc": MCMCStrategy}


def train(
    data: Dataset,
    conf: Conf,
    checkpoint: Checkpoint | None = None,
    extra_components: Iterable[Component] = (),
    evaluate: Evaluate | None = None,
) -> TrainingResult:
    """Train one configuration. The same data, config and seed give the same bits on the CPU.

    Args:
        data: The training views and the SfM points.
        conf: The config. `components.count_matched`, which needs several trainings, is ignored:
            use `xrgs.training.count_matching.train_cell` for it.
        checkpoint: Saves the state of the run. Training continues from the state that
            `Checkpoint.load` has read, if any. None saves nothing.
        extra_components: Components that run after those of the config.
        evaluate: Scores the Gaussians, as they would be saved, every `train.evaluate_every` steps
            except after the last. Its time does not count as training time.

    Returns:
        The trained Gaussians, on the CPU, and the record of the training.

    Raises:
        CheckpointError: The checkpoint does not fit this config and data.
        XrgsError: A component's value is out of range, a view is too small for a component, the
            components exclude every view, or the backend can't be used on this machine.
    """
    checkpoint = checkpoint or Checkpoint()
    run = _Run(data, conf, extra_components)
    run.components.before_training(run.renderer)
    run.components.on_gaussians_changed(run.gaussians)
    # All objects that a step changes. The optimizer is first: it restores the Gaussians, and the
    # other states must fit their number.
    checkpoint.register(
        optimizer=run.optimizer,
        strategy=run.strategy,
        components=run.components,
        sampler=run.sampler,
        recorder=run.recorder,
        memory=run.memory,
    )
    run.steps(checkpoint, evaluate)
    run.components.bake(run.gaussians)
    run.components.after_training(run.gaussians)
    return run.recorder.finish(run.gaussians.to("cpu"), run.memory.largest_bytes)


class _Views:
    """The training views as the components changed them, and their targets for the loss."""

    def __init__(self, views: Iterable[TrainingView], backend: str) -> None:
        self.backend = backend
        self.own: Mapping[str, TrainingView] = {view.name: view for view in views}
        self.present: Mapping[str, TrainingView] = {}
        self.drawn: Target | None = None
        """The target of the last step's view."""
        self.change_to(self.own)

    def change_to(self, views: Mapping[str, TrainingView]) -> None:
        """Replace the views, and compute the SSIM statistics of the new photographs."""
        if views is not self.present:
            self.present = views
            self.moments = OnDemand(self._moments, views.values())

    def target(self, view: TrainingView) -> Target:
        """Return the target of a view; an 8-bit photograph is converted to a new float tensor."""
        # Freed first, so that there is only one target in memory.
        self.drawn = None
        self.drawn = Target(view.image, *self.moments[view.name])
        return self.drawn

    def _moments(self, view: TrainingView) -> tuple[Tensor, Tensor]:
        """Return mean and variance of a view's photograph in each SSIM window (`Target`)."""
        target = prepare_target(view.image, backend=self.backend)
        return target.mean, target.variance


class _Forward(NamedTuple):
    """The result of a step's forward pass."""

    camera: Camera
    sh_degree: int
    """Highest band of the spherical harmonics that was rendered."""
    means2d_offset: Tensor
    """[N, 2] zeros, whose gradient is the image-plane gradient for densification."""
    render: Render
    loss: Tensor
    """Scalar."""


class _Run:
    """The objects of one run, and its steps."""

    def __init__(self, data: Dataset, conf: Conf, extra_components: Iterable[Component]) -> None:
        self.splat, self.train = conf.splat, conf.train
        self.backend = resolve_backend(conf.splat.backend)
        splat, steps, backend = self.splat, self.train.steps, self.backend
        first, start_seconds = _first_gaussians(data, conf, backend)
        place = device(backend)
        self.gaussians = first.to(place)
        # The points stay on the CPU, since they are used only once.
        data = replace(data, train=tuple(view.to(place) for view in data.train))
        self.optimizer = SplatOptimizer(
            self.gaussians,
            splat.optimizer,
            scene_scale=data.scene_scale,
            steps=steps,
            backend=backend,
        )
        built = build_components(conf.components, data, splat, backend, conf.seed)
        self.components = Components([*built, *extra_components])
        self.components.check_strategy(splat.strategy, STRATEGIES[splat.strategy])
        self.strategy = STRATEGIES[splat.strategy](
            self.optimizer,
            splat.densify.scaled(steps),
            scene_scale=data.scene_scale,
            generator=seeded_generator(conf.seed, "densify"),
            groups=self.components.densification_groups(splat.densify),
            view_pixels=data.view_pixels,
        )
        self.views = _Views(data.train, backend)
        # Last of what takes time, since its clock starts here.
        self.recorder = TrainingRecorder(
            steps, splat.densify.grow_grad2d, data.train, start_seconds
        )
        self.sampler = EpochSampler(
            data.train, conf.seed, steps, self.components.allows_view, self.train.hr_share
        )
        sh_every = max(1, int(splat.sh_every * steps / NOMINAL_STEPS))
        self.renderer = StepRenderer(
            self.components, splat.raster, sh_every, backend, self.recorder
        )
        holders = (self.optimizer, self.strategy, self.components, self.views, data)
        self.memory = TrainingMemory(*holders, device=place)

    def steps(self, checkpoint: Checkpoint, evaluate: Evaluate | None) -> None:
        """Run all steps that are left."""
        components, sampler, recorder = self.components, self.sampler, self.recorder
        for sampled in progress(
            sampler, "training", "step", self.train.steps, done=sampler.next_step
        ):
            self.views.change_to(components.training_views(self.views.own, sampled))
            step = replace(sampled, view=self.views.present[sampled.view.name])
            forward = self._forward(step)
            recorder.lap("forward")
            # Update the Gaussians, and record the step while its gradients and buffers still exist.
            if components.needs_backward(forward.loss, step):
                self._update(step, forward)
                self.memory.record(forward.render)
            else:
                self.optimizer.skip_step()
                recorder.record_skipped("backward")
            recorder.record_step(
                step, forward.loss, forward.render, self.gaussians, forward.sh_degree
            )
            recorder.record_refinement(self._densify(step, forward))
            components.after_step(self.gaussians, step)
            # Evaluation and checkpoints do not count as training time. The caller scores the
            # trained Gaussians.
            done, every = step.number + 1, self.train.evaluate_every
            if evaluate is not None and every and done % every == 0 and done < self.train.steps:
                recorder.record_scores(done, len(self.gaussians), partial(self._scores, evaluate))
            recorder.exclude_time(checkpoint.save_if_due(step.number))

    def _scores(self, evaluate: Evaluate) -> Mapping[str, float | None]:
        """Bake a copy of the Gaussians and score it."""
        values = {name: self.gaussians[name].detach().clone() for name in PARAMETERS}
        copy = Gaussians(**values)
        self.components.bake(copy)
        return evaluate(copy)

    def _forward(self, step: Step) -> _Forward:
        """Render the view of a step, and compute the loss against its photograph."""
        components, gaussians, ssim = self.components, self.gaussians, self.splat.ssim_weight
        camera = components.render_camera(step.view.camera, step)
        sh_degree = self.renderer.sh_degree(step)
        means2d_offset = zero_means2d_offset(len(gaussians), gaussians.means.device)
        target, kept = self.views.target(step.view), step.view.name in self.views.moments.kept
        with self.memory.of_forward(step, len(gaussians), sh_degree, kept=kept):
            render = self.renderer.render(gaussians, step, camera, means2d_offset)
            # Loss: L1 and SSIM against the photograph, then terms and weights of the components.
            image = components.match_colors(components.to_photograph(render.image, step), step)
            image = inside_mask(image, target.image, step.view.mask)
            weights = components.pixel_weights(step)
            loss = photometric_loss(
                image, target, l1=1 - ssim, ssim=ssim, pixel_weight=weights, backend=self.backend
            )
            loss = components.modify_loss(loss, image, gaussians, step)
        return _Forward(camera, sh_degree, means2d_offset, render, loss)

    def _update(self, step: Step, forward: _Forward) -> None:
        """Run the backward pass, the components' changes of gradients, and the optimizer's step."""
        self.optimizer.zero_grad()
        torch.autograd.backward(forward.loss)
        self.components.after_backward(self.gaussians, step)
        self.recorder.lap("backward")
        if not self.optimizer.moves_harmonics:
            self.recorder.record_skipped("shN")
        self.optimizer.step(forward.camera, sh_degree=forward.sh_degree)
        self.recorder.lap("optimizer")

    def _densify(self, step: Step, forward: _Forward) -> Refinement:
        """Densify, prune and reset; return the counts."""
        # None without a backward pass, or if the render shows no Gaussian.
        grad2d, visible = forward.means2d_offset.grad, forward.render.visible
        if grad2d is not None:
            if step.view.mask is not None:  # masked pixels show no Gaussian
                visible = visible & (grad2d != 0).any(dim=1)
            grad2d = self.components.densification_grad2d(grad2d, step)
        refinement = self.strategy.after_step(
            step.number,
            grad2d,
            visible,
            width=forward.camera.width,
            height=forward.camera.height,
            group=step.view.tag,
            hooks=self.components.strategy_hooks(step),
        )
        if refinement != Refinement():
            self.components.on_gaussians_changed(self.gaussians)
        to_prune = self.components.to_prune(self.gaussians, step)
        if to_prune is None or not to_prune.any():
            return refinement
        removed = self.strategy.remove(to_prune)
        self.components.on_gaussians_changed(self.gaussians)
        return replace(refinement, pruned_by_components=removed)


def _first_gaussians(data: Dataset, conf: Conf, backend: str) -> tuple[Gaussians, float]:
    """Create the first Gaussians; return them and the time of a dense start, seconds."""
    splat = conf.splat
    sparse = Gaussians.from_points(
        data.points,
        data.colors,
        init_opacity=splat.init_opacity,
        init_scale=splat.init_scale,
        sh_degree=splat.raster.sh_degree,
        generator=seeded_generator(conf.seed, "init"),
    )
    if splat.init == "sfm":
        return sparse, 0.0
    from xrgs.training.dense import dense_start  # in a cell's identity only if on

    began = time.perf_counter()
    gaussians = dense_start(data, sparse, backend, seeded_generator(conf.seed, "dense"))
    return gaussians, time.perf_counter() - began
