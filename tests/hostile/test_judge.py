"""The harness of hostile stores on commands that are known to be wrong."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from dataclasses import replace
from pathlib import Path

import pytest

from tests.hostile import judge, reference
from tests.hostile.looks import Look
from tests.hostile.sandbox import Ended

ROOT = Path(__file__).parents[2]
LOOK = Look("status", "status", (), names=("scores.csv",), shows=("3 done",))
FINE = Ended(1, b"3 done\n1 corrupt: scores.csv is missing\n", 0.1, 0.1, 10**8, hung=False)


def found(ended: Ended, look: Look = LOOK) -> list[str]:
    return list(judge.verdicts(look, ended))


def test_a_command_that_does_its_work_is_ok() -> None:
    assert found(FINE) == []


@pytest.mark.parametrize(
    ("changes", "verdict"),
    [
        ({"hung": True, "code": -9}, "hang"),
        ({"cpu_s": 5.1}, "hang"),
        ({"code": -11}, "signal 11"),
        ({"code": 3}, "exit code 3"),
        ({"peak_rss": (1 << 30) + 1}, "memory"),
        ({"output": FINE.output + b"Traceback (most recent call last):\n"}, "traceback"),
        ({"output": FINE.output + b"\x1b[2J"}, "escapes (U+001B)"),
        ({"output": FINE.output + "\u202e\x9b".encode()}, "escapes (U+009B U+202E)"),
        ({"output": FINE.output + b"a\rb"}, "escapes (U+000D)"),
        ({"output": b"3 done\n"}, "file not named (scores.csv)"),
        ({"output": b"scores.csv\n"}, "rest not shown (3 done)"),
    ],
)
def test_a_command_that_is_wrong_is_found(changes: dict[str, object], verdict: str) -> None:
    assert found(replace(FINE, **changes)) == [verdict]  # type: ignore[arg-type]


def test_a_command_that_must_succeed_may_not_end_with_1() -> None:
    assert found(FINE, replace(LOOK, succeeds=True)) == ["exit code 1"]


@pytest.mark.parametrize(
    ("name", "content", "verdict"),
    [
        ("a.csv", "x,=1+1\n", "formula ('=1+1' in a.csv)"),
        ("a.csv", "x\n-1+1\n", "formula ('-1+1' in a.csv)"),
        ("a.csv", '-1.5,+2e-3,"-1,234.50 ↑",-inf,a=b\n', ""),
        ("a.csv", "\x1b[2J\n", "escapes (U+001B in a.csv)"),
        ("table.md", "a <script>b</script>\n", "active ('<script' in table.md)"),
        ("table.md", "a \\<script> ![f](figures/a.png)\n", ""),
        ("table.tex", "\\input{/etc/passwd}\n", "active ('\\\\input' in table.tex)"),
    ],
)
def test_what_a_report_holds(tmp_path: Path, name: str, content: str, verdict: str) -> None:
    folder = tmp_path / "reports" / "id"
    folder.mkdir(parents=True)
    (folder / name).write_text(content)
    assert list(judge.report_verdicts(tmp_path)) == [verdict] * bool(verdict)


def test_a_report_outside_is_not_read(tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "a.csv").write_text("=1\n")
    (tmp_path / "reports").symlink_to(outside)
    assert not list(judge.report_verdicts(tmp_path))


def test_what_is_written_outside_is_found(tmp_path: Path) -> None:
    (tmp_path / "victim").write_text("old")
    (tmp_path / "store").mkdir()
    before = judge.snapshot(tmp_path, tmp_path / "store")
    (tmp_path / "store" / "inside").touch()
    assert not judge.changed(before, judge.snapshot(tmp_path, tmp_path / "store"))
    (tmp_path / "victim").write_text("new")
    (tmp_path / "link").symlink_to("/nonexistent")
    after = judge.snapshot(tmp_path, tmp_path / "store")
    assert judge.changed(before, after) == [str(tmp_path / "link"), str(tmp_path / "victim")]


def test_the_sandbox_measures_and_limits(tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("secret")
    (tmp_path / "secret").chmod(0)
    # In a process of its own: it forks, and this one has threads.
    script = f"""
        import sys, time
        from pathlib import Path
        sys.path.append({str(ROOT)!r})
        from tests.hostile import sandbox

        def show(name, function, seconds=30.0):
            ended = sandbox.run(function, Path({str(tmp_path)!r}) / name, seconds)
            measured = ended.peak_rss >> 20, ended.cpu_s > 0.3
            print(name, ended.code, ended.hung, ended.output, *measured)

        def burn():
            end = time.process_time() + 0.4
            while time.process_time() < end: pass

        show("ok", lambda: print("é"))
        show("exit", lambda: sys.exit("a message"))
        show("error", lambda: 1 // 0)
        show("hang", lambda: time.sleep(60), 0.2)
        show("grow", lambda: bytearray(300 << 20))
        show("bomb", lambda: bytearray(1 << 40))
        show("burn", burn)
        show("read", lambda: open({str(tmp_path / "secret")!r}))
    """
    done = subprocess.run(
        [sys.executable, "-P", "-c", textwrap.dedent(script)],
        capture_output=True,
        text=True,
        check=True,
    )
    lines = {line.split()[0]: line for line in done.stdout.splitlines()}
    assert lines["ok"].startswith("ok 0 False b'\\xc3\\xa9\\n'")
    assert lines["exit"].startswith("exit 1 False b'a message\\n'")
    assert "ZeroDivisionError" in lines["error"]
    assert lines["hang"].startswith("hang -9 True")
    assert int(lines["grow"].split()[-2]) >= 300
    assert "MemoryError" in lines["bomb"]
    assert lines["burn"].endswith("True")
    assert "PermissionError" in lines["read"]


def test_the_reference_store_is_finished(tmp_path: Path) -> None:
    from xrgs.experiment.store import Store

    store = tmp_path / "store"
    reference.build(store)
    table = Store(store).cells()
    assert list(table["state"]) == ["done"] * 4
    assert sorted(set(table["label"])) == ["baseline", "consistency"]
    cell = reference.cell_of(store)
    (cell / "scores.csv").write_text((cell / "scores.csv").read_text().replace("0.8", "0.7"))
    assert list(Store(store).cells()["state"]).count("corrupt") == 1
    reference.seal(cell)
    assert list(Store(store).cells()["state"]) == ["done"] * 4
    assert reference.variant_of(store).parent == store / "variants"
