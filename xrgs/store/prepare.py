"""Makes datasets for `train` from Python: for a config, or from the folder of a variant."""

from __future__ import annotations

import logging
from pathlib import Path

from xrgs.config import Conf
from xrgs.mixture import variant
from xrgs.splat.torch_defaults import on_cpu_in_float32
from xrgs.store.inspect import read_report
from xrgs.training import dataset
from xrgs.training.dataset import Dataset

_log = logging.getLogger(__name__)


@on_cpu_in_float32
def build_dataset(conf: Conf) -> Dataset:
    """Load the views of a config, building their variant in its store where it is missing.

    Building takes minutes: COLMAP places the views. A variant is built once; the next call, and any
    sweep with the same scene and variant, finds it. Warnings in the log say which photographs
    were left out or changed.

    Args:
        conf: The config, as `compose` gives it; `scene`, `variant`, `store`, `seed`, `train.views`
            and `train.validation` are read.

    Raises:
        SceneFailed: COLMAP can't place enough views.
        XrgsError: A value of the config or a photograph is wrong; the message names it.

    Examples:
        >>> data = build_dataset(compose("scene=motorcycle", "preset=smoke"))
        >>> len(data.test)
        2
    """
    store = Path(conf.store)
    store.mkdir(parents=True, exist_ok=True)
    built = variant.build(conf.scene, conf.variant, store / "variants", store / "scenes")
    for note in read_report(built.folder).all_notes():
        _log.warning("scene %s: %s", built.scene, note)
    return dataset.load(built, conf.train.views, validation=conf.train.validation, seed=conf.seed)


@on_cpu_in_float32
def load_dataset(folder: str | Path, views: str = "mixed") -> Dataset:
    """Load the views of a variant that a sweep has built.

    Args:
        folder: The variant's folder, `<store>/variants/<variant id>`.
        views: Which training views: `mixed`, `all_hr`, `hr_only` or `lr_only` (`train.views`).

    Raises:
        CorruptVariant: The folder is not a variant, or a file in it has changed.
        XrgsError: `views` is none of these, or the variant has no such views.

    Examples:
        >>> data = load_dataset(f"xrgs-store/variants/{variant_id}")
        >>> [view.tag for view in data.train]
        ['HR', 'HR', 'LR']
    """
    return dataset.load(variant.load(Path(folder)), views)
