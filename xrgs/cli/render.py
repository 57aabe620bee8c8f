"""`xrgs-render`: renders one or two trained cells along a path of cameras, into a film."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from xrgs.cli import options
from xrgs.cli.options import STORE, Cells, Folder, shown_as
from xrgs.runtime.streams import say
from xrgs.store.store import Store

#: The values of --antialiased.
_CHOICES = {"yes": True, "no": False, None: None}


def render(
    cells: Positional[Cells],
    path: Annotated[
        Literal["orbit", "training", "spiral", "test"] | None,
        shown_as("orbit|training|spiral|test"),
    ] = None,
    views: int = 120,
    out: Annotated[Path, arg(metavar="FILE.mp4|FOLDER")] = Path("film.mp4"),
    size: Annotated[tuple[int, int] | None, shown_as("WIDTH HEIGHT")] = None,
    fps: int = 30,
    antialiased: Annotated[Literal["yes", "no"] | None, shown_as("yes|no")] = None,
    store: Folder = STORE,
) -> None:
    """Render trained cells along a path of cameras; two of them side by side with their names.

    Args:
        cells: One cell or two, each by its id, the beginning of its id, the name of a scene with
            one done cell, or a file: .ply, .glb or .spz.
        path: The path, fitted to the training cameras; by default `orbit`, or `training` if an
            orbit would leave the space that they see, as in a room seen from inside. `orbit`
            circles around the point that they look at; if they see it only from one side, it
            swings over their arc. `training` goes along the training cameras in their order.
            `spiral` is LLFF's, for forward-facing scenes. `test` goes through the test cameras in
            their order. On every path, all frames have the focal length of the first test view.
        views: Number of frames.
        out: An .mp4 file, which needs PyAV (pip install 'xrgs[video]'), or a new folder for PNG
            frames.
        size: Width and height of one cell's picture, px, both even; by default the size of the test
            views.
        fps: Frames per second.
        antialiased: Whether to compensate opacities for the blur of a pixel, as Mip-Splatting does;
            by default as in the cell's training, or as the file says.
        store: The store that has the cells.
    """
    from xrgs.viewer.film import make_film
    from xrgs.viewer.models import load_models

    models = load_models(cells, Store(store), _CHOICES[antialiased])
    say(make_film(models, out, path=path, views=views, size=size, fps=fps))


main = partial(
    options.run,
    "xrgs-render",
    render,
    hint="An incomplete film is removed; PNG frames are kept.",
)
