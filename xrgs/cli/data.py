"""`xrgs-data`: downloads photographs and the weights of LPIPS, shows and exports variants."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import cast

from omegaconf import OmegaConf

from xrgs import composing, config
from xrgs.cli.arguments import (
    answer_version,
    choices,
    completion,
    errors_as_messages,
    with_quotes,
)
from xrgs.errors import XrgsError
from xrgs.experiment.store import Store
from xrgs.runtime.streams import say
from xrgs.safeio.paths import user_path
from xrgs.sweep import variants

_HELP = """\
xrgs-data download DATASET [SCENE]... [data_root=FOLDER] [url=URL] [sha256=HEX] [max_bytes=N]
    Downloads published scenes and unpacks them into data_root. Run again, it continues.
    DATASET: {data}
    redirect_hosts=HOST,... admits redirects from url= to these hosts; no others are followed.
xrgs-data lpips [from=FILE_OR_URL]
    Downloads the weights of LPIPS; without them its rows in tables are n/a.
xrgs-data inspect VARIANT_FOLDER [out=FILE.png]
xrgs-data inspect scene=NAME [KEY=VALUE]... [out=FILE.png]
    Prints a table of a variant's views and the result of SfM, and draws all views on one sheet.
    The keys are those of xrgs-sweep; a variant that is not in the store is built.
xrgs-data export CELL_OR_VARIANT [format=colmap|nerfstudio] [out=FOLDER] [store=FOLDER]
    Writes images, cameras, points and split, and the splats of a cell, for other programs.
    CELL_OR_VARIANT is a folder, or an id in the store or the beginning of one.
"""


def main() -> None:
    """Run `xrgs-data COMMAND [WORD]... [KEY=VALUE]...`."""
    words = [argument for argument in sys.argv[1:] if "=" not in argument]
    values = dict(argument.split("=", 1) for argument in sys.argv[1:] if "=" in argument)
    answer_version("xrgs-data")
    if "--completion" in words:
        say(completion("xrgs-data", ["download", "lpips", "inspect", "export"]))
        return
    if not sys.argv[1:] or {"-h", "--help"} & set(words):
        say(_HELP.format(data=choices("data")).rstrip())
        return
    with errors_as_messages("xrgs-data"):
        if words[:1] == ["download"]:
            text = _download(words[1:], values)
        elif words == ["lpips"]:
            text = _lpips(values)
        elif words[:1] == ["inspect"]:
            text = _inspect(words[1:], values)
        elif words[:1] == ["export"]:
            text = _export(words[1:], values)
        else:
            raise XrgsError(f"{' '.join(words)}: there is no such command; see xrgs-data --help")
        say(text)


def _lpips(values: dict[str, str]) -> str:
    from xrgs.evaluation.lpips.download import fetch_weights

    source = values.pop("from", None)
    if values:
        raise XrgsError(f"{next(iter(values))}=: lpips takes only from=; see xrgs-data --help")
    return fetch_weights(source)


def _download(words: list[str], values: dict[str, str]) -> str:
    from xrgs.capture.download.scenes import DatasetConf, fetch_scenes

    file = config.CONF_DIR / "data" / f"{words[0] if words else ''}.yaml"
    if not words or words[0] not in choices("data").split(", "):
        raise XrgsError(f"download {' '.join(words)}: the dataset must be one of {choices('data')}")
    data_root = values.pop("data_root", None)
    root = data_root or OmegaConf.load(config.CONF_DIR / "config.yaml").data_root
    hosts = values.pop("redirect_hosts", None)
    conf = OmegaConf.merge(OmegaConf.structured(DatasetConf), OmegaConf.load(file), values)
    if hosts is not None:
        conf.redirect_hosts = hosts.split(",")
    return fetch_scenes(cast("DatasetConf", OmegaConf.to_object(conf)), words[1:], Path(root))


def _inspect(words: list[str], values: dict[str, str]) -> str:
    from xrgs.capture.description import describe

    out = values.pop("out", None)
    if bool(words) == bool(values) or len(words) > 1:
        raise XrgsError("inspect: give a variant's folder, or scene=NAME and other keys")
    folder: Path
    if words:
        folder = Path(words[0]).expanduser()
    else:
        overrides = with_quotes([f"{key}={value}" for key, value in values.items()])
        conf = composing.compose(*overrides)
        store = Store(Path(conf.store))
        folder = store.variants / variants.find_or_build(conf, store)
    return describe(folder, Path(out) if out else None)


def _export(words: list[str], values: dict[str, str]) -> str:
    layout, out = values.pop("format", "colmap"), values.pop("out", None)
    store = Store(user_path(values.pop("store", "xrgs-store")))
    if values or len(words) != 1:
        raise XrgsError("export: give one cell or variant, and format=, out= or store= alone")
    from xrgs.experiment.export import export

    path = user_path(words[0])
    if not path.exists() and path.name == words[0]:
        path = store.find_folder(words[0])
    return export(path, layout, user_path(out or f"{path.name}-{layout}"))
