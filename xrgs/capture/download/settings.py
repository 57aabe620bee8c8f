"""What a published set of scenes is, as `conf/data/` describes it."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class DatasetConf:
    """One archive of scenes, a folder each."""

    url: str = ""
    page: str = ""
    """Where a person finds the archive with a browser."""
    file: str = ""
    """The archive's name on disk."""
    max_bytes: int = 0
    """The most that is downloaded for it, whatever the server says or sends."""
    sha256: str = ""
    """Of the archive, in hexadecimal; empty where it is not known."""
    folder: str = ""
    """The folder in the archive that holds the scenes' folders."""
    scenes: list[str] = field(default_factory=list)
    """All that the archive holds."""
