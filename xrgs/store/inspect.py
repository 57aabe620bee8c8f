"""Says how a variant was made: notes for sweeps and reports, texts for `xrgs-data inspect`.

A contact sheet shows each view: the whole image, and its centre pixel by pixel. Nothing here
imports torch.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from msgspec import Struct, structs
from PIL import Image, ImageDraw, ImageFont

from xrgs.errors import UnreadableError, XrgsError
from xrgs.mixture import variant
from xrgs.mixture.paths import is_failed
from xrgs.mixture.saved_variant import REPORT, Manifest, ViewEntry, read_manifest
from xrgs.mixture.views import Variant, View
from xrgs.photos import images
from xrgs.photos.images import ImageError
from xrgs.runtime.progress import progress
from xrgs.runtime.text import TextTable, listed, to_text
from xrgs.safeio.atomic import atomic_writer
from xrgs.safeio.records import read_struct
from xrgs.safeio.sanitize import MAX_CELL, for_line
from xrgs.splat.normalize import camera_positions

#: Two views count as taken by one camera where the angle between them, in degrees, and the
#: distance, as a share of the cameras' extent, are at most these. SfM placed the copies of two sets
#: within 0.06 degrees and 0.9 %. In the scenes of the studies no other pair is within four times
#: both limits.
_SAME_ANGLE, _SAME_PLACE = 0.1, 0.01
#: The least share of coarse training views in a mixture. Our choice, between monstree (0.45), a
#: tree from close and far, and reichstag (0.11), a building by tourists (reports/captures).
_MIXTURE_FROM = 0.25
#: The recipe (a file of `conf/ablation/`) for photographs, alike or not: reports/alike.
RECIPE = "plus"
#: The beginning of the note that undegraded photographs differ too little for HR and LR classes.
_MEANINGLESS = "the split by variant.tags="
#: The beginnings of all notes on a split into HR and LR views.
_SPLIT_NOTES = (_MEANINGLESS, "sampling rates of training views differ by")


class SfmAttempt(Struct):
    """One attempt of SfM at a scene's views."""

    attempt: str
    """The name of the recipe."""
    refused: str = ""
    """Why its result was not taken; empty where it was."""
    registered: int = 0


class SfmReport(Struct):
    """The part of `report.json` that is shown: notes, how SfM went, the classes of the views."""

    scene: str = "?"
    reason: str = ""
    """Why the scene failed; empty where it did not."""
    images: int = 0
    registered: int = 0
    points: int = 0
    reprojection_error_px: float | None = None
    poses: str | None = None
    """The digest of poses that were given; None where SfM has estimated them."""
    lr_images: str | None = None
    max_num_features: int | None = None
    attempts: tuple[SfmAttempt, ...] = ()
    tags: str | None = None
    degradation: str | None = None
    notes: tuple[str, ...] = ()
    """Sentences on photographs that were taken, left out, turned, converted or masked."""
    pose_error: dict[str, float] = {}
    """`position_percent` of the extent, `rotation_degrees`, and `..._max` of each."""
    pose_error_against: str = ""
    rho: dict[str, tuple[float, ...]] = {}
    """Least, median and most of the sampling rate, by tag."""
    lr_blur: float | None = None
    """The estimated blur of LR training views, LR px; None where it is not known."""
    tests: int = 0
    """Number of views that are held out; 0 where the training views are scored."""
    hr: tuple[str, ...] = ()
    lr: tuple[str, ...] = ()
    not_registered: tuple[str, ...] = ()
    as_they_are: bool = False
    """Whether nothing is degraded and `variant.factor` is 1: nobody asked for LR views."""

    @property
    def alike(self) -> bool:
        """Whether the photographs are of one resolution, so that HR and LR classes mean nothing.

        Degraded photographs are never alike.
        """
        if self.degradation != "none":
            return bool(self.hr) and not self.lr
        return not (self.hr and self.lr) or any(n.startswith(_MEANINGLESS) for n in self.notes)

    @property
    def tagless(self) -> bool:
        """Whether the photographs are undegraded and alike, so that tags are not shown."""
        return self.as_they_are and self.alike

    @property
    def own_notes(self) -> tuple[str, ...]:
        """The notes; without those on HR and LR classes where no view is degraded."""
        left_out = _SPLIT_NOTES if self.as_they_are else ()
        return tuple(note for note in self.notes if not note.startswith(left_out))

    @property
    def not_scored(self) -> tuple[str, ...]:
        """Names of the views that would be scored and are not placed."""
        training = {*self.hr, *self.lr} if self.tests else ()
        return tuple(name for name in self.not_registered if name not in training)

    def all_notes(self, most: int = 6) -> tuple[str, ...]:
        """Return the notes, and sentences of at most some names on views that are not placed."""
        if not (self.hr or self.lr):  # a scene that failed, whose reason names the views
            return self.own_notes
        not_trained = [name for name in self.not_registered if name in {*self.hr, *self.lr}]
        lost = (("trained on", not_trained), ("scored", self.not_scored))
        unplaced = [
            f"not placed, and so not {use}: {listed(names, most)}" for use, names in lost if names
        ]
        return (*self.own_notes, *unplaced)


def read_report(folder: Path) -> SfmReport:
    """Read how a variant was made, from its folder: a whole, a trimmed or a failed one."""
    report = read_struct(folder / REPORT, SfmReport)
    if is_failed(folder.name):
        return report
    manifest = read_manifest(folder)
    notes = (*report.notes, *shared_cameras(manifest))
    as_they_are = manifest.factor == 1 and report.degradation == "none"
    return structs.replace(report, notes=notes, as_they_are=as_they_are)


def shared_cameras(manifest: Manifest) -> list[str]:
    """Return a note on views that share one camera: copies of one photograph, or nearly.

    No other check finds copies whose names are not alike.
    """
    splits = {"train", "test"} if manifest.held_out else {"train"}
    views = [view for view in manifest.views if view.split in splits]
    world_to_camera = np.array([view.viewmat for view in views])
    rotations, centres = world_to_camera[:, :3, :3], camera_positions(world_to_camera)
    extent = np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()
    distances = np.linalg.norm(centres[:, None] - centres, axis=2)
    cosines = (np.einsum("nij,mij->nm", rotations, rotations) - 1) / 2
    same = (distances <= _SAME_PLACE * extent) & (cosines >= np.cos(np.radians(_SAME_ANGLE)))
    shared = [
        " and ".join(f"{views[k].name} ({views[k].split})" for k in pair)
        for pair in np.argwhere(np.triu(same, k=1))
    ]
    if not shared:
        return []
    return [f"views of one camera, as copies of a photograph are; remove one: {listed(shared)}"]


def describe(folder: Path, out: Path | None = None) -> str:
    """Describe a frozen variant and draw its contact sheet; for a failed one, say why it failed.

    The folder is the variant's in a store, or the `failed-...` folder of one that failed. Without
    `out`, the sheet is `<variant id>.png` in the current folder.

    Raises:
        XrgsError: The folder is not a variant, or is damaged, or the sheet can't be written.
    """
    if not folder.is_dir():
        raise XrgsError(f"{folder}: no such folder; variants are in <store>/variants/")
    failed = is_failed(folder.name)
    frozen = None if failed else variant.load(folder)
    report = read_report(folder)
    sfm = [for_line(line) for line in _sfm(report)]
    if frozen is None:
        why = report.reason or f"{report.scene}: failed"
        return "\n".join([for_line(f"{why} So there are no views."), *sfm])
    table = to_text(views_table(frozen, report))
    sheet, notes = contact_sheet(frozen)
    file = out or Path(f"{frozen.id}.png")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with atomic_writer(file) as stream:
            images.write_png(stream, sheet)
    except OSError as error:
        if out is None:
            why = f"the sheet {file} can't be written here ({error.strerror}); give --out=FILE.png"
            raise XrgsError(why) from error
        raise XrgsError(f"out={file}: can't be written ({error.strerror})") from error
    more = [f"Contact sheet: {file}", *(f"  {note}" for note in notes)]
    return "\n".join([table, _mixture(frozen), *sfm, *map(for_line, more)])


def views_table(frozen: Variant, report: SfmReport) -> TextTable:
    """Return a table of the photographs that are trained on or held out, or are not placed."""
    rows = [
        (v.name, v.split, v.tag, f"{v.width} x {v.height}", f"{v.sampling_rate:.3f}", "yes")
        for v in frozen.views
        if v.split != "original"
    ]
    for name in report.not_registered:
        split = "train" if name in {*report.hr, *report.lr} else "test"
        rows.append((name, split, "LR" if name in report.lr else "HR", "", "", "no"))
    columns = ("View", "Split", "Tag", "Size, px", "rho", "Placed")
    title = f"{frozen.scene}, variant {frozen.id}, factor {frozen.factor}"
    train = [view.tag for view in frozen.views if view.split == "train"]
    tests = sum(view.split == "test" for view in frozen.views)
    kind = "held out" if frozen.held_out else "tests, at the trained poses"
    trained = f"{train.count('HR')} HR and {train.count('LR')} LR"
    notes = [f"{len(train) if report.tagless else trained} to train on, {tests} {kind}"]
    if originals := sum(view.split == "original" for view in frozen.views):
        notes.append(f"originals of degraded views kept beside them: {originals}")
    kept = [i for i, name in enumerate(columns) if name != "Tag" or not report.tagless]
    heads, *cells = (tuple(row[i] for i in kept) for row in (columns, *sorted(rows)))
    align = "".join("lllrrl"[i] for i in kept)
    return TextTable(title, heads, tuple(cells), align, tuple(notes))


class Mixture(NamedTuple):
    """How many training views are coarse: they would need at least 1.5 times as many px a side."""

    coarse: int
    views: int

    @property
    def is_one(self) -> bool:
        """Whether enough views are coarse to call the photographs a mixture."""
        return self.coarse >= _MIXTURE_FROM * self.views


def mixture(views: Iterable[View | ViewEntry]) -> Mixture:
    """Count the coarse training views among the views of a variant."""
    needs = [view.supersampling for view in views if view.split == "train"]
    # `supersampled`, and so the recipes, render a view larger by its `supersampling`, rounded.
    return Mixture(sum(round(need) > 1 for need in needs), len(needs))


def _mixture(frozen: Variant) -> str:
    """Say whether the training views are a mixture, and which recipes are for them."""
    counts = mixture(frozen.views)
    recipes = f"+ablation={RECIPE} is for such views too"
    if counts.is_one:
        recipes = f"+ablation={RECIPE} and +ablation=lean are for mixtures"
    return (
        f"{'a mixture' if counts.is_one else 'hardly a mixture'}: {counts.coarse} of {counts.views}"
        " training views would need at least 1.5 times as many px a side to show the scene as"
        f" finely as the finest; {recipes}"
    )


def _sfm(report: SfmReport) -> Iterator[str]:
    """Yield lines on how SfM went, as far as the report has them."""
    error = report.reprojection_error_px
    yield (
        f"{'SfM' if report.poses is None else 'Poses given'}: {report.registered} of"
        f" {report.images or '?'} views placed, {report.points} points"
        + (f", {error:.2f} px" if error is not None else "")
    )
    if report.lr_images is not None:
        lr = "" if report.tagless else f"LR images {report.lr_images}, "
        yield f"  {lr}{report.max_num_features} features a view"
    for attempt in report.attempts:
        verdict = attempt.refused or f"accepted, {attempt.registered} placed"
        yield f"  recipe {attempt.attempt}: {verdict}"
    if report.tags is not None and not report.tagless:
        yield f"  tags by {report.tags}, degradation {report.degradation}"
    yield from (f"  {note}" for note in report.own_notes)
    if report.pose_error:
        yield f"  poses against {report.pose_error_against}: " + "; ".join(_pose(report.pose_error))
    if not report.tagless:
        yield from _classes(report)
    if report.not_registered:
        yield f"  not placed: {', '.join(report.not_registered)}"


def _classes(report: SfmReport) -> Iterator[str]:
    for tag in ("HR", "LR"):
        if rates := report.rho.get(tag):
            numbers = ", ".join(f"{rate:.3f}" for rate in rates)
            yield f"  rho of {tag}: {numbers} (least, median, most)"
    if report.lr_blur is not None:
        yield f"  blur of LR: {report.lr_blur:.2f} px, estimated (a pixel's area has 0.29)"


def _pose(error: dict[str, float]) -> Iterator[str]:
    for name, label, unit in (
        ("position_percent", "position", "% of the extent"),
        ("rotation_degrees", "rotation", "degrees"),
    ):
        if name in error:
            yield f"{label} {error[name]:.3f} {unit}, at most {error[f'{name}_max']:.3f}"


#: In px: the box for the whole image, the side of the square centre beside it, and margins.
_BOX = (256, 192)
_CENTRE = 192
_BORDER, _GAP, _TEXT = 4, 8, 16
_TILE = (_BOX[0] + _CENTRE + 3 * _BORDER, _BOX[1] + 2 * _BORDER + _TEXT + 4)
#: The colour of each class's border, distinct in every kind of colour vision (Okabe and Ito).
COLOURS: Mapping[str, str] = {"HR": "#0072b2", "LR": "#e69f00", "test": "#7f7f7f"}
_BACKGROUND, _TEXT_COLOUR = "white", "black"
#: How many times darker pixels outside a mask are.
_DIMMED = 4
#: Width over height of the sheet, about as a screen has.
_ASPECT = 1.6
#: The most views that are drawn, by name; a tile takes 0.4 MB.
_MAX_TILES = 500


def contact_sheet(variant: Variant) -> tuple[Image.Image, list[str]]:
    """Draw the training and test views, sorted by name, each in a border of its class's colour.

    Beside each image is its centre. The centre of a view that is smaller than the largest one is
    magnified by the nearest whole factor, each pixel a square, so that its missing detail can be
    seen. Pixels outside a mask are dark.

    Returns:
        An RGB image, and notes: why an image can't be read, or that some views are not drawn.
    """
    views = sorted(
        (view for view in variant.views if view.split != "original"),
        key=lambda view: (view.name, view.split),
    )
    shown = views[:_MAX_TILES]
    notes = [f"the first {len(shown)} of {len(views)} views"] if len(shown) < len(views) else []
    largest = max(max(view.width, view.height) for view in shown)
    columns = max(1, round(math.sqrt(_ASPECT * len(shown) * _TILE[1] / _TILE[0])))
    rows = math.ceil(len(shown) / columns)
    step = _TILE[0] + _GAP, _TILE[1] + _GAP
    top = _TEXT + 2 * _GAP
    sheet = Image.new("RGB", (_GAP + columns * step[0], top + rows * step[1]), _BACKGROUND)
    _legend(sheet, variant, views)
    for index, view in enumerate(progress(shown, "contact sheet", "view")):
        row, column = divmod(index, columns)
        image = None
        try:
            image = _read(view)
        except (ImageError, UnreadableError) as error:
            notes.append(str(error))
        tile = _tile(view, image, largest)
        sheet.paste(tile, (_GAP + column * step[0], top + row * step[1]))
    return sheet, notes


def _read(view: View) -> Image.Image:
    """Read the image of a view, dark outside its mask."""
    size = view.width, view.height
    image = images.read_png_pil(view.file, size)
    if view.mask is None:
        return image
    used = Image.fromarray(images.read_mask(view.mask, size))
    return Image.composite(image, image.point(lambda value: value // _DIMMED), used)


def _view_class(view: View) -> str:
    """Return the class that the border shows: `test`, or the tag of a training view."""
    return "test" if view.split == "test" else view.tag


def _tile(view: View, image: Image.Image | None, largest: int) -> Image.Image:
    """Draw the border, the whole image, its centre, and the name below."""
    tile = Image.new("RGB", _TILE, _BACKGROUND)
    draw = ImageDraw.Draw(tile)
    frame = (0, 0, _TILE[0] - 1, _BOX[1] + 2 * _BORDER - 1)
    draw.rectangle(frame, fill=COLOURS[_view_class(view)])
    if image is None:
        draw.text((2 * _GAP, 2 * _GAP), "unreadable", _BACKGROUND, _font())
    else:
        _draw_image(tile, image, largest)
    label = f"{view.width}x{view.height}  {view.split} {view.tag}"
    width = _TILE[0] - draw.textlength(label, _font()) - _GAP
    draw.text((0, frame[3] + 3), _shorten(draw, view.name, width), _TEXT_COLOUR, _font())
    draw.text((_TILE[0], frame[3] + 3), label, _TEXT_COLOUR, _font(), anchor="ra")
    return tile


def _draw_image(tile: Image.Image, image: Image.Image, largest: int) -> None:
    """Draw the whole image, averaged where it shrinks, and its centre beside it."""
    box, nearest = Image.Resampling.BOX, Image.Resampling.NEAREST
    scale = min(_BOX[0] / image.width, _BOX[1] / image.height)
    size = max(1, round(image.width * scale)), max(1, round(image.height * scale))
    whole = image.resize(size, box if scale < 1 else nearest)
    left = _BORDER + (_BOX[0] - whole.width) // 2
    tile.paste(whole, (left, _BORDER + (_BOX[1] - whole.height) // 2))
    magnified = min(_CENTRE, max(1, round(largest / max(image.size))))
    side = math.ceil(_CENTRE / magnified)
    left, top = (image.width - side) // 2, (image.height - side) // 2
    cut = image.crop((left, top, left + side, top + side))
    large = cut.resize((side * magnified, side * magnified), nearest)
    tile.paste(large.crop((0, 0, _CENTRE, _CENTRE)), (_BOX[0] + 2 * _BORDER, _BORDER))


def _legend(sheet: Image.Image, variant: Variant, views: Sequence[View]) -> None:
    draw = ImageDraw.Draw(sheet)
    x = float(_GAP)
    classes = [_view_class(view) for view in views]
    for name, colour in COLOURS.items():
        text = f"{name}: {classes.count(name)}"
        draw.rectangle((x, _GAP, x + _TEXT, _GAP + _TEXT), fill=colour)
        draw.text((x + _TEXT + 4, _GAP), text, _TEXT_COLOUR, _font())
        x += _TEXT + 4 + draw.textlength(text, _font()) + 2 * _GAP
    title = _shorten(draw, f"{variant.scene}  {variant.id}", sheet.width - x - _GAP)
    draw.text((x, _GAP), title, _TEXT_COLOUR, _font())


def _shorten(draw: ImageDraw.ImageDraw, text: str, width: float) -> str:
    """Make a text one line, and shorten it to `width` px by leaving out its middle."""
    text = for_line(text, MAX_CELL)
    if draw.textlength(text, _font()) <= width:
        return text
    for length in range(len(text) - 1, 1, -1):
        short = f"{text[: length // 2]}...{text[len(text) - (length - length // 2) :]}"
        if draw.textlength(short, _font()) <= width:
            return short
    return ""


def _font() -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(_TEXT - 3)
