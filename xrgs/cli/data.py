"""`xrgs-data`: photographs and weights from elsewhere, and a look at a variant."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path
from typing import cast

import hydra
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from xrgs import config
from xrgs.capture import variant
from xrgs.cli.arguments import choices, with_quotes
from xrgs.errors import XrgsError
from xrgs.experiment.store import Store
from xrgs.sweep.jobs import worker

_DATA_HELP = """\
xrgs-data download DATASET [SCENE...] [data_root=FOLDER] [url=URL] [sha256=HEX]
                       [max_bytes=N]
    Fetches published scenes and unpacks them into data_root; run again, it continues.
    DATASET: {data}
xrgs-data lpips [from=FILE_OR_URL]
    Fetches the weights of LPIPS; without them its row of the tables is n/a.
xrgs-data inspect VARIANT_FOLDER | scene=NAME [KEY=VALUE...]  [out=FILE.png]
    Tables a variant's views and how SfM went, and draws every view on one sheet. The keys are
    xrgs-sweep's; a variant that is not in the store yet is built.
"""


def main() -> None:
    """`xrgs-data COMMAND [WORD...] [KEY=VALUE...]`."""
    words = [a for a in sys.argv[1:] if "=" not in a]
    values = dict(a.split("=", 1) for a in sys.argv[1:] if "=" in a)
    if not sys.argv[1:] or {"-h", "--help"} & set(words):
        print(_DATA_HELP.format(data=choices("data")), end="")  # noqa: T201
        return
    try:
        if words[:1] == ["download"]:
            print(_download(words[1:], values))  # noqa: T201
        elif words == ["lpips"]:
            from xrgs.evaluation.lpips import download as lpips

            source = values.pop("from", None)
            _none_left(values)
            print(lpips.get(source))  # noqa: T201
        elif words[:1] == ["inspect"]:
            print(_inspect(words[1:], values))  # noqa: T201
        else:
            raise XrgsError(f"{' '.join(words)}: unknown; xrgs-data --help lists what there is")
    except (XrgsError, OmegaConfBaseException, HydraException) as error:
        sys.exit(f"xrgs-data: {config.one_line(error)}")


def _none_left(values: dict[str, str]) -> None:
    if values:
        raise XrgsError(f"{next(iter(values))}=: unknown here; see xrgs-data --help")


def _download(words: list[str], values: dict[str, str]) -> str:
    from xrgs.capture.download import scenes
    from xrgs.capture.download.settings import DatasetConf

    file = config.CONF_DIR / "data" / f"{words[0] if words else ''}.yaml"
    if not words or words[0] not in choices("data").split(", "):
        raise XrgsError(f"download {' '.join(words)}: choose one of {choices('data')}")
    root = (
        values.pop("data_root", None) or OmegaConf.load(config.CONF_DIR / "config.yaml").data_root
    )
    conf = OmegaConf.merge(OmegaConf.structured(DatasetConf), OmegaConf.load(file), values)
    return scenes.get(cast("DatasetConf", OmegaConf.to_object(conf)), words[1:], Path(root))


def _inspect(words: list[str], values: dict[str, str]) -> str:
    from xrgs.report import variant as inspect

    out = values.pop("out", None)
    if bool(words) == bool(values) or len(words) > 1:
        raise XrgsError("inspect: give a variant's folder, or scene=NAME and other keys")
    if words:
        folder = Path(words[0]).expanduser()
    else:
        config.register()
        with hydra.initialize_config_dir(str(config.CONF_DIR), version_base="1.3"):
            words = with_quotes([f"{key}={value}" for key, value in values.items()])
            composed = hydra.compose("config", words)
        folder = _folder_of(config.to_conf(composed))
    return inspect.describe(folder, Path(out) if out else None)


def _folder_of(conf: config.Conf) -> Path:
    """Where the variant of a config lies; it is built if need be, in a process of its own.

    Raises:
        XrgsError: the photographs aren't there, or can't be made into a variant.
    """
    store = Store(Path(conf.store))
    found = variant.find(store.variants, variant.key(conf.scene, conf.variant))
    if found is not None:
        return found.path
    store.prepare()
    built = worker.run("variant", {"conf": asdict(conf), "store": conf.store})
    return store.variants / str(built["variant"])
