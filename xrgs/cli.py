"""The commands: `xrgs-sweep`, `xrgs-status`, `xrgs-report`, `xrgs-bench` and `xrgs-data`."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from xrgs import config
from xrgs.arguments import dotlist, with_quotes
from xrgs.bench.settings import Settings
from xrgs.errors import XrgsError
from xrgs.machine import let_openmp_sleep
from xrgs.stop import stoppable
from xrgs.streams import outlive_readers

if TYPE_CHECKING:
    from collections.abc import Callable


@hydra.main(version_base="1.3", config_path=str(config.CONF_DIR), config_name="config")
def _sweep(cfg: DictConfig) -> str:
    from xrgs.jobs.job import Call, run_job

    call = Call(Path(HydraConfig.get().sweep.dir))
    outcome = run_job(config.to_conf(cfg), call)
    if call.gone:  # a worker of joblib's would wait for ever to hand its answer over
        os._exit(os.EX_TEMPFAIL)
    return outcome


_HELP = """\
xrgs-sweep [+ablation=NAME[,NAME...]] [scene=NAME] [preset=NAME] [KEY=VALUE[,VALUE...]]...

Trains the baseline and the ablations on mixed-resolution scenes; prints what changed, in percent.
Commas make axes, +ablation=[a,b] stacks. Finished cells are found in the store and not run again.

  +ablation=  {ablation}
  scene=      {scene}
  preset=     {preset}
  +sweeps=    {sweeps}
  seed=0,1    store=FOLDER    data_root=FOLDER    threads=N    dry_run=true
  limits.minutes=N  limits.memory_gb=N    a cell beyond is ended and failed
  retry=failed      fail_fast=true        run failed cells again; stop after the first

xrgs-sweep rerun=CELL_FOLDER [out=FOLDER] [store=FOLDER] [threads=N] [scene.path=FOLDER]
  trains a finished cell again, beside it: says "the same, bit for bit", or what differs

--cfg job prints every key with its value; --hydra-help tells of Hydra's own flags.
"""


def _choices(group: str) -> str:
    folder = config.CONF_DIR / group
    folder = folder if folder.is_dir() else config.CONF_DIR.parent / group
    files = sorted(folder.rglob("*.yaml"))
    return ", ".join(file.relative_to(folder).with_suffix("").as_posix() for file in files)


def sweep() -> None:
    """`xrgs-sweep [+ablation=NAME] [KEY=VALUE[,VALUE...]]...`."""
    if {"-h", "--help"} & set(sys.argv[1:]):  # Hydra's own takes seconds to list its groups
        groups = ("ablation", "scene", "preset", "sweeps")
        print(_HELP.format(**{group: _choices(group) for group in groups}))  # noqa: T201
        return
    outlive_readers()
    if any(argument.startswith("rerun=") for argument in sys.argv[1:]):
        with stoppable("The cell is as it was; what was begun beside it is no result."):
            _rerun(sys.argv[1:])
        return
    config.register()
    # `ablation` is not in the defaults list, so Hydra wants the plus; people forget it.
    words = ["+" + a if a.startswith("ablation=") else a for a in sys.argv[1:]]
    try:
        sys.argv[1:] = with_quotes(words)
    except XrgsError as error:
        sys.exit(f"xrgs-sweep: {error}")
    with stoppable("What is done is kept: the same command goes on from there."):
        _sweep()


@dataclass
class PhotographsConf:
    """Where photographs are now."""

    path: str | None = None


@dataclass
class RerunConf:
    """Arguments of `xrgs-sweep rerun=...`; with any other value it would be another cell."""

    rerun: str = MISSING
    out: str | None = None
    store: str | None = None
    threads: int | None = None
    scene: PhotographsConf = field(default_factory=PhotographsConf)


def _rerun(arguments: list[str]) -> None:
    from xrgs.study.rerun import rerun

    try:
        given = dotlist(arguments)
        conf = OmegaConf.merge(OmegaConf.structured(RerunConf), given)
        out, store = (Path(path) if path else None for path in (conf.out, conf.store))
        again = rerun(Path(conf.rerun), out, store, conf.threads, conf.scene.path)
    except OmegaConfBaseException as error:
        taken = "rerun= takes out=, store=, threads= and scene.path="
        sys.exit(f"xrgs-sweep: {config.one_line(error)} ({taken})")
    except XrgsError as error:
        sys.exit(f"xrgs-sweep: {error}")
    print(again)  # noqa: T201
    if again.differences:
        sys.exit(1)


def _arguments(schema: type[Any], command: Callable[[], None]) -> DictConfig:
    """What the command line gives; where it asks for help, that is printed and all there is.

    Raises:
        OmegaConfBaseException: a key that the schema has not, or a value of another type.
    """
    known = OmegaConf.structured(schema)
    if {"-h", "--help"} & set(sys.argv[1:]):
        usage = (command.__doc__ or "").replace("`", "")
        print(f"{usage}\n\n{OmegaConf.to_yaml(known)}", end="")  # noqa: T201
        sys.exit()
    return cast("DictConfig", OmegaConf.merge(known, dotlist(sys.argv[1:])))


@dataclass
class ReportConf:
    """Arguments of `xrgs-report`."""

    store: str = "xrgs-store"
    sweep: str | None = None
    """Id of the sweep; the latest where none is given."""
    out: str | None = None
    """Folder to write to; `<store>/reports/<sweep>` where none is given."""
    pictures: str = "all"
    """`all`, `none`, or files' names without their suffix: `trade-off,fern--plus`."""


def report() -> None:
    """`xrgs-report [KEY=VALUE ...]`: tables and pictures of a sweep, from the store alone."""
    try:
        conf = _arguments(ReportConf, report)
        from xrgs.report import build

        out = Path(conf.out) if conf.out else None
        names = {"all": None, "none": []}.get(conf.pictures, conf.pictures.split(","))
        print(build(Path(conf.store), conf.sweep, out, names).text)  # noqa: T201
    except (XrgsError, OmegaConfBaseException) as error:
        sys.exit(f"xrgs-report: {config.one_line(error)}")


@dataclass
class StatusConf:
    """Arguments of `xrgs-status`."""

    store: str = "xrgs-store"
    verify: bool = False
    """Hash what reports rest on too; sizes alone are compared without."""


def status() -> None:
    """`xrgs-status [store=FOLDER] [verify=true]`: what a store holds, at a glance."""
    from xrgs.study.status import describe, read

    try:
        conf = _arguments(StatusConf, status)
        print(describe(read(Path(conf.store), verify=conf.verify)))  # noqa: T201
    except (XrgsError, OmegaConfBaseException) as error:
        sys.exit(f"xrgs-status: {config.one_line(error)}")


def bench() -> None:
    """`xrgs-bench [KEY=VALUE]...`: run time against error. See `xrgs/bench/settings.py`."""
    let_openmp_sleep()  # as training does
    try:
        settings = OmegaConf.to_object(_arguments(Settings, bench))
        from xrgs.bench.run import run

        print(run(cast("Settings", settings)))  # noqa: T201
    except (XrgsError, OmegaConfBaseException) as error:
        sys.exit(f"xrgs-bench: {config.one_line(error)}")


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


def data() -> None:
    """`xrgs-data COMMAND [WORD...] [KEY=VALUE...]`."""
    words = [a for a in sys.argv[1:] if "=" not in a]
    values = dict(a.split("=", 1) for a in sys.argv[1:] if "=" in a)
    if not sys.argv[1:] or {"-h", "--help"} & set(words):
        print(_DATA_HELP.format(data=_choices("data")), end="")  # noqa: T201
        return
    try:
        if words[:1] == ["download"]:
            print(_download(words[1:], values))  # noqa: T201
        elif words == ["lpips"]:
            from xrgs.data import lpips

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
    from xrgs.data import scenes
    from xrgs.data.settings import DatasetConf

    file = config.CONF_DIR / "data" / f"{words[0] if words else ''}.yaml"
    if not words or words[0] not in _choices("data").split(", "):
        raise XrgsError(f"download {' '.join(words)}: choose one of {_choices('data')}")
    root = (
        values.pop("data_root", None) or OmegaConf.load(config.CONF_DIR / "config.yaml").data_root
    )
    conf = OmegaConf.merge(OmegaConf.structured(DatasetConf), OmegaConf.load(file), values)
    return scenes.get(cast("DatasetConf", OmegaConf.to_object(conf)), words[1:], Path(root))


def _inspect(words: list[str], values: dict[str, str]) -> str:
    from xrgs.data import inspect

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
        folder = inspect.folder_of(config.to_conf(composed))
    return inspect.describe(folder, Path(out) if out else None)
