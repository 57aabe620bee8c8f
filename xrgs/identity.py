"""What makes two cells the same cell: everything that can change a number, and nothing else.

Paths, thread counts, logging and labels are not in it, so a finished cell is found again under
another name, in another folder or on another machine.
"""

from __future__ import annotations

from dataclasses import asdict
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from xrgs.evaluate import PROTOCOL
from xrgs.hashing import file_digest
from xrgs.splat.backend import resolve_backend

if TYPE_CHECKING:
    from collections.abc import Iterable

    from xrgs.config import Conf

_PACKAGE = Path(__file__).parent
#: Files of the package whose change can change a trained number (folders: every .py inside).
TRAINING_CODE = ("splat", "components.py", "dataset.py", "evaluate.py", "metrics.py", "train.py")


def code_digests(names: Iterable[str] = TRAINING_CODE) -> dict[str, str]:
    """SHA-256 of each source file under `names`, keyed by its path inside the package."""
    found: dict[str, str] = {}
    for name in names:
        path = _PACKAGE / name
        files = sorted(path.rglob("*.py")) if path.is_dir() else [path]
        found |= {file.relative_to(_PACKAGE).as_posix(): file_digest(file) for file in files}
    return found


@cache
def _training_code(backend: str) -> dict[str, str]:
    code = code_digests()
    if backend == "native":
        spec = find_spec("xrgs._native")
        if spec is not None and spec.origin is not None:
            code["_native"] = file_digest(Path(spec.origin))
    return code


def cell_identity(conf: Conf, variant_id: str) -> dict[str, Any]:
    """Everything that decides a cell's numbers, as plain JSON values."""
    backend = resolve_backend(conf.splat.backend)
    return {
        "splat": asdict(conf.splat) | {"backend": backend},
        "train": asdict(conf.train),
        "components": asdict(conf.components),
        "seed": conf.seed,
        "variant": variant_id,
        "protocol": PROTOCOL,
        "code": _training_code(backend),
    }
