"""Hydra loads plugins from this namespace package only: the sweeper and where `sweeps/` lies.

Hydra imports every plugin at start, so this file stays light: the work is in `xrgs.sweep.study`. It
executes the file before it is in `sys.modules`, where a dataclass can't resolve annotations that
are strings: hence no `from __future__ import annotations`.
"""

from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.plugins.search_path_plugin import SearchPathPlugin
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf

from xrgs.config import CONF_DIR


@dataclass
class XrgsSweeperConf:
    """`hydra/sweeper: xrgs`."""

    _target_: str = "hydra_plugins.xrgs_sweeper.XrgsSweeper"
    params: dict[str, str] | None = None
    """Axes that a file of `sweeps/` sets: override -> comma-separated values."""


ConfigStore.instance().store(
    group="hydra/sweeper", name="xrgs", node=XrgsSweeperConf, provider="xrgs"
)

_EXTRAS = {
    "joblib": ("joblib",),
    "submitit": ("submitit_local", "submitit_slurm"),
    "ray": ("ray",),
}
for _extra, _launchers in _EXTRAS.items():
    if find_spec(f"hydra_plugins.hydra_{_extra}_launcher") is not None:
        continue
    for _name in _launchers:
        # In the launcher's place, and open to its settings, so that the sweep can say what to do.
        _node = OmegaConf.create({"install": f"xrgs[{_extra}]"}, flags={"struct": False})
        ConfigStore.instance().store(_name, _node, group="hydra/launcher", provider="xrgs")


class XrgsSearchPath(SearchPathPlugin):
    """Lets `+sweeps=NAME` find `sweeps/`, which lies beside `conf/` in a checkout."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Add the folder that holds `sweeps/`."""
        if not (CONF_DIR / "sweeps").is_dir():
            search_path.append(provider="xrgs", path=f"file://{CONF_DIR.parent}")


class XrgsSweeper(Sweeper):
    """Plans the cells of a study and hands those that are not done to the launcher."""

    def __init__(self, params: dict[str, str] | None) -> None:
        self._params = params or {}

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """Keep what Hydra hands over."""
        self._context = hydra_context
        self._task = task_function
        self._config = config

    def sweep(self, arguments: list[str]) -> Any:
        """Run the study."""
        from xrgs.sweep.study import Study

        axes = [f"{key}={values}" for key, values in self._params.items()]
        return Study(self._context, self._task, self._config).run([*axes, *arguments])
