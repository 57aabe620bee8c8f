"""`xrgs-train`: makes a scene of photographs, or of a video, without degrading them.

It inspects the photographs, finds their cameras, chooses size and steps (with --minutes by this
machine's measured speed), and trains one cell by the code of `xrgs-sweep`. All its
choices are overrides of Hydra, which the user's own overrides replace.
"""

from __future__ import annotations

import shlex
import time
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from xrgs import composing
from xrgs.cli import options, sweep
from xrgs.cli.data import as_they_are, form_of, last_of_each_key, write_export
from xrgs.cli.options import STORE, Flag, Folder, OptionalFolder, shown_as
from xrgs.cli.overrides import check_no_axis, explained, with_quotes
from xrgs.config import Conf
from xrgs.errors import StoreError, XrgsError
from xrgs.photos import scenes
from xrgs.runtime.machine import usable_cores
from xrgs.runtime.streams import say
from xrgs.runtime.text import format_duration
from xrgs.safeio.sanitize import counted, for_line
from xrgs.splat.settings import NOMINAL_STEPS
from xrgs.store.cell_folder import CellFolder
from xrgs.store.export import check_place
from xrgs.store.inspect import RECIPE, SfmReport
from xrgs.store.store import BASELINE, Store

if TYPE_CHECKING:
    from xrgs.bench.speed import Trial

#: --quality -> its overrides.
_QUALITIES = {
    "draft": ("preset=laptop", "variant.long_side=336", "train.steps=1000"),
    "normal": ("preset=laptop",),
    "high": ("preset=paper", "train.evaluate_every=0"),
}
#: Runs of at least _LONG_RUN steps have the settings of `preset=paper`. Shorter runs refine every
#: _REFINED_EVERY steps, as `preset=laptop` does; more refinements grow more than they can train.
_LONG_RUN, _REFINED_EVERY = 10_000, 50


#: The longer sides of views to choose from, px. A size is worth it from 3,000 steps on at 504 px
#: (`preset=laptop`); at other sizes in proportion to the number of pixels.
_SIZES, _AT, _STEPS = (252, 378, 504, 756, 1008), 504, 3000
#: The fewest steps, whatever the time, and the most, those of the paper.
_LEAST, _MOST = 200, 30_000
#: Guesses for unknown views: height over width, and rendered pixels plus Gaussians for each pixel.
_ASPECT, _UNITS_OF_A_PIXEL = 0.7, 1.5
#: The share of the whole time for training, before the time for the cameras is known; the share of
#: the remaining time afterwards; and the seconds for scores and page.
_TRAINING, _OF_THE_REST, _ENDING_S = 0.6, 0.95, 15.0


@dataclass(frozen=True)
class Settings:
    """The options of `xrgs-train`."""

    photographs: Positional[Annotated[str, shown_as("FOLDER|VIDEO")]] = ""
    """Folder of photographs of one place (FOLDER/** with all folders below), or a video."""
    overrides: Positional[Annotated[tuple[str, ...], shown_as("KEY=VALUE ...")]] = ()
    """Keys of xrgs-sweep, such as train.steps=5000 or seed=1; they replace the chosen values."""
    minutes: Annotated[float | None, shown_as("N")] = None
    """Choose size and steps so that the command takes about N minutes on this machine."""
    quality: Literal["draft", "normal", "high"] = "normal"
    """draft: 1,000 steps at 336 px; normal: 3,000 at 504 px; high: 30,000 at 1,008 px."""
    size: Annotated[int | None, shown_as("PX")] = None
    """Longer side of the photographs in training; 0 keeps their size."""
    recipe: Annotated[str, shown_as("NAME[,NAME]")] = RECIPE
    """Ablations of xrgs-sweep, trained together; `baseline` is gsplat's training."""
    hold_none: Annotated[Flag, arg(name="all")] = False
    """Train on all photographs; otherwise every eighth is held out, to measure the quality."""
    masks: OptionalFolder = None
    """Folder of the photographs' masks: white is used, black is not."""
    out: Annotated[Path | None, shown_as("FILE|FOLDER")] = None
    """Also write the scene: a .ply, .glb or .spz file, or a folder for other programs."""
    dry_run: Flag = False
    """Say which photographs there are, and stop."""
    store: Folder = STORE
    """Folder for all results."""


@dataclass
class _Words:
    """The arguments of `xrgs-sweep`; a later word replaces an earlier one with the same key."""

    given: Sequence[str]
    """The user's words, which replace all others."""
    own: list[str] = field(default_factory=list)
    """Words that this command has chosen."""
    confs: dict[tuple[str, ...], Conf] = field(default_factory=dict)
    """Words -> the config that Hydra has composed of them, which takes it 0.1 s."""

    @property
    def all(self) -> list[str]:
        """All words, one for each key."""
        return last_of_each_key([*self.own, *self.given])

    def value(self, key: str) -> str:
        """Return the value of a key; empty if no word has it."""
        values = (word.lstrip("+").partition("=") for word in self.all)
        return next((value for name, _, value in values if name == key), "")

    def compose(self) -> Conf:
        """Return a config of its own, composed once for equal words.

        Raises:
            XrgsError: A word is wrong, or gives several values.
        """
        key = tuple(self.all)
        if key not in self.confs:
            with explained():
                words = with_quotes(key)
                check_no_axis(words)
                self.confs[key] = composing.compose(*words)
        return deepcopy(self.confs[key])


def train(settings: Settings) -> None:
    """Make a 3D scene of photographs: find the cameras, train, and write a page with the result.

    The same command continues after an interruption. Afterwards xrgs-view shows the scene,
    xrgs-render makes a film of it, and xrgs-data export writes it for other programs.

    Args:
        settings: The options.
    """
    begin = time.monotonic()
    if not settings.photographs:
        raise XrgsError("give a folder of photographs, or a video")
    if settings.minutes is not None and (settings.quality != "normal" or not settings.minutes > 0):
        raise XrgsError(f"minutes={settings.minutes:g}: must be above 0, and without --quality")
    if settings.out is not None:
        check_place(settings.out, form_of(settings.out))
    words = _words(settings)
    if settings.minutes and settings.size is None:
        side = size_for(60 * settings.minutes, _measured_unit(words.compose()))
        words.own.append(f"variant.long_side={side}")
    placed = _place(words)
    if placed is None:
        return
    trial = None
    if settings.minutes:
        trial = _trial(placed, words.compose())
        left_s = 60 * settings.minutes - (time.monotonic() - begin) - trial.start_s
        _choose_steps(words, settings, trial.step_s, left_s)
    steps = words.compose().train.steps
    if steps < _LONG_RUN:
        words.own.append(f"splat.densify.every={_REFINED_EVERY * NOMINAL_STEPS // steps}")
    conf = words.compose()
    recipe = words.value("ablation") or BASELINE
    description = f"{recipe}: {conf.train.steps:,} steps at {conf.variant.long_side} px"
    if _cell(placed, conf).state(verify=False).name == "done":
        _say(f"trained already by {description}")
    else:
        _say(f"training by {description}, {format_duration(_expected_s(placed, conf, trial))}")
    again = "the command above continues" if settings.minutes else "run it again to continue"
    hint = f"What is done is kept: {again}."
    sweep.run("xrgs-train", [*words.all, "hydra.sweeper.brief=true"], hint)
    _say_end(placed, conf, settings, time.monotonic() - begin)


def _words(settings: Settings) -> _Words:
    """Return the words that don't depend on the photographs."""
    words = [*as_they_are(settings.photographs), f"store={settings.store}"]
    words += _recipe(settings.recipe)
    words += ["retry=failed", "lpips.fetch=false", *_QUALITIES[settings.quality]]
    words += [f"variant.long_side={settings.size}"] if settings.size is not None else []
    words += ["variant.test_every=0"] if settings.hold_none else []
    words += [f"scene.masks={settings.masks}"] if settings.masks else []
    words += ["dry_run=true"] if settings.dry_run else []
    return _Words(settings.overrides, words)


@dataclass(frozen=True)
class _Placed:
    """The result of `_place`: the variant with the found cameras."""

    variant_id: str
    report: SfmReport


def _place(words: _Words) -> _Placed | None:
    """Find the photographs and their cameras, and print both; return None in a dry run.

    Raises:
        XrgsError: There are too few photographs, or too few are placed.
    """
    from xrgs.store.inspect import mixture, read_report
    from xrgs.store.trimming import home_of
    from xrgs.sweep import build_variants
    from xrgs.sweep.estimate import read_views
    from xrgs.sweep.plan import check_plugins

    conf = words.compose()
    store, name = Store(conf.store), scenes.label(conf.scene)
    photographs = scenes.names(conf.scene, conf.variant.long_side)
    kind = _kind(conf)
    _say(f"{name}: {counted(len(photographs), kind)} found")
    check_plugins([conf], imported=conf.dry_run)
    if conf.dry_run:
        store.check_room()
    (planned,) = build_variants.plan([conf], store, allow_build=not conf.dry_run)
    if planned.error:
        raise XrgsError(planned.error)
    notes = planned.notes
    if notes and not conf.dry_run:
        notes = (f"{counted(len(notes), 'note')} on what was left out or changed: see the page",)
    for note in notes:
        _say(f"  {note}")
    if planned.id is None:
        _say("without --dry-run, their cameras are found")
        return None
    report = read_report(home_of(store.variants, planned.id))
    mix = mixture(read_views(store.variants, planned.id))
    _say(f"{name}: the cameras of {report.registered} of {report.images} {kind}s are found")
    _say(
        f"{name}: {'a mixture' if mix.is_one else f'{kind}s alike'}: {mix.coarse or 'none'}"
        f" of {mix.views} to train on are 1.5 times or more as coarse as the finest"
    )
    return None if conf.dry_run else _Placed(planned.id, report)


def _recipe(names: str) -> list[str]:
    """Return the words for a recipe: one ablation, several joined by commas, or the baseline."""
    if names == BASELINE:
        return []
    return [f"+ablation=[{names}]" if "," in names else f"+ablation={names}", "baseline=false"]


def size_for(seconds: float, unit: float) -> int:
    """Return the longer side of the views, px, for a time, s, that includes finding the cameras.

    `unit` is the seconds per step for each rendered pixel and each Gaussian.
    """
    fitting = [
        size
        for size in _SIZES
        if _STEPS * (size / _AT) ** 2 * _ASPECT * size**2 * _UNITS_OF_A_PIXEL * unit
        <= _TRAINING * seconds
    ]
    return max(fitting, default=_SIZES[0])


def steps_for(seconds: float, step_s: float) -> int:
    """Return how many steps of `step_s` seconds fit into the remaining time, to two digits."""
    count = int((_OF_THE_REST * seconds - _ENDING_S) / step_s)
    digits: int = 10 ** max(0, len(str(max(count, 0))) - 2)
    return min(_MOST, max(_LEAST, count // digits * digits))


def _measured_unit(conf: Conf) -> float:
    """Measure this machine's speed: seconds per step for each pixel and Gaussian."""
    from xrgs.bench.speed import seconds_per_unit

    return seconds_per_unit(conf.threads or usable_cores(), conf.splat.backend)


def _trial(placed: _Placed, conf: Conf) -> Trial:
    """Measure this machine's speed on these photographs by a short training."""
    from xrgs.bench.speed import trial

    return trial(conf, Store(conf.store).variants / placed.variant_id)


def _choose_steps(words: _Words, settings: Settings, step_s: float, left_s: float) -> None:
    """Choose the steps for the remaining time, and print a command that repeats this training."""
    conf = words.compose()
    steps = steps_for(left_s, step_s)
    quality = "high" if steps >= _LONG_RUN else "normal"
    side = conf.variant.long_side
    words.own += [*_QUALITIES[quality], f"variant.long_side={side}", f"train.steps={steps}"]
    again = ["xrgs-train", settings.photographs, "--quality", quality, "--size", str(side)]
    again += ["--recipe", settings.recipe] if settings.recipe != RECIPE else []
    again += ["--all"] if settings.hold_none else []
    again += ["--masks", str(settings.masks)] if settings.masks else []
    again += ["--store", str(settings.store)] if settings.store != STORE else []
    again += [f"train.steps={steps}", *settings.overrides]
    _say(f"chosen for {settings.minutes:g} min; the same again, bit for bit: {shlex.join(again)}")


def _expected_s(placed: _Placed, conf: Conf, trial: Trial | None) -> float:
    """Return the expected seconds of a training, by the trial, finished cells or a measurement."""
    from xrgs.sweep.estimate import CostEstimator, units_of_a_step

    if trial is not None:
        return trial.start_s + conf.train.steps * trial.step_s
    threads = conf.threads or usable_cores()
    cost = CostEstimator(Store(conf.store)).cost(conf, placed.variant_id, threads)
    if cost is not None:
        return cost.seconds
    units = units_of_a_step(Store(conf.store), conf, placed.variant_id)
    return conf.train.steps * _measured_unit(conf) * units


def _say_end(placed: _Placed, conf: Conf, settings: Settings, seconds: float) -> None:
    """Print the result, its page and the next commands, in at most eight lines."""
    from xrgs.report.page import PAGE
    from xrgs.sweep.status import next_commands

    store, name = Store(conf.store), scenes.label(conf.scene)
    cell = _cell(placed, conf)
    summary, report = cell.summary(), placed.report
    scores = [values["psnr"] for _, values in cell.view_scores()]
    unseen = "that it had not seen" if report.tests else "that it was trained on"
    took = f"{seconds / 60:.1f} min" + (f" of {settings.minutes:g} min" if settings.minutes else "")
    (sweep_id,) = store.sweeps_of(cell.id)[-1:]
    _say(f"{name}: {report.registered} of {report.images} {_kind(conf)}s are placed")
    _say(f"{fmean(scores):.1f} dB on {counted(len(scores), _kind(conf))} {unseen}")
    _say(f"{summary.gaussians:,} Gaussians after {summary.steps:,} steps; all took {took}")
    _say(f"Page: {store.reports / sweep_id / PAGE}")
    try:
        word = name if store.find_cell(name).id == cell.id else cell.id
    except StoreError:  # several cells of the scene are done
        word = cell.id[:8]
    say("Next:")
    # Not the name of the video itself: a film of that name would replace the video.
    file = f"{Path(name).stem}-scene" if conf.scene.kind == "video" else name
    commands = next_commands([word], file, store.path)
    if settings.out is not None:
        commands[-1] = write_export(cell.path, settings.out)
    for command in commands:
        say(f"  {command}")


def _cell(placed: _Placed, conf: Conf) -> CellFolder:
    from xrgs.store.identity import cell_id, cell_identity

    return Store(conf.store).cell(cell_id(cell_identity(conf, placed.variant_id)))


def _kind(conf: Conf) -> str:
    return "frame" if conf.scene.kind == "video" else "photograph"


def _say(line: str) -> None:
    say(for_line(line))


main = partial(
    options.run,
    "xrgs-train",
    train,
    overrides="xrgs-train",
    hint="Run the same command again to continue.",
)
