"""Paths as users write them."""

from __future__ import annotations

from pathlib import Path


def user_path(text: str) -> Path:
    """Return the path that a user wrote, with `~` and `~name` expanded to home folders.

    It stays as it stands where there is no user of that name, or no home folder, as for a user of a
    container without HOME.
    """
    try:
        return Path(text).expanduser()
    except RuntimeError:
        return Path(text)
