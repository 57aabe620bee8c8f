"""Writes a variant or a cell for other programs: data for COLMAP or nerfstudio, or only Gaussians.

Cameras, points and splats are in the normalised world of training. `transform.json` has the
similarity from the world of SfM to that world. Images are undistorted, and each has its own pinhole
camera. Gaussians of a cell that no render shows are left out.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from xrgs.errors import XrgsError
from xrgs.mixture.saved_variant import MANIFEST
from xrgs.mixture.views import Variant
from xrgs.safeio.atomic import write_json, write_text
from xrgs.safeio.files import check_writable, list_names
from xrgs.store.cell_folder import IDENTITY, SPLATS, CellFolder

if TYPE_CHECKING:
    from xrgs.mixture.colmap import PinholeImage
    from xrgs.splat.gaussians import Gaussians
    from xrgs.training.dataset import Dataset, LoadedView

#: Formats of a file that has only the Gaussians; each is also the file's suffix.
SPLAT_FORMATS = ("ply", "glb", "spz")


def export(path: Path, layout: str, out: Path) -> str:
    """Write a cell or a variant, by its folder, for another program: `colmap` or `nerfstudio`.

    The folder `out`, which is new or empty, gets `images/<split>_<view>.png`; `split.json`, with
    the view, split and tag of each image; `transform.json`, the similarity from the world of SfM to
    the world of all other files; and, for a cell, `splats.ply`. Cameras and points are in
    `sparse/0` (`colmap`), or in `transforms.json` and `points.ply` (`nerfstudio`).

    The images of a cell are its training views and its scored views. Where a view has a mask, each
    image has one: `masks/<image>.png`, white where a pixel is used. A line with the numbers of
    views and points is returned.

    Raises:
        XrgsError: The folder is not a finished cell or a variant, or is damaged; or `out` can't be
            written, or is not empty.
    """
    from xrgs.formats.ply import save_ply
    from xrgs.mixture import variant
    from xrgs.training import dataset

    cell = _cell(path)
    frozen = variant.load(path) if cell is None else cell.variant()
    data = dataset.load(frozen) if cell is None else cell.dataset()
    check_place(out, layout)
    try:
        out.mkdir(parents=True, exist_ok=True)
        images = _write_images(data, out)
        write_json(out / "transform.json", {"sfm_to_export": transform(frozen).tolist()})
        _LAYOUTS[layout](data, images, out)
        if cell is not None:
            # Not a copy: cells of older versions have no tag of antialiased Gaussians.
            antialiased = cell.config().splat.raster.antialiased
            save_ply(out / SPLATS, _shown(cell), antialiased=antialiased)
    except BaseException as error:
        shutil.rmtree(out, ignore_errors=True)  # or the same command would find it not empty
        if isinstance(error, OSError):
            raise XrgsError(f"out={out}: {error.filename}: {error.strerror}") from error
        raise
    splats = "" if cell is None else f", {SPLATS}"
    counts = f"{len(data.train)} training and {len(data.test)} test views"
    return f"{counts}, {len(data.points)} points{splats}: written to {out}"


def export_splats(path: Path, form: str, out: Path) -> str:
    """Write the Gaussians of a cell, or of a .ply, .glb or .spz file, to a .ply, .glb or .spz file.

    They stay in the normalised world of training. A .glb of a cell is shown with the cameras' mean
    up direction upwards. A line with the number of Gaussians is returned.

    Raises:
        XrgsError: The cell or the file can't be read, or `out` ends otherwise or can't be written.
    """
    from xrgs.formats.files import load_gaussians, save_gaussians

    check_place(out, form)
    up, total = {}, 0
    if path.suffix and not path.is_dir():
        gaussians, antialiased = load_gaussians(path)
    else:
        cell = _cell(path)
        if cell is None:
            raise XrgsError(f"{path}: a variant has no Gaussians; give a cell, or another format")
        gaussians, antialiased = _shown(cell), cell.config().splat.raster.antialiased
        total = cell.summary().gaussians
        viewmats = np.stack([view.camera.viewmat.numpy() for view in cell.dataset().train])
        up = {"up": -viewmats[:, 1, :3].mean(axis=0)}  # y of a camera points down
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        save_gaussians(out, gaussians, antialiased=antialiased, **up)
    except OSError as error:
        raise XrgsError(f"out={out}: {error.strerror}") from error
    kind = "antialiased Gaussians" if antialiased else "Gaussians"
    left_out = f" of {total}, without those that no render shows" if total > len(gaussians) else ""
    return f"{len(gaussians)} {kind}{left_out}: written to {out}"


def check_place(out: Path, form: str) -> None:
    """Raise `XrgsError` where an export can't be written to `out`, for its name or what is there.

    Args:
        out: The file or the folder to write.
        form: The format of the export.
    """
    if form in SPLAT_FORMATS:
        if out.suffix.lower() != f".{form}":
            raise XrgsError(f"out={out}: the name of a {form} file must end with .{form}")
        if out.is_dir():
            raise XrgsError(f"out={out}: is a folder; name a file")
    elif out.is_dir() and any(out.iterdir()):
        raise XrgsError(f"out={out}: is not empty; name a new folder")
    elif out.exists() and not out.is_dir():
        raise XrgsError(f"out={out}: is a file; name a new folder")
    # A training of hours may come before the export.
    try:
        check_writable(out.parent if form in SPLAT_FORMATS else out)
    except OSError as error:
        raise XrgsError(
            f"out={out}: can't be written: {error.filename}: {error.strerror}"
        ) from error


def without_invisible(gaussians: Gaussians, alpha_min: float) -> Gaussians:
    """Return new Gaussians without those that no render shows, and without gradients.

    The renderer skips contributions below `alpha_min`, so that renders stay the same but for
    rounding. A training leaves such Gaussians behind where they fade after its last removal.
    """
    from xrgs.splat.gaussians import Gaussians

    # A thousandth less: the logistic functions of two renderers round differently.
    kept = gaussians.opacities.detach().sigmoid() >= 0.999 * alpha_min
    return Gaussians(*(parameter.detach()[kept] for parameter in gaussians.raw()))


def _shown(cell: CellFolder) -> Gaussians:
    return without_invisible(cell.gaussians(), cell.config().splat.raster.alpha_min)


def transform(variant: Variant) -> NDArray[np.float64]:
    """Return the similarity [4, 4] from the world of SfM or of given poses to that of training."""
    from xrgs.splat.normalize import normalize_scene

    posed = [view.viewmat for view in variant.views if view.split != "original"]
    return normalize_scene(np.stack(posed), variant.points).transform @ variant.world


def _cell(folder: Path) -> CellFolder | None:
    """Return the finished cell in a folder; None where it holds a variant."""
    try:
        names = list_names(folder)
    except OSError as error:
        raise XrgsError(
            f"{folder}: {error.strerror}; give the folder of a cell or a variant"
        ) from error
    if MANIFEST in names:
        return None
    if IDENTITY not in names:
        raise XrgsError(f"{folder}: neither a cell nor a variant")
    cell = CellFolder(folder.absolute())
    cell.check_done()
    return cell


def _views(data: Dataset) -> Iterator[tuple[str, str, LoadedView]]:
    """Yield file name, split and view of each image. Views of both splits may have one name."""
    for split, views in (("train", data.train), ("test", data.test)):
        for view in views:
            yield f"{split}_{view.name}.png", split, view


def _write_images(data: Dataset, target: Path) -> list[PinholeImage]:
    """Write the images and `split.json`; return the cameras."""
    from xrgs.mixture.colmap import PinholeImage
    from xrgs.photos.images import save, save_mask

    images, entries = [], []
    is_masked = any(view.mask is not None for *_, view in _views(data))
    for name, split, view in _views(data):
        save(target / "images" / name, view.image.numpy(), durable=False)
        if is_masked:  # COLMAP and nerfstudio want a mask of every image, or none
            used = np.ones(view.image.shape[:2], np.bool_)
            mask = used if view.mask is None else view.mask.numpy()
            save_mask(target / _mask_name(name), mask, durable=False)
        entries.append({"file": name, "view": view.name, "split": split, "tag": view.tag})
        camera = view.camera
        K, viewmat = camera.K.double().numpy(), camera.viewmat.double().numpy()
        images.append(PinholeImage(name, camera.width, camera.height, K, viewmat))
    write_json(target / "split.json", {"images": entries})
    return images


def _write_colmap(data: Dataset, images: list[PinholeImage], target: Path) -> None:
    """Write a binary model, and the split where other programs look for it.

    The trainer of 3DGS reads `test.txt` in the model, nerfbaselines and nerfstudio's `colmap` read
    a list of each split in the folder. nerfstudio asks for `val` while it trains.
    """
    from xrgs.mixture import colmap

    model = target / "sparse/0"
    model.mkdir(parents=True)
    colmap.write_model(model, images, *_points(data))
    lists = {"train": "", "test": ""}
    for name, split, _ in _views(data):
        lists[split] += f"{name}\n"
    write_text(model / "test.txt", lists["test"])
    for listed, split in (("train", "train"), ("val", "test"), ("test", "test")):
        write_text(target / f"{listed}_list.txt", lists[split])


def _write_nerfstudio(data: Dataset, images: list[PinholeImage], target: Path) -> None:
    from xrgs.mixture import colmap

    colmap.write_points(target / "points.ply", *_points(data))
    files: dict[str, list[str]] = {"train": [], "test": []}
    for name, split, _ in _views(data):
        files[split].append(f"images/{name}")
    content = {
        "camera_model": "OPENCV",
        "orientation_override": "none",  # else nerfstudio turns the cameras, but not the splats
        "ply_file_path": "points.ply",
        "train_filenames": files["train"],
        "val_filenames": files["test"],
        "test_filenames": files["test"],
        "frames": [_frame(image, target) for image in images],
    }
    write_json(target / "transforms.json", content)


def _mask_name(name: str) -> str:
    """Return the path of an image's mask, as COLMAP's `mask_path=masks` expects it."""
    return f"masks/{name}.png"


def _frame(image: PinholeImage, target: Path) -> dict[str, Any]:
    """Return a frame of transforms.json, whose cameras look along -z with y up."""
    camera_to_world = np.linalg.inv(image.viewmat) @ np.diag([1.0, -1.0, -1.0, 1.0])
    mask = _mask_name(image.name)
    return {
        "file_path": f"images/{image.name}",
        **({"mask_path": mask} if (target / mask).exists() else {}),
        "w": image.width,
        "h": image.height,
        "fl_x": float(image.K[0, 0]),
        "fl_y": float(image.K[1, 1]),
        "cx": float(image.K[0, 2]),
        "cy": float(image.K[1, 2]),
        "transform_matrix": camera_to_world.tolist(),
    }


def _points(data: Dataset) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    colors = (data.colors * 255).round().byte().numpy()
    return data.points.double().numpy(), colors


_LAYOUTS: dict[str, Callable[[Dataset, list[PinholeImage], Path], None]] = {
    "colmap": _write_colmap,
    "nerfstudio": _write_nerfstudio,
}
