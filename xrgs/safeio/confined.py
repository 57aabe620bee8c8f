"""Files and folders below a root that nothing in the root can lead out of.

A store, a variant or the folder of a report may come from anybody, and may hold links, named pipes
and files of any size. `ConfinedPath` is the one way into them. Its root is what a user has named:
it may be a link, or lie behind links. Below the root no link is followed, only regular files are
opened, and nothing is made in a root that is no longer there. A root can be pinned: then nothing is
written to another folder that has taken its name.

The kernel resolves such a path in one call where it has openat2 (Linux from 5.6 on); elsewhere each
folder on the way is opened from the one before, without following links.
"""

from __future__ import annotations

import errno
import os
import shutil
import stat
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from xrgs.safeio.beneath import open_folder_beneath, regular_size

if TYPE_CHECKING:
    from collections.abc import Iterator

#: The largest file that is read whole, in bytes. Ten thousand cells' sweep record takes 3 MB.
MAX_BYTES = 1 << 26
#: The deepest nesting of folders that is walked. A store's own folders have five levels.
_MAX_DEPTH = 40
_FOLDER = os.O_DIRECTORY | os.O_CLOEXEC | os.O_RDONLY
#: Opening a named pipe without O_NONBLOCK would wait for its writer, for ever.
_REGULAR = os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOFOLLOW
_READABLE_BY_ALL = 0o666  # less the umask: a store is shared by a team
#: Parts of a path that name nothing inside a folder.
_NO_NAMES = frozenset({"", ".", ".."})


#: Errors that tell what is there, or that nothing is; every other one may be gone when the same
#: file is read again: permissions, a disk or a server that fails, too many open files.
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


class RootMissingError(FileNotFoundError):
    """The root of a path is no longer there: it was moved or deleted."""


class ReplacedError(RootMissingError):
    """Another folder has the name of a root that was pinned."""


def is_passing(error: OSError) -> bool:
    """Tell whether an error says nothing about what a file holds, so that it is to be tried again.

    Args:
        error: The error of a system call that looked at a file or read it. Libraries raise others,
            without a number: those are about the content.
    """
    if isinstance(error, RootMissingError):
        return True
    return error.errno is not None and error.errno not in _CONCLUSIVE


class _Pin:
    """Keeps a folder open, so that its inode is given to no other folder meanwhile."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self.identity = _identity(os.fstat(descriptor))
        """Device and inode."""

    def open(self, name: Path) -> int:
        """Return a descriptor of the folder, which the caller closes.

        Args:
            name: The path that has to lead to it still.

        Raises:
            RootMissingError: There is nothing of that name.
            ReplacedError: Another folder has that name.
        """
        try:
            now = _identity(name.stat())
        except FileNotFoundError as error:
            raise RootMissingError(error.errno, error.strerror, str(name)) from None
        if now != self.identity:
            why = "it was replaced by another folder while this process worked in it"
            raise ReplacedError(errno.ESTALE, why, str(name))
        # Not opened by its name: that may lead to another folder by now.
        return os.dup(self._descriptor)

    def __del__(self) -> None:
        os.close(self._descriptor)


@dataclass(frozen=True, order=True)
class ConfinedPath:
    """A path below a root, which need not exist.

    It has no `__fspath__`, so that nothing opens it by any other way. Errors are those of the
    system calls, `OSError`, and name the whole path; a link on the way below the root is ELOOP, or
    ENOTDIR where a folder is expected.
    """

    root: Path
    """The folder (or the file) that a user has named."""
    parts: tuple[str, ...] = ()
    """The names from the root on."""
    pin: _Pin | None = field(default=None, compare=False, repr=False)
    """Which folder the root is, where it is pinned."""

    def __truediv__(self, inside: str) -> ConfinedPath:
        """Return a path further inside.

        Args:
            inside: A relative path with `/`.

        Raises:
            ValueError: A part of it is empty, `.` or `..`, or has a NUL character.
        """
        return ConfinedPath(self.root, (*self.parts, *_split(inside)), self.pin)

    def __str__(self) -> str:
        return str(self.path)

    @property
    def path(self) -> Path:
        """The whole path, for messages; opening it would follow links."""
        return self.root.joinpath(*self.parts)

    @property
    def name(self) -> str:
        """The last name."""
        return self.parts[-1] if self.parts else self.root.name

    @property
    def stem(self) -> str:
        """The last name without its suffix."""
        return Path(self.name).stem

    @property
    def suffix(self) -> str:
        """The suffix of the last name, with its dot; empty where there is none."""
        return Path(self.name).suffix

    @property
    def parent(self) -> ConfinedPath:
        """The folder that this is in.

        Raises:
            ValueError: This is the root.
        """
        if not self.parts:
            raise ValueError(f"{self} is the root")
        return ConfinedPath(self.root, self.parts[:-1], self.pin)

    def with_name(self, name: str) -> ConfinedPath:
        """Return a sibling.

        Args:
            name: The sibling's name.

        Raises:
            ValueError: It is not a name.
        """
        if not self.parts:
            return ConfinedPath(self.root.with_name(name))
        return self.parent / name

    def relative_to(self, folder: ConfinedPath) -> str:
        """Return the path from a folder to this, with `/`.

        Args:
            folder: A folder above this, of the same root.

        Raises:
            ValueError: This is not below the folder.
        """
        depth = len(folder.parts)
        if folder.root != self.root or self.parts[:depth] != folder.parts:
            raise ValueError(f"{self} is not in {folder}")
        return "/".join(self.parts[depth:])

    # Looking

    def lstat(self) -> os.stat_result:
        """Return what the system knows of the file, the folder, or the link itself."""
        with self._located() as (folder, name):
            return os.stat(name, dir_fd=folder, follow_symlinks=not self.parts)

    def identity(self) -> tuple[int, int]:
        """Return device and inode of whatever is there; no two things that exist share them."""
        if self.pin is not None and not self.parts:
            return self.pin.identity
        return _identity(self.lstat())

    def exists(self) -> bool:
        """Tell whether something is there: a file, a folder, a link or anything else.

        Raises:
            OSError: It can't be told now, for want of permission or because the disk fails.
        """
        return self._mode() != 0

    def is_file(self) -> bool:
        """Tell whether a regular file is there, and raise as `exists` does."""
        return stat.S_ISREG(self._mode())

    def is_dir(self) -> bool:
        """Tell whether a folder is there, and raise as `exists` does."""
        return stat.S_ISDIR(self._mode())

    def is_link(self) -> bool:
        """Tell whether a symbolic link is there, and raise as `exists` does."""
        return stat.S_ISLNK(self._mode())

    def look(self) -> os.stat_result | None:
        """Return what `lstat` returns; None where nothing is there. It raises as `exists` does."""
        try:
            return self.lstat()
        except RootMissingError:
            raise
        except (FileNotFoundError, NotADirectoryError):
            return None

    def _mode(self) -> int:
        found = self.look()
        return 0 if found is None else found.st_mode

    def sizes(self, names: list[str]) -> dict[str, int]:
        """Return the bytes of regular files below this folder; -1 for whatever is not one.

        Each folder is opened once for all files in it.

        Args:
            names: Paths in this folder, with `/`.

        Raises:
            OSError: It can't be told now what a name is.
            ValueError: A name is not a path in this folder.
        """
        sizes = dict.fromkeys(names, -1)
        by_folder: dict[str, list[str]] = {}
        for name in names:
            _split(name)
            by_folder.setdefault(name.rpartition("/")[0], []).append(name)
        for folder, inside in by_folder.items():
            try:
                with (self / folder if folder else self)._opened() as descriptor:
                    for name in inside:
                        sizes[name] = regular_size(descriptor, name.rpartition("/")[2])
            except OSError as error:
                if is_passing(error):
                    raise
        return sizes

    def names(self) -> list[str]:
        """Return the names in this folder, sorted; names that aren't UTF-8 have lone surrogates."""
        with self._opened() as folder:
            return sorted(os.listdir(folder))  # noqa: PTH208  Path lists no descriptor

    def siblings(self) -> list[str]:
        """Return the names in the folder that this is in, sorted."""
        return self._around().names()

    def iterdir(self) -> list[ConfinedPath]:
        """Return the paths in this folder, sorted by name."""
        return [ConfinedPath(self.root, (*self.parts, name), self.pin) for name in self.names()]

    def folders(self) -> list[str]:
        """Return the names of the folders in this folder, sorted; links are none."""
        with self._opened() as folder, os.scandir(folder) as entries:
            return sorted(entry.name for entry in entries if entry.is_dir(follow_symlinks=False))

    def walk(self) -> Iterator[tuple[str, os.stat_result]]:
        """Yield the path from here and the status of whatever is below this folder but folders.

        Raises:
            OSError: A folder can't be read, or they are nested more than 40 deep.
        """
        waiting = [self]
        while waiting:
            folder = waiting.pop()
            if len(folder.parts) - len(self.parts) > _MAX_DEPTH:
                raise OSError(errno.ENAMETOOLONG, "folders are nested too deeply", str(folder))
            with folder._opened() as descriptor, os.scandir(descriptor) as entries:
                for entry in entries:
                    inside = ConfinedPath(self.root, (*folder.parts, entry.name), self.pin)
                    if entry.is_dir(follow_symlinks=False):
                        waiting.append(inside)
                    else:
                        yield inside.relative_to(self), entry.stat(follow_symlinks=False)

    # Reading

    def open(self) -> BinaryIO:
        """Open a regular file for reading.

        Raises:
            OSError: It is missing, or a link, a pipe, a device or a folder.
        """
        return os.fdopen(self._open_regular(os.O_RDONLY), "rb")

    def read_bytes(self, max_bytes: int = MAX_BYTES) -> bytes:
        """Read all of a regular file.

        Args:
            max_bytes: The largest size that is read; a file of exactly this size is.

        Raises:
            OSError: As `open`, or the file is larger than `max_bytes`.
        """
        with self.open() as stream:
            size = os.fstat(stream.fileno()).st_size
            content = stream.read(size + 1) if size <= max_bytes else b""
            if len(content) > size:  # it grows; otherwise no more memory than this is asked for
                content += stream.read(max_bytes + 1 - len(content))
        if max(size, len(content)) > max_bytes:
            why = f"{max(size, len(content))} bytes, at most {max_bytes} are read"
            raise OSError(errno.EFBIG, why, str(self))
        return content

    def read_text(self, max_bytes: int = MAX_BYTES) -> str:
        """Read all of a UTF-8 file.

        Args:
            max_bytes: As for `read_bytes`.

        Raises:
            OSError: As `read_bytes`.
            UnicodeDecodeError: The content is not UTF-8.
        """
        return self.read_bytes(max_bytes).decode("utf-8")

    # Writing

    def create(self) -> BinaryIO:
        """Create a file for writing.

        Raises:
            FileExistsError: Something of that name exists.
            OSError: The file can't be created.
        """
        return os.fdopen(self._open_regular(os.O_WRONLY | os.O_CREAT | os.O_EXCL), "wb")

    def append(self) -> BinaryIO:
        """Open a regular file for writing at its end; it is created where it is missing."""
        return os.fdopen(self._open_regular(os.O_WRONLY | os.O_CREAT | os.O_APPEND), "ab")

    def update(self) -> BinaryIO:
        """Open an existing regular file for reading and writing, with the content that it has.

        What is written goes to the file that was opened, even if its name is another file's or
        nobody's by then.

        Raises:
            OSError: As `open`, or the file can't be written.
        """
        return os.fdopen(self._open_regular(os.O_RDWR), "r+b")

    def make_folder(self, *, exclusive: bool = False) -> None:
        """Make this folder and those above it, as far as they are below the root.

        Args:
            exclusive: Whether it is an error that the folder exists. Only so is a root itself made.

        Raises:
            RootMissingError: The root is not there.
            OSError: A folder can't be made, or something else has its name.
        """
        for depth in range(1, len(self.parts)):
            ConfinedPath(self.root, self.parts[:depth], self.pin)._make_one(exclusive=False)
        if self.parts or exclusive:
            self._make_one(exclusive=exclusive)

    def make_parent(self) -> None:
        """Make the folder that this is in; for a root, with those above it, as a user asked."""
        if self.parts:
            self.parent.make_folder()
        else:
            self.root.parent.mkdir(parents=True, exist_ok=True)

    def _make_one(self, *, exclusive: bool) -> None:
        with self._located() as (folder, name):
            try:
                os.mkdir(name, dir_fd=folder)
            except FileExistsError:
                if exclusive or not self.is_dir():
                    raise

    def rename(self, target: ConfinedPath) -> None:
        """Give this file or folder another name, in the place of a file that has it.

        Args:
            target: The new path.

        Raises:
            OSError: It can't be renamed; for a folder, also where a folder with content is there.
        """
        with self._located() as (here, name), target._located() as (there, new):
            os.rename(name, new, src_dir_fd=here, dst_dir_fd=there)

    def unlink(self, *, missing_ok: bool = False) -> None:
        """Remove a file or a link.

        Args:
            missing_ok: Whether a missing file is no error; a missing root always is one.
        """
        try:
            with self._located() as (folder, name):
                os.unlink(name, dir_fd=folder)
        except RootMissingError:
            raise
        except FileNotFoundError:
            if not missing_ok:
                raise

    def remove(self) -> None:
        """Remove a file, a link, or a folder with all that is in it.

        Nothing happens where nothing is there. What a link leads to is never touched.

        Raises:
            OSError: It is there and can't be removed.
        """
        if not self.is_dir():
            self.unlink(missing_ok=True)
            return
        with self._located() as (folder, name):
            try:
                shutil.rmtree(name, dir_fd=folder)
            except RecursionError:
                why = "folders are nested too deeply to be removed"
                raise OSError(errno.ENAMETOOLONG, why, str(self)) from None

    def sync_name(self) -> None:
        """Wait until this name is on the disk, as after creating or renaming the file or folder.

        A file whose content was synced can still be lost with its name in a power failure.
        """
        with self._around()._opened() as folder, self._naming_errors():
            _sync_folder(folder)

    def sync_tree(self) -> None:
        """Wait until the files in this folder and all folders below are on the disk, names and all.

        The name of this folder itself is not, see `sync_name`.
        """
        folders = {self}
        for name, status in self.walk():
            file = folder = self / name
            while (folder := folder.parent) not in folders:
                folders.add(folder)
            if stat.S_ISREG(status.st_mode):
                with file.open() as stream, file._naming_errors():
                    os.fsync(stream.fileno())
        for folder in folders:
            with folder._opened() as descriptor, folder._naming_errors():
                _sync_folder(descriptor)

    def make_root(self) -> None:
        """Make the root, a folder, with those above it. A root that vanishes is not made again.

        Raises:
            OSError: It can't be made, or something else has its name.
        """
        self.root.mkdir(parents=True, exist_ok=True)

    def pinned(
        self, identity: tuple[int, int] | None = None, name: Path | None = None
    ) -> ConfinedPath:
        """Return this folder as a root that is this very folder, whatever else gets its name.

        All that is done with paths below it is done in the folder that is open now, and only while
        the name leads to it. It stays open as long as one of these paths exists.

        Args:
            identity: Device and inode that the folder must have.
            name: The name by which the folder is to be known, once it is renamed to it.

        Raises:
            ReplacedError: The folder is another one.
            OSError: It can't be opened.
        """
        with self._opened() as descriptor:
            pin = _Pin(os.dup(descriptor))
        if identity not in {None, pin.identity}:
            why = "it was replaced by another folder before this process began to work in it"
            raise ReplacedError(errno.ESTALE, why, str(self))
        return ConfinedPath(name or self.path, pin=pin)

    # Resolving

    def _open_regular(self, flags: int) -> int:
        flags |= _REGULAR
        if not self.parts:  # a user may name a link
            flags &= ~os.O_NOFOLLOW
        with self._located() as (folder, name):
            descriptor = os.open(name, flags, _READABLE_BY_ALL, dir_fd=folder)
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            os.close(descriptor)
            raise OSError(errno.EINVAL, "not a regular file", str(self))
        return descriptor

    def _around(self) -> ConfinedPath:
        """Return the folder that this is in, of a root as well."""
        return self.parent if self.parts else ConfinedPath(self.root.parent)

    @contextmanager
    def _located(self) -> Iterator[tuple[int | None, str]]:
        """Open the folder that this is in; yield its descriptor and the last name.

        For a root, which the user has named, the descriptor is None and the name its whole path:
        the folder around it need not be readable. An error in the block names the whole path.
        """
        if not self.parts:
            with self._naming_errors():
                yield None, str(self.root)
            return
        with self.parent._opened() as folder, self._naming_errors():
            yield folder, self.parts[-1]

    @contextmanager
    def _opened(self) -> Iterator[int]:
        """Open this folder; yield its descriptor."""
        descriptor = self._open_root()
        try:
            if self.parts:
                root = descriptor
                with self._naming_errors():
                    descriptor = open_folder_beneath(root, self.parts)
                os.close(root)
            yield descriptor
        finally:
            os.close(descriptor)

    def _open_root(self) -> int:
        if self.pin is not None:
            return self.pin.open(self.root)
        try:
            return os.open(self.root, _FOLDER)
        except FileNotFoundError as error:
            raise RootMissingError(error.errno, error.strerror, str(self.root)) from None

    @contextmanager
    def _naming_errors(self) -> Iterator[None]:
        try:
            yield
        except RootMissingError:
            raise
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self)) from None


def confined(path: Path | ConfinedPath) -> ConfinedPath:
    """Return a path that a user has named as the root that it is; a confined one as it stands.

    Args:
        path: The path.
    """
    return path if isinstance(path, ConfinedPath) else ConfinedPath(path)


def _split(inside: str) -> list[str]:
    parts = inside.split("/")
    if "\0" in inside or not _NO_NAMES.isdisjoint(parts):
        raise ValueError(f"{inside!r:.200} is not a path inside a folder")
    return parts


def _identity(status: os.stat_result) -> tuple[int, int]:
    return status.st_dev, status.st_ino


def _sync_folder(descriptor: int) -> None:
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in {errno.EINVAL, errno.ENOTSUP}:  # the file system has no such thing
            raise
