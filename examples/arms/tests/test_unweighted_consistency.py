"""The consistency loss without the weight of its view, against the paper's formula."""

from __future__ import annotations

import pytest

from tests.splat.scenes import noise
from tests.training.components.conftest import Build
from tests.training.components.test_consistency import loss_of, paper_5_6
from xrgs.config import ComponentsConf
from xrgs.errors import XrgsError
from xrgs.training.components import Step

NAME = "unweighted_consistency"


@pytest.mark.parametrize("tag", ["HR", "LR"])
def test_the_weight_of_the_view_multiplies_only_the_other_loss(
    tag: str, build: Build, off: ComponentsConf, steps: dict[str, Step]
) -> None:
    step = steps[tag]
    height, width, _ = step.view.image.shape
    image = step.view.image + 0.4 * (noise(height, width, 7) - 0.5)
    off.plugins[NAME] = {"weight": 0.1}
    off.loss_weighting.lr_weight = 0.25
    term = paper_5_6(image, step.view, weight=0.1, l1=0.8, ssim=0.2)
    expected = 0.5 * (0.25 if tag == "LR" else 1) + term
    assert loss_of(build(off), image, step, base=0.5) == pytest.approx(expected, rel=1e-9)


def test_a_weight_of_0_is_off_and_less_is_refused(build: Build, off: ComponentsConf) -> None:
    off.plugins[NAME] = {"weight": 0.0}
    assert build(off) == ()
    off.plugins[NAME] = {"weight": -0.1}
    with pytest.raises(XrgsError, match=rf"^components\.plugins\.{NAME}\.weight=-0\.1"):
        build(off)
