from __future__ import annotations

import torch

from xrgs.bench.timing import Timings, time_interleaved, use_threads


def test_tasks_run_in_turn() -> None:
    ran: list[str] = []
    times = time_interleaved(
        {"a": lambda: ran.append("a"), "b": lambda: ran.append("b")}, repeats=3
    )
    assert "".join(ran) == "ab" + "ababab"  # once to warm up
    assert all(len(times[name].milliseconds) == 3 for name in "ab")


def test_minimum_and_median() -> None:
    times = Timings((5.0, 1.0, 2.0, 9.0, 3.0))
    assert times.minimum == 1.0
    assert times.median == 3.0


def test_the_number_of_threads_is_restored() -> None:
    before = torch.get_num_threads()
    with use_threads(before + 1):
        assert torch.get_num_threads() == before + 1
    assert torch.get_num_threads() == before
