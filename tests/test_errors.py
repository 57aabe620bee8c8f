"""Names that are offered in place of one that does not exist."""

import pytest

from xrgs.errors import did_you_mean

KNOWN = ("seed", "store", "train", "train.steps", "train.views", "llff/fern", "llff/flower",
         *(f"{group}.every" for group in "abcd"))  # fmt: skip


@pytest.mark.parametrize(
    ("name", "end"),
    [
        ("fern", "; did you mean llff/fern?"),
        ("steps", "; did you mean train.steps?"),
        ("train.stesp", "; did you mean train.steps?"),
        ("stroe", "; did you mean store?"),
        ("lff/fern", "; did you mean llff/fern?"),
        ("nothing.like.it", ""),
        ("", ""),
        ("every", "; did you mean a.every or b.every or c.every?"),  # three at most
    ],
)
def test_names_like_it_are_offered(name: str, end: str) -> None:
    assert did_you_mean(name, KNOWN) == end
