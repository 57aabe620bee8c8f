"""`xrgs-sweep`: plans a sweep and trains its cells; with `rerun=` it trains one cell again."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, field
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from xrgs import config
from xrgs.cli.arguments import choices, dotlist, with_quotes
from xrgs.errors import XrgsError
from xrgs.runtime.signals import stoppable
from xrgs.runtime.streams import ignore_broken_pipe


@hydra.main(version_base="1.3", config_path=str(config.CONF_DIR), config_name="config")
def _sweep(cfg: DictConfig) -> str:
    from xrgs.sweep.jobs.job import SweepSession, run_job

    call = SweepSession(Path(HydraConfig.get().sweep.dir))
    outcome = run_job(config.to_conf(cfg), call)
    if call.owner_dead:  # a worker of joblib's would wait for ever to hand its answer over
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


def main() -> None:
    """`xrgs-sweep [+ablation=NAME] [KEY=VALUE[,VALUE...]]...`."""
    if {"-h", "--help"} & set(sys.argv[1:]):  # Hydra's own takes seconds to list its groups
        groups = ("ablation", "scene", "preset", "sweeps")
        print(_HELP.format(**{group: choices(group) for group in groups}))  # noqa: T201
        return
    ignore_broken_pipe()
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
    from xrgs.sweep.rerun import rerun

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
