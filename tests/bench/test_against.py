"""The comparison of two installations."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import numpy as np
import pytest

from xrgs.bench import against, run
from xrgs.bench.against import HR_STEP, LR_STEP, MEAN_STEP, RENDER, SIDES
from xrgs.bench.loads import Load
from xrgs.bench.settings import Settings
from xrgs.errors import XrgsError
from xrgs.splat.backend import resolve_backend


def test_ratios_are_taken_repetition_by_repetition() -> None:
    """The machine is half as fast in the second repetition, which changes no ratio."""
    slowness = np.array([1.0, 2.0, 1.0, 1.0, 1.0])
    ms = {
        (side, task, count): base * factor * slowness / count
        for side, factor in zip(SIDES, (1.0, 1.5), strict=True)
        for task, base in ((RENDER, 8.0), (HR_STEP, 10.0), (LR_STEP, 2.0))
        for count in (1, 2)
    }
    ms["other", RENDER, 1] = 8.0 * slowness * np.array([1.0, 2.0, 3.0, 4.0, 5.0])
    rows = {(row["task"], row["threads"]): row for row in against.summarize(ms, [1, 2])}
    assert len(rows) == 8
    mean = rows[MEAN_STEP, 2]
    assert mean["this_ms"] == pytest.approx((0.3 * 10 + 0.7 * 2) / 2)
    assert mean["other_ms"] == pytest.approx(1.5 * mean["this_ms"])
    for key in ("times_faster", "times_faster_low", "times_faster_high"):
        assert mean[key] == pytest.approx(1.5)
    assert mean["this_speedup"] == mean["other_speedup"] == pytest.approx(2)
    assert rows[MEAN_STEP, 1]["this_speedup"] == pytest.approx(1)
    render = rows[RENDER, 1]
    assert render["times_faster"] == pytest.approx(3)
    assert render["times_faster_low"] == pytest.approx(2)
    assert render["times_faster_high"] == pytest.approx(4)


def test_both_processes_are_started_anew_after_a_few_repetitions(
    load: Load, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process that is slow for as long as it lives is one of several, on either side."""
    started: list[str] = []

    class Worker:
        def __init__(self, python: str, log: Path) -> None:
            started.append(log.name)
            self.ms = 20.0 if started.count(log.name) == 1 and log.name == "this" else 10.0

        def __enter__(self) -> Worker:
            return self

        def __exit__(self, *error: object) -> None:
            pass

        def send(self, request: dict[str, object]) -> None:
            pass

        def answer(self) -> dict[str, float]:
            return {"ms": self.ms}

    monkeypatch.setattr(against, "_Worker", Worker)
    found = against.measure(Path(sys.executable), load, (load, load), [1], 11)
    assert started == ["this", "other", "other", "this", "this", "other"]
    row = found["rows"][0]
    assert (row["times_faster_low"], row["times_faster"]) == (0.5, 1.0)


@pytest.mark.slow
def test_this_installation_is_compared_with_one_that_takes_a_ms_for_anything(
    tmp_path: Path,
) -> None:
    if resolve_backend("auto") != "native":
        pytest.skip("the native backend was not built")
    python = tmp_path / "python"
    python.write_text(
        '#!/bin/sh\nread setup\necho \'{"package": "theirs", "isa": "slow"}\'\n'
        "while read task; do echo '{\"ms\": 1}'; done\n"
    )
    python.chmod(0o755)
    settings = Settings(smoke=True, repeats=1, threads=2, out=tmp_path / "o", against=python)
    text = run.run(settings)
    with (tmp_path / "o" / "against.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    tasks = (RENDER, HR_STEP, LR_STEP, MEAN_STEP)
    cases = [(task, count) for task in tasks for count in "12"]
    assert [(row["task"], row["threads"]) for row in rows] == cases
    assert all(float(row["this_ms"]) > 0 for row in rows)
    assert all(float(row["other_ms"]) == 1 for row in rows)
    for word in (*tasks, "times faster", "speed-up", "300 Gaussians at 80x60", "theirs, slow"):
        assert word in text


def test_an_installation_that_cannot_run_is_named_with_its_reason(
    load: Load, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    this = tmp_path / "this"
    this.write_text("#!/bin/sh\nread request\necho '{}'\nexec cat >/dev/null\n")
    this.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(this))
    python = tmp_path / "python"
    python.write_text("#!/bin/sh\necho 'no torch here' >&2\nexit 3\n")
    python.chmod(0o755)
    with pytest.raises(XrgsError, match=r"python cannot run the benchmark: no torch here"):
        against.measure(python, load, (load, load), [1], 1)
    python.write_text("#!/bin/sh\necho hello\nexec cat >/dev/null\n")
    with pytest.raises(XrgsError, match=r"answers 'hello', not JSON"):
        against.measure(python, load, (load, load), [1], 1)
    python.write_bytes(b"\0")
    with pytest.raises(XrgsError, match=r"cannot be run: Exec format error"):
        against.measure(python, load, (load, load), [1], 1)
    with pytest.raises(XrgsError, match="must be the Python executable"):
        against.measure(tmp_path, load, (load, load), [1], 1)
