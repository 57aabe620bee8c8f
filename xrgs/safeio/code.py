"""Computes digests of source code in which comments, docstrings and blank lines do not count.

The digest is of text and not of a syntax tree, whose dump differs between versions of Python: the
spans that `ast` and `tokenize` find are cut out of the text, and blank lines are dropped.
"""

from __future__ import annotations

import ast
import hashlib
import io
import re
import tokenize
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from xrgs.errors import XrgsError

PACKAGE = Path(__file__).parents[1]
_NAME = "xrgs"
_SUFFIXES = frozenset({".py", ".cpp", ".h", ".txt"})
#: Modules that define only types: an import from them changes no result.
_TYPING = frozenset({"__future__", "typing", "typing_extensions", "collections.abc", "_typeshed"})
_TYPING |= {"numpy.typing"}
#: Comments of C++, and the strings, raw strings and character literals that may contain text like a
#: comment. A raw string ends with the delimiter that it begins with.
_CPP = re.compile(
    r'R"(?P<mark>[^(]*)\(.*?\)(?P=mark)"'
    r"|\"(?:\\.|[^\"\\\n])*\"|(?<![0-9A-Fa-f])'(?:\\.|[^'\\\n])*'"  # but for the ' of 1'000
    r"|(?P<comment>//[^\n]*|/\*.*?\*/)",
    re.DOTALL,
)
#: Strings and line comments of CMake.
_CMAKE = re.compile(r'"(?:\\.|[^"\\])*"|(?P<comment>#[^\n]*)', re.DOTALL)


@dataclass(frozen=True)
class CodeFolders:
    """Folders whose code decides numbers: a core that counts always, and parts that can be off.

    A file that only parts import counts with each of them. A file of `folders_of_parts` that is no
    part and that nothing imports never counts. Files and folders are relative to the package.
    """

    folders: tuple[str, ...]
    """The folders."""
    whole_parts: tuple[str, ...]
    """Folders below these that the core leaves out. The caller takes each as a part, or not at
    all."""
    folders_of_parts: tuple[str, ...]
    """Folders below these in which each file is a part, or is imported by a part or the core."""
    parts: frozenset[str]
    """The files of the parts in these folders."""
    registries: frozenset[str] = frozenset()
    """Files that import the parts to list them. They never count."""

    def core(self) -> tuple[str, ...]:
        """Return the files that count always, sorted."""
        outside = (*self.whole_parts, *self.folders_of_parts)
        names = {file.relative_to(PACKAGE).as_posix() for file in sources(*self.folders)}
        files = {name for name in names if not _is_in(name, outside)}
        files |= {f"{folder}/__init__.py" for folder in self.folders_of_parts}
        return tuple(sorted(self._with_imports(files, self.parts) - self.registries))

    def part(self, file: str, core: tuple[str, ...] = ()) -> tuple[str, ...]:
        """Return the file of a part, and the files of `folders_of_parts` that it needs, sorted.

        A caller that asks for several parts gives `core()`, which takes most of the time.
        """
        others = {*(core or self.core()), *self.registries}
        return tuple(sorted(self._with_imports({file}, others)))

    def needed_by(self, files: Iterable[Path]) -> dict[str, Path]:
        """Return the parts that files of any package import, and what these need, by name."""
        core = {*self.core()}
        parts = {n for file in files for n in _imported(file, self.folders_of_parts)} - core
        return {name: PACKAGE / name for name in self._with_imports(parts, core | self.registries)}

    def _with_imports(self, files: set[str], end: Iterable[str]) -> set[str]:
        """Add all files of `folders_of_parts` that files import, but for those of `end`."""
        files, pending = set(files), list(files)
        while pending:
            imported = _imported(PACKAGE / pending.pop(), self.folders_of_parts)
            pending += imported - files - {*end}
            files |= imported - {*end}
        return files


def _is_in(name: str, folders: Iterable[str]) -> bool:
    return any(name.startswith(f"{folder}/") for folder in folders)


def _imported(file: Path, folders: Iterable[str]) -> set[str]:
    """Return the files below these folders that a file imports, if only for types."""
    if file.suffix != ".py":
        return set()
    packages = [f"{_NAME}.{folder.replace('/', '.')}." for folder in folders]
    imported = {
        _file_of(dotted)
        for dotted in _own_imports(file, file.stat().st_mtime_ns)
        if any(f"{dotted}.".startswith(package) for package in packages)
    }
    return {name for name in imported if name is not None and _is_in(name, folders)}


def _file_of(dotted: str) -> str | None:
    """Return the file of a module of this package, or the one that defines a name."""
    parts = dotted.split(".")[1:]
    for names in (parts, parts[:-1]):
        module = PACKAGE.joinpath(*names)
        for file in (module.with_suffix(".py"), module / "__init__.py"):
            if names and file.is_file():
                return file.relative_to(PACKAGE).as_posix()
    return None


@cache
def _own_imports(file: Path, _modified_ns: int) -> frozenset[str]:
    """Return the dotted names that a file imports from this package."""
    dotted: set[str] = set()
    for node in ast.walk(ast.parse(file.read_bytes())):
        if isinstance(node, ast.Import):
            dotted.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            dotted.update(f"{node.module}.{alias.name}" for alias in node.names)
    return frozenset(name for name in dotted if name.startswith(f"{_NAME}."))


def code_digest(*names: str) -> str:
    """Return a digest of source files of this package, 16 hexadecimal digits.

    Names are relative to the package; that of a folder stands for every source file below it.
    """
    return digest_files({file.relative_to(PACKAGE).as_posix(): file for file in sources(*names)})


def sources(*names: str) -> list[Path]:
    """Return the source files that names stand for, see `code_digest`; sorted.

    It raises XrgsError if there is no such file or folder.
    """
    files: set[Path] = set()
    for name in names:
        path = PACKAGE / name
        if not path.exists():
            raise XrgsError(f"{path}: this source file is missing; install xrgs again")
        files.update(path.rglob("*") if path.is_dir() else [path])
    return sorted(file for file in files if file.suffix in _SUFFIXES)


def digest_files(files: dict[str, Path]) -> str:
    """Return a digest of source files by their names, which count too; 16 hexadecimal digits."""
    sha256 = hashlib.sha256()
    for name, file in sorted(files.items()):
        sha256.update(f"{name}\0{_meaning_of(file, file.stat().st_mtime_ns)}\0".encode())
    return sha256.hexdigest()[:16]


@cache
def _meaning_of(file: Path, _modified_ns: int) -> str:
    """Return `meaning` of a file; a plan asks for the same files for each of its cells."""
    content = file.read_bytes()
    try:
        return meaning(content.decode("utf-8"), file.suffix)
    except UnicodeDecodeError:  # data in the package of a plugin
        return hashlib.sha256(content).hexdigest()


def meaning(text: str, suffix: str) -> str:
    """Return source code without the text that changes no result.

    `suffix` is `.py`, `.cpp`, `.h` or `.txt` (CMake); other text is returned as it is.
    """
    if suffix == ".py":
        text = _cut(text, _python_spans(text))
    elif suffix in {".cpp", ".h"}:
        text = _CPP.sub(lambda match: " " if match["comment"] else match[0], text)
    elif suffix == ".txt":
        text = _CMAKE.sub(lambda match: "" if match["comment"] else match[0], text)
    return "\n".join(line for line in map(str.rstrip, text.splitlines()) if line.strip())


#: Start and end of a part of a text: lines from 1, columns from 0.
_Span = tuple[tuple[int, int], tuple[int, int]]


def _python_spans(text: str) -> list[_Span]:
    """Find comments, docstrings and type-only imports; columns are in characters."""
    lines = text.splitlines(keepends=True)

    def span(node: ast.stmt) -> _Span:
        # `ast` counts columns in bytes of UTF-8.
        def position(line: int, column: int) -> tuple[int, int]:
            return line, len(lines[line - 1].encode()[:column].decode())

        end = position(node.end_lineno or node.lineno, node.end_col_offset or 0)
        return position(node.lineno, node.col_offset), end

    statements = (node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.stmt))
    spans = [span(node) for node in statements if _is_idle(node)]
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return spans + [(token.start, token.end) for token in tokens if token.type == tokenize.COMMENT]


def _is_idle(node: ast.stmt) -> bool:
    """Return whether a statement is a docstring, or a type-only import or block."""
    match node:
        case ast.Expr(value=ast.Constant(value=str())):  # docstrings of attributes too
            return True
        case ast.ImportFrom(module=str(module)):
            return module in _TYPING
        case ast.If(test=ast.Name(id="TYPE_CHECKING"), orelse=[]):
            return True
    return False


def _cut(text: str, spans: list[_Span]) -> str:
    """Return a text without some of its parts, which may overlap."""
    lines = text.splitlines(keepends=True)
    for (first, start), (last, end) in spans:
        for number in range(first - 1, last):
            line = lines[number].rstrip("\n")
            left = start if number == first - 1 else 0
            right = end if number == last - 1 else len(line)
            # Blanks keep the columns of other parts of the same line.
            lines[number] = line[:left] + " " * (right - left) + line[right:] + "\n"
    return "".join(lines)
