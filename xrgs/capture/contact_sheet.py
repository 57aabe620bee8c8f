"""Every view of a variant on one picture: whole, and its centre pixel by pixel."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from PIL import Image, ImageDraw, ImageFont

from xrgs.capture import images
from xrgs.runtime.progress import progress

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from xrgs.capture.views import Variant, View

#: px: the box that a whole view is fitted into, the side of the centre beside it, and the rest.
_BOX = (256, 192)
_CENTRE = 192
_BORDER, _GAP, _TEXT = 4, 8, 16
_TILE = (_BOX[0] + _CENTRE + 3 * _BORDER, _BOX[1] + 2 * _BORDER + _TEXT + 4)
#: Distinct to every kind of colour vision (Okabe and Ito).
COLOURS: Mapping[str, str] = {"HR": "#0072b2", "LR": "#e69f00", "test": "#7f7f7f"}
_PAPER, _INK = "white", "black"
#: Columns for rows: a sheet is about as wide as a screen is to its height.
_ASPECT = 1.6


def contact_sheet(variant: Variant) -> Image.Image:
    """All views to train on and held out, by name, in a border of their tag's colour.

    Beside each whole view is its centre at the pixels of the finest view: a coarser one is
    magnified by its whole-numbered factor, each pixel a square, so that one sees what it lacks.

    Raises:
        XrgsError: an image can't be read.
    """
    views = sorted(
        (view for view in variant.views if view.split != "original"),
        key=lambda view: (view.name, view.split),
    )
    finest = max(max(view.width, view.height) for view in views)
    columns = max(1, round(math.sqrt(_ASPECT * len(views) * _TILE[1] / _TILE[0])))
    rows = math.ceil(len(views) / columns)
    step = _TILE[0] + _GAP, _TILE[1] + _GAP
    top = _TEXT + 2 * _GAP
    sheet = Image.new("RGB", (_GAP + columns * step[0], top + rows * step[1]), _PAPER)
    _legend(sheet, variant, views)
    for index, view in enumerate(progress(views, "contact sheet", "view")):
        row, column = divmod(index, columns)
        sheet.paste(_tile(view, finest), (_GAP + column * step[0], top + row * step[1]))
    return sheet


def kind(view: View) -> str:
    """What its border tells: `test`, or of a training view its tag."""
    return "test" if view.split == "test" else view.tag


def _tile(view: View, finest: int) -> Image.Image:
    """Border, whole view, centre, and the name below."""
    tile = Image.new("RGB", _TILE, _PAPER)
    draw = ImageDraw.Draw(tile)
    framed = (0, 0, _TILE[0] - 1, _BOX[1] + 2 * _BORDER - 1)
    draw.rectangle(framed, fill=COLOURS[kind(view)])
    image = images.opened(view.file)
    whole = _fit(image)
    left = _BORDER + (_BOX[0] - whole.width) // 2
    tile.paste(whole, (left, _BORDER + (_BOX[1] - whole.height) // 2))
    magnified = max(1, round(finest / max(image.size)))
    tile.paste(_centre(image, magnified), (_BOX[0] + 2 * _BORDER, _BORDER))
    label = f"{view.width}x{view.height}  {view.split} {view.tag}"
    room = _TILE[0] - draw.textlength(label, _font()) - _GAP
    draw.text((0, framed[3] + 3), _cut(draw, view.name, room), _INK, _font())
    draw.text((_TILE[0], framed[3] + 3), label, _INK, _font(), anchor="ra")
    return tile


def _fit(image: Image.Image) -> Image.Image:
    """The whole image in the box: shrunk smoothly, or magnified with its pixels as they are."""
    scale = min(_BOX[0] / image.width, _BOX[1] / image.height)
    size = max(1, round(image.width * scale)), max(1, round(image.height * scale))
    return image.resize(size, Image.Resampling.BOX if scale < 1 else Image.Resampling.NEAREST)


def _centre(image: Image.Image, magnified: int) -> Image.Image:
    """The middle of the image, [_CENTRE, _CENTRE] px, each of its pixels `magnified` wide."""
    side = math.ceil(_CENTRE / magnified)
    left, top = (image.width - side) // 2, (image.height - side) // 2
    cut = image.crop((left, top, left + side, top + side))
    large = cut.resize((side * magnified, side * magnified), Image.Resampling.NEAREST)
    return large.crop((0, 0, _CENTRE, _CENTRE))


def _legend(sheet: Image.Image, variant: Variant, views: Sequence[View]) -> None:
    draw = ImageDraw.Draw(sheet)
    x = float(_GAP)
    kinds = [kind(view) for view in views]
    for name, colour in COLOURS.items():
        text = f"{name}: {kinds.count(name)}"
        draw.rectangle((x, _GAP, x + _TEXT, _GAP + _TEXT), fill=colour)
        draw.text((x + _TEXT + 4, _GAP), text, _INK, _font())
        x += _TEXT + 4 + draw.textlength(text, _font()) + 2 * _GAP
    title = _cut(draw, f"{variant.scene}  {variant.id}", sheet.width - x - _GAP)
    draw.text((x, _GAP), title, _INK, _font())


def _cut(draw: ImageDraw.ImageDraw, text: str, room: float) -> str:
    """`text`, its middle left out where it is too long for `room` px."""
    if draw.textlength(text, _font()) <= room:
        return text
    for kept in range(len(text) - 1, 1, -1):
        short = f"{text[: kept // 2]}...{text[len(text) - (kept - kept // 2) :]}"
        if draw.textlength(short, _font()) <= room:
            return short
    return ""


def _font() -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(_TEXT - 3)
