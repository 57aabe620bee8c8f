"""`xrgs-render`: renders one or two trained cells along a path of cameras, into a film."""

from __future__ import annotations

import re
from dataclasses import dataclass

from xrgs.cli.arguments import errors_as_messages, parse_with_words
from xrgs.errors import XrgsError
from xrgs.experiment.store import Store
from xrgs.runtime.machine import set_passive_openmp_wait
from xrgs.runtime.signals import exit_on_signal
from xrgs.runtime.streams import say
from xrgs.safeio.paths import user_path

_HELP = """\
xrgs-render CELL [CELL] [KEY=VALUE]...

Renders trained cells along a path that is fitted to their training cameras, two of them side by
side with their names. CELL is a cell's id, the beginning of one, or a .ply file.

  path=orbit       orbit: around the point that the cameras look at; where they see it from one side
                   alone, to and fro over the arc that they span
                   spiral: LLFF's, for forward-facing scenes
                   test: through the test cameras in their order; as on every path, all frames
                   have the focal length of the first one, also where the cameras' differ
  views=120        number of frames
  out=film.mp4     an .mp4 file, which needs PyAV (pip install 'xrgs[video]'), or a new folder for
                   PNG frames
  size=WxH         size of one cell's picture, px, both even; the size of the test views by default
  fps=30           frames a second
  store=FOLDER     the store; xrgs-store by default
"""
_SIZE = re.compile(r"(\d{1,5})x(\d{1,5})")


@dataclass
class RenderConf:
    """Arguments of `xrgs-render`."""

    path: str = "orbit"
    """`orbit`, `spiral` or `test`."""
    views: int = 120
    """Number of frames."""
    out: str = "film.mp4"
    """An .mp4 file, or a folder for PNG frames."""
    size: str | None = None
    """Width and height of one cell's panel as `504x378`, px; None for that of the test views."""
    fps: int = 30
    """Frames a second."""
    store: str = "xrgs-store"
    """The store's folder."""


def main() -> None:
    """Run `xrgs-render CELL [CELL] [KEY=VALUE]...`."""
    set_passive_openmp_wait()  # as in training
    with errors_as_messages("xrgs-render"):
        words, conf = parse_with_words(RenderConf, _HELP)
        size = _size(conf.size)
        from xrgs.viewer.film import make_film
        from xrgs.viewer.models import load_models

        with exit_on_signal("A film that is not complete is not kept; single frames are."):
            models = load_models(words, Store(user_path(conf.store)))
            out = user_path(conf.out)
            line = make_film(models, out, path=conf.path, views=conf.views, size=size, fps=conf.fps)
        say(line)


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    match = _SIZE.fullmatch(text)
    if not match:
        raise XrgsError(f"size={text}: must be WIDTHxHEIGHT, as 504x378")
    return int(match[1]), int(match[2])
