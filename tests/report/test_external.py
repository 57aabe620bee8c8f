"""Another program's renders: their scores against scikit-image, and what is refused."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray
from PIL import Image
from skimage.metrics import peak_signal_noise_ratio

from xrgs.errors import XrgsError
from xrgs.mixture import saved_variant
from xrgs.mixture.views import Variant, View
from xrgs.report import build
from xrgs.report.collect import ReportError, ReportStore
from xrgs.report.external import External, parse, with_external

SIZE = (32, 24)
VIEWS = ("IMG_001", "IMG_009")
MakeStore = Any  # MadeStore of conftest.py


def save(file: Path, pixels: NDArray[np.uint8]) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(file)


def noise(seed: int, size: tuple[int, int] = SIZE) -> NDArray[np.uint8]:
    shape = (size[1], size[0], 3)
    return np.random.default_rng(seed).integers(0, 256, shape).astype(np.uint8)


@pytest.fixture
def frozen_variant(made: MakeStore) -> Callable[[int], str]:
    """(draw) -> the id of a real variant in the store, with the test views of the made-up cells."""

    def make(draw: int = 0) -> str:
        folder = made.store.variants / f".made-{draw}"
        views = []
        for number, (split, name) in enumerate([("train", "a"), *(("test", v) for v in VIEWS)]):
            file = folder / "images" / split / f"{name}.png"
            save(file, noise(number))
            K = np.array([[30.0 + draw, 0, 16], [0, 30, 12], [0, 0, 1]])
            views.append(View(name, file, split, "HR", *SIZE, K, np.eye(4), 1.0))
        points = np.random.default_rng(0).normal(size=(5, 3))
        colors = np.zeros((5, 3), np.uint8)
        variant = Variant("", folder, "fern", 5, True, tuple(views), points, colors, {})
        return saved_variant.freeze(variant, f"{draw:016x}", folder, made.store.variants, {}).id

    return make


def rendered(folder: Path, offset: int = 10) -> Path:
    """Renders of the two test views: the photographs, each value changed by so much."""
    for number, view in enumerate(VIEWS, start=1):
        pixels = noise(number).astype(int)
        changed = np.where(pixels > 127, pixels - offset, pixels + offset)
        save(folder / f"{view}.png", changed.astype(np.uint8))
    return folder


def test_renders_are_scored_against_the_photographs(
    made: MakeStore, frozen_variant: Callable[..., str], tmp_path: Path
) -> None:
    variant = frozen_variant()
    made.add(variant=variant)
    made.add("consistency", variant=variant, factors={"psnr": 1.1})
    sweep = made.read()
    other = External("gsplat", tmp_path / "renders")
    rendered(other.folder / "fern")
    joined = with_external(sweep, ReportStore(made.store.path), [other])
    row = joined.cells.iloc[-1]
    assert list(joined.cells["label"]) == ["baseline", "consistency", "gsplat"]
    assert (row["scene"], row["state"], row["variant_id"]) == ("fern", "done", variant)
    views = joined.views[joined.views["cell_id"] == row["cell_id"]].set_index("view")
    for number, view in enumerate(VIEWS, start=1):
        render = np.asarray(Image.open(other.folder / "fern" / f"{view}.png"))
        expected = peak_signal_noise_ratio(noise(number), render, data_range=255)
        assert views.loc[view, "psnr"] == pytest.approx(expected, rel=1e-6)
    assert row["psnr"] == pytest.approx(views["psnr"].mean())
    assert pd.isna(row[["training_time_s", "gaussians", "lpips"]]).all()


@pytest.mark.slow
def test_the_report_has_one_more_column(
    made: MakeStore, frozen_variant: Callable[..., str], tmp_path: Path
) -> None:
    variant = frozen_variant()
    for seed in (0, 1):
        rendered(made.add(variant=variant, seed=seed).path / "renders", 30)
        made.add("consistency", variant=variant, seed=seed)
    sweep_id = made.write()
    others = (External("gsplat", rendered(tmp_path / "a")),
              External("b", rendered(tmp_path / "c", 40)))  # fmt: skip
    report = build(made.store.path, sweep_id, None, ["fern--gsplat"], externals=others)
    assert report.folder.name == f"{sweep_id}.with-gsplat.with-b"
    assert "Renders of another program: gsplat, b." in report.text
    assert any(line.startswith("gsplat  ") for line in report.text.splitlines())
    table = (
        pd.read_csv(report.folder / "table.csv")
        .set_index(["level", "label", "metric"])
        .sort_index()
    )
    mean = table.xs(("mean", "gsplat"))
    psnr = mean.loc["psnr"]
    assert psnr["pairs"] == 1, "the lowest seed alone"
    assert psnr["value"] == pytest.approx(20 * np.log10(255 / 10), abs=0.01)
    assert mean["change"].isna()["gaussians"]
    assert (report.folder / "figures" / "fern--gsplat.png").is_file()
    training = pd.read_csv(report.folder / "training.csv")
    assert set(training["label"]) == {"baseline", "consistency"}
    against = build(made.store.path, sweep_id, tmp_path / "out", [], "gsplat", externals=others)
    assert "consistency against gsplat" in against.text


def test_each_draw_of_a_variant_has_a_folder_of_its_own(
    made: MakeStore, frozen_variant: Callable[..., str], tmp_path: Path
) -> None:
    for draw in (0, 1):
        made.add(variant=frozen_variant(draw), draw=draw)
    sweep = made.read()
    other = External("gsplat", tmp_path / "renders")
    rendered(other.folder)
    rendered(other.folder / "fern")
    with pytest.raises(ReportError, match=r"fern with variant.seed=0: \S+/fern/0 is exp"):
        with_external(sweep, ReportStore(made.store.path), [other])
    for draw, offset in ((0, 10), (1, 20)):
        rendered(other.folder / "fern" / str(draw), offset)
    rows = with_external(sweep, ReportStore(made.store.path), [other]).cells.tail(2)
    assert list(rows["variant_seed"]) == [0, 1]
    assert rows["psnr"].iloc[0] - rows["psnr"].iloc[1] == pytest.approx(20 * np.log10(2), abs=0.01)


@pytest.fixture
def join(made: MakeStore, frozen_variant: Callable[..., str]) -> Callable[..., pd.DataFrame]:
    """(folder, label) -> the cells of a sweep of one cell, with the renders of a folder."""
    made.add(variant=frozen_variant())

    def joined(folder: Path, label: str = "other") -> pd.DataFrame:
        sweep = made.read()
        return with_external(sweep, ReportStore(made.store.path), [External(label, folder)]).cells

    return joined


def test_what_its_training_took_stands_in_the_row(
    join: Callable[..., pd.DataFrame], tmp_path: Path
) -> None:
    folder = rendered(tmp_path / "r")
    (folder / "figures.json").write_text('{"training_time_s": 61.5, "gaussians": 41230}')
    row = join(folder).iloc[-1]
    assert (row["training_time_s"], row["gaussians"]) == (61.5, 41230)
    assert pd.isna(row[["memory_bytes", "peak_rss_bytes", "evaluations"]]).all()


@pytest.mark.parametrize(
    ("content", "why"),
    [
        ('{"seconds": 3}', "unknown field `seconds`"),
        ('{"gaussians": 0}', "gaussians: .*> 0"),
        ('{"training_time_s": NaN}', "not valid JSON"),
    ],
)
def test_wrong_figures_are_refused(
    join: Callable[..., pd.DataFrame], tmp_path: Path, content: str, why: str
) -> None:
    folder = rendered(tmp_path / "r")
    (folder / "figures.json").write_text(content)
    with pytest.raises(XrgsError, match=rf"{folder}/figures\.json: .*{why}"):
        join(folder)


@pytest.mark.parametrize(
    ("size", "mode", "why"),
    [
        (None, "", "No such file"),
        ((33, 24), "RGB", "33 x 24 pixels, not 32 x 24"),
        (SIZE, "RGBA", "RGBA, not 8-bit RGB"),
    ],
)
def test_a_render_that_can_not_be_scored_is_named(
    join: Callable[..., pd.DataFrame],
    tmp_path: Path,
    size: tuple[int, int] | None,
    mode: str,
    why: str,
) -> None:
    file = rendered(tmp_path / "renders") / f"{VIEWS[1]}.png"
    file.unlink()
    if size:
        Image.fromarray(noise(0, size)).convert(mode).save(file)
    with pytest.raises(ReportError) as caught:
        join(tmp_path / "renders")
    message = str(caught.value)
    assert message.startswith(str(file))
    assert why in message
    assert "expected is an 8-bit RGB PNG of 32 x 24 px, the render of the view IMG_009" in message


def test_a_render_of_16_bits_is_refused(join: Callable[..., pd.DataFrame], tmp_path: Path) -> None:
    file = rendered(tmp_path / "renders") / f"{VIEWS[1]}.png"
    file.write_bytes(imagecodecs.png_encode(noise(0).astype(np.uint16) * 257))
    with pytest.raises(ReportError, match="16 bits a channel; expected is an 8-bit RGB PNG"):
        join(tmp_path / "renders")


def test_a_label_of_the_sweep_is_refused(join: Callable[..., pd.DataFrame], tmp_path: Path) -> None:
    with pytest.raises(ReportError, match="external=baseline: cells of the sweep have that label"):
        join(rendered(tmp_path / "r"), "baseline")


def test_a_damaged_variant_is_no_truth(
    made: MakeStore, join: Callable[..., pd.DataFrame], tmp_path: Path
) -> None:
    (photograph,) = made.store.variants.glob("*/images/test/IMG_001.png")
    shutil.copy(rendered(tmp_path / "r") / "IMG_001.png", photograph)
    with pytest.raises(saved_variant.CorruptVariant, match=r"IMG_001\.png"):
        join(tmp_path / "r")


def test_folders_have_labels_or_their_own_names() -> None:
    assert parse([]) == ()
    assert parse(["gsplat:out/a", "/data/other", "c:d:e"]) == (
        External("gsplat", Path("out/a")),
        External("other", Path("/data/other")),
        External("c", Path("d:e")),
    )
    assert parse(["./a:b"]) == (External("a:b", Path("a:b")),)
    for wrong in ("gsplat:", "a:x b/a"):
        with pytest.raises(ReportError, match="external="):
            parse(wrong.split())


def test_renders_beside_no_done_cell_are_refused(made: MakeStore, tmp_path: Path) -> None:
    made.add_error("fern")
    with pytest.raises(ReportError, match="external=gsplat: no cell of the sweep is done"):
        with_external(made.read(), ReportStore(made.store.path), [External("gsplat", tmp_path)])
