"""File operations that `pathlib` lacks: bounded reads, walks, removal of any path, and fsync.

A store belongs to its user: paths in it are plain `Path`s, and links in it are followed. A store of
somebody else is checked once, by `xrgs-store import`.
"""

from __future__ import annotations

import errno
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

#: The largest file that is read whole, in bytes. A sweep's record of ten thousand cells has 3 MB.
MAX_BYTES = 1 << 26
#: Errors that another try gives again: the path leads to nothing, or to another kind of thing. All
#: others may be gone then: permissions, a disk or a server that fails, too many open files.
_CONCLUSIVE = frozenset(
    {
        errno.ENOENT,
        errno.ENOTDIR,
        errno.EISDIR,
        errno.ELOOP,
        errno.EINVAL,
        errno.EFBIG,
        errno.ENAMETOOLONG,
        errno.ENXIO,
    }
)
#: The longest name in bytes: file systems end at 255, and `.png` may be appended.
_MAX_NAME_BYTES = 251
_NOT_IN_NAMES = re.compile(r"[/\\\x00-\x1f\x7f-\x9f\ud800-\udfff]")


def is_transient(error: OSError) -> bool:
    """Return True for an I/O error that says nothing about the file's content: try again later.

    Errors that libraries raise without a number are about the content.
    """
    return error.errno is not None and error.errno not in _CONCLUSIVE


def is_name(value: object) -> bool:
    """Return whether a value can name one file or folder on any file system.

    A name is a string of at most 251 bytes without slash, backslash, control character or lone
    surrogate, and is neither empty, `.` nor `..`. It may have any script, spaces and quotes.
    """
    if not isinstance(value, str) or value in {"", ".", ".."} or _NOT_IN_NAMES.search(value):
        return False
    return len(value.encode("utf-8")) <= _MAX_NAME_BYTES


def is_inside(value: object) -> bool:
    """Return whether a value is a relative path with `/` whose parts all satisfy `is_name`."""
    return isinstance(value, str) and all(is_name(part) for part in value.split("/"))


def list_names(folder: Path) -> list[str]:
    """Return the sorted names in a folder; names that aren't UTF-8 have lone surrogates."""
    return sorted(path.name for path in folder.iterdir())


def walk_files(folder: Path, *, hidden: bool = False) -> Iterator[tuple[str, os.stat_result]]:
    """Yield each file below a folder: its path from there, with `/`, and its status.

    Links to folders are files here, so that no walk is endless. Names that begin with a dot are
    passed over unless `hidden`: the system makes and removes such files when it likes (`.nfs0123`
    of a file that is removed while it is open on NFS, `.DS_Store`), and no result has such a name.
    """
    waiting = [""]
    while waiting:
        inside = waiting.pop()
        with os.scandir(folder / inside) as entries:
            for entry in entries:
                name = f"{inside}{entry.name}"
                if entry.name.startswith(".") and not hidden:
                    continue
                if entry.is_dir(follow_symlinks=False):
                    waiting.append(f"{name}/")
                else:
                    yield name, entry.stat(follow_symlinks=False)


def file_bytes(path: Path) -> int:
    """Return the bytes of the regular files at a path and below."""
    statuses = [path.lstat()]
    if path.is_dir():
        statuses = [status for _, status in walk_files(path, hidden=True)]
    return sum(status.st_size for status in statuses if stat.S_ISREG(status.st_mode))


def read_bytes(path: Path, max_bytes: int = MAX_BYTES) -> bytes:
    """Read a regular file of at most `max_bytes`.

    The OSError for a file that is missing, larger (EFBIG) or not a regular file (EINVAL) has the
    path as `filename`.
    """
    # Opening a named pipe without O_NONBLOCK waits for its writer.
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise OSError(errno.EINVAL, "not a regular file", str(path))
        if status.st_size > max_bytes:
            why = f"{status.st_size} bytes, at most {max_bytes} are read"
            raise OSError(errno.EFBIG, why, str(path))
        with open(descriptor, "rb", closefd=False) as stream:
            return stream.read(status.st_size)  # `max_bytes` would allocate all of it
    finally:
        os.close(descriptor)


def check_writable(folder: Path, count: int = 0) -> None:
    """Check that a file of `count` bytes can be written in a folder, and leave nothing behind.

    Of a folder that does not exist, the nearest one above that does is tried: the OSError has its
    path as `filename`.
    """
    folder = folder.absolute()
    while not folder.exists() and not folder.is_symlink():
        folder = folder.parent
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(count))
    except OSError as error:
        error.filename = str(folder)  # the file's own name is random
        raise


def remove_path(path: Path) -> None:
    """Remove a file, a link, or a folder with its content; do nothing where nothing is there.

    The target of a link is never touched.
    """
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def sync_name(path: Path) -> None:
    """Wait until the name of a file or folder is on the disk, after it was created or renamed.

    Without this, a power failure can lose the name of a file whose content was synced.
    """
    _sync_folder(path.parent)


def sync_tree(folder: Path) -> None:
    """Wait until all files below a folder are on the disk, with their names, but not its own."""
    folders = {folder}
    for name, status in walk_files(folder):
        file = folder / name
        folders.update(above for above in file.parents if above.is_relative_to(folder))
        if stat.S_ISREG(status.st_mode):
            with file.open("rb") as stream:
                os.fsync(stream.fileno())
    for inside in folders:
        _sync_folder(inside)


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    except OSError as error:
        # Some file systems cannot sync a folder.
        if error.errno not in {errno.EINVAL, errno.ENOTSUP}:
            raise OSError(error.errno, error.strerror, str(folder)) from None
    finally:
        os.close(descriptor)
