"""Section 5.5: LR views alone at first, then all views."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from xrgs.config import ComponentsConf
from xrgs.errors import XrgsError
from xrgs.training.components import Components, Step


@pytest.mark.parametrize("total", [30_000, 3_000])
@pytest.mark.parametrize(
    ("nominal", "allowed"), [(0, False), (4990, False), (5000, True), (29_990, True)]
)
def test_hr_views_wait_until_the_warm_up_is_over(
    nominal: int,
    allowed: bool,
    total: int,
    build: Callable[..., Components],
    off: ComponentsConf,
    hr: Step,
    lr: Step,
) -> None:
    off.curriculum.lr_only = 5000
    parts = build(off)
    number = nominal * total // 30_000
    assert parts.allows_view(replace(hr, number=number, total=total)) == allowed
    assert parts.allows_view(replace(lr, number=number, total=total))


def test_without_lr_views_it_is_an_error(
    build: Callable[..., Components], off: ComponentsConf, hr: Step
) -> None:
    off.curriculum.lr_only = 5000
    with pytest.raises(XrgsError, match=r"^components\.curriculum\.lr_only=5000: .*no LR view"):
        build(off, hr.view)
