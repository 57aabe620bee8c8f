"""The schema: what a composed config becomes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from omegaconf.errors import OmegaConfBaseException

from xrgs.config import Conf, from_dict
from xrgs.errors import XrgsError


@pytest.mark.parametrize("key", ["variant.bogus", "components.loss_weighting.bogus"])
def test_a_key_that_a_plus_adds_to_the_schema_is_refused(
    compose: Callable[..., Conf], key: str
) -> None:
    with pytest.raises(XrgsError, match=f"^{key}: there is no such key"):
        compose(f"+{key}=1")


def test_a_value_that_is_missing_is_named(compose: Callable[..., Conf]) -> None:
    with pytest.raises(OmegaConfBaseException, match="factor"):
        compose("variant.factor=???")


def test_values_are_of_their_types_and_interpolations_resolved(
    compose: Callable[..., Conf],
) -> None:
    conf = compose("limits.minutes=2", "scene=folder", "scene.path=${data_root}/a", "store=7")
    assert type(conf.limits.minutes) is float
    assert conf.scene.path == "data/llff/a"
    assert conf.store == "7"


@settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(text=st.text(alphabet="${}\\\\ab':.,é"))
def test_a_text_is_taken_as_it_is(baseline: Conf, text: str) -> None:
    conf = replace(
        baseline, store=text, scene=replace(baseline.scene, name="${oc.env:HOME}", path=text)
    )
    assert from_dict(asdict(conf)) == conf
