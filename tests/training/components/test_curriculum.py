"""Section 5.5: LR views alone at first, then all views."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.training.components.conftest import Build
from xrgs.config import ComponentsConf
from xrgs.errors import XrgsError
from xrgs.training.components import Step


@pytest.mark.parametrize(
    ("nominal", "allowed", "total"),
    [(0, False, 3_000), (4990, False, 3_000), (4999, False, 30_000), (5000, True, 3_000)],
)
def test_hr_views_wait_until_the_warm_up_is_over(
    nominal: int,
    allowed: bool,
    total: int,
    build: Build,
    off: ComponentsConf,
    hr: Step,
    lr: Step,
) -> None:
    off.curriculum.lr_only = 5000
    parts = build(off)
    number = nominal * total // 30_000
    assert parts.allows_view(replace(hr, number=number, total=total)) == allowed
    assert parts.allows_view(replace(lr, number=number, total=total))


def test_without_lr_views_it_is_an_error(build: Build, off: ComponentsConf, hr: Step) -> None:
    off.curriculum.lr_only = 5000
    with pytest.raises(XrgsError, match=r"^components\.curriculum\.lr_only=5000: .*no LR view"):
        build(off, hr.view)
