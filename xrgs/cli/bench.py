"""`xrgs-bench`: run time against error."""

from __future__ import annotations

import sys
from typing import cast

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from xrgs import config
from xrgs.bench.settings import Settings
from xrgs.cli.arguments import parse
from xrgs.errors import XrgsError
from xrgs.runtime.machine import let_openmp_sleep


def main() -> None:
    """`xrgs-bench [KEY=VALUE]...`: run time against error. See `xrgs/bench/settings.py`."""
    let_openmp_sleep()  # as training does
    try:
        settings = OmegaConf.to_object(parse(Settings, main))
        from xrgs.bench.run import run

        print(run(cast("Settings", settings)))  # noqa: T201
    except (XrgsError, OmegaConfBaseException) as error:
        sys.exit(f"xrgs-bench: {config.one_line(error)}")
