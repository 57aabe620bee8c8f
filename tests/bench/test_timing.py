from __future__ import annotations

import torch

from xrgs.bench.timing import Times, alternate, threads


def test_things_run_in_turn() -> None:
    ran: list[str] = []
    times = alternate({"a": lambda: ran.append("a"), "b": lambda: ran.append("b")}, repeats=3)
    assert "".join(ran) == "ab" + "ababab"  # once to warm up
    assert all(len(times[name].all) == 3 for name in "ab")


def test_least_and_median() -> None:
    times = Times((5.0, 1.0, 2.0, 9.0, 3.0))
    assert times.least == 1.0
    assert times.median == 3.0


def test_threads_are_put_back() -> None:
    before = torch.get_num_threads()
    with threads(before + 1):
        assert torch.get_num_threads() == before + 1
    assert torch.get_num_threads() == before
