"""The page in a real browser: what a reader does with it, and what a hostile store can't."""

from __future__ import annotations

import base64
import io
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from tests.report.html.conftest import HOSTILE, data_of
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import Gaussians
from xrgs.splat.rendering import rasterize
from xrgs.splat.settings import RasterSettings
from xrgs.splat.sh import C0
from xrgs.training.dataset import Dataset
from xrgs.viewer.trained import LOG_SCALES

pytestmark = pytest.mark.slow


@pytest.fixture
def opened(browser: Any, page: Path) -> Any:
    """The browser with the page open."""
    browser.get_log("browser")
    browser.get(page.as_uri())
    return browser


def wait(browser: Any, script: str) -> Any:
    """Return what a script gives as soon as that is true."""
    from selenium.webdriver.support.wait import WebDriverWait

    return WebDriverWait(browser, 30).until(lambda driver: driver.execute_script(script))


def choose(browser: Any, selector: str, value: str) -> None:
    """Choose an option as a reader does."""
    browser.execute_script(
        "const select = document.querySelector(arguments[0]); select.value = arguments[1];"
        "select.dispatchEvent(new Event('change'))",
        selector,
        value,
    )


def column(browser: Any, table: str, place: int) -> list[str]:
    """The texts of a column of a table, as far as its rows are shown."""
    return list(
        browser.execute_script(
            f"return [...document.querySelectorAll('{table} tbody tr:not([hidden])')]"
            f".map(row => row.cells[{place}].textContent.trim())"
        )
    )


def sides(browser: Any, section: str) -> list[str]:
    """What is left and right of a section's slider."""
    script = f"return [...document.querySelectorAll('#{section} .side')].map(s => s.textContent)"
    return list(browser.execute_script(script))


def canvas_pixels(browser: Any) -> Any:
    """The first canvas of the 3D view [H, W, 3] in 0..1, after its next drawing."""
    browser.execute_script("document.getElementById('splats').scrollIntoView()")
    wait(browser, "return document.querySelector('.pair canvas')?.width === 720")
    url = browser.execute_async_script(
        "const done = arguments[0]; requestAnimationFrame(() => requestAnimationFrame(() =>"
        " done(document.querySelector('.pair canvas').toDataURL())))"
    )
    stream = io.BytesIO(base64.b64decode(url.partition(",")[2]))
    with Image.open(stream) as image:
        return np.asarray(image.convert("RGB"), dtype=np.float64) / 255


def test_nothing_goes_wrong_and_a_hostile_label_stays_text(opened: Any) -> None:
    canvas_pixels(opened)
    assert opened.get_log("browser") == []
    assert opened.title.startswith("Change from baseline")
    assert HOSTILE in column(opened, "#changes-table", 0)
    assert opened.execute_script("return document.querySelectorAll('img[onerror]').length") == 0
    options = opened.execute_script(
        "return [...document.getElementById('filter-label').options].map(one => one.value)"
    )
    assert options == ["", "consistency", HOSTILE]


def test_scripts_and_the_network_are_forbidden(opened: Any) -> None:
    blocked = opened.execute_async_script(
        "const done = arguments[0], seen = [];"
        "addEventListener('securitypolicyviolation', e => {"
        " seen.push(e.effectiveDirective); if (seen.length === 3) done(seen.sort()); });"
        "const image = new Image(); image.src = 'https://example.org/x.png';"
        "fetch('https://example.org/').catch(() => 0);"
        "const script = document.createElement('script'); script.textContent = 'window.ran = 1';"
        "document.body.append(script)"
    )
    assert blocked == ["connect-src", "img-src", "script-src-elem"]
    assert opened.execute_script("return window.ran") is None
    opened.get_log("browser")  # the violations themselves


def test_a_slider_moves_and_pictures_are_chosen(opened: Any) -> None:
    from selenium.webdriver.common.keys import Keys

    views = "return [...document.querySelector('#views select[aria-label=View]').options]"
    names = opened.execute_script(f"{views}.map(one => one.textContent)")
    assert [name.split(", ")[0] for name in names] == ["IMG_009", "IMG_001"], "worst first"
    assert names[0] < names[1].replace("IMG_001", "IMG_009"), "with their PSNR"
    slider = opened.find_element("css selector", "#views .slider")
    clip = "return document.querySelectorAll('#views .stage img')[1].style.clipPath"
    before = opened.execute_script(clip)
    slider.send_keys(Keys.ARROW_RIGHT, Keys.ARROW_RIGHT)
    clips = before, opened.execute_script(clip)
    assert clips == ("inset(0px 0px 0px 50%)", "inset(0px 0px 0px 52%)")
    assert sides(opened, "views")[0] == "photograph"
    choose(opened, "#views select[aria-label='Left of the slider']", "1")
    assert sides(opened, "views")[0] == "baseline"


def test_the_loupe_moves_in_all_pictures_at_once_by_keyboard(opened: Any) -> None:
    from selenium.webdriver.common.keys import Keys

    places = (
        "return [...document.querySelectorAll('#views .stage, #views .tile')]"
        ".map(frame => frame.querySelector('canvas')?.style.left)"
    )
    opened.find_element("css selector", "#views .stage").send_keys(Keys.ARROW_RIGHT)
    assert opened.execute_script(places) == ["52%"] * 8  # stage, photograph, 3 renders, 3 errors
    opened.find_element("css selector", "#views .stage").send_keys(Keys.ESCAPE)
    assert opened.execute_script(places) == [None] * 8


def test_a_table_sorts_and_a_filter_holds_for_tables_and_curves(opened: Any) -> None:
    lines = (
        "return document.querySelectorAll('#curves-body .chart')[arguments[0]]"
        ".querySelectorAll('polyline').length"
    )
    assert [opened.execute_script(lines, place) for place in range(2)] == [3, 3], "of each label"
    numbers = [float(text) for text in column(opened, "#scores-table", 5)]
    assert len(numbers) == 6
    heads = opened.find_elements("css selector", "#scores-table thead button")
    heads[5].click()
    ascending = [float(text) for text in column(opened, "#scores-table", 5)]
    assert ascending == sorted(numbers)
    heads[5].click()
    assert [float(text) for text in column(opened, "#scores-table", 5)] == ascending[::-1]
    choose(opened, "#filter-label", "consistency")
    choose(opened, "#filter-metric", "PSNR")
    assert column(opened, "#changes-table", 0) == ["consistency"]
    assert opened.execute_script(lines, 0) == 2
    assert set(column(opened, "#scores-table", 2)) == {"baseline", "consistency"}


def test_a_figure_of_the_paper_shows_its_counterpart(opened: Any) -> None:
    links = {
        link.find_element("xpath", "../..").text.split()[1]: link
        for link in opened.find_elements("css selector", ".figure-link")
    }
    assert sorted(links) == ["5", "6"]  # those of consistency
    opened.execute_script("arguments[0].click()", links["5"])
    texts = (
        "return [...document.querySelectorAll('#training .stage .side')].map(s => s.textContent)"
    )
    assert opened.execute_script(texts) == ["LR photograph", "consistency"]


def test_it_fits_a_phone(opened: Any) -> None:
    size = {"width": 390, "height": 800, "deviceScaleFactor": 1, "mobile": True}
    opened.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    try:
        assert opened.execute_script("return document.documentElement.scrollWidth") <= 390
    finally:
        opened.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def dequantised(model: dict[str, Any]) -> Gaussians:
    """The Gaussians of a model of the page, of which only band 0 of the harmonics is kept."""
    content, count = base64.b64decode(model["data"]), model["count"]
    bounded = np.frombuffer(content[: 6 * count], "<u2").reshape(count, 3) / 65535 * 2 - 1
    rest = np.frombuffer(content[6 * count :], "u1").reshape(count, 11) / 255
    arrays = {
        "means": bounded / (1 - np.abs(bounded)),
        "quats": rest[:, 3:7] * 2 - 1,
        "scales": LOG_SCALES[0] + rest[:, :3] * (LOG_SCALES[1] - LOG_SCALES[0]),
        "opacities": np.log(rest[:, 10] / np.maximum(1 - rest[:, 10], 1e-6)),
        "sh0": (rest[:, None, 7:10] - 0.5) / C0,
        "shN": np.zeros((count, 15, 3)),
    }
    return Gaussians(**{name: torch.from_numpy(a).float() for name, a in arrays.items()})


def test_the_3d_view_shows_what_the_rasterizer_renders_and_both_turn_together(
    opened: Any, page: Path, cameras: Dataset
) -> None:
    """Independent truth: our own rasterizer, at the size of the canvas, from the same camera."""
    from selenium.webdriver.common.keys import Keys

    canvas_pixels(opened)
    opened.execute_script("document.querySelector('#splats input[type=checkbox]').click()")
    shown = canvas_pixels(opened)
    view = cameras.test[0].camera
    scale = 720 / view.width
    K = torch.diag(torch.tensor([scale, scale, 1.0])) @ view.K
    camera = Camera(view.viewmat, K, 720, round(view.height * scale))
    settings = replace(RasterSettings(), eps2d=0.3 * scale**2)
    gaussians = dequantised(data_of(page)["models"][0])
    truth = rasterize(gaussians, camera, settings=settings).image.clamp(0, 1).numpy()
    assert truth.std() > 0.05
    assert len(np.unique(shown.reshape(-1, 3), axis=0)) > 100
    # The canvas rounds to 8 bits after each Gaussian.
    assert np.sqrt(np.mean((shown - truth) ** 2)) < 0.01
    opened.find_elements("css selector", ".pair canvas")[1].send_keys(Keys.ARROW_LEFT)
    assert np.abs(canvas_pixels(opened) - shown).mean() > 0.005


def test_the_page_of_one_cell_works_and_has_no_tags_where_photographs_are_alike(
    browser: Any, alone: Path
) -> None:
    browser.get_log("browser")
    browser.get(alone.as_uri())
    canvas_pixels(browser)
    assert browser.get_log("browser") == []
    assert browser.execute_script("return document.querySelectorAll('canvas').length") == 1
    shown = browser.execute_script("return document.querySelector('main').innerText")
    tagged = {"HR", "LR"} & set(re.findall(r"\w+", shown))
    assert bool(tagged) == (alone.parent.name == "mixed")
    assert sides(browser, "views") == ["photograph", "render"]
    places = [
        browser.execute_script(f"return document.querySelector('{of}').getBoundingClientRect().top")
        for of in ("#splats canvas", "#views .stage", "#photographs")
    ]
    assert places == sorted(places)
    scores = [float(text) for text in column(browser, "#scores-table", 3)]
    assert len(scores) == 2
    assert scores == sorted(scores), "worst first, as the pictures"
    assert "Nothing of this was recorded" not in shown
