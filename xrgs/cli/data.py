"""`xrgs-data`: downloads photographs and the weights of LPIPS, shows and exports variants."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg
from tyro.extras import literal_type_from_choices

from xrgs import config
from xrgs.cli import options
from xrgs.cli.options import STORE, Folder, Names, OptionalFolder, shown_as
from xrgs.errors import StoreError, XrgsError
from xrgs.mixture.paths import is_failed
from xrgs.mixture.saved_variant import MANIFEST
from xrgs.photos.images import SUFFIXES
from xrgs.photos.scenes.folder import VIDEOS
from xrgs.photos.scenes.scene import ALL_BELOW
from xrgs.runtime.streams import say
from xrgs.safeio.paths import user_path
from xrgs.store.cell_folder import IDENTITY, CellFolder
from xrgs.store.export import SPLAT_FORMATS
from xrgs.store.store import Store

if TYPE_CHECKING:
    from collections.abc import Sequence

    Dataset = str
else:
    Dataset = literal_type_from_choices(
        sorted(file.stem for file in (config.CONF_DIR / "data").glob("*.yaml"))
    )


def download(
    dataset: Positional[Dataset],
    scenes: Positional[Names] = (),
    data_root: OptionalFolder = None,
    url: Annotated[str | None, shown_as("URL")] = None,
    sha256: Annotated[str | None, shown_as("HEX")] = None,
    max_bytes: Annotated[int | None, shown_as("N")] = None,
    redirect_hosts: Annotated[list[str] | None, shown_as("HOST ...")] = None,
) -> None:
    """Download published scenes and unpack them; run it again to continue an interrupted download.

    Args:
        dataset: The set of scenes.
        scenes: Names of scenes in the set; all by default.
        data_root: The folder to unpack into; by default `data_root` of the config.
        url: The address of the archive, instead of the one in the config.
        sha256: The hash of the archive, instead of the one in the config.
        max_bytes: The largest size to download, instead of the one in the config.
        redirect_hosts: Hosts to which the address may redirect; no others are followed.
    """
    from omegaconf import OmegaConf

    from xrgs.photos.download.scenes import DatasetConf, fetch_scenes

    published: Any = OmegaConf.to_container(
        OmegaConf.load(config.CONF_DIR / "data" / f"{dataset}.yaml")
    )
    given = {"url": url, "sha256": sha256, "max_bytes": max_bytes, "redirect_hosts": redirect_hosts}
    changes: Any = {key: value for key, value in given.items() if value is not None}
    root = data_root or Path(OmegaConf.load(config.CONF_DIR / "config.yaml").data_root)
    say(fetch_scenes(replace(DatasetConf(**published), **changes), scenes, root))


def lpips(
    source: Annotated[str | None, arg(name="from"), shown_as("FILE|URL")] = None,
    network: Literal["alex", "vgg"] = "alex",
) -> None:
    """Download the weights of LPIPS; without them its rows in tables are n/a.

    Args:
        source: The archive or the weights: a file, or another address.
        network: `alex`, used in every evaluation, or `vgg`, for `xrgs-store rescore --also
            lpips_vgg`.
    """
    from xrgs.evaluation.lpips.download import fetch_weights
    from xrgs.evaluation.lpips.weights import ALEX, VGG

    say(fetch_weights(source, ALEX if network == "alex" else VGG))


def inspect(
    variant: Positional[Annotated[str, shown_as("FOLDER|CELL|KEY=VALUE")]] = "",
    overrides: Positional[Annotated[tuple[str, ...], shown_as("KEY=VALUE ...")]] = (),
    out: Annotated[Path | None, shown_as("FILE.png")] = None,
    store: OptionalFolder = None,
) -> None:
    """Print a table of a variant's views and the result of SfM, and draw all views on one sheet.

    Args:
        variant: A folder of photographs, which are not degraded; overrides may follow. Or overrides
            as for xrgs-sweep, such as scene=llff/fern variant.factor=4. In both cases a variant
            that the store lacks is built. Or a variant by its folder or id, or a cell of it.
        overrides: Keys of xrgs-sweep.
        out: The file of the sheet; by default it is named after the variant.
        store: The store, as store=FOLDER.
    """
    from xrgs.store.inspect import describe

    if not variant:
        raise XrgsError("inspect: give a folder of photographs, a variant, a cell, or overrides")
    if out is not None and out.suffix.lower() != ".png":  # before the cameras are looked for
        raise XrgsError(f"out={out}: the sheet is a PNG; name a file FILE.png")
    stores = (f"store={store}",) if store else ()
    say(describe(_variant((variant, *overrides, *stores)), out))


def _variant(words: Sequence[str]) -> Path:
    """Return the folder of the variant that `inspect` shows; build the variant if it is missing."""
    from xrgs import composing
    from xrgs.cli.overrides import check_no_axis, explained, with_quotes
    from xrgs.sweep import build_variants, job

    first, *others = words
    path = user_path(first.removesuffix(ALL_BELOW))
    if is_failed(path.name) or (path / MANIFEST).is_file():
        return path
    if path.exists() and not (path / IDENTITY).is_file():
        words = last_of_each_key([*as_they_are(first), *others])
    elif "=" not in first:
        store = Store(next((user_path(w[6:]) for w in others if w.startswith("store=")), STORE))
        if not path.exists() and not store.exists:
            raise XrgsError(f"{first}: there is no such folder, and no store {store.path}")
        folder = store.find_folder(first)
        is_cell = (folder / IDENTITY).is_file()
        return CellFolder(folder.absolute()).variant().folder if is_cell else folder
    with explained():
        words = with_quotes(words)
        check_no_axis(words)
        conf = composing.compose(*words)
    conf.retry = "failed"
    store = Store(Path(conf.store))
    (planned,) = build_variants.plan([conf], store, allow_build=True)
    if planned.id is None:
        hint = build_variants.how_to_get([conf.scene])
        raise XrgsError("; ".join(filter(None, (planned.error, hint))))
    job.restore_images(conf, store, planned.id)
    return store.variants / planned.id


def export(
    name: Positional[Annotated[str, shown_as("CELL|VARIANT|FILE")]] = "",
    layout: Annotated[
        Literal["auto", "colmap", "nerfstudio", "ply", "glb", "spz"], arg(name="format")
    ] = "auto",
    out: Annotated[Path | None, shown_as("FOLDER|FILE")] = None,
    store: Folder = STORE,
) -> None:
    """Write a cell or a variant for other programs, or convert a file of Gaussians.

    Args:
        name: A cell or a variant: its id in the store or the beginning of the id, its folder, or
            the name of a scene with one done cell. Or a .ply, .glb or .spz file to convert.
        layout: `ply`, `glb` (glTF with KHR_gaussian_splatting) and `spz` (8 bits per value): one
            file of Gaussians. `colmap` and `nerfstudio`: a folder with images, cameras, points and
            split, and the splats of a cell. `auto`: by the suffix of --out; a folder gets `colmap`.
        out: The file to write, which is replaced, or a new folder; by default named after the cell,
            variant or file.
        store: The store.
    """
    if not name:
        raise XrgsError("export: give a cell, a variant, or a file of Gaussians")
    path = user_path(name)
    is_other_path = path.name != name and not path.is_dir()
    if path.suffix.lower()[1:] not in SPLAT_FORMATS and not is_other_path:
        home = Store(store)
        try:
            path = path if path.is_dir() and not home.exists else home.find_folder(name)
        except StoreError:
            from xrgs.formats.saved import check_is_read

            check_is_read(path)
            raise
    say(write_export(path, out, layout))


def form_of(out: Path) -> str:
    """Return the format of an export by the suffix of its file; `colmap` for a folder.

    Raises:
        XrgsError: The suffix is of no format.
    """
    if (form := out.suffix.lower()[1:]) in SPLAT_FORMATS:
        return form
    if out.suffix:
        suffixes = ", ".join(f".{form}" for form in SPLAT_FORMATS)
        raise XrgsError(f"out={out}: a file ends with {suffixes}; a folder has no suffix")
    return "colmap"


def write_export(path: Path, out: Path | None, layout: str = "auto") -> str:
    """Write an export, and return a line for the terminal.

    `path` is the folder of a cell or a variant, or a file of Gaussians. `out` is the file or the
    folder to write; None names it after `path`. The layout `auto` is `form_of(out)`.

    Raises:
        XrgsError: The export is not possible in this format, or `out` can't be written.
    """
    from xrgs.store.export import export as write
    from xrgs.store.export import export_splats

    if layout == "auto":
        layout = "colmap" if out is None else form_of(out)
    if layout in SPLAT_FORMATS:
        return export_splats(path, layout, out or Path(f"{path.stem}.{layout}"))
    if out is not None and out.suffix.lower()[1:] in SPLAT_FORMATS:
        raise XrgsError(f"out={out}: --format {layout} writes a folder, and this names a file")
    return write(path, layout, out or Path(f"{path.name}-{layout}"))


main = partial(
    options.run,
    "xrgs-data",
    {"download": download, "lpips": lpips, "inspect": inspect, "export": export},
    "Download photographs and the weights of LPIPS, show and export variants.",
    overrides="inspect",
)


def as_they_are(photographs: str) -> list[str]:
    """Return the overrides for a folder of photographs, or a video, without any degradation.

    Views are tagged HR and LR by their measured sampling rates.

    Raises:
        XrgsError: There is no such folder or video.
    """
    path = user_path(photographs.removesuffix(ALL_BELOW))
    if path.suffix.lower() in SUFFIXES and not path.is_dir():
        raise XrgsError(f"{photographs}: is a photograph; name the folder that it is in")
    if not path.exists():
        raise XrgsError(f"{photographs}: there is no such folder or video")
    kind = "folder" if path.is_dir() else "video"
    if kind == "video" and path.suffix.lower() not in VIDEOS:
        raise XrgsError(f"{photographs}: is neither a folder of photographs nor a video")
    # `factor=1` crops nothing, and with `min_hr=1` two training photographs are enough.
    variant = ("variant=sampling_rate", "variant.factor=1", "variant.min_hr=1")
    return [f"scene={kind}", f"scene.path={photographs}", *variant]


def last_of_each_key(words: Iterable[str]) -> list[str]:
    """Keep only the last override of each key: Hydra refuses a group that is given twice."""
    return list({word.lstrip("+").partition("=")[0]: word for word in words}.values())
