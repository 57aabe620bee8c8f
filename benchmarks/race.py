"""The race: which quality our arms and OpenSplat reach within minutes of training on two cores.

    python benchmarks/race.py FOLDER data_root=DATA --opensplat PATH
    python benchmarks/race.py FOLDER --table docs/speed.md

The first command trains and scores: for each scene and each budget of minutes, all arms in turn. It
continues where it was stopped. Each run has a planned number of steps, to which its schedules are
scaled; the number follows from the seconds of shorter runs of the same arm and scene. FOLDER gets a
row for each run (`race.csv`), tables (`table.md`), a picture (`race.png`) and the store. The second
command makes tables and picture again, and puts the tables between the two `race` comments of a
page. Words with `=` are passed to `xrgs-sweep`.
"""

from __future__ import annotations

import argparse
import math
import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any

import opensplat
import psutil
import race_table
from race_table import Run

import xrgs
from xrgs.formats.ply import load_ply
from xrgs.report.external import FIGURES
from xrgs.safeio.atomic import write_json, write_text
from xrgs.safeio.records import table_text
from xrgs.splat.backend import resolve_backend
from xrgs.splat.settings import NOMINAL_STEPS
from xrgs.store.cell_folder import SPLATS
from xrgs.store.provenance import this_processor
from xrgs.store.results import cell_metrics
from xrgs.store.store import BASELINE, Store
from xrgs.training import dataset

CORES = 2
_SEVEN = (
    *("llff/fern", "llff/flower", "llff/fortress"),
    *("llff/horns", "llff/orchids", "llff/room", "llff/trex"),
)
#: Longer side of a photograph, px -> budgets in minutes, and scenes.
RACES = {
    504: ((1.0, 3.0, 10.0), _SEVEN),
    1008: ((10.0, 30.0), ("llff/fern", "llff/horns", "llff/room", "llff/trex")),
}
ARMS = ("fast", "plus", "lean", "tuned_baseline", BASELINE)
#: OpenSplat with its defaults, stopped at each budget; and with steps and schedules for a budget.
PEERS = ("opensplat", "opensplat_planned")
#: Steps between two .ply files of `opensplat`.
_PEER_EVERY = 10
#: Options of OpenSplat in steps -> their defaults, which `opensplat_planned` scales.
_PEER_SCHEDULES = {
    "resolution-schedule": 3000,
    "sh-degree-interval": 1000,
    "warmup-length": 500,
    "stop-screen-size-at": 4000,
}
#: Steps of the first run of an arm on a scene.
_PROBE_STEPS = 200
#: A run fits a budget if it takes at least _LEAST and at most all of it; runs are planned for _AIM.
_LEAST, _AIM = 0.85, 0.93
#: After this many runs of half to twice a budget, the longest run within the budget is taken.
_MOST_TRIES = 3
#: A run is planned for at most this many times the seconds of another run.
_MOST_TIMES = 6


@dataclass(frozen=True)
class Start:
    """The arm and the scene of a run, and the longer side of its photographs, px."""

    size: int
    scene: str
    arm: str


def plan(runs: Sequence[Run], minutes: float, probe_steps: int = _PROBE_STEPS) -> int | None:
    """Choose the number of steps of the next run for a budget.

    The seconds of a run are taken to grow with a power of its steps: fitted to the two runs nearest
    to the budget, or 1 if there is one run. A run is planned for at most `_MOST_TIMES` the seconds
    of another, so that a large budget has several short runs before it.

    Args:
        runs: The runs of one arm on one scene so far.
        minutes: The budget.
        probe_steps: Steps of the first run.

    Returns:
        The steps; None if a run fits the budget, or if one is within the budget and enough others
        came close to it.
    """
    budget = 60 * minutes
    if not runs:
        return probe_steps
    within = [run.seconds for run in runs if run.seconds <= budget]
    close = [run for run in runs if budget / 2 <= run.seconds <= 2 * budget]
    if max(within, default=0) >= _LEAST * budget or (within and len(close) >= _MOST_TRIES):
        return None
    near, *others = sorted(runs, key=lambda run: abs(math.log(run.seconds / budget)))
    power = 1.0
    for other in others[:1]:
        power = math.log(other.seconds / near.seconds) / math.log(other.steps / near.steps)
    times = min(_AIM * budget / near.seconds, _MOST_TIMES)
    steps = int(near.steps * times ** (1 / min(max(power, 0.7), 2.0)))
    if steps < 1:
        raise SystemExit(f"{near.scene} / {near.arm}: {minutes:g} min are less than a step takes")
    return None if steps in {run.steps for run in runs} else steps


class Race:
    """The runs so far, and methods for further runs.

    Args:
        folder: The folder of the race.
        words: Words for `xrgs-sweep`.
        peer: The path of OpenSplat; empty to race without it.
        probe_steps: Steps of the first run of an arm on a scene.
    """

    def __init__(self, folder: Path, words: Sequence[str], peer: str, probe_steps: int) -> None:
        self.folder, self.words, self.peer, self.probe_steps = folder, words, peer, probe_steps
        self.store = Store(folder / "store")
        self.runs = race_table.read(folder)
        self.machine = f"{this_processor(resolve_backend('auto'))}, {CORES} cores"
        self.programs = {True: opensplat.version(peer) if peer else "", False: _program()}
        if others := {run.machine for run in self.runs} - {self.machine}:
            raise SystemExit(f"{folder}: begun on {others.pop()}, this is {self.machine}")

    def fill(self, start: Start, budgets: Sequence[float], minutes: float) -> None:
        """Train an arm on a scene until it has a run for a budget.

        Args:
            start: The arm, the scene and the size.
            budgets: All budgets of the size, minutes.
            minutes: The budget.
        """
        if start.arm == PEERS[0]:
            if not any(run.minutes == max(budgets) for run in self._of(start)):
                self._add(start, self._with_defaults(start, budgets))
            return
        run = self._planned if start.arm in PEERS else self._ours
        while steps := plan(self._of(start), minutes, self.probe_steps):
            self._add(start, run(start, steps, minutes))

    def _of(self, start: Start) -> list[Run]:
        key = (start.size, start.scene, start.arm)
        return [run for run in self.runs if (run.size, run.scene, run.arm) == key]

    def _add(self, start: Start, run_rows: Iterator[dict[str, Any]]) -> None:
        before, began = _cpu_seconds(), time.monotonic()
        rows = list(run_rows)
        others = (_cpu_seconds() - before) / (time.monotonic() - began)
        for row in rows:
            program = self.programs[start.arm in PEERS]
            run = Run(**asdict(start), **row, others=others, machine=self.machine, program=program)
            self.runs.append(run)
            sys.stdout.write(f"{race_table.line(run)}\n")
        sys.stdout.flush()
        write_text(self.folder / race_table.RUNS, table_text([asdict(run) for run in self.runs]))

    def _ours(self, start: Start, steps: int, minutes: float) -> Iterator[dict[str, Any]]:
        """Train one of our arms; yield the row of the run."""
        arm = [] if start.arm == BASELINE else [f"+ablation={start.arm}", "baseline=false"]
        size = [f"variant.long_side={start.size}", "variant.sfm.reference=false"]
        words = ["preset=laptop", *size, f"train.steps={steps}", *arm, f"scene={start.scene}"]
        script = "from xrgs.cli.sweep import main; main()"
        done = subprocess.run(  # noqa: S603
            [sys.executable, "-P", "-c", script, *words, *self.words, f"store={self.store.path}"],
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            raise SystemExit(f"xrgs-sweep {' '.join(words)}: {done.stderr.strip()}")
        [row] = self.store.sweep_record(self.store.latest_sweep()).cells
        cell = self.store.cell(str(row.cell_id))
        metrics = cell_metrics(cell.summary(), cell.scores())
        yield {
            "minutes": minutes,
            "steps": steps,
            "seconds": metrics["training_time_s"],
            "gaussians": int(metrics["gaussians"]),
            "bytes": cell.status().files[SPLATS].bytes,
            "cell": cell.id,
            **{name: metrics.get(name, math.nan) for name in race_table.SCORES},
        }

    def _with_defaults(self, start: Start, budgets: Sequence[float]) -> Iterator[dict[str, Any]]:
        """Run OpenSplat once with its defaults; yield a row for the last .ply in each budget."""
        options = ("-n", str(NOMINAL_STEPS))
        yield from self._peer(start, options, _PEER_EVERY, {60 * m: m for m in budgets})

    def _planned(self, start: Start, steps: int, minutes: float) -> Iterator[dict[str, Any]]:
        """Run OpenSplat with schedules scaled to the steps; yield the row of the run."""
        options = ["-n", str(steps)]
        for name, nominal in _PEER_SCHEDULES.items():
            options += [f"--{name}", str(max(1, round(nominal * steps / NOMINAL_STEPS)))]
        yield from self._peer(start, options, steps, {math.inf: minutes})

    def _peer(
        self, start: Start, options: Sequence[str], every: int, minutes: Mapping[float, float]
    ) -> Iterator[dict[str, Any]]:
        """Run OpenSplat; yield the rows. `minutes` maps each limit, s, to its budget."""
        cells = {(run.size, run.scene): run.cell for run in self.runs if run.cell}
        cell = self.store.cell(cells[start.size, start.scene])  # any cell: they share a variant
        data, conf = dataset.load(cell.variant()), cell.config()
        folder = self.folder / "opensplat" / str(start.size)
        photographs = folder / "data" / conf.scene.name
        photographs.parent.mkdir(parents=True, exist_ok=True)
        opensplat.write_training_views(data, photographs)
        options = (str(photographs), *options)
        out = folder / "running"
        shutil.rmtree(out, ignore_errors=True)  # files of a stopped run
        out.mkdir()
        kept = opensplat.train(self.peer, options, every, list(minutes), out)
        for snapshot, limit in {kept[limit]: limit for limit in sorted(kept)}.items():
            gaussians = load_ply(snapshot.file)
            renders = folder / f"{start.arm}-{minutes[limit]:g}min" / conf.scene.name
            scores = opensplat.score(gaussians, data.test, conf.splat, renders)
            figures = {"training_time_s": snapshot.seconds, "gaussians": len(gaussians)}
            write_json(renders / FIGURES, figures)
            yield {
                "minutes": minutes[limit],
                "steps": snapshot.steps,
                "seconds": snapshot.seconds,
                "gaussians": len(gaussians),
                "bytes": snapshot.file.stat().st_size,
                **{name: scores[name] for name in race_table.SCORES},
            }
        shutil.rmtree(out)


def main() -> None:
    """Parse the command line, and race or make the tables."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, help="the folder of the race")
    parser.add_argument("words", nargs="*", help="words for xrgs-sweep, as data_root=DATA")
    parser.add_argument("--opensplat", default="", metavar="PATH", help="OpenSplat's program")
    parser.add_argument("--sizes", type=int, nargs="+", default=list(RACES), help="px")
    parser.add_argument("--scenes", nargs="+", help="as the words of scene=; default: the race's")
    parser.add_argument("--minutes", type=float, nargs="+", help="budgets; default: the race's")
    parser.add_argument("--arms", nargs="+", default=list(ARMS), help="ablations, and baseline")
    parser.add_argument("--probe-steps", type=int, default=_PROBE_STEPS, help="of each first run")
    parser.add_argument("--against", default="", metavar="ARM", help="what tables compare with")
    parser.add_argument("--table", type=Path, metavar="PAGE", help="make tables anew; no training")
    args = parser.parse_intermixed_args()
    if args.table is None:
        race(args)
    race_table.write(args.folder, args.table, args.against)


def race(args: argparse.Namespace) -> None:
    """Train the missing runs, on the first two cores that this process may use."""
    cores = sorted(os.sched_getaffinity(0))[:CORES]
    if len(cores) < CORES:
        raise SystemExit(f"the race is of {CORES} cores, this process may use {len(cores)}")
    os.sched_setaffinity(0, cores)
    args.folder.mkdir(parents=True, exist_ok=True)
    running = Race(args.folder, args.words, args.opensplat, args.probe_steps)
    arms = [*args.arms, *(PEERS if args.opensplat else ())]
    for size in args.sizes:
        usual, scenes = RACES.get(size, ((), ()))
        budgets = sorted(args.minutes or usual)
        for scene, minutes, arm in product(args.scenes or scenes, budgets, arms):
            running.fill(Start(size, scene, arm), budgets, minutes)


def _program() -> str:
    return f"xrgs {xrgs.__version__}"


def _cpu_seconds() -> float:
    """Return the CPU seconds of all other programs on this machine."""
    now = psutil.cpu_times()
    busy: float = now.user + now.nice + now.system + now.irq + now.softirq + now.steal
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return busy - sum(used.ru_utime + used.ru_stime for used in usages)


if __name__ == "__main__":
    main()
