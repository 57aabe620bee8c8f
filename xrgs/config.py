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

from xrgs.splat.backend import CHOICES
from xrgs.splat.settings import (
    DECIDE,
    STARTS,
    STRATEGIES,
    DensifySettings,
    OptimizerSettings,
    RasterSettings,
)

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


def off(value: Any, **limits: Any) -> Any:
    """Declare a key, and its value that means "off". At this value it is in no cell's id."""
    return field(metadata={"off": value, **limits})


def limited(**limits: Any) -> Any:
    """Declare a key with limits, see `xrgs.splat.settings.outside_limits`; `off` takes them too."""
    return field(metadata=limits)


def amount(**limits: Any) -> Any:
    """Declare a key that is finite and at least 0; with `off` it has a value that means "off"."""
    return field(metadata={"finite": True, "least": 0, **limits})


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
    seed: int = limited(least=0, below=2**31)  # as COLMAP holds it
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
    seed: int = limited(least=0)
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
    strategy: str = off("default", choices=STRATEGIES)
    init: str = off("sfm", choices=STARTS)
    sh_every: int = limited(least=1)
    init_opacity: float = limited(above=0, below=1)
    init_scale: float = off(1.0, finite=True, above=0)
    ssim_weight: float = limited(least=0, most=1)
    backend: str = limited(choices=CHOICES)


@dataclass(kw_only=True)
class TrainConf:
    """The length of a training, and its views."""

    steps: int = limited(least=1)
    views: str = limited(choices=TRAINING_VIEWS)
    evaluate_every: int = off(0, least=0)
    validation: float = off(0.0, least=0, below=1)
    hr_share: float = off(0.0, least=0, below=1)


@dataclass(kw_only=True)
class LossWeightingConf:
    """Resolution-aware loss weighting (paper, section 5.2)."""

    lr_weight: float = amount(off=1.0)
    # With an `lr_weight` of 1, continuous weighting still reads this key.
    stat_from: str = off("weighted", choices=("weighted", "unweighted"))


@dataclass(kw_only=True)
class GradientScalingConf:
    """Gradient scaling for Gaussian radii (paper, section 5.3)."""

    lr_scale: float = amount(off=1.0)


@dataclass(kw_only=True)
class DensifyConf:
    """Resolution-aware densification and pruning (paper, section 5.4)."""

    decide: str = off("shared", choices=("shared", *DECIDE))
    lr_grow: float = amount()
    lr_prune: float = amount()


@dataclass(kw_only=True)
class CurriculumConf:
    """LR-only warm-up (paper, section 5.5)."""

    lr_only: float = amount(off=0.0)


@dataclass(kw_only=True)
class RenderScaleConf:
    """Resolution-aware rendering (paper, sections 5.7 and 6.3)."""

    gamma: float = amount(off=0.0)


@dataclass(kw_only=True)
class SupersampledConf:
    """Coarse views rendered larger, then downsampled as their photographs; not in the paper."""

    factor: int = off(1, least=1)
    late_factor: int = off(1, least=1)
    late_from: int = limited(least=0)


@dataclass(kw_only=True)
class FormationConf:
    """Trained widths of the blur of LR photographs; not in the paper."""

    widths: str = off("none", choices=("none", "tag", "view"))
    lr: float = amount()
    prior: float = amount()


@dataclass(kw_only=True)
class ResolutionScheduleConf:
    """HR views at a reduced resolution early in training (DashGaussian); not in the paper."""

    start_share: float = off(1.0, above=0, most=1)
    until: int = limited(least=1)


@dataclass(kw_only=True)
class ConsistencyConf:
    """Cross-resolution consistency loss (paper, section 5.6)."""

    weight: float = amount(off=0.0)
    l1: float = amount()
    ssim: float = amount()
    lr_mode: str = limited(choices=("exact", "fold", "off"))


@dataclass(kw_only=True)
class AdaptiveWeightingConf:
    """Higher weight of LR views in scenes with little texture (paper, section 7.2, 1)."""

    texture: float = amount(off=0.0)


@dataclass(kw_only=True)
class RegionWeightingConf:
    """Full weight of regions of LR views that are smooth or in no HR view (paper, 7.2, 2)."""

    texture: float = amount(off=0.0)


@dataclass(kw_only=True)
class HybridScheduleConf:
    """Return of LR views to full weight after densification (paper, section 7.2, 3)."""

    ramp: int = amount(off=0)


@dataclass(kw_only=True)
class ContinuousWeightingConf:
    """Loss weights by the views' sampling rates instead of their tags (paper, conclusion)."""

    gamma: float = amount(off=0.0)


@dataclass(kw_only=True)
class MipConf:
    """Mip-Splatting's 3D smoothing filter; not in the paper."""

    variance: float = amount(off=0.0)
    every: int = limited(least=1)


@dataclass(kw_only=True)
class NaturalSelectionConf:
    """Removal of Gaussians that fade under a constant opacity gradient (GNS); not in the paper."""

    budget: float = amount(off=0.0)
    until: int = limited(least=1)
    drop_every: int = off(50, least=1)


@dataclass(kw_only=True)
class ExposureConf:
    """A trained colour map for each photograph; not in the paper."""

    mode: str = off("none", choices=("none", "affine", "gain"))
    lr: float = amount()
    lr_final: float = limited(above=0, most=1)
    prior: float = amount()


@dataclass(kw_only=True)
class FloatersConf:
    """Removal of Gaussians in the empty space close to cameras; not in the paper."""

    near_share: float = amount(off=0.0)


@dataclass(kw_only=True)
class RegularizationConf:
    """Penalties on opacities and scales (3DGS-MCMC); not in the paper."""

    opacity: float = amount(off=0.0)
    scale: float = amount(off=0.0)


@dataclass(kw_only=True)
class CountMatchedConf:
    """Training with the number of Gaussians of another cell (`xrgs.training.count_matching`)."""

    gaussians: int = amount(off=0)
    tolerance: float = amount()


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

    minutes: float = limited(least=0)
    memory_gb: float = limited(least=0)


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
    seed: int = limited(least=0)
    store: str
    data_root: str
    threads: int = limited(least=0)
    checkpoint_s: float = limited(least=0)
    limits: LimitsConf
    lpips: LpipsConf
    retry: str = limited(choices=("none", "failed"))
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
