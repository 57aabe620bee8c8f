"""The commit of a checkout of xrgs, and what differs from it.

The build backend runs this file, without the package, to write `xrgs/_commit.json` into sdists and
wheels. It must import only the standard library.
"""

from __future__ import annotations

import hashlib
import subprocess
from pathlib import Path

#: The file in the package of a wheel or an sdist that has the result of `of_checkout` at the build.
FILE = "_commit.json"
#: The folders of a checkout that a cell's numbers come from.
_SOURCES = ("xrgs", "conf", "sweeps", "hydra_plugins")


def of_checkout(root: Path) -> dict[str, str | None] | None:
    """Return the commit of a checkout and the hash of its changed sources, as in `Provenance`.

    None where the folder is not itself the root of a checkout, though it may be inside another one,
    or where git can't tell.
    """
    if not (root / ".git").exists():  # a file in a worktree
        return None
    commit = (_git(root, "rev-parse", "HEAD") or "").strip()
    if not commit:
        return None
    diff = _uncommitted(root)
    sha256 = hashlib.sha256(diff.encode()).hexdigest() if diff else None
    return {"git": commit, "git_diff_sha256": sha256}


def _uncommitted(root: Path) -> str:
    """Return the diff of tracked sources from the commit, and new files with their hashes."""
    listed = _git(root, "ls-files", "--others", "--exclude-standard", "-z", "--", *_SOURCES) or ""
    new = [name for name in listed.split("\0") if name]
    hashes = (_git(root, "hash-object", "--", *new) if new else "") or ""
    return "\n".join([_git(root, "diff", "HEAD", "--", *_SOURCES) or "", *new, hashes]).strip()


def _git(root: Path, *arguments: str) -> str | None:
    command = ["git", "-C", str(root), *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)  # noqa: S603
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout
