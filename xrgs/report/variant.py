"""Describes a variant for `xrgs-data inspect`: its views, how SfM went, and a contact sheet."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from xrgs.capture import variant
from xrgs.capture.contact_sheet import contact_sheet
from xrgs.capture.failures import FAILED_PREFIX
from xrgs.errors import XrgsError
from xrgs.report.render import TextTable, to_text
from xrgs.safeio.atomic import atomic_writer
from xrgs.safeio.files import is_name
from xrgs.safeio.records import read_struct
from xrgs.safeio.sanitize import for_line

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from xrgs.capture.views import Variant

#: How many names of views and attempts of a report are read.
_MAX_NAMES, _MAX_ATTEMPTS = 1 << 14, 10
_REGISTERED, _NOT_REGISTERED = "yes", "no"


def describe(path: Path, out: Path | None = None) -> str:
    """Describe a frozen variant and draw its contact sheet; for a failed one, say why it failed.

    Args:
        path: The variant's folder in a store, or the `failed-...` folder of one that failed.
        out: The PNG of the contact sheet; None writes `<variant id>.png` to the current folder.

    Returns:
        Tables and lines for a terminal. They name each image that can't be read.

    Raises:
        XrgsError: The folder is not a variant or has changed, or the sheet can't be written.
    """
    folder = path
    try:
        found = folder.is_dir()
    except FileNotFoundError:
        found = False
    except OSError as error:
        raise XrgsError(f"{folder}: {error.strerror}; try again") from error
    if not found:
        raise XrgsError(f"{folder}: no such folder; variants are in <store>/variants/")
    if folder.name.startswith(FAILED_PREFIX):
        report = read_struct(folder / "report.json", dict[str, Any])
        failed = f"{report.get('scene')}: failed, so there are no views"
        return "\n".join([for_line(failed), *_sfm_lines(folder, report)])
    frozen = variant.load(folder)
    sfm = _sfm_lines(folder, frozen.report)
    table = to_text(views_table(frozen))
    sheet, notes = contact_sheet(frozen)
    file = out or Path(f"{frozen.id}.png")
    try:
        with atomic_writer(file) as stream:
            sheet.save(stream, "PNG")
    except OSError as error:
        raise XrgsError(f"out={file}: can't be written ({error})") from error
    more = [f"Contact sheet: {file}", *(f"  {note}" for note in notes)]
    return "\n".join([table, *sfm, *map(for_line, more)])


def _sfm_lines(folder: Path, report: Mapping[str, Any]) -> list[str]:
    """Check a report, which anybody may have written, and return lines on how SfM went.

    Raises:
        XrgsError: The report is malformed.
    """
    try:
        _check_names(report)
        return [for_line(line) for line in _sfm(report)]
    except (AttributeError, LookupError, TypeError, ValueError, ArithmeticError) as error:
        file = folder / "report.json"
        raise XrgsError(f"{file}: not a variant's report ({error!r:.200})") from error


def _check_names(report: Mapping[str, Any]) -> None:
    """Check the names of views that a table will have.

    Raises:
        ValueError: A list is not one, has what is no name, or is longer than any variant's.
    """
    for key in ("hr", "lr", "not_registered"):
        names = report.get(key, [])
        if not isinstance(names, list) or len(names) > _MAX_NAMES or not all(map(is_name, names)):
            raise ValueError(f"{key} is not a list of views")


def views_table(frozen: Variant) -> TextTable:
    """Return a table of the photographs that are trained on or held out, by name.

    Args:
        frozen: The variant; photographs that SfM did not register are in the table too, by the
            names in its report.
    """
    rows = [
        (v.name, v.split, v.tag, f"{v.width} x {v.height}", f"{v.rho:.3f}", _REGISTERED)
        for v in frozen.views
        if v.split != "original"
    ]
    low = set(frozen.report.get("lr", ()))
    trained = low | set(frozen.report.get("hr", ()))
    for name in frozen.report.get("not_registered", ()):
        split = "train" if name in trained else "test"
        rows.append((name, split, "LR" if name in low else "HR", "", "", _NOT_REGISTERED))
    columns = ("View", "Split", "Tag", "Size, px", "rho", "Placed")
    title = f"{frozen.scene}, variant {frozen.id}, factor {frozen.factor}"
    return TextTable(title, columns, tuple(sorted(rows)), "lllrrl", tuple(_counts(frozen)))


def _counts(frozen: Variant) -> Iterator[str]:
    train = [view.tag for view in frozen.views if view.split == "train"]
    tests = sum(view.split == "test" for view in frozen.views)
    kind = "held out" if frozen.held_out else "tests, at the trained poses"
    yield f"{train.count('HR')} HR and {train.count('LR')} LR to train on, {tests} {kind}"
    if originals := sum(view.split == "original" for view in frozen.views):
        yield f"originals of degraded views kept beside them: {originals}"


def _sfm(report: Mapping[str, Any]) -> Iterator[str]:
    """Yield lines on how SfM went, as far as the report has them."""
    source = "Poses given" if "poses" in report else "SfM"
    yield (
        f"{source}: {report.get('registered', 0)} of {report.get('images', '?')} views placed, "
        f"{report.get('points', 0)} points"
        + _number(report, "reprojection_error_px", ", {:.2f} px")
    )
    if "lr_images" in report:
        features = report.get("max_num_features")
        yield f"  LR images {report['lr_images']}, {features} features a view"
    for attempt in report.get("attempts", ())[:_MAX_ATTEMPTS]:
        verdict = attempt.get("refused") or f"accepted, {attempt.get('registered')} placed"
        yield f"  recipe {attempt.get('attempt')}: {verdict}"
    if "tags" in report:
        yield f"  tags by {report['tags']}, degradation {report.get('degradation')}"
    yield from (f"  {note}" for note in report.get("notes", ())[:_MAX_ATTEMPTS])
    if error := report.get("pose_error"):
        against = report.get("pose_error_against", "exact cameras")
        yield f"  poses against {against}: " + "; ".join(_pose(error))
    for tag in ("HR", "LR"):
        if rates := report.get("rho", {}).get(tag):
            numbers = ", ".join(f"{rate:.3f}" for rate in rates)
            yield f"  rho of {tag}: {numbers} (least, median, most)"
    for key, label in (("not_registered", "not placed"), ("unreadable", "unreadable")):
        if names := report.get(key):
            yield f"  {label}: {', '.join(names)}"


def _pose(error: Mapping[str, float]) -> Iterator[str]:
    for key, label, unit in (
        ("position", "position", "% of the extent"),
        ("rotation", "rotation", "degrees"),
    ):
        name = f"{key}_{'percent' if key == 'position' else 'degrees'}"
        if name in error:
            yield f"{label} {error[name]:.3f} {unit}, at most {error[f'{name}_max']:.3f}"


def _number(report: Mapping[str, Any], key: str, form: str) -> str:
    return form.format(report[key]) if key in report else ""
