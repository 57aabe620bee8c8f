"""What mkdocs adds to the pages of docs/ when it builds the site.

- The home page is README.md. A file of the repository that a page links to is part of the site, and
  so are the pages and files that it links to in turn. Links are those of the repository: a page
  reads the same on a code host, and a link that leads nowhere ends `mkdocs build --strict`.
- Reference pages are made of what they describe: the keys of conf/config.yaml, the other files of
  conf/ and sweeps/, and what each command prints for `--help`.
- Formulas become MathML, which browsers show without a script.
"""

from __future__ import annotations

import html
import io
import os
import posixpath
import re
import sys
import textwrap
import tomllib
from contextlib import redirect_stdout
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING
from unittest.mock import patch

from latex2mathml.converter import convert
from mkdocs.structure.files import File

from xrgs import config as xrgs_config
from xrgs.cli import sweep
from xrgs.registry import BUILT_IN

if TYPE_CHECKING:
    from collections.abc import Iterator

    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
#: Pages that are made of a file of the repository: a link to the file leads to its page.
PAGES = {
    "README.md": "index.md",
    "conf/config.yaml": "conf/config.md",
    "xrgs/registry.py": "components.md",
}
#: Files that are shown as a page, with the language that they are highlighted as.
SOURCES = {".py": "python", ".yaml": "yaml", ".bib": "bibtex", ".cff": "yaml", ".toml": "toml"}
_COLUMNS = 100  # of the help of commands
FILES_PAGE = "conf/files.md"
#: Folders of conf/ and their titles, in the order of the page.
GROUPS = {
    "ablation": "Ablations",
    "variant": "Variants",
    "preset": "Presets",
    "scene": "Scenes",
    "sweeps": "Studies",
}

_FENCE = re.compile(r"(^ *```.*?^ *```\s*?$)", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"(\]\()(?!\w+:)([^)#\s]+)((?:#[^)\s]*)?\))")
_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[\[(](.*?)\\[\])]</\1>', re.DOTALL)
_NUMBER = re.compile(r"\\tag\{(\d+)\}")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages, README.md as home, and all that pages link to in the repository."""
    made = {
        "conf/config.md": keys_page(),
        FILES_PAGE: files_page(),
        "commands.md": commands_page(),
        "components.md": components_page(),
    }
    for uri, text in made.items():
        files.append(File.generated(config, uri, content=text))
    pages = [DOCS / file.src_uri for file in files.documentation_pages() if not file.generated_by]
    queue = [*pages, ROOT / "README.md", ROOT / "CHANGELOG.md"]
    seen = set(pages)
    while queue:
        path = queue.pop()
        if path not in seen:
            seen.add(path)
            _add(files, config, path)
        if path.suffix == ".md":
            queue += [target for target in _targets(path) if target not in seen]
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Make links to files of the repository links to their places on the site."""
    del config, files
    source = page.file.abs_src_path
    if source is None or Path(source).suffix != ".md":  # made above
        return markdown
    folder = Path(source).resolve().parent
    here = posixpath.dirname(page.file.src_uri)
    if page.file.name == "table":  # the numbers of studies: 2 MB that nobody searches for
        page.meta["search"] = {"exclude": True}

    def moved(link: re.Match[str]) -> str:
        target = (folder / link[2]).resolve()
        if not target.exists():  # mkdocs says so
            return link[0]
        uri = posixpath.relpath(site_uri(target), here or ".")
        return f"{link[1]}{uri}{link[3]}"

    parts = _FENCE.split(markdown)  # every other part is a block of code
    parts[::2] = [_LINK.sub(moved, part) for part in parts[::2]]
    return "".join(parts)


def on_page_content(content: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Make MathML of formulas."""
    del page, config, files
    return _FORMULA.sub(lambda found: _mathml(html.unescape(found[2]), found[1]), content)


def site_uri(path: Path) -> str:
    """Return the place on the site of a file of the repository, as mkdocs names sources."""
    name = path.relative_to(DOCS if path.is_relative_to(DOCS) else ROOT).as_posix()
    group, _, file = name.removeprefix("conf/").partition("/")
    if name in PAGES:
        return PAGES[name]
    if group in GROUPS:
        anchor = f"{group}-{_slug(file.removesuffix('.yaml'))}" if file else GROUPS[group].lower()
        return f"{FILES_PAGE}#{anchor}"
    return f"{name}.md" if path.suffix in SOURCES else name


def _slug(name: str) -> str:
    return name.replace("/", "-")


def keys_page() -> str:
    """Return the page of every key of conf/config.yaml: its value and its comment."""
    parts = [
        "# Every key",
        "The baseline is gsplat's default training, with every component present and off."
        " `KEY=VALUE` on the command line sets a key. `xrgs-sweep help=KEY` prints what stands"
        " here, and `xrgs-sweep --cfg job` the values in effect. Presets, scenes, variants and"
        " ablations set [other values](files.md). Numbers of steps are of a run of 30,000 steps,"
        " and shrink with `train.steps`, unless a key says otherwise.",
    ]
    titles: dict[str, list[str]] = {"": ["## The run"]}  # a group's title and keys, by its name
    for key, (value, comment) in sweep.entries().items():
        text = html.escape(" ".join(comment), quote=False)
        text = text[:1].upper() + text[1:]  # of a comment behind a value
        if not value:
            titles[key] = [f"## `{key}` {{ #{key} }}", text]
        else:
            said = [f"### `{key}={value}` {{ #{key} }}", text]
            titles[key.rpartition(".")[0]] += said
    return "\n\n".join([*parts, *(line for lines in titles.values() for line in lines)])


def files_page() -> str:
    """Return the page of the other files of conf/ and of sweeps/: what each sets, and why."""
    parts = [
        "# Ablations, presets, studies",
        "Each is a YAML file that changes keys of [the baseline](config.md); the command line calls"
        " it by its name. `--config-dir FOLDER` adds [your own](../study.md#files-of-your-own).",
    ]
    for group, title in GROUPS.items():
        folder = ROOT / group if group == "sweeps" else ROOT / "conf" / group
        plus = "+" if group in xrgs_config.PLUS_GROUPS else ""
        parts.append(f"## {title}")
        for file in sorted(folder.rglob("*.yaml")):
            name = file.relative_to(folder).with_suffix("").as_posix()
            text = file.read_text(encoding="utf-8").removeprefix("# @package _global_\n")
            about = re.match(r"(?:#.*\n)*", text)
            comment = re.sub(r"^# ?", "", about[0] if about else "", flags=re.MULTILINE)
            parts.append(f"### `{plus}{group}={name}` {{ #{group}-{_slug(name)} }}")
            parts.append(html.escape(" ".join(comment.split()), quote=False))
            if body := text[about.end() if about else 0 :].strip():
                parts.append(f"```yaml\n{body}\n```")
    return "\n\n".join(parts)


def commands_page() -> str:
    """Return the page of every command and subcommand: what `--help` prints."""
    parts = ["# Commands", "What each command prints for `--help`."]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for command in project["scripts"]:
        usage = _help(command).partition("\n\n")[0]
        subcommands = re.search(r"\{([a-z,]+)\}", usage)
        names = subcommands[1].split(",") if subcommands else []
        parts += [f"## `{command}`", f"```text\n{_help(command)}\n```"]
        for name in names:
            parts += [f"### `{command} {name}`", f"```text\n{_help(command, name)}\n```"]
    return "\n\n".join(parts)


def components_page() -> str:
    """Return the page of every component: the docstring of its class."""
    parts = [
        "# Components",
        "A component is one change to training. It is off unless its settings, keys of"
        " [`components`](conf/config.md#components), switch it on. The docstring of its class says"
        " what it does. They stand in the order in which their hooks run."
        " [The method](method.md) has the paper's formulas on one page, and"
        " [Add a component](extend.md#add-a-component) says how to write one.",
    ]
    options = ("members: []", "show_root_heading: false", "show_bases: false")
    lines = "".join(f"\n      {option}" for option in options)
    for key, entry in BUILT_IN.items():
        parts.append(f"## {', '.join(f'`{name}`' for name in (key, *entry.reads))}")
        path = f"xrgs.training.components.{entry.module}.{entry.name}"
        parts.append(f"::: {path}\n    options:{lines}")
    parts += ["## The interface", "::: xrgs.training.components.base.Component"]
    return "\n\n".join(parts)


def _help(command: str, *words: str) -> str:
    """Return what a command prints for `--help`, without colours."""
    main = import_module(command.replace("xrgs-", "xrgs.cli.")).main
    argv = [command, *words, "--help"]
    environment = {"COLUMNS": str(_COLUMNS), "NO_COLOR": "1", "TERM": "dumb"}
    with (
        patch.object(sys, "argv", argv),
        patch.dict(os.environ, environment),
        redirect_stdout(io.StringIO()) as printed,
    ):
        try:
            main()
        except SystemExit as end:
            if end.code:
                raise
    return "\n".join(_wrapped(line) for line in printed.getvalue().strip().splitlines())


def _wrapped(line: str) -> str:
    """Break a line of help that is too long, and indent what follows as its second column."""
    margin = " " * len(re.findall(r"^ *\S+ {2,}|^ *", line)[0])
    wrapped = textwrap.wrap(line, _COLUMNS, subsequent_indent=margin)
    return "\n".join(wrapped) if len(line) > _COLUMNS else line.rstrip()


def _add(files: Files, config: MkDocsConfig, path: Path) -> None:
    uri = site_uri(path).partition("#")[0]
    if files.get_file_from_path(uri) is not None:  # made from the file, or there already
        return
    if path.suffix in SOURCES:
        title, text = path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8")
        content = f"# {title}\n\n````{SOURCES[path.suffix]}\n{text}\n````\n"
        files.append(File.generated(config, uri, content=content))
    else:
        files.append(File.generated(config, uri, abs_src_path=str(path)))


def _targets(page: Path) -> Iterator[Path]:
    """Yield the files of the repository that a page links to."""
    for part in _FENCE.split(page.read_text(encoding="utf-8"))[::2]:
        for _, link, _ in _LINK.findall(part):
            target = (page.parent / link).resolve()
            if target.is_file() and target.is_relative_to(ROOT):
                yield target


def _mathml(latex: str, element: str) -> str:
    number = _NUMBER.search(latex)
    display = "inline" if element == "span" else "block"
    formula = convert(_NUMBER.sub("", latex).strip(), display=display)
    if element == "span":
        return formula
    return f'<div class="equation">{formula}{f"<span>({number[1]})</span>" if number else ""}</div>'
