"""A store with photographs, renders and Gaussians, the page of its report, and a browser."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.report.conftest import MadeStore, baseline_config, finish_again
from xrgs.formats.ply import save_ply
from xrgs.mixture import saved_variant
from xrgs.mixture.views import Variant, View
from xrgs.photos import images
from xrgs.report import build, pictures
from xrgs.safeio.atomic import write_json
from xrgs.splat.gaussians import Gaussians
from xrgs.store.store import Store
from xrgs.training import dataset

HR, LR = (48, 36), (24, 18)
TEST_VIEWS = ("IMG_001", "IMG_009")
TRAINING_VIEWS = {"IMG_002": "HR", "IMG_003": "LR", "IMG_004": "LR"}
HOSTILE = "<img src=x onerror=alert(1)></script><script>document.title='taken'</script>{{7*7}}"
QUALITY = "step,seconds,evaluations,gaussians,psnr,ssim,lpips\n" + "".join(
    f"{step},{step / 10},{step * 10**6},{step * 5},{15 + step / 100},0.7,0.4\n"
    for step in (100, 200, 300)
)
HISTORY = "step,loss,gaussians,duplicated,split,pruned_opacity,pruned_scale\n" + "".join(
    f"{step},0.1,{100 + step},{step},{step // 2},{step // 3},0\n" for step in range(0, 500, 50)
)


def _view(folder: Path, name: str, split: str, tag: str, number: int) -> View:
    """A view of coloured noise; the cameras stand in a row, three units before the origin."""
    width, height = HR if tag == "HR" else LR
    file = folder / f"images/{split}/{name}.png"
    rng = np.random.default_rng(number)
    file.parent.mkdir(parents=True, exist_ok=True)
    images.save(file, np.kron(rng.random((6, 8, 3)), np.ones((height // 6, width // 8, 1))))
    viewmat = np.eye(4)
    viewmat[:3, 3] = (-0.4 * number, 0.1 * (number % 2), 3.0)
    K = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]])
    return View(name, file, split, tag, width, height, K, viewmat, width / HR[0])


def make_variant(store: Store, tags: Mapping[str, str] = TRAINING_VIEWS) -> Variant:
    """Freeze a variant of two test views and three training views into a store.

    Args:
        store: The store.
        tags: The tag of each training view; an LR view has an original.
    """
    folder = store.path / "source"
    views = [_view(folder, name, "test", "HR", at) for at, name in enumerate(TEST_VIEWS)]
    for at, (name, tag) in enumerate(tags.items(), 2):
        views.append(_view(folder, name, "train", tag, at))
        if tag == "LR":
            views.append(_view(folder, name, "original", "HR", at))
    points = np.random.default_rng(0).normal(0, 1, (50, 3))
    report = {} if "LR" in tags.values() else {"degradation": "none", "hr": [*tags]}
    views.sort(key=lambda view: (view.split, view.name))
    made = Variant(
        "id", folder, "fern", 2, True, tuple(views), points, np.zeros((50, 3), np.uint8), report
    )
    return saved_variant.freeze(made, "0123456789abcdef", folder, store.variants, {})


def make_gaussians(seed: int, count: int = 200) -> Gaussians:
    """Opaque and faint Gaussians of all colours around the centre of the normalised world."""
    rng = np.random.default_rng(seed)
    arrays = {
        "means": rng.normal(0, 0.25, (count, 3)),
        "quats": rng.normal(size=(count, 4)),
        "scales": rng.normal(-3.0, 0.4, (count, 3)),
        "opacities": rng.normal(0.5, 1.5, count),
        "sh0": rng.normal(0, 1.2, (count, 1, 3)),
        "shN": np.zeros((count, 15, 3)),
    }
    return Gaussians(**{name: torch.from_numpy(a).float() for name, a in arrays.items()})


def data_of(page: Path) -> dict[str, Any]:
    """The JSON of a page."""
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page.read_text())
    assert found is not None
    return dict(json.loads(found[1]))


def page_of(store: Path, out: Path | None = None) -> Path:
    """The page of a store's report, which shows none of the report's figures: none is drawn."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pictures, "trade_off", lambda *_: b"")
        return build(store, out=out, pictures=["trade-off"]).folder / "report.html"


@pytest.fixture(scope="session")
def pictured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of one scene, with everything that a page shows, and a hostile label."""
    return _pictured(tmp_path_factory.mktemp("pictured") / "store", TRAINING_VIEWS, 3)


@pytest.fixture(scope="session", params=["alike", "mixed"])
def alone(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of one cell, of photographs alike or of a mixture; its name says which."""
    folder = tmp_path_factory.mktemp("alone")
    tags = TRAINING_VIEWS if request.param == "mixed" else dict.fromkeys(TRAINING_VIEWS, "HR")
    store = _pictured(folder / "store", tags, 1)
    return build(store, out=folder / request.param).folder / "report.html"


def _pictured(folder: Path, tags: Mapping[str, str], count: int) -> Path:
    made = MadeStore(folder)
    variant = make_variant(made.store, tags)
    for seed, label in enumerate(("baseline", "consistency", HOSTILE)[:count]):
        factors = {"gaussians": 1 - 0.2 * seed, "psnr": 1 + 0.01 * seed}
        cell = made.add(
            label, variant=variant.id, factors=factors, quality=QUALITY, history=HISTORY
        )
        config = baseline_config()
        if "LR" not in tags.values():
            config = config | {"variant": config["variant"] | {"hr_fraction": 1.0}}
        write_json(cell.path / "config.json", config)
        save_ply(cell.path / "splats.ply", make_gaussians(seed))
        for number, view in enumerate(TEST_VIEWS):
            photograph = images.read_png(variant.folder / f"images/test/{view}.png")
            noise = np.random.default_rng(seed + number).normal(0, 0.05 * seed, photograph.shape)
            images.save(cell.path / f"renders/{view}.png", (photograph + noise).astype("f4"))
        finish_again(cell)
    made.write(("+ablation=consistency", f"scene.name={HOSTILE}"))
    return made.store.path


@pytest.fixture
def copied(pictured: Path, tmp_path: Path) -> Path:
    """A copy of `pictured` that a test may damage."""
    return Path(shutil.copytree(pictured, tmp_path / "store"))


@pytest.fixture(scope="session")
def page(pictured: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of the report of `pictured`."""
    return page_of(pictured, tmp_path_factory.mktemp("page"))


@pytest.fixture(scope="session")
def cameras(pictured: Path) -> dataset.Dataset:
    """The views of the store's variant in the normalised world."""
    (folder,) = (pictured / "variants").glob("0123*")
    return dataset.load(saved_variant.load(folder))
