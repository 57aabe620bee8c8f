"""`xrgs-data`: downloads photographs and the weights of LPIPS, shows and exports variants."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg
from tyro.extras import literal_type_from_choices

from xrgs import config
from xrgs.cli import options
from xrgs.cli.options import STORE, Folder, Names, OptionalFolder, shown_as
from xrgs.errors import XrgsError
from xrgs.experiment.store import Store
from xrgs.runtime.streams import say

if TYPE_CHECKING:
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
    """Download published scenes and unpack them. Run again, it continues.

    Args:
        dataset: The set of scenes.
        scenes: Names of its scenes; all by default.
        data_root: The folder to unpack into; by default `data_root` of the config.
        url: The address of the archive, in place of the known one.
        sha256: The hash of the archive, in place of the known one.
        max_bytes: The largest size that is downloaded, in place of the known one.
        redirect_hosts: Hosts to which the address may redirect; no others are followed.
    """
    from omegaconf import OmegaConf

    from xrgs.capture.download.scenes import DatasetConf, fetch_scenes

    known: Any = OmegaConf.to_container(
        OmegaConf.load(config.CONF_DIR / "data" / f"{dataset}.yaml")
    )
    given = {
        "url": url,
        "sha256": sha256,
        "max_bytes": max_bytes,
        "redirect_hosts": redirect_hosts,
    }
    changes: Any = {key: value for key, value in given.items() if value is not None}
    root = data_root or Path(OmegaConf.load(config.CONF_DIR / "config.yaml").data_root)
    say(fetch_scenes(replace(DatasetConf(**known), **changes), scenes, root))


def lpips(
    source: Annotated[str | None, arg(name="from"), shown_as("FILE|URL")] = None,
    network: Literal["alex", "vgg"] = "alex",
) -> None:
    """Download the weights of LPIPS; without them its rows in tables are n/a.

    Args:
        source: The archive or the weights, as a file or at another address.
        network: `alex`, which every evaluation has, or `vgg`, for `xrgs-store rescore --also
            lpips_vgg`.
    """
    from xrgs.evaluation.lpips.download import fetch_vgg, fetch_weights

    say(fetch_weights(source) if network == "alex" else fetch_vgg(source))


def inspect(
    variant: Positional[Annotated[tuple[str, ...], shown_as("FOLDER|KEY=VALUE ...")]],
    out: Annotated[Path | None, shown_as("FILE.png")] = None,
) -> None:
    """Print a table of a variant's views and the result of SfM, and draw all views on one sheet.

    Args:
        variant: The variant's folder; or what it is made of, by overrides of Hydra as xrgs-sweep
            takes them: scene=llff/fern variant.factor=4. A variant that the store lacks is built.
        out: The file of the sheet; by default it is named after the variant.
    """
    from xrgs import composing
    from xrgs.capture.description import describe
    from xrgs.cli.hydra_words import explained, with_quotes
    from xrgs.sweep import variants

    if not variant:
        raise XrgsError("inspect: give a variant's folder, or scene=NAME and other keys")
    folder = Path(variant[0])
    if len(variant) > 1 or ("=" in variant[0] and not folder.exists()):
        with explained():
            conf = composing.compose(*with_quotes(variant))
            store = Store(Path(conf.store))
            folder = store.variants / variants.find_or_build(conf, store)
    say(describe(folder, out))


def export(
    name: Positional[Annotated[str, arg(metavar="CELL|VARIANT|FILE")]],
    layout: Annotated[
        Literal["colmap", "nerfstudio", "ply", "glb", "spz"], arg(name="format")
    ] = "colmap",
    out: Annotated[Path | None, shown_as("FOLDER|FILE")] = None,
    store: Folder = STORE,
) -> None:
    """Write a cell or a variant for other programs, or convert a file of Gaussians.

    Args:
        name: A cell or a variant: its folder, or its id in the store or the beginning of the id. A
            .ply, .glb or .spz file is converted to another of these.
        layout: `colmap` and `nerfstudio`: a folder of images, cameras, points and split, and the
            splats of a cell. `ply`, `glb` (glTF with KHR_gaussian_splatting) and `spz` (8 bits a
            value): one file of Gaussians.
        out: The new folder or file to write; by default it is named after what is exported.
        store: The store.
    """
    from xrgs.experiment.export import SPLAT_FORMATS, export_splats
    from xrgs.experiment.export import export as write

    path = Path(name)
    if not path.exists() and path.name == name and path.suffix[1:] not in SPLAT_FORMATS:
        path = Store(store).find_folder(name)
    if layout in SPLAT_FORMATS:
        say(export_splats(path, layout, out or Path(f"{path.stem}.{layout}")))
    else:
        say(write(path, layout, out or Path(f"{path.name}-{layout}")))


def main() -> None:
    """Run `xrgs-data`."""
    options.run(
        "xrgs-data",
        {"download": download, "lpips": lpips, "inspect": inspect, "export": export},
        "Download photographs and the weights of LPIPS, show and export variants.",
        overrides="inspect",
    )
