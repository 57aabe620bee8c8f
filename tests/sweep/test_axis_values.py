"""Tests that an axis has the values that are written: those that hydra-core 1.4.0rc3 gives."""

from __future__ import annotations

import pytest
from hydra.errors import HydraException
from hypothesis import given
from hypothesis import strategies as st

from xrgs.errors import XrgsError
from xrgs.sweep.axes import as_name, expand


def values(written: str) -> list[str]:
    """Return the values of an axis in the order of the plan."""
    return [spec.overrides[0].partition("=")[2] for spec in expand([f"key={written}"])]


@pytest.mark.parametrize(
    ("written", "expected"),
    [
        ("range(5,0,-2)", "5 3 1"),
        ("sort(range(5,0,-2))", "1 3 5"),
        ("sort(range(0,5,2),reverse=true)", "4 2 0"),
        ("range(0.1,0.4,0.1)", "0.1 0.2 0.3"),
        ("range(0,1,0.1)", "0.0 0.1 0.2 0.3 0.4 0.5 0.6 0.7 0.8 0.9"),
        ("sort(range(0.1,0.4,0.1),reverse=true)", "0.3 0.2 0.1"),
        ("range(1e-5,4e-5,1e-5)", "1e-05 2e-05 3e-05"),
        ("range(start=1,stop=4)", "1 2 3"),
        ("int(range(0.5,3.5))", "0 1 2"),
        ("sort(choice(3,1,2),reverse=true)", "3 2 1"),
    ],
)
def test_an_axis_has_the_values_that_are_written(written: str, expected: str) -> None:
    assert values(written) == expected.split()


@given(start=st.integers(-99, 99), count=st.integers(1, 30), step=st.integers(1, 99))
def test_a_range_of_decimals_is_that_of_whole_numbers_divided(
    start: int, count: int, step: int
) -> None:
    whole = [start + i * step for i in range(count)]
    stop = start + count * step
    found = values(f"range({start / 100},{stop / 100},{step / 100})")
    assert found == [str(number / 100) for number in whole]
    assert values(f"sort(range({stop - step},{start - 1},{-step}))") == [*map(str, whole)]


@pytest.mark.parametrize("written", ["range(3,3)", "range(1,3),7", "[range(1,3)]"])
def test_an_axis_without_values_and_a_function_in_a_list_are_refused(written: str) -> None:
    with pytest.raises(XrgsError, match=r"this axis has no value|an axis is one list"):
        values(written)


@pytest.mark.parametrize("written", ["range(1,5,0)", "range(0,nan)", "range(0,99999999)"])
def test_a_function_of_wrong_arguments_is_refused(written: str) -> None:
    with pytest.raises(HydraException, match="while evaluating"):
        values(written)


def test_names_that_yaml_reads_as_numbers_stay_names() -> None:
    assert [*map(as_name, ["50", "1e3", "true", "null", "mip"])] == [
        "'50'", "'1e3'", "'true'", "'null'", "mip"
    ]  # fmt: skip
    (_, *cells) = expand(["+ablation=choice(50,[a,b])"])
    assert [cell.overrides for cell in cells] == [["+ablation='50'"], ["+ablation=[a,b]"]]
    assert [cell.label for cell in cells] == ["50", "a+b"]
