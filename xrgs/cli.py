"""The commands: `xrgs-sweep` and `xrgs-report`."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import hydra
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from xrgs import config
from xrgs.errors import XrgsError


@hydra.main(version_base="1.3", config_path=str(config.CONF_DIR), config_name="config")
def _sweep(cfg: DictConfig) -> str:
    from xrgs.sweep import run_job

    return run_job(cfg)


def sweep() -> None:
    """`xrgs-sweep [+ablation=NAME] [KEY=VALUE[,VALUE...]]...`."""
    config.register()
    # `ablation` is not in the defaults list, so Hydra wants the plus; people forget it.
    sys.argv[1:] = ["+" + a if a.startswith("ablation=") else a for a in sys.argv[1:]]
    _sweep()


@dataclass
class ReportConf:
    """Arguments of `xrgs-report`."""

    store: str = "xrgs-store"
    sweep: str | None = None
    """Id of the sweep; the latest where none is given."""


def report() -> None:
    """`xrgs-report [store=FOLDER] [sweep=ID]`: the tables again, from the store alone."""
    from xrgs.report import build

    try:
        given = OmegaConf.from_dotlist(sys.argv[1:])
        conf = OmegaConf.merge(OmegaConf.structured(ReportConf), given)
        print(build(Path(conf.store), conf.sweep).text)  # noqa: T201
    except (XrgsError, OmegaConfBaseException) as error:
        sys.exit(f"xrgs-report: {str(error).splitlines()[0]}")
