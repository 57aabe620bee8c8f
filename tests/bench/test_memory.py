from __future__ import annotations

from pathlib import Path

import pytest

from xrgs.bench import memory


@pytest.mark.slow
def test_a_process_grows_by_what_is_counted_and_not_by_the_imports() -> None:
    row = memory.measure(20_000, 64, 48, "torch", threads=1, seed=0)
    assert (row["gaussians"], row["width"], row["height"]) == (20_000, 64, 48)
    model = 4 * 20_000 * (3 + 4 + 3 + 1 + 48)
    assert row["counted_bytes"] > 4 * model  # parameters, gradients, two moments
    if not Path("/proc/self/status").exists():
        assert row["growth_bytes"] is None
        return
    assert row["peak_rss_bytes"] - row["base_rss_bytes"] == row["growth_bytes"]
    assert row["base_rss_bytes"] > 50e6  # torch alone
    assert row["growth_bytes"] > 3 * model
