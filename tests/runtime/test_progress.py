"""Progress as a bar, as lines of a log, and in a file."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest

from xrgs.runtime import progress
from xrgs.runtime.progress import Progress, ProgressBar, read, written_to


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every update is shown at once."""
    for name in ("_BAR_S", "_FILE_S", "_LINE_S", "_BAR_DELAY_S"):
        monkeypatch.setattr(progress, name, 0.0)


@pytest.mark.usefixtures("quick")
def test_a_log_gets_lines_and_no_carriage_return(capsys: pytest.CaptureFixture[str]) -> None:
    assert list(progress.progress("abc", "reading", "letter")) == ["a", "b", "c"]
    output = capsys.readouterr().err
    assert "\r" not in output
    lines = output.splitlines()
    assert lines[0] == "reading 0 of 3 letters"
    assert lines[-1].startswith("reading 3 of 3 letters, ")


@pytest.mark.usefixtures("quick")
def test_a_terminal_gets_a_bar_that_is_cleared_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    with ProgressBar("SfM: matches", "pair", 10, done=3) as bar:
        bar.update(2)
    output = terminal.getvalue()
    assert "SfM: matches" in output
    assert "5/10" in output
    assert "\n" not in output
    assert output.rpartition("5/10")[2].rpartition("\r")[0].rpartition("\r")[2].strip() == ""


def test_a_line_replaces_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    progress.log_line("a cell failed")
    assert terminal.getvalue() == "\r\x1b[Ka cell failed\n"


@pytest.mark.usefixtures("quick")
def test_progress_in_a_file_is_shown_nowhere_and_removed_at_the_end(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "progress.json"
    with written_to(file):
        for item in progress.progress(range(5, 8), "training", "step", 8, done=5):
            found = read(file)
            assert found is not None
            assert found.count == f"training {item} of 8 steps"
        last = read(file)
        assert last is not None
        assert last.count == "training 8 of 8 steps"
        assert [entry.name for entry in tmp_path.iterdir()] == ["progress.json"]
    assert not list(tmp_path.iterdir())
    assert capsys.readouterr().err == ""
    with pytest.raises(ZeroDivisionError), written_to(file):
        [1 / number for number in progress.progress([1, 0], "training", "step")]
    assert not list(tmp_path.iterdir())


def test_the_text_has_all_that_is_known() -> None:
    assert str(Progress("training", "step", 1200, 3000, 31.04)) == (
        "training 1,200 of 3,000 steps, 31 steps/s, ~58 s left"
    )
    assert str(Progress("training", "step", 0, 3000, None)) == "training 0 of 3,000 steps"
    assert str(Progress("a.zip", "byte", 7, None, 2.0)) == "a.zip 7 bytes, 2 bytes/s"


def test_the_words_of_another_process_are_plain_and_short(tmp_path: Path) -> None:
    file = tmp_path / "progress.json"
    content = {"what": "\x1b[2J" + "x" * 999, "unit": "a\nb", "done": 1, "total": 2, "rate": None}
    file.write_text(json.dumps(content))
    found = read(file)
    assert found is not None
    assert str(found).startswith(" [2Jxxx")
    assert str(found).endswith("1 of 2 a bs")
    assert len(str(found)) < 200
