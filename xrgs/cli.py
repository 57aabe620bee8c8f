"""The commands: `xrgs-sweep`, `xrgs-report` and `xrgs-bench`."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import hydra
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from xrgs import config
from xrgs.bench.settings import Settings
from xrgs.errors import XrgsError


@hydra.main(version_base="1.3", config_path=str(config.CONF_DIR), config_name="config")
def _sweep(cfg: DictConfig) -> str:
    from xrgs.sweep import run_job

    return run_job(cfg)


_HELP = """\
xrgs-sweep [+ablation=NAME[,NAME...]] [scene=NAME] [preset=NAME] [KEY=VALUE[,VALUE...]]...

Trains the baseline and the ablations on mixed-resolution scenes; prints what changed, in percent.
Commas make axes, +ablation=[a,b] stacks. Finished cells are found in the store and not run again.

  +ablation=  {ablation}
  scene=      {scene}
  preset=     {preset}
  +sweeps=    {sweeps}
  seed=0,1    store=FOLDER    data_root=FOLDER    threads=N    dry_run=true

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
    config.register()
    # `ablation` is not in the defaults list, so Hydra wants the plus; people forget it.
    sys.argv[1:] = ["+" + a if a.startswith("ablation=") else a for a in sys.argv[1:]]
    _sweep()


def _line(error: Exception) -> str:
    """What is wrong, in one line that names the argument."""
    line, key = str(error).splitlines()[0], getattr(error, "full_key", None)
    return line if not key or key in line else f"{key}: {line}"


@dataclass
class ReportConf:
    """Arguments of `xrgs-report`."""

    store: str = "xrgs-store"
    sweep: str | None = None
    """Id of the sweep; the latest where none is given."""
    out: str | None = None
    """Folder to write to; `<store>/reports/<sweep>` where none is given."""


def report() -> None:
    """`xrgs-report [store=FOLDER] [sweep=ID] [out=FOLDER]`: the tables, from the store alone."""
    from xrgs.report import build

    try:
        given = OmegaConf.from_dotlist(sys.argv[1:])
        conf = OmegaConf.merge(OmegaConf.structured(ReportConf), given)
        out = Path(conf.out) if conf.out else None
        print(build(Path(conf.store), conf.sweep, out).text)  # noqa: T201
    except (XrgsError, OmegaConfBaseException) as error:
        sys.exit(f"xrgs-report: {_line(error)}")


def bench() -> None:
    """`xrgs-bench [KEY=VALUE]...`: run time against error (`xrgs.bench.settings.Settings`)."""
    try:
        given = OmegaConf.from_dotlist(sys.argv[1:])
        settings = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(Settings), given))
        from xrgs.bench.run import run

        print(run(cast("Settings", settings)))  # noqa: T201
    except (XrgsError, OmegaConfBaseException) as error:
        sys.exit(f"xrgs-bench: {_line(error)}")
