"""Registers with Hydra: the schema, the sweeper, the folder `sweeps/`, and missing launchers.

Hydra loads plugins only from this namespace package. It imports every plugin when it starts, so
this file stays light: the work is done in `xrgs.sweep.study`. There is no `from __future__ import
annotations`: a dataclass looks up string annotations in `sys.modules`, to which Hydra adds this
file only after executing it.
"""

from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Any

from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.plugins.search_path_plugin import SearchPathPlugin
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf

from xrgs.config import CONF_DIR, Conf


@dataclass
class XrgsSweeperConf:
    """The config of `hydra/sweeper: xrgs`."""

    _target_: str = "hydra_plugins.xrgs_sweeper.XrgsSweeper"
    params: dict[str, str] = field(default_factory=dict)
    """Axes in a file of `sweeps/`: key of the override -> comma-separated values."""
    brief: bool = False
    """Whether to print only progress and failures; `xrgs-train` prints the rest itself."""


#: The schema against which Hydra checks `conf/config.yaml`.
ConfigStore.instance().store(name="xrgs_schema", node=Conf, provider="xrgs")
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
        # Replaces the missing launcher and accepts its settings, so that the sweep can name the
        # package to install, instead of failing on an unknown key.
        _node = OmegaConf.create({"install": f"xrgs[{_extra}]"}, flags={"struct": False})
        ConfigStore.instance().store(_name, _node, group="hydra/launcher", provider="xrgs")


class XrgsSearchPath(SearchPathPlugin):
    """Lets `+sweeps=NAME` find `sweeps/`, which is beside `conf/` in a checkout."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Add the folder that contains `sweeps/`.

        Args:
            search_path: Hydra's search path, which is changed.
        """
        if not (CONF_DIR / "sweeps").is_dir():
            search_path.append(provider="xrgs", path=f"file://{CONF_DIR.parent}")


class XrgsSweeper(Sweeper):
    """Plans the cells of a study and launches those that are not done."""

    def __init__(self, params: dict[str, str], brief: bool) -> None:
        self._params = params
        self._brief = brief

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """Store the arguments; Hydra calls this before `sweep`.

        Args:
            hydra_context: Hydra's context of this call.
            task_function: The function that runs one job.
            config: The config composed from the command line.
        """
        self._context = hydra_context
        self._task = task_function
        self._config = config

    def sweep(self, arguments: list[str]) -> Any:
        """Run the study.

        Args:
            arguments: Overrides of the command line, with the axes among them.
        """
        from xrgs.sweep.study import Study

        axes = [f"{key}={values}" for key, values in self._params.items()]
        study = Study(self._context, self._task, self._config, brief=self._brief)
        return study.run([*axes, *arguments])
