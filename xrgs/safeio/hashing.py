"""Hashes of values and of files: the names that results are found by."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

_PACKAGE = Path(__file__).parents[1]
_SOURCES = frozenset({".py", ".cpp", ".h", ".txt"})
_CHUNK = 1 << 16  # bytes


def canonical(value: object) -> str:
    """`value` as JSON with sorted keys and no spaces: equal values give equal text."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False)


def digest(value: object) -> str:
    """The first 16 hexadecimal digits of the SHA-256 of `canonical(value)`."""
    return hashlib.sha256(canonical(value).encode()).hexdigest()[:16]


def plain(value: Any) -> Any:
    """A config's dataclasses as dicts of the same values.

    What `dataclasses.asdict` gives, eight times as fast: it copies every value deeply, and a plan
    of ten thousand cells asks for each of them several times.
    """
    if hasattr(value, "__dataclass_fields__"):
        return {name: plain(getattr(value, name)) for name in value.__dataclass_fields__}
    return value


def file_digest(path: Path) -> str:
    """SHA-256 of a file's bytes, in hexadecimal."""
    total = hashlib.sha256()
    # hashlib.file_digest zeroes a buffer of 256 kB first, which takes longer than a small file.
    with path.open("rb", buffering=0) as stream:
        while chunk := stream.read(_CHUNK):
            total.update(chunk)
    return total.hexdigest()


def source_digests(*names: str) -> dict[str, str]:
    """SHA-256 of source files, keyed by their path in this package.

    Args:
        names: Files and folders of the package; a folder stands for every source file inside.
    """
    roots = [_PACKAGE / name for name in names]
    files = [f for root in roots for f in ([root] if root.is_file() else root.rglob("*"))]
    return {
        file.relative_to(_PACKAGE).as_posix(): file_digest(file)
        for file in sorted(files)
        if file.suffix in _SOURCES
    }
