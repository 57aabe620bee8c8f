"""Draws every view of a variant on one sheet: the whole image, and its centre pixel by pixel."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from PIL import Image, ImageDraw, ImageFont

from xrgs.errors import UnreadableError
from xrgs.photos import images
from xrgs.photos.images import ImageError
from xrgs.runtime.progress import progress
from xrgs.safeio.sanitize import MAX_CELL, for_line

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from xrgs.mixture.views import Variant, View

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
