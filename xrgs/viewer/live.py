"""Shows models live in a browser: viser draws the splats of each model in a frame of one page.

Each model has its own viser server, since a page of viser shows one scene. If the user moves the
camera of a frame, those of the other frames follow. All servers listen only on the loopback
interface. A browser sorts and blends all Gaussians itself, which is slow for more than some hundred
thousand, so that the least opaque ones can be left out.
"""

from __future__ import annotations

import html
import io
import math
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, redirect_stdout
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from xrgs.errors import XrgsError
from xrgs.safeio.sanitize import for_markdown
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import Gaussians
from xrgs.splat.quaternions import rotation_matrices
from xrgs.splat.sh import sh_to_colors
from xrgs.store.inspect import COLOURS
from xrgs.viewer.models import Model, reference
from xrgs.viewer.paths import look_at_point, up_direction

if TYPE_CHECKING:
    from viser import CameraHandle, ClientHandle, ViserServer

    _Pose = dict[str, Any]  # by the names of _POSE

HOST = "127.0.0.1"
NOT_ANTIALIASED = (
    "it is antialiased, which viser can't draw: small and far Gaussians look thicker here than "
    "in xrgs-render and in the report"
)
"""The note on an antialiased model."""
#: How many poses that we set ourselves are remembered, to tell them from the user's moves.
_REMEMBERED = 1000
#: A browser rounds a pose that we set by up to this much, relative to the distance from the camera
#: to the point that it looks at.
_ROUNDING = 1e-4
#: The attributes of viser's cameras that make up a pose.
_POSE = ("position", "look_at", "up_direction", "fov")
#: The size of a drawn camera, relative to the cameras' median distance from their focus.
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
    """Show models of one world while a `with` block runs; yield the address of the page.

    viser's servers take the next ports after that of the page, which is `port`; 0 lets the system
    choose all of them. At most `limit` Gaussians of a model are drawn.

    Raises:
        XrgsError: viser is missing, or the port can't be used.
    """
    try:
        import viser
    except ImportError as error:
        raise XrgsError("the live viewer needs viser: pip install 'xrgs[view]'") from error
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
            if start is not None:  # for viser's button that resets the camera
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
    """Hide viser's output: it prints the addresses of single frames, which nobody should open."""
    with redirect_stdout(io.StringIO()):
        yield


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
        is_page = self.path == "/"
        self.send_response(200 if is_page else 404)
        self.send_header("Content-Type", "text/html; charset=utf-8")
        self.send_header("Content-Security-Policy", _POLICY)
        self.end_headers()
        if is_page:
            self.wfile.write(self.server.content)

    def log_message(self, *_: object) -> None:
        """Write no log of requests."""


def _fill(server: ViserServer, model: Model, world: Model | None, limit: int) -> None:
    """Add the splats of a model, and the cameras of its world."""
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
    """Return a phrase on how many Gaussians of a model are drawn, at most `limit`."""
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


def _start(world: Model | None) -> _Pose | None:
    """Return the first test view's pose, turned to the point that the training cameras look at."""
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
    """Return the vertical field of view of a camera, radians."""
    return 2 * math.atan2(camera.height / 2, float(camera.K[1, 1]))


def _go_to(event: Any) -> None:
    """Move the browser's camera to the clicked camera."""
    camera, clicked = event.client.camera, event.target
    camera.position, camera.wxyz = clicked.position, clicked.wxyz


class _SharedCamera:
    """Lets the cameras of all frames follow the one that the user moves.

    A camera reports each new pose, whether the user moved it or we set it. So a reported pose that
    we have set is no move of the user, however late it comes. A frame that opens first reports
    poses of the browser's choice, so we set its pose again until it reports one that we have set.
    """

    def __init__(self, start: _Pose | None) -> None:
        self._lock = threading.Lock()
        self._pose = start
        self._set_poses: dict[ClientHandle, deque[_Pose]] = {}
        self._arrived: set[ClientHandle] = set()

    def join(self, client: ClientHandle) -> None:
        """Add a frame, whose camera then follows the others and can lead them."""
        with self._lock:
            self._set_poses[client] = deque(maxlen=_REMEMBERED)
            if self._pose is not None:
                self._set(client, self._pose)
        client.camera.on_update(self._moved)

    def leave(self, client: ClientHandle) -> None:
        """Forget a frame that was closed."""
        with self._lock:
            self._set_poses.pop(client, None)
            self._arrived.discard(client)

    async def _moved(self, camera: CameraHandle) -> None:
        pose, client = {name: getattr(camera, name) for name in _POSE}, camera.client
        with self._lock:
            poses = self._set_poses.get(client)
            if poses is None:  # the frame was closed
                return
            if any(_same(pose, other) for other in poses):  # a pose that we have set
                self._arrived.add(client)
                while not _same(pose, poses[0]):
                    poses.popleft()
            elif self._pose is None or client in self._arrived:  # the user moved it
                self._arrived.add(client)
                self._pose = pose
                poses.clear()
                for other in self._set_poses:
                    if other is not client:
                        self._set(other, pose)
            else:
                self._set(client, self._pose)

    def _set(self, client: ClientHandle, pose: _Pose) -> None:
        self._set_poses[client].append(pose)
        with client.atomic():
            for name in _POSE:
                setattr(client.camera, name, pose[name])


def _same(first: _Pose, second: _Pose) -> bool:
    """Return whether two poses differ at most by the browser's rounding."""
    near = _ROUNDING * np.linalg.norm(np.subtract(first["position"], first["look_at"]))
    return all(np.allclose(first[name], second[name], rtol=0, atol=near) for name in _POSE)


Array = NDArray[np.float32]


@dataclass(frozen=True)
class Splats:
    """N Gaussians without harmonics above band 0, in the order of the model."""

    centers: Array
    """[N, 3] world units."""
    covariances: Array
    """[N, 3, 3] world units squared."""
    colors: Array
    """[N, 3] in 0..1."""
    opacities: Array
    """[N] in 0..1."""


@torch.no_grad()
def to_splats(gaussians: Gaussians, limit: int) -> Splats:
    """Convert the `limit` most opaque Gaussians of a model; of equal ones, the first are taken."""
    kept = gaussians.opacities.argsort(descending=True, stable=True)[:limit].sort().values
    rotations, scales = rotation_matrices(gaussians.quats[kept]), gaussians.scales[kept].exp()
    factor = rotations * scales[:, None, :]  # [N, 3, 3], each axis times its length
    means, sh0 = gaussians.means[kept], gaussians.sh0[kept]
    any_direction = torch.zeros_like(means)
    arrays = (
        means,
        factor @ factor.transpose(1, 2),
        sh_to_colors(0, any_direction, sh0, gaussians.shN[kept]).clamp(0, 1),
        gaussians.opacities[kept].sigmoid(),
    )
    return Splats(*(array.numpy() for array in arrays))
