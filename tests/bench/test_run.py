"""The benchmark as a user runs it."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure

from xrgs.bench import plot, rendering, run
from xrgs.bench.settings import Settings
from xrgs.errors import XrgsError
from xrgs.splat.backend import resolve_backend

CallCommand = Callable[..., tuple[int, str, str]]
Smoke = tuple[Path, str, dict[str, Any]]


@pytest.fixture(scope="module")
def smoke(tmp_path_factory: pytest.TempPathFactory) -> Smoke:
    """Run a smoke benchmark; return its folder, its text, and its JSON."""
    folder = tmp_path_factory.mktemp("bench")
    settings = Settings(smoke=True, repeats=1, out=folder / "o", json=folder / "all.json")
    text = run.run(settings)
    return folder, text, json.loads((folder / "all.json").read_text())


@pytest.mark.slow
def test_every_backend_is_timed_on_every_load(smoke: Smoke) -> None:
    _, out, found = smoke
    backends = {"torch"} if resolve_backend("auto") == "torch" else {"native", "torch"}
    assert {row["method"] for row in found["rows"]} >= backends | {"torch float64"}
    loads = len(run.SMOKE.gaussians) * len(run.SMOKE.images)
    for backend in backends:
        rows = [row for row in found["rows"] if row["method"] == backend]
        counts = {row["threads"] for row in rows}
        assert 1 in counts
        assert len(rows) == loads * len(counts)
        for row in rows:
            assert min(row["forward_ms"], row["backward_ms"], row["memory_mib"]) > 0
            assert row["evaluations"] > row["width"] * row["height"]
            assert row["image_mean_error"] < 1e-6
            assert row["gradient_error"] < 1e-2
            if backends != {backend} and backend == "torch":
                assert row["times_slower"] > 1
    assert {row["view"] for row in found["steps"]} == {"HR", "LR"}
    assert len(found["growth"]) == len(run.SMOKE.images) + len(run.SMOKE.gaussians) + 2
    for title in ("gradient error", "exponent", "densify", "same bits", "growth MiB"):
        assert title in out


@pytest.mark.slow
def test_a_process_grows_by_the_counted_bytes_and_not_by_the_imports(smoke: Smoke) -> None:
    row = smoke[2]["memory"]
    gaussians, *size = run.SMOKE.memory
    assert [row["gaussians"], row["width"], row["height"]] == [gaussians, *size]
    model = 4 * gaussians * (3 + 4 + 3 + 1 + 48) / 2**20
    assert row["counted_mib"] > 4 * model  # parameters, gradients, two moments
    if Path("/proc/self/status").exists():
        assert row["base_rss_mib"] > 50  # torch alone
        assert row["growth_mib"] == row["peak_rss_mib"] - row["base_rss_mib"] > 3 * model


@pytest.mark.slow
def test_a_higher_cutoff_costs_accuracy(smoke: Smoke) -> None:
    rows = [row for row in smoke[2]["rows"] if row["gaussians"] == max(run.SMOKE.gaussians)]
    by_method = {row["method"]: row for row in rows}
    usual = by_method[rows[0]["method"]]
    fewer = by_method[f"{usual['method']}, alpha cut 4/255"]
    assert fewer["image_mean_error"] > 1e-4
    assert fewer["evaluations"] < usual["evaluations"]


@pytest.mark.slow
def test_stages_add_up_to_no_more_than_the_pass(smoke: Smoke) -> None:
    native = [row for row in smoke[2]["rows"] if row["backend"] == "native"]
    if not native:
        pytest.skip("the native backend was not built")
    for row in native:
        stages = {stage: row[f"{stage}_ms"] for stage in rendering.STAGES}
        back = sum(ms for stage, ms in stages.items() if stage.endswith("backward"))
        assert 0 < back <= row["backward_ms"]
        assert 0 < sum(stages.values()) - back <= row["forward_ms"]
        # A pair is a tile of 256 pixels at most.
        assert row["evaluations"] <= 256 * row["pairs"]


@pytest.mark.slow
def test_the_files_hold_the_results(smoke: Smoke) -> None:
    folder, _, found = smoke
    shortcuts = found["shortcuts"] + found["step_shortcuts"]
    for name, results in (("bench.csv", found["rows"]), ("shortcuts.csv", shortcuts)):
        with (folder / "o" / name).open(newline="") as file:
            rows = list(csv.DictReader(file))
        written = [{key: text for key, text in row.items() if text} for row in rows]
        assert written == [{key: str(value) for key, value in row.items()} for row in results]
    assert (folder / "o" / "bench.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_a_file_is_timed(file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plot, "draw", lambda _: Figure())  # half of the time
    settings = Settings(load=file, out=tmp_path / "o", json=tmp_path / "a.json")
    settings.repeats = settings.threads = 1
    text = run.run(settings)
    found = json.loads((tmp_path / "a.json").read_text())
    names = ("load", "gaussians", "width", "height")
    assert {tuple(row[name] for name in names) for row in found["rows"]} == {("load", 150, 40, 30)}
    assert "40x30" in text
    assert {row["load"] for row in found["steps"]} == {"load"}
    sizes = {(row["width"], row["height"]) for row in found["shortcuts"]}
    assert sizes == {(40, 30), (11, 11)}  # as an LR view, at least the window of SSIM


def test_results_that_cant_be_written_are_refused_before_any_measurement(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(run, "_measure", lambda *_: pytest.fail("it was measured"))
    (tmp_path / "file").touch()
    out, file = tmp_path / "o", tmp_path / "file"
    for settings in (Settings(out=file / "o"), Settings(out=out, json=file / "a.json")):
        with pytest.raises(XrgsError, match=f"{tmp_path}/file.*: cannot be written: "):
            run.run(settings)
    assert out.is_dir()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--save=a.npz"], "--save FILE.npz needs --cell FOLDER and --view NAME"),
        (["--cell=a", "--view=b"], "--cell and --view are for --save FILE.npz"),
        (["--save=a.npz", "--cell=nowhere", "--view=a"], "nowhere: the cell is absent, not done"),
        (["--repeats=0"], "--repeats 0: must be at least 1"),
        (["--threads=-1"], "--threads -1: must be at least 0"),
        (["--seed", "-1"], "--seed -1: must be at least 0"),
        (["--seed", str(2**63)], f"--seed {2**63}: must be at least 0 and below {2**63}"),
    ],
)
def test_bad_arguments_end_in_one_line(
    call_command: CallCommand, arguments: list[str], message: str
) -> None:
    code, out, err = call_command("bench", *arguments)
    assert code != 0
    assert not out
    assert err.startswith("xrgs-bench: ")
    assert message in err
    assert "\n" not in err
