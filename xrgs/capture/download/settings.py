"""The config schema of a published set of scenes, whose values are in `conf/data/`."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class DatasetConf:
    """One archive of scenes, each in a folder of its own."""

    url: str = ""
    """The address to download the archive from."""
    page: str = ""
    """The web page where a person finds the archive with a browser."""
    file: str = ""
    """The archive's file name on disk."""
    max_bytes: int = 0
    """The largest size that is downloaded, in bytes, whatever the server announces or sends."""
    sha256: str = ""
    """The archive's SHA-256, in hexadecimal; empty where it is not known."""
    redirect_hosts: list[str] = field(default_factory=list)
    """Hosts besides that of `url` to which it may redirect, with a port where it is not the usual
    one; redirects to others are refused."""
    folder: str = ""
    """The folder in the archive that holds the scenes' folders."""
    scenes: list[str] = field(default_factory=list)
    """The names of all scenes in the archive."""
