"""Every parser of foreign files on mutated files, and the fuzzer on parsers that are wrong."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.hostile import fuzz_parsers
from tests.hostile.fuzz_parsers import Fault, Parser, fuzz, limited_memory
from tests.hostile.mutations import mutate_bytes, mutate_json

ROOT = Path(__file__).parents[2]
_START = (
    f"import sys; sys.path.append({str(ROOT)!r}); "
    "from tests.hostile.fuzz_parsers import main; sys.exit(main(sys.argv[1:]))"
)
NAMES = (
    *("json", "json-object", "table", "config", "progress", "status", "scores", "scores-sealed"),
    *("history", "identity", "sweep", "sweep-names", "lock", "locks", "cells-identity"),
    *("cells-config", "cells-summary", "failed-scene", "variant", "variant-points"),
    *("variant-report", "variant-image", "variant-unsealed", "trimmed-variant", "trimmed-report"),
    *("image-header", "image", "exif", "npz", "checkpoint", "ply"),
)


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Parser]:
    return fuzz_parsers.parsers(tmp_path_factory.mktemp("fuzz"))


def faults(name: str, parser: Parser, count: int) -> list[Fault]:
    with limited_memory():
        return [fault for fault in fuzz(name, parser, range(count)) if fault is not None]


def test_every_parser_is_fuzzed(known: dict[str, Parser]) -> None:
    assert tuple(known) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_a_valid_file_is_read(known: dict[str, Parser], name: str) -> None:
    parser = known[name]
    for content in (parser.file.read_bytes(), *parser.seeds):
        parser.file.write_bytes(content)
        assert parser.parse(parser.file) is not None


@pytest.mark.parametrize("name", NAMES)
def test_a_parser_reads_or_refuses_what_is_mutated(known: dict[str, Parser], name: str) -> None:
    assert faults(name, known[name], 50) == []


@pytest.mark.parametrize(
    ("name", "seed"), [("variant", 77), ("progress", 105), ("config", 512), ("scores-sealed", 691)]
)
def test_what_the_fuzzer_found_stays_mended(known: dict[str, Parser], name: str, seed: int) -> None:
    assert list(fuzz(name, known[name], [seed])) == [None]


@pytest.mark.parametrize("name", NAMES)
def test_a_parser_reads_or_refuses_any_bytes(known: dict[str, Parser], name: str) -> None:
    parser = known[name]
    raw = Parser(parser.file, lambda *_: content, parser.parse, parser.errors, parser.names)
    content = b""

    @given(st.binary(max_size=200) | st.text(max_size=200).map(str.encode))
    @settings(max_examples=10, deadline=None, suppress_health_check=list(HealthCheck))
    def check(anything: bytes) -> None:
        nonlocal content
        content = anything
        assert faults(name, raw, 1) == []

    check()


@pytest.mark.slow
@pytest.mark.parametrize("count", [100, pytest.param(1000, marks=pytest.mark.exhaustive)])
@pytest.mark.parametrize("part", range(4))
def test_a_parser_reads_or_refuses_mutations(part: int, count: int) -> None:
    # In a process of its own, so that a crash is a failure of this test alone.
    chosen = [word for name in NAMES[part::4] for word in ("--parser", name)]
    done = subprocess.run(
        [sys.executable, "-P", "-c", _START, "--seed", "1000", "--count", f"{count}", *chosen],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count(f"{count} inputs, 0 faults") == len(NAMES[part::4])


# --- the fuzzer itself --------------------------------------------------------------------------


def _crash(_: Path) -> None:
    raise KeyError("x")


def _forget_the_name(_: Path) -> None:
    raise ValueError("something is wrong")


def _name_it(file: Path) -> None:
    raise ValueError(f"{file}: something is wrong")


def _be_slow(_: Path) -> None:
    end = time.process_time() + 1.2
    while time.process_time() < end:
        pass


def _grow(_: Path) -> None:
    bytearray(350 << 20)


def _want_everything(file: Path) -> None:
    try:
        bytearray(1 << 40)
    except MemoryError as error:
        raise ValueError(f"{file}: too large") from error


@pytest.mark.parametrize(
    ("parse", "what"),
    [
        (_crash, "KeyError: 'x'"),
        (_forget_the_name, "the message does not name the file: 'something is wrong'"),
        (_be_slow, "took 1."),
        (_grow, "took 3"),
        (_want_everything, "wanted more memory than there is"),
    ],
)
def test_the_fuzzer_finds_what_is_wrong(
    tmp_path: Path, parse: Callable[[Path], None], what: str
) -> None:
    file = tmp_path / "file.json"
    file.write_text('{"a": [1, 2]}')
    (fault,) = faults("planted", Parser(file, mutate_json, parse, (ValueError,)), 1)
    assert fault.what.startswith(what)
    assert fault.seed == 0
    assert file.read_text() == '{"a": [1, 2]}'


def test_the_fuzzer_accepts_errors_that_name_the_file(tmp_path: Path) -> None:
    file = tmp_path / "file.json"
    file.write_text('{"a": [1, 2]}')
    assert faults("planted", Parser(file, mutate_json, _name_it, (ValueError,)), 3) == []


def test_a_seed_makes_the_same_input_again(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(bytes(range(200)))
    seen: list[bytes] = []
    parser = Parser(file, mutate_bytes, lambda path: seen.append(path.read_bytes()))
    for seeds in (range(20), range(20)):
        list(fuzz("planted", parser, seeds))
    assert seen[:20] == seen[20:]
    assert len(set(seen[:20])) > 10
