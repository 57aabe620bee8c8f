"""What of this machine a process may use."""

from __future__ import annotations

import os

import pytest

from xrgs.machine import usable_cores


def test_cores_are_those_this_process_may_use() -> None:
    if not hasattr(os, "sched_getaffinity"):
        pytest.skip("the system has no processor affinity")
    allowed = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {min(allowed)})
        assert usable_cores() == 1
    finally:
        os.sched_setaffinity(0, allowed)
    assert usable_cores() == len(allowed)
