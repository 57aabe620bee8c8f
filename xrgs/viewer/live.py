"""Shows models live in a browser: viser draws the splats, one frame a model under one camera.

Each model has a server of its own, since a page of viser shows one scene. One page holds the frames
of all of them, and the camera that a user moves moves the others. All servers listen on this
machine's loopback interface alone.
"""

from __future__ import annotations

import html
import io
import math
import threading
from collections import deque
from contextlib import ExitStack, contextmanager, redirect_stdout
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Any

import numpy as np

from xrgs.errors import XrgsError
from xrgs.safeio.sanitize import for_markdown
from xrgs.store.contact_sheet import COLOURS
from xrgs.viewer.models import reference
from xrgs.viewer.paths import look_at_point, up_direction
from xrgs.viewer.splats import to_splats

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from viser import CameraHandle, ClientHandle, ViserServer

    from xrgs.splat.cameras import Camera
    from xrgs.viewer.models import Model

    _Place = dict[str, Any]  # by the names of _PLACE

HOST = "127.0.0.1"
NOT_ANTIALIASED = (
    "it is antialiased, which viser can't draw: small and far Gaussians look thicker here than "
    "in xrgs-render and in the report"
)
"""What is said of an antialiased model."""
#: So many places that a camera was told to take are remembered until it reports them.
_REMEMBERED = 1000
#: A browser reports a place this near to the one that it was told, as a share of the distance
#: from the camera to the point that it looks at.
_ROUNDING = 1e-4
#: The attributes of viser's cameras that make up a place.
_PLACE = ("position", "look_at", "up_direction", "fov")
#: The size of a drawn camera, as a share of the cameras' median distance from what they look at.
_FRUSTUM_SCALE = 0.04
_PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><title>xrgs-view</title>
<style>
body {{ margin: 0; display: flex; height: 100vh; background: #202020; gap: 2px; }}
figure {{ margin: 0; flex: 1; display: flex; flex-direction: column; min-width: 0; }}
figcaption {{ color: white; font: 15px sans-serif; padding: 6px 10px; }}
iframe {{ flex: 1; border: 0; }}
</style>
{frames}
</html>
"""
_FRAME = (
    '<figure><figcaption>{name}</figcaption><iframe title="{name}" src="{url}"></iframe></figure>'
)
_POLICY = f"default-src 'none'; style-src 'unsafe-inline'; frame-src http://{HOST}:*"


@contextmanager
def shown(models: Sequence[Model], port: int, limit: int) -> Iterator[str]:
    """Show models for the length of a block.

    Args:
        models: One model, or several of one world.
        port: The port of the page; viser's servers take the next ones that are free. 0 lets the
            system choose all of them.
        limit: The most Gaussians of a model that are drawn, see `xrgs.viewer.splats.to_splats`.

    Yields:
        The address of the page.

    Raises:
        XrgsError: viser is missing, or the port can't be used.
    """
    viser = _viser()
    with ExitStack() as stack:
        page = _PageServer(port)
        stack.callback(page.server_close)
        start = _start(reference(models))
        cameras, frames = _SharedCamera(start), []
        for number, model in enumerate(models):
            wanted = port and port + 1 + number
            with _without_banners():
                server = viser.ViserServer(HOST, wanted, verbose=False)
            stack.callback(_stop, server)
            _fill(server, model, reference(models), limit)
            if start is not None:  # to which viser's own button leads back
                home = server.initial_camera
                home.position, home.look_at = start["position"], start["look_at"]
                home.up, home.fov = start["up_direction"], start["fov"]
            server.on_client_connect(cameras.join)
            server.on_client_disconnect(cameras.leave)
            url = f"http://{HOST}:{server.get_port()}"
            frames.append(_FRAME.format(name=html.escape(model.name), url=url))
        page.content = _PAGE.format(frames="\n".join(frames)).encode()
        threading.Thread(target=page.serve_forever, name="xrgs-view", daemon=True).start()
        stack.callback(page.shutdown)
        yield f"http://{HOST}:{page.server_port}"


def _stop(server: ViserServer) -> None:
    with _without_banners():
        server.stop()


@contextmanager
def _without_banners() -> Iterator[None]:
    """Hide what viser prints: the addresses of single frames, which nobody should open."""
    with redirect_stdout(io.StringIO()):
        yield


def _viser() -> Any:
    try:
        import viser
    except ImportError as error:
        raise XrgsError("the live viewer needs viser: pip install 'xrgs[view]'") from error
    return viser


class _PageServer(ThreadingHTTPServer):
    """Serves one page."""

    daemon_threads = True

    def __init__(self, port: int) -> None:
        try:
            super().__init__((HOST, port), _PageHandler)
        except (OSError, OverflowError) as error:
            why = getattr(error, "strerror", None) or error
            raise XrgsError(f"port={port}: can't be used ({why}); name another one") from error
        self.content = b""


class _PageHandler(BaseHTTPRequestHandler):
    server: _PageServer

    def do_GET(self) -> None:
        found = self.path == "/"
        self.send_response(200 if found else 404)
        self.send_header("Content-Type", "text/html; charset=utf-8")
        self.send_header("Content-Security-Policy", _POLICY)
        self.end_headers()
        if found:
            self.wfile.write(self.server.content)

    def log_message(self, *_: object) -> None:
        """Write no log of requests."""


def _fill(server: ViserServer, model: Model, world: Model | None, limit: int) -> None:
    """Add the splats of a model, and the cameras of the world that it is in."""
    splats = to_splats(model.gaussians, limit)
    server.gui.configure_theme(control_width="small", show_share_button=False, show_logo=False)
    # viser keeps covariances as float16, where standard deviations below 0.0002 become 0 and those
    # above 255 infinite: in this unit the largest is 250, and 0.01 keeps its precision.
    unit = float(np.sqrt(splats.covariances.max(initial=0))) / 250 or 1.0
    server.scene.add_gaussian_splats(
        "/splats",
        splats.centers / unit,
        splats.covariances / unit**2,
        splats.colors,
        splats.opacities[:, None],
        scale=unit,
    )
    server.gui.add_markdown(f"**{for_markdown(model.name)}**\n\n{count_text(model, limit)}")
    if world is not None:
        _add_cameras(server, world)


def count_text(model: Model, limit: int) -> str:
    """Say how many Gaussians of a model are drawn, at most `limit`."""
    count = len(model.gaussians)
    if count <= limit:
        return f"{count:,} Gaussians"
    return f"the {limit:,} most opaque of {count:,} Gaussians (--limit {limit})"


def _add_cameras(server: ViserServer, world: Model) -> None:
    """Draw the views' cameras in the colours of their kinds."""
    from viser.transforms import SO3

    if world.poses is None:
        return
    for kind, colour in COLOURS.items():
        views = [view for view in world.views if view.kind == kind]
        parent = server.scene.add_frame(f"/{kind}", show_axes=False)
        for number, view in enumerate(views):
            camera = view.camera
            frustum = server.scene.add_camera_frustum(
                f"/{kind}/{number}",
                fov=_vertical_fov(camera),
                aspect=camera.width / camera.height,
                scale=_FRUSTUM_SCALE,
                color=tuple(int(colour[at : at + 2], 16) for at in (1, 3, 5)),
                wxyz=SO3.from_matrix(camera.viewmat[:3, :3].T.double().numpy()).wxyz,
                position=camera.position.double().numpy(),
            )
            frustum.on_click(_go_to)
        box = server.gui.add_checkbox(f"{kind}: {len(views)} cameras", initial_value=True)
        box.on_update(lambda event, parent=parent: setattr(parent, "visible", event.target.value))
    server.scene.set_up_direction(tuple(up_direction(world.poses)))


def _start(world: Model | None) -> _Place | None:
    """Return the place of the first test view, which looks at what all cameras look at."""
    if world is None or world.poses is None:
        return None
    first = next(view.camera for view in world.views if view.kind == "test")
    return {
        "position": first.position.double().numpy(),
        "look_at": look_at_point(world.poses),
        "up_direction": up_direction(world.poses),
        "fov": _vertical_fov(first),
    }


def _vertical_fov(camera: Camera) -> float:
    """Return the angle from the upper to the lower edge of a camera's image, radians."""
    return 2 * math.atan2(camera.height / 2, float(camera.K[1, 1]))


def _go_to(event: Any) -> None:
    """Move the camera of the browser to the camera that was clicked."""
    camera, clicked = event.client.camera, event.target
    camera.position, camera.wxyz = clicked.position, clicked.wxyz


class _SharedCamera:
    """Lets the cameras of all frames follow the one that the user moves.

    A camera that follows reports its new place just as one that the user moves does. So a report
    of a place that the camera was told to take is no move of the user, however late it comes. A
    frame that opens reports places of the browser's own choice first. So it is told its place
    again until it has reported one that it was told.
    """

    def __init__(self, start: _Place | None) -> None:
        self._lock = threading.Lock()
        self._place = start
        self._told: dict[ClientHandle, deque[_Place]] = {}
        self._arrived: set[ClientHandle] = set()

    def join(self, client: ClientHandle) -> None:
        """Let a frame's camera follow and lead."""
        with self._lock:
            self._told[client] = deque(maxlen=_REMEMBERED)
            if self._place is not None:
                self._tell(client, self._place)
        client.camera.on_update(self._moved)

    def leave(self, client: ClientHandle) -> None:
        """Forget a frame that was closed."""
        with self._lock:
            self._told.pop(client, None)
            self._arrived.discard(client)

    async def _moved(self, camera: CameraHandle) -> None:
        place, client = {name: getattr(camera, name) for name in _PLACE}, camera.client
        with self._lock:
            told = self._told.get(client)
            if told is None:  # it has left
                return
            if any(_same(place, known) for known in told):  # it follows
                self._arrived.add(client)
                while not _same(place, told[0]):
                    told.popleft()
            elif self._place is None or client in self._arrived:  # the user moved it
                self._arrived.add(client)
                self._place = place
                told.clear()
                for other in self._told:
                    if other is not client:
                        self._tell(other, place)
            else:
                self._tell(client, self._place)

    def _tell(self, client: ClientHandle, place: _Place) -> None:
        self._told[client].append(place)
        with client.atomic():
            for name in _PLACE:
                setattr(client.camera, name, place[name])


def _same(first: _Place, second: _Place) -> bool:
    """Return whether two places differ by no more than a browser's rounding."""
    near = _ROUNDING * np.linalg.norm(np.subtract(first["position"], first["look_at"]))
    return all(np.allclose(first[name], second[name], rtol=0, atol=near) for name in _PLACE)
