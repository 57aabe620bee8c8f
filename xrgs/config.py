"""The schema of an experiment: every field, its type and its meaning.

The values live in `conf/`: `conf/config.yaml` is the baseline with every component present and off.
The model's own fields are in `xrgs.splat.settings`, which knows nothing of experiments.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, is_dataclass
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from xrgs.errors import XrgsError
from xrgs.safeio import untrusted
from xrgs.splat.backend import CHOICES
from xrgs.splat.settings import DensifySettings, OptimizerSettings, RasterSettings

_HERE = Path(__file__).parent
#: `conf/` is inside the package in a wheel and beside it in a checkout.
CONF_DIR = _HERE / "conf" if (_HERE / "conf").is_dir() else _HERE.parent / "conf"

#: Backslashes before it are an escape.
_INTERPOLATION = re.compile(r"(\\*)\$\{")
_RETRY = ("none", "failed")


@dataclass
class SceneConf:
    """Where the photographs come from."""

    name: str = MISSING
    """Label in tables."""
    kind: str = MISSING
    """`procedural`, `motorcycle` or `folder` (a module of `xrgs.capture.scenes`)."""
    path: str | None = None
    """Of `folder`: the folder of images, or an LLFF scene (images/, images_4/, images_8/)."""
    views: int = 24
    """Of `procedural`: how many."""


@dataclass
class SfmConf:
    """How COLMAP is run on the mixed images."""

    lr_images: str = MISSING
    """`upsampled`: LR images are brought to HR size for SIFT only. `native`: files as they are."""
    max_num_features: int = MISSING
    """Per image; 0 chooses by the number of images so that exhaustive matching stays quick."""
    init_min_tri_angle: float = MISSING
    """Degrees between the first two views; COLMAP's 16 fails on forward-facing scenes."""
    min_registered: float = MISSING
    """Share of the views that must register, else the next fallback is tried."""
    seed: int = MISSING
    camera: str = MISSING
    """`single`, `per_image`, or `auto`: one for photographs of the same size, make, model and focal
    length; those without EXIF share one where all have one size, and else have one each."""
    first_octave: int | None = MISSING
    """Of SIFT: 0, -1 for twice the resolution; null takes -1 up to 640 px."""
    min_inliers: int = MISSING
    """Points that place a view; the first pair needs 10/3 of it, as in COLMAP (30 and 100)."""
    fallbacks: bool = MISSING
    """Try other recipes, as `xrgs.capture.placing` orders them, where this one places too few."""
    reference: bool = MISSING
    """Place the undegraded photographs too, to tell how far off the mixed poses are; not where
    exact cameras are known or nothing is degraded."""


@dataclass
class VariantConf:
    """The mixed-resolution dataset made of a scene."""

    long_side: int = MISSING
    """Longer side of the largest HR view, px; 0 keeps the photographs' size. All are shrunk by one
    scale, so that differing photographs keep their relative sampling rates."""
    factor: int = MISSING
    """How many times smaller an LR view is, and across what the consistency loss compares; HR
    views are cropped to a multiple of it."""
    hr_fraction: float = MISSING
    """Share of the training views that are HR."""
    min_hr: int = MISSING
    """At least this many of them."""
    selection: str = MISSING
    """Of `tags=flag`: `random` (seeded) or `uniform` (evenly spaced)."""
    test_every: int = MISSING
    """Every n-th view is held out, from the first; 0 trains on all and tests on the same poses."""
    seed: int = MISSING
    """Of the selection. Not the training's: all seeds of a study share one variant."""
    tags: str = MISSING
    """Which views are HR: `flag` (the selection's), or those of most `megapixels`, of least
    `distance` from what they show, or of the highest `sampling_rate` (focal px over depth)."""
    hr_above: float = MISSING
    """Of the latter three: HR from this share of the best view's value on; 0 goes by hr_fraction.
    Values: pixels, 1 / distance, sampling rate."""
    degradation: str = MISSING
    """Of LR views: `downsample`, `digital_zoom` (down, then up again: same size, no detail),
    `jpeg` or `none`; `auto` is downsample with `tags=flag` and none with the others."""
    jpeg_quality: int = MISSING
    """Of `jpeg`: 1 to 95."""
    sfm: SfmConf = field(default_factory=SfmConf)


@dataclass
class SplatConf:
    """The model and its optimisation."""

    raster: RasterSettings = field(default_factory=RasterSettings)
    optimizer: OptimizerSettings = field(default_factory=OptimizerSettings)
    densify: DensifySettings = field(default_factory=DensifySettings)
    sh_every: int = MISSING
    """Steps of a 30,000-step run after which one more SH band is switched on."""
    init_opacity: float = MISSING
    ssim_weight: float = MISSING
    """Weight of 1 - SSIM in the loss; L1 has the rest."""
    backend: str = MISSING
    """`native`, `torch`, or `auto`: native where the extension was built."""


@dataclass
class TrainConf:
    """How long to train."""

    steps: int = MISSING
    """One view a step. Every schedule is written for 30,000 steps and scales with this."""
    views: str = MISSING
    """`mixed`: all, as the variant has them. The controls: `all_hr`, the originals in place of the
    degraded ones; `hr_only` and `lr_only`, those of one tag."""


@dataclass
class LossWeightingConf:
    """Resolution-aware loss weighting (paper 5.2)."""

    lr_weight: float = MISSING
    """Factor of the whole loss of an LR view; 1 is off."""
    stat_from: str = MISSING
    """What densification reads of a view's image-plane gradient: `weighted`, as the weighted loss
    gives it, or `unweighted`. Open in the paper, whose formula gives the former."""


@dataclass
class GradientScalingConf:
    """Gradient scaling for Gaussian radii (paper 5.3)."""

    lr_scale: float = MISSING
    """Factor of the gradient of the log-scales in LR views; 1 is off."""


@dataclass
class DensifyConf:
    """Resolution-aware densification and pruning (paper 5.4)."""

    decide: str = MISSING
    """Who sets the thresholds: `nobody` (off: all views alike), `per_class` or `current_view`. Open
    in the paper; see `xrgs.training.components.densify`."""
    lr_grow: float = MISSING
    """Times `splat.densify.grow_grad2d`: the threshold of LR views; HR views have that itself. The
    paper has threshold_HR < threshold_LR, and leaves both open."""
    lr_prune: float = MISSING
    """Times `splat.densify.prune_opacity`, likewise."""


@dataclass
class CurriculumConf:
    """LR-only warm-up (paper 5.5)."""

    lr_only: float = MISSING
    """Steps of a 30,000-step run in which LR views alone are trained on; 0 is off. Open in the
    paper whether densification rests meanwhile: here it goes on."""


@dataclass
class RenderScaleConf:
    """Resolution-aware rendering (paper 5.7 and 6.3)."""

    gamma: float = MISSING
    """Scales of LR views x (R_max / R)^gamma, R the view's longer side in px; 0 is off. Open in the
    paper are k(R), its values, and what R is."""


@dataclass
class ConsistencyConf:
    """Cross-resolution consistency loss (paper 5.6)."""

    weight: float = MISSING
    """w of the paper; 0 is off."""
    l1: float = MISSING
    ssim: float = MISSING
    lr_mode: str = MISSING
    """LR views: `exact` (both upsampled), `fold` (its L1 part by weight alone) or `off`."""


@dataclass
class AdaptiveWeightingConf:
    """LR views weigh the more, the less texture the scene has (paper 7.2, 1)."""

    texture: float = MISSING
    """Mean gradient of the LR views, intensity a px, from which they weigh no more than loss
    weighting has it; 0 is off."""


@dataclass
class RegionWeightingConf:
    """Smooth or HR-less regions of LR views keep their full weight (paper 7.2, 2)."""

    texture: float = MISSING
    """Gradient, intensity a px, from which a region that an HR view covers weighs no more than loss
    weighting has it; 0 is off."""


@dataclass
class HybridScheduleConf:
    """LR views come back to their full weight after densification (paper 7.2, 3)."""

    ramp: int = MISSING
    """Steps of a 30,000-step run that it takes them, from `splat.densify.stop` on; 0 is off."""


@dataclass
class ContinuousWeightingConf:
    """A view's weight from its sampling rate, in place of loss weighting's (paper, conclusion)."""

    gamma: float = MISSING
    """Power of the view's rate over the finest view's; 0 is off. Open in the paper."""


@dataclass
class MipConf:
    """Mip-Splatting's 3D smoothing filter; not in the paper."""

    variance: float = MISSING
    """Of the filter, px^2 of the finest view that sees a Gaussian; 0 is off."""
    every: int = MISSING
    """Steps after which the rates are found anew."""


@dataclass
class CountMatchedConf:
    """The baseline with as many Gaussians as another cell (`conf/ablation/count_matched.yaml`)."""

    gaussians: int = MISSING
    """How many; 0 is off. A sweep fills it in from the cell that `matched_to` names."""
    tolerance: float = MISSING
    """Relative, of that number."""


@dataclass
class ComponentsConf:
    """The components of XR-GS, each the identity in the baseline."""

    loss_weighting: LossWeightingConf = field(default_factory=LossWeightingConf)
    gradient_scaling: GradientScalingConf = field(default_factory=GradientScalingConf)
    densify: DensifyConf = field(default_factory=DensifyConf)
    curriculum: CurriculumConf = field(default_factory=CurriculumConf)
    render_scale: RenderScaleConf = field(default_factory=RenderScaleConf)
    consistency: ConsistencyConf = field(default_factory=ConsistencyConf)
    adaptive_weighting: AdaptiveWeightingConf = field(default_factory=AdaptiveWeightingConf)
    region_weighting: RegionWeightingConf = field(default_factory=RegionWeightingConf)
    hybrid_schedule: HybridScheduleConf = field(default_factory=HybridScheduleConf)
    continuous_weighting: ContinuousWeightingConf = field(default_factory=ContinuousWeightingConf)
    mip: MipConf = field(default_factory=MipConf)
    count_matched: CountMatchedConf = field(default_factory=CountMatchedConf)
    plugins: dict[str, Any] = field(default_factory=dict)
    """The settings of components that other installed packages provide, by the names of their entry
    points in the group `xrgs.components`. A name that is not here is never imported. See
    `examples/new_component`."""


@dataclass
class LimitsConf:
    """What a cell may take before it is ended and counts as failed; 0 is no limit."""

    minutes: float = MISSING
    """From its start to its end, training and evaluation."""
    memory_gb: float = MISSING
    """Resident, of its process and the children of that; 1 GB is 10^9 bytes."""


@dataclass
class Conf:
    """One cell of a study, and how to run it."""

    scene: SceneConf = field(default_factory=SceneConf)
    variant: VariantConf = field(default_factory=VariantConf)
    splat: SplatConf = field(default_factory=SplatConf)
    train: TrainConf = field(default_factory=TrainConf)
    components: ComponentsConf = field(default_factory=ComponentsConf)
    matched_to: str | None = None
    """Ablation whose number of Gaussians a sweep puts in `components.count_matched.gaussians`."""
    seed: int = MISSING
    store: str = MISSING
    """Folder of everything that is kept: variants, cells, reports."""
    data_root: str = MISSING
    """Folder that `scene=llff/...` looks in."""
    threads: int = MISSING
    """Of a cell; 0 takes every core this process may use."""
    checkpoint_s: float = MISSING
    """Seconds between two checkpoints of a cell in training, from which it goes on where it was
    killed; 0 writes none."""
    limits: LimitsConf = field(default_factory=LimitsConf)
    retry: str = MISSING
    """`failed` runs failed cells again; `none` reports them and leaves them."""
    fail_fast: bool = MISSING
    """Start no further cell after the first that fails."""
    dry_run: bool = MISSING
    """Print the plan and stop."""


def register() -> None:
    """Give Hydra the schema that `conf/config.yaml` is checked against."""
    ConfigStore.instance().store(name="xrgs_schema", node=Conf)


def to_conf(cfg: DictConfig) -> Conf:
    """A composed Hydra config as plain dataclasses, every value present and of its type.

    Raises:
        OmegaConfBaseException: a value is missing or of another type; the message names its key.
        XrgsError: a value is out of its range; the message names its key.
    """
    # The schema is in the config's own defaults, so that its nodes are checked and typed already:
    # merging them into it once more takes twenty times as long, and a plan composes many.
    conf = Conf(**{name: _as_object(cfg, name) for name in Conf.__dataclass_fields__})
    _check_known(conf, "")
    _check_plugins(conf.components)
    least_values = (
        ("train.steps", conf.train.steps, 1),
        ("threads", conf.threads, 0),
        ("checkpoint_s", conf.checkpoint_s, 0),
        ("limits.minutes", conf.limits.minutes, 0),
        ("limits.memory_gb", conf.limits.memory_gb, 0),
    )
    for key, value, least in least_values:
        if not value >= least:
            raise XrgsError(f"{key}={value}: must be at least {least}")
    if conf.splat.backend not in CHOICES:
        raise XrgsError(f"splat.backend={conf.splat.backend}: must be one of {', '.join(CHOICES)}")
    if conf.retry not in _RETRY:
        raise XrgsError(f"retry={conf.retry}: must be one of {', '.join(_RETRY)}")
    return conf


def _as_object(cfg: DictConfig, name: str) -> Any:
    value = cfg[name]
    return OmegaConf.to_object(value) if OmegaConf.is_config(value) else value


def _check_known(value: Any, path: str) -> None:
    """Refuse what a `+` has added to the schema, which would be read by nobody.

    Raises:
        XrgsError: names the key.
    """
    for name, inner in vars(value).items():
        if name not in value.__dataclass_fields__:
            raise XrgsError(f"{path}{name}: there is no such key")
        if is_dataclass(inner):
            _check_known(inner, f"{path}{name}.")


def _check_plugins(components: ComponentsConf) -> None:
    """Check that every plugin's settings are a mapping; the plugin itself checks what is in it.

    Raises:
        XrgsError: One is something else; the message names its key.
    """
    for name, settings in components.plugins.items():
        if not isinstance(settings, dict):
            key = f"components.plugins.{name}"
            raise XrgsError(
                f"{key}={settings}: must be a mapping of settings, e.g. +{key}.weight=0.1"
            )


def from_dict(values: Any) -> Conf:
    """The config that `dataclasses.asdict` wrote, its texts as they are.

    A path may hold a `${`; and what a stranger writes there is not to be looked up in this
    process's environment.
    """
    conf = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(Conf), literal(values)))
    if not isinstance(conf, Conf):
        raise TypeError(f"expected a config of schema Conf, got {type(conf).__name__}")
    _check_plugins(conf.components)
    return conf


def literal(value: Any) -> Any:
    """Values in which OmegaConf finds nothing to be resolved."""
    if isinstance(value, dict):
        return {name: literal(inner) for name, inner in value.items()}
    if isinstance(value, list):
        return [literal(inner) for inner in value]
    if not isinstance(value, str):
        return value
    return _INTERPOLATION.sub(lambda found: 2 * found[1] + r"\${", value)


def from_file(file: Path) -> Conf:
    """The config that a cell's folder holds, as JSON.

    Raises:
        XrgsError: it can't be read, or is of another schema; the message names the file and key.
    """
    try:
        return from_dict(untrusted.parse_json(untrusted.read_bytes(file)))
    except OmegaConfBaseException as error:
        raise XrgsError(f"{file}: {one_line(error)} (another version's config?)") from error
    except XrgsError as error:
        raise XrgsError(f"{file}: {error}") from error
    except (OSError, ValueError, TypeError) as error:
        raise XrgsError(f"{file}: no config ({error})") from error


def one_line(error: Exception) -> str:
    """What is wrong, in one line that names the key."""
    line, key = str(error).splitlines()[0], getattr(error, "full_key", None)
    return line if not key or key in line else f"{key}: {line}"
