"""The photographs in scikit-image's wheel."""

from __future__ import annotations

import pytest

from xrgs.capture import images
from xrgs.capture.scenes import procedural
from xrgs.capture.scenes.bundled import bundled_photograph
from xrgs.errors import XrgsError


@pytest.mark.parametrize("name", [file for file, _ in procedural.TEXTURES.values()])
def test_the_photographs_are_in_the_installed_wheel(name: str) -> None:
    assert images.read(bundled_photograph(name)).ndim == 3


def test_a_photograph_that_the_wheel_lacks_is_named() -> None:
    with pytest.raises(XrgsError, match=r"nothing\.png"):
        bundled_photograph("nothing.png")
