"""The live viewer: its page, its servers, how it ends, and that one camera moves the others."""

from __future__ import annotations

import asyncio
import io
import re
import socket
import urllib.request
from collections.abc import Callable
from contextlib import contextmanager, nullcontext
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from xrgs.errors import XrgsError
from xrgs.splat.gaussians import Gaussians
from xrgs.viewer import live
from xrgs.viewer.live import to_splats
from xrgs.viewer.models import Model

MakeModel = Callable[..., Model]


def fetch(url: str) -> tuple[str, Any]:
    with urllib.request.urlopen(url, timeout=10) as answer:  # noqa: S310 - on this machine
        return answer.read().decode(), answer.headers


def is_open(url: str) -> bool:
    with socket.socket() as tried:
        return tried.connect_ex(("127.0.0.1", int(url.rpartition(":")[2]))) == 0


@pytest.mark.slow
def test_a_page_of_this_machine_has_a_frame_for_each_model_until_it_ends(
    model: MakeModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    bound = []
    bind = socket.socket.bind

    def noted(own: socket.socket, address: Any) -> None:
        bound.append(address[0])
        bind(own, address)

    monkeypatch.setattr(socket.socket, "bind", noted)
    models = [model("baseline"), model("<b>&", seed=1)]
    with live.shown(models, 0, 30) as address:
        page, headers = fetch(address)
        assert page.count("<iframe") == 2
        assert "<b>" not in page
        assert "&lt;b&gt;&amp;" in page
        assert headers["Content-Security-Policy"].startswith("default-src 'none'")
        frames = re.findall(r'src="(http://127\.0\.0\.1:\d+)"', page)
        assert len(set(frames)) == 2
        for url in frames:
            assert "<html" in fetch(url)[0]
    assert not any(map(is_open, [address, *frames]))
    assert set(bound) == {"127.0.0.1"}


def test_a_port_in_use_is_named(model: MakeModel) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with (
            pytest.raises(XrgsError, match=rf"port={port}: can't be used"),
            live.shown([model()], port, 30),
        ):
            pass
    with (
        pytest.raises(XrgsError, match="port=70000: can't be used"),
        live.shown([model()], 70_000, 30),
    ):
        pass


@pytest.mark.slow
@pytest.mark.parametrize("size", [1e-5, 1e4])
def test_gaussians_of_any_size_reach_viser(
    model: MakeModel, monkeypatch: pytest.MonkeyPatch, size: float
) -> None:
    """viser 1.1.1 sends covariances as float16 (viser/_scene_api.py, add_gaussian_splats).

    One guesses float32, as of the centres: Gaussians of small units would vanish in silence.
    """
    viser = pytest.importorskip("viser")
    added: list[Any] = []
    add = viser.SceneApi.add_gaussian_splats
    monkeypatch.setattr(
        viser.SceneApi,
        "add_gaussian_splats",
        lambda *args, **options: added.append(add(*args, **options)),
    )
    made = model()
    with torch.no_grad():
        made.gaussians.means.mul_(size)
        made.gaussians.scales.add_(np.log(size))
    with live.shown([made], 0, 40):
        (handle,) = added
        sent = np.ascontiguousarray(handle.buffer)
    expected = to_splats(made.gaussians, 40)
    upper = expected.covariances[:, *np.triu_indices(3)]
    covariances = sent[:, 4:7].copy().view(np.float16).astype(float) * handle.scale**2
    largest = expected.covariances.max((1, 2))
    assert abs(covariances - upper).max(1) / largest == pytest.approx(0, abs=1e-3)
    assert sent[:, :3].view(np.float32) * handle.scale == pytest.approx(expected.centers, rel=1e-5)


def test_without_viser_the_extra_is_named(without: Callable[[str], None]) -> None:
    without("viser")
    with pytest.raises(XrgsError, match=r"pip install 'xrgs\[view\]'"), live.shown([], 0, 1):
        pass


class Client:
    """A frame of the page, with the camera that its browser has reported."""

    def __init__(self) -> None:
        self.callbacks: list[Any] = []
        self.camera = SimpleNamespace(
            client=self, on_update=self.callbacks.append, position=np.zeros(3),
            look_at=np.ones(3), up_direction=np.array([0.0, 0, 1]), fov=1.0,
        )  # fmt: skip
        self.atomic: Callable[[], Any] = nullcontext

    def move(self, x: float) -> None:
        self.report(np.array([x, 0.0, 0.0]))

    def report(self, position: Any) -> None:
        self.camera.position = position
        for callback in self.callbacks:
            asyncio.run(callback(self.camera))


def test_the_camera_that_is_moved_moves_the_others() -> None:
    shared, clients = live._SharedCamera(None), [Client(), Client()]
    for client in clients:
        shared.join(client)
    first, second = clients
    together: list[str] = []

    @contextmanager
    def atomic() -> Any:
        together.append("begin")
        yield
        together.append("end")

    second.atomic = atomic
    first.camera.fov = 0.5
    first.move(1.0)
    assert (second.camera.position[0], second.camera.fov) == (1.0, 0.5)
    assert together == ["begin", "end"]
    first.move(2.0)
    second.move(1.0)  # the second browser reports where it was told to be a moment ago
    second.move(2.0)
    assert first.camera.position[0] == 2.0, "which is no move of the user"
    second.move(7.0)
    assert first.camera.position[0] == 7.0
    first.move(7.0)
    first.move(1.0)
    assert second.camera.position[0] == 1.0, "a place that was told before is one to move to"
    shared.leave(first)
    second.move(8.0)
    first.move(9.0)
    assert (first.camera.position[0], second.camera.position[0]) == (9.0, 8.0)


def test_a_frame_that_is_opened_takes_the_place_of_the_others() -> None:
    place = {"position": np.ones(3), "look_at": np.zeros(3), "up_direction": np.ones(3), "fov": 0.5}
    shared, first, second = live._SharedCamera(place), Client(), Client()
    shared.join(first)
    shared.join(second)
    assert np.array_equal(second.camera.position, np.ones(3))
    first.move(3.0)  # what its browser reports from before it was put to its place
    assert np.array_equal(second.camera.position, np.ones(3))
    assert np.array_equal(first.camera.position, np.ones(3)), "it is told again"
    for client in (first, second):
        client.report(np.ones(3))
    second.move(7.0)
    assert first.camera.position[0] == 7.0
    first.report(np.ones(3))  # a report from before it followed, which came late
    assert second.camera.position[0] == 7.0


@pytest.mark.slow
def test_in_a_browser_both_models_move_as_one(model: MakeModel, browser: Any) -> None:
    from selenium.common.exceptions import TimeoutException
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.support.wait import WebDriverWait

    def panes() -> list[Any]:
        """The lower left of both frames, where viser's panel is not, [300, 350, 3] each."""
        with Image.open(io.BytesIO(browser.get_screenshot_as_png())) as screen:
            pixels = np.asarray(screen.convert("RGB"), dtype=np.float64)
        left, right = browser.execute_script(
            "return [...document.querySelectorAll('iframe')].map(f => f.getBoundingClientRect().x)"
        )
        return [pixels[-300:, round(x) : round(x) + 350] for x in (left, right)]

    def same(_: Any = None) -> bool:
        first, second = panes()
        return bool(first.std() > 5 and abs(first - second).mean() < 0.5)

    browser.get_log("browser")
    # The driver gives the page 10 s for a screenshot, which drawing on a busy core may exceed.
    wait = WebDriverWait(browser, 180, ignored_exceptions=[TimeoutException])
    one = model()
    with live.shown([one, one], 0, 40) as address:
        browser.get(address)
        wait.until(same)
        before = wait.until(lambda _: panes())
        frame = browser.find_elements("css selector", "iframe")[1]
        drag = ActionChains(browser).move_to_element_with_offset(frame, -150, 150).click_and_hold()
        drag.move_by_offset(80, -20).release().perform()
        wait.until(
            lambda _: all(abs(a - b).mean() > 3 for a, b in zip(before, panes(), strict=True))
        )
        wait.until(same)
        said = [entry["message"] for entry in browser.get_log("browser")]
        # three.js says this of the splats of any page of viser's, once for each frame
        errors = [text for text in said if "rror" in text and "computeBoundingSphere" not in text]
        assert errors == []
        browser.get("about:blank")


def random_gaussians(count: int) -> Gaussians:
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    return Gaussians(
        normal(count, 3),
        normal(count, 4),
        normal(count, 3),
        normal(count),
        normal(count, 1, 3),
        normal(count, 15, 3),
    )


def test_splats_are_the_gaussians_with_their_flat_colours() -> None:
    gaussians = random_gaussians(20)
    splats = to_splats(gaussians, 20)
    rotations = Rotation.from_quat(gaussians.quats.numpy(), scalar_first=True).as_matrix()
    variances = np.exp(2 * gaussians.scales.double().numpy())
    covariances = np.einsum("nij,nj,nkj->nik", rotations, variances, rotations)
    assert splats.covariances == pytest.approx(covariances, rel=1e-4, abs=1e-5)
    assert (splats.centers == gaussians.means.numpy()).all()
    colours = 0.5 + 0.28209479177387814 * gaussians.sh0[:, 0].double().numpy()
    assert splats.colors == pytest.approx(colours.clip(0, 1), abs=1e-6)
    assert splats.colors.max() <= 1
    opacities = 1 / (1 + np.exp(-gaussians.opacities.double().numpy()))
    assert splats.opacities == pytest.approx(opacities, abs=1e-6)


def test_the_most_opaque_are_kept_in_their_order() -> None:
    gaussians = random_gaussians(6)
    gaussians.opacities = torch.tensor([0.0, 2.0, -1.0, 2.0, 3.0, 2.0])
    splats = to_splats(gaussians, 3)
    assert (splats.centers == gaussians.means[[1, 3, 4]].numpy()).all()
