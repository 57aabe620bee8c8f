"""The schema of a config: every key and its type.

`conf/config.yaml` has the value, unit, source and meaning of each key; `xrgs-sweep help=KEY` prints
them. The keys of the model are declared in `xrgs.splat.settings`, which does not depend on this
module. `xrgs.composing` makes configs.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import Field, dataclass, field, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, get_type_hints

from xrgs.splat.settings import DensifySettings, OptimizerSettings, RasterSettings

_PACKAGE = Path(__file__).parent
#: Folder of the config's files: inside the package in a wheel, next to it in a checkout.
CONF_DIR = _PACKAGE / "conf" if (_PACKAGE / "conf").is_dir() else _PACKAGE.parent / "conf"

#: Allowed values of `train.views`.
TRAINING_VIEWS = ("mixed", "all_hr", "hr_only", "lr_only")
#: Config groups that an override needs a plus for, since they are not in the defaults list of
#: `conf/config.yaml`; then all config groups.
PLUS_GROUPS = ("ablation", "sweeps")
GROUPS = (*PLUS_GROUPS, "scene", "preset", "variant")
#: Keys whose values are paths, in which `~` is the user's home folder.
PATHS = ("scene.path", "scene.masks", "variant.poses", "store", "data_root")


def off(value: Any) -> Any:
    """Declare a key, and its value that means "off". At this value it is in no cell's id."""
    return field(metadata={"off": value})


@dataclass(kw_only=True)
class SceneConf:
    """The photographs."""

    name: str
    kind: str
    path: str | None
    views: int
    masks: str | None
    alpha: str
    background: tuple[float, float, float]


@dataclass(kw_only=True)
class SfmConf:
    """Structure from motion of the mixed images, by COLMAP."""

    long_side: int
    lr_images: str
    max_num_features: int
    init_min_tri_angle: float
    min_registered: float
    seed: int
    camera: str
    first_octave: int | None
    min_inliers: int
    fallbacks: bool
    reference: bool


@dataclass(kw_only=True)
class PhoneConf:
    """The degradation `phone`; not in the paper."""

    blur: float
    noise: float
    jpeg_quality: int


@dataclass(kw_only=True)
class VariantConf:
    """The mixed-resolution dataset that is made from a scene (paper, section 4.1)."""

    long_side: int
    factor: int
    hr_fraction: float
    min_hr: int
    selection: str
    test_every: int
    test: list[str]
    poses: str | None
    seed: int
    tags: str
    hr_above: float
    degradation: str
    jpeg_quality: int
    phone: PhoneConf
    sfm: SfmConf


@dataclass(kw_only=True)
class SplatConf:
    """The model, the renderer and the optimisation."""

    raster: RasterSettings
    optimizer: OptimizerSettings
    densify: DensifySettings
    strategy: str = off("default")
    init: str = off("sfm")
    sh_every: int
    init_opacity: float
    init_scale: float = off(1.0)
    ssim_weight: float
    backend: str


@dataclass(kw_only=True)
class TrainConf:
    """The length of a training, and its views."""

    steps: int
    views: str
    evaluate_every: int = off(0)
    validation: float = off(0.0)
    hr_share: float = off(0.0)


@dataclass(kw_only=True)
class LossWeightingConf:
    """Resolution-aware loss weighting (paper, section 5.2)."""

    lr_weight: float = off(1.0)
    # With an `lr_weight` of 1, continuous weighting still reads this key.
    stat_from: str = off("weighted")


@dataclass(kw_only=True)
class GradientScalingConf:
    """Gradient scaling for Gaussian radii (paper, section 5.3)."""

    lr_scale: float = off(1.0)


@dataclass(kw_only=True)
class DensifyConf:
    """Resolution-aware densification and pruning (paper, section 5.4)."""

    decide: str = off("shared")
    lr_grow: float
    lr_prune: float


@dataclass(kw_only=True)
class CurriculumConf:
    """LR-only warm-up (paper, section 5.5)."""

    lr_only: float = off(0.0)


@dataclass(kw_only=True)
class RenderScaleConf:
    """Resolution-aware rendering (paper, sections 5.7 and 6.3)."""

    gamma: float = off(0.0)


@dataclass(kw_only=True)
class SupersampledConf:
    """Coarse views rendered larger, then downsampled as their photographs; not in the paper."""

    factor: int = off(1)
    late_factor: int = off(1)
    late_from: int


@dataclass(kw_only=True)
class FormationConf:
    """Trained widths of the blur of LR photographs; not in the paper."""

    widths: str = off("none")
    lr: float
    prior: float


@dataclass(kw_only=True)
class ResolutionScheduleConf:
    """HR views at a reduced resolution early in training (DashGaussian); not in the paper."""

    start_share: float = off(1.0)
    until: int


@dataclass(kw_only=True)
class ConsistencyConf:
    """Cross-resolution consistency loss (paper, section 5.6)."""

    weight: float = off(0.0)
    l1: float
    ssim: float
    lr_mode: str


@dataclass(kw_only=True)
class AdaptiveWeightingConf:
    """Higher weight of LR views in scenes with little texture (paper, section 7.2, 1)."""

    texture: float = off(0.0)


@dataclass(kw_only=True)
class RegionWeightingConf:
    """Full weight of regions of LR views that are smooth or in no HR view (paper, 7.2, 2)."""

    texture: float = off(0.0)


@dataclass(kw_only=True)
class HybridScheduleConf:
    """Return of LR views to full weight after densification (paper, section 7.2, 3)."""

    ramp: int = off(0)


@dataclass(kw_only=True)
class ContinuousWeightingConf:
    """Loss weights by the views' sampling rates instead of their tags (paper, conclusion)."""

    gamma: float = off(0.0)


@dataclass(kw_only=True)
class MipConf:
    """Mip-Splatting's 3D smoothing filter; not in the paper."""

    variance: float = off(0.0)
    every: int


@dataclass(kw_only=True)
class NaturalSelectionConf:
    """Removal of Gaussians that fade under a constant opacity gradient (GNS); not in the paper."""

    budget: float = off(0.0)
    until: int
    drop_every: int = off(50)


@dataclass(kw_only=True)
class ExposureConf:
    """A trained colour map for each photograph; not in the paper."""

    mode: str = off("none")
    lr: float
    lr_final: float
    prior: float


@dataclass(kw_only=True)
class FloatersConf:
    """Removal of Gaussians in the empty space close to cameras; not in the paper."""

    near_share: float = off(0.0)


@dataclass(kw_only=True)
class RegularizationConf:
    """Penalties on opacities and scales (3DGS-MCMC); not in the paper."""

    opacity: float = off(0.0)
    scale: float = off(0.0)


@dataclass(kw_only=True)
class CountMatchedConf:
    """Training with the number of Gaussians of another cell (`xrgs.training.count_matching`)."""

    gaussians: int = off(0)
    tolerance: float


@dataclass(kw_only=True)
class ComponentsConf:
    """The components; each group except `plugins` has a key that switches it on."""

    loss_weighting: LossWeightingConf
    gradient_scaling: GradientScalingConf
    densify: DensifyConf
    curriculum: CurriculumConf
    render_scale: RenderScaleConf
    supersampled: SupersampledConf
    formation: FormationConf
    resolution_schedule: ResolutionScheduleConf
    consistency: ConsistencyConf
    adaptive_weighting: AdaptiveWeightingConf
    region_weighting: RegionWeightingConf
    hybrid_schedule: HybridScheduleConf
    continuous_weighting: ContinuousWeightingConf
    mip: MipConf
    natural_selection: NaturalSelectionConf
    exposure: ExposureConf
    floaters: FloatersConf
    regularization: RegularizationConf
    count_matched: CountMatchedConf
    # `off` declares no default, so that instances share no dict.
    plugins: dict[str, Any] = off({})  # noqa: RUF009


@dataclass(kw_only=True)
class LimitsConf:
    """Limits of time and memory; a cell that exceeds them is ended and counts as failed."""

    minutes: float
    memory_gb: float


@dataclass(kw_only=True)
class LpipsConf:
    """The download of LPIPS's weights, which are not part of xrgs."""

    fetch: bool


@dataclass(kw_only=True)
class Conf:
    """The config of one cell, and how to run it."""

    scene: SceneConf
    variant: VariantConf
    splat: SplatConf
    train: TrainConf
    components: ComponentsConf
    matched_to: str | None
    seed: int
    store: str
    data_root: str
    threads: int
    checkpoint_s: float
    limits: LimitsConf
    lpips: LpipsConf
    retry: str
    baseline: bool
    fail_fast: bool
    dry_run: bool
    track: str


def is_on(group: Any) -> bool:
    """Return whether any key of a group declared by `off` has another value than "off"."""
    return any(
        "off" in key.metadata and not _is_off(key, getattr(group, key.name))
        for key in fields(group)
    )


def identity_values(group: Any) -> dict[str, Any]:
    """Return the values of a group as nested dicts, without the keys that are off.

    A component that is off is left out with all its keys. So adding a key or a component that is
    off by default changes no id.

    Args:
        group: A dataclass of the schema, as `Conf.splat` or `Conf.components`.

    Returns:
        JSON values: tuples become lists.
    """
    values: dict[str, Any] = {}
    for key in fields(group):
        value = getattr(group, key.name)
        if is_dataclass(value):
            if is_on(value) or not isinstance(group, ComponentsConf):
                values[key.name] = identity_values(value)
        elif not _is_off(key, value):
            values[key.name] = list(value) if isinstance(value, tuple) else value
    return values


def _is_off(key: Field[Any], value: Any) -> bool:
    return "off" in key.metadata and bool(value == key.metadata["off"])


@cache
def known_keys() -> tuple[str, ...]:
    """Return the keys that an override may set.

    Returns:
        The config groups (`scene`), and all keys and groups of keys of the schema (`train.steps`,
        `train`).
    """
    return tuple(dict.fromkeys((*GROUPS, *_keys_of(Conf, ""))))


def _keys_of(schema: Any, prefix: str) -> Iterator[str]:
    for name, kind in types_of(schema).items():
        yield f"{prefix}{name}"
        if is_dataclass(kind):
            yield from _keys_of(kind, f"{prefix}{name}.")


@cache
def types_of(schema: Any) -> Mapping[str, Any]:
    """Return name -> type, of a group's keys."""
    return get_type_hints(schema)
