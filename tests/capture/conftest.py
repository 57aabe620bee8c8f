"""Configs of variants."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from xrgs.config import Conf, SfmConf, VariantConf


@pytest.fixture(scope="session")
def configured(compose: Callable[..., Conf]) -> Callable[..., VariantConf]:
    """(**changes; sfm=those of SfM) -> the baseline's variant with them; placed only once."""
    baseline = compose("variant.sfm.reference=false").variant

    def changed(sfm: dict[str, Any] | None = None, **changes: Any) -> VariantConf:
        return replace(baseline, sfm=replace(baseline.sfm, **(sfm or {})), **changes)

    return changed


@pytest.fixture(scope="session")
def sfm_conf(configured: Callable[..., VariantConf]) -> SfmConf:
    """The baseline's SfM."""
    return configured().sfm
