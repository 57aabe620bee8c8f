"""Tests that a variant is found or built, and that a scene that fails is remembered."""

from __future__ import annotations

import errno
import os
import re
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from platform import machine
from types import SimpleNamespace
from typing import Any

import pytest
from PIL import Image

from tests.mixture.manifests import one_view
from xrgs.config import Conf
from xrgs.errors import StoreError, XrgsError
from xrgs.mixture import variant
from xrgs.mixture.paths import TO_TRY
from xrgs.safeio.atomic import write_json
from xrgs.store import inspect
from xrgs.store.store import Store, StoreGoneError
from xrgs.sweep import build_variants, job
from xrgs.sweep.build_variants import PlannedVariant
from xrgs.sweep.status import describe

BUILDING = "building the mixed-resolution variant"
CONF = ("variant.factor=1", "variant.sfm.fallbacks=false")
HINT = "failed cells are not trained again; retry=failed trains them again"


@pytest.fixture
def store(tmp_path: Path) -> Store:
    """An empty store."""
    store = Store(tmp_path / "s")
    store.prepare()
    return store


@pytest.fixture
def conf(compose: Callable[..., Conf]) -> Conf:
    """A config of the embedded two-image scene."""
    return compose("scene=motorcycle")


@pytest.fixture
def of_folder(compose: Callable[..., Conf], tmp_path: Path) -> Callable[..., Conf]:
    """(path of the scene, **changes of the variant) -> a config of a folder of photographs."""

    def made(path: Path, **changes: Any) -> Conf:
        conf = compose("scene=folder", f"scene.path={tmp_path.root}")
        variant_conf = replace(conf.variant, **changes)
        return replace(conf, scene=replace(conf.scene, path=str(path)), variant=variant_conf)

    return made


def plan(conf: Conf, store: Store, *, allow_build: bool) -> PlannedVariant:
    (planned,) = build_variants.plan([conf], store, allow_build=allow_build)
    return planned


def fail(*_: object) -> dict[str, Any]:
    raise job.WorkError("SfM placed too few views")


def unexpected(*_: object) -> dict[str, Any]:
    raise AssertionError("no child process is needed")


def remember_failure(conf: Conf, store: Store) -> None:
    """Write the report of a build that failed, as `variant.build` does."""
    folder = store.variants / f"failed-{variant.key(conf.scene, conf.variant)}"
    folder.mkdir()
    write_json(folder / "report.json", {"scene": "motorcycle", "reason": "no first pair"})


@pytest.fixture
def reported(store: Store, monkeypatch: pytest.MonkeyPatch) -> PlannedVariant:
    """The variant `k-1`, of which the store has the report alone."""
    monkeypatch.setattr(inspect, "read_manifest", lambda _: one_view())
    report = {"notes": ["icon.png left out"], "hr": ["a"], "tests": 1, "not_registered": ["b"]}
    (store.variants / "k-1").mkdir()
    write_json(store.variants / "k-1" / "report.json", report)
    notes = ("icon.png left out", "not placed, and so not scored: b")
    return PlannedVariant("k-1", notes=notes)


def test_a_frozen_variant_is_found_and_not_built(
    conf: Conf, store: Store, monkeypatch: pytest.MonkeyPatch, reported: PlannedVariant
) -> None:
    monkeypatch.setattr(variant, "find", lambda *_: SimpleNamespace(id="k-1"))
    monkeypatch.setattr(job, "run_in_child", unexpected)
    assert plan(conf, store, allow_build=True) == reported


def test_a_trimmed_variant_has_its_notes_and_a_report_that_is_damaged_is_named(
    conf: Conf, store: Store, monkeypatch: pytest.MonkeyPatch, reported: PlannedVariant
) -> None:
    monkeypatch.setattr(variant, "key", lambda *_: "k")
    trimmed = (store.variants / "k-1").rename(store.variants / "trimmed-k-1")
    assert plan(conf, store, allow_build=False) == reported
    (trimmed / "report.json").write_text('{"notes": 3}')
    (note,) = plan(conf, store, allow_build=True).notes
    assert "k-1/report.json" in note


def test_a_variant_that_the_store_lacks_is_built_in_a_child(
    conf: Conf, store: Store, monkeypatch: pytest.MonkeyPatch, reported: PlannedVariant
) -> None:
    requests = []

    def build(work: str, request: dict[str, Any], *_: object) -> dict[str, Any]:
        requests.append((work, request["conf"]["scene"]["kind"], request["store"]))
        return {"variant": "k-1"}

    monkeypatch.setattr(job, "run_in_child", build)
    assert plan(conf, store, allow_build=False) == PlannedVariant()
    assert not requests
    assert plan(conf, store, allow_build=True) == reported
    assert requests == [("variant", "motorcycle", str(store.path))]


def test_a_scene_that_failed_is_not_tried_again_unless_asked(
    conf: Conf, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(job, "run_in_child", fail)
    assert plan(conf, store, allow_build=True) == PlannedVariant(error="SfM placed too few views")
    remember_failure(conf, store)
    monkeypatch.setattr(job, "run_in_child", unexpected)
    failed_before = PlannedVariant(error="no first pair", remembered=True)
    assert plan(conf, store, allow_build=True) == failed_before
    conf.retry = "failed"
    assert plan(conf, store, allow_build=False) == PlannedVariant()
    monkeypatch.setattr(job, "run_in_child", fail)
    # The reason is the remembered one, so that the record of a repeated sweep is the same.
    assert plan(conf, store, allow_build=True) == failed_before


@pytest.mark.parametrize("said", [True, False])
def test_a_full_disk_is_not_a_failure_of_the_scene_and_ends_the_other_builds(
    conf: Conf, store: Store, monkeypatch: pytest.MonkeyPatch, said: bool
) -> None:
    """COLMAP dies of it without saying so."""
    both, ended = threading.Barrier(2, timeout=30), []

    def full(**_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def build(
        _: str, request: dict[str, Any], __: object, on_poll: Callable[[int], None], ___: object
    ) -> dict[str, Any]:
        both.wait()
        if request["conf"]["variant"]["factor"] == 2:
            if said:
                raise job.WorkError("No space left on device", job.UNWRITABLE)
            monkeypatch.setattr(tempfile, "TemporaryFile", full)
            raise job.WorkError("its process was ended by SIGABRT")
        end = time.monotonic() + 30
        try:
            while time.monotonic() < end:
                on_poll(0)
        except job.WorkError:
            ended.append(3)
            raise
        return {"variant": "k-3"}

    monkeypatch.setattr(build_variants, "usable_cores", lambda: 2)
    monkeypatch.setattr(job, "run_in_child", build)
    with pytest.raises(StoreError, match="No space left"):
        build_variants.plan(two(conf), store, allow_build=True)
    assert ended == [3]


def test_a_variant_that_can_not_be_read_now_is_not_built_anew(
    conf: Conf,
    store: Store,
    monkeypatch: pytest.MonkeyPatch,
    unreadable: Callable[..., None],
) -> None:
    frozen = store.variants / f"{variant.key(conf.scene, conf.variant)}-0123456789abcdef"
    frozen.mkdir()
    (frozen / "variant.json").write_text("{}")
    monkeypatch.setattr(job, "run_in_child", unexpected)
    unreadable("variant.json", errno.ESTALE)
    found = plan(conf, store, allow_build=True)
    assert found == PlannedVariant(error=found.error)
    assert f"{frozen}/variant.json: {os.strerror(errno.ESTALE)}" in str(found.error)
    assert [path.name for path in frozen.iterdir()] == ["variant.json"]

    def fail(path: Path) -> list[str]:
        raise OSError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    monkeypatch.setattr(Path, "iterdir", fail)  # the folder of variants can't be listed
    assert "Permission denied" in str(plan(conf, store, allow_build=True).error)


@pytest.mark.parametrize("seen", ["by its parent", "by the child"])
def test_a_store_that_vanishes_while_a_variant_is_built_does_not_reappear(
    conf: Conf, store: Store, monkeypatch: pytest.MonkeyPatch, seen: str
) -> None:
    def build(
        _: str, __: object, ___: object, on_poll: Callable[[int], None], ____: object
    ) -> dict[str, Any]:
        on_poll(0)
        store.path.rename(store.path.with_name("moved"))
        if seen == "by its parent":
            on_poll(0)
        raise job.WorkError("FileNotFoundError: no such file")

    monkeypatch.setattr(job, "run_in_child", build)
    with pytest.raises(StoreGoneError, match="no longer there"):
        plan(conf, store, allow_build=True)
    assert not store.path.exists()


def two(conf: Conf) -> list[Conf]:
    """Configs of two variants of a scene."""
    return [replace(conf, variant=replace(conf.variant, factor=factor)) for factor in (2, 3)]


@pytest.mark.parametrize(
    ("cores", "memory", "at_once"), [(5, 1 << 40, 2), (1, 1 << 40, 1), (8, 1, 1)]
)
def test_variants_are_built_at_once_on_shares_of_the_cores(
    conf: Conf,
    store: Store,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    cores: int,
    memory: int,
    at_once: int,
) -> None:
    together = threading.Barrier(at_once, timeout=30)
    environments = []

    def build(_: str, request: dict[str, Any], *rest: Any) -> dict[str, Any]:
        environments.append(rest[-1])
        together.wait()  # a second build that began after the end of the first would break it
        return {"variant": f"k-{request['conf']['variant']['factor']}"}

    monkeypatch.setattr(build_variants, "usable_cores", lambda: cores)
    monkeypatch.setattr(build_variants, "usable_memory", lambda: memory)
    monkeypatch.setattr(job, "run_in_child", build)
    planned = build_variants.plan(two(conf), store, allow_build=True)
    assert [found.id for found in planned] == ["k-2", "k-3"]
    several = {"TQDM_DISABLE": "1"} if at_once > 1 else {}
    assert environments == [{"PYTHON_CPU_COUNT": str(cores // at_once)} | several] * 2
    lines = sorted(capfd.readouterr().err.splitlines())
    assert lines == [f"motorcycle: {BUILDING} {place} of 2" for place in (1, 2)]


@pytest.mark.slow
@pytest.mark.usefixtures("here")
def test_sweeps_of_a_scene_that_sfm_can_not_place(
    sweep_here: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    photographs(tmp_path / "leaves", 3, (40, 30))  # SIFT finds no feature in a flat image
    scene = ("scene=folder", "scene.path=leaves", "preset=smoke", "store=s", *CONF)
    code, table, err = sweep_here(*scene)
    assert code == 1
    assert BUILDING in err
    assert "0 of 3 photographs are placed" in table
    code, second_table, err = sweep_here(*scene)
    assert code == 1
    assert second_table == table
    assert BUILDING not in err
    assert "  failed     variant not built" in err
    assert "0 of 3 photographs are placed" in err
    assert HINT in err
    assert err.count(TO_TRY[0]) == table.count(TO_TRY[0]) == 1
    text = describe(tmp_path / "s")
    assert "failed scenes, not tried again; retry=failed tries them again" in text
    assert "  leaves  scene leaves failed: 0 of 3 photographs are placed" in text
    assert "\n".join(TO_TRY) in text


@pytest.mark.parametrize("readable", [1, 4])
def test_a_dry_run_reads_the_headers_of_photographs(
    of_folder: Callable[..., Conf], store: Store, tmp_path: Path, readable: int
) -> None:
    scene = photographs(tmp_path / "scene", readable)
    (scene / "x.jpg").write_bytes(b"xx")
    planned = plan(of_folder(scene), store, allow_build=False)
    if readable == 4:
        note, becomes = planned.notes
        assert note.startswith("left out: x.jpg (unreadable or truncated image")
        assert becomes == (
            "4 photographs: 1 held out, 3 to train on, 1 of which are made 5 times smaller;"
            " variant.hr_fraction=1 leaves them as they are"
        )
        assert planned == PlannedVariant(notes=planned.notes)
    else:
        assert planned.error is not None
        assert "scene scene: 1 photograph(s) can be used, two are needed: x.jpg" in planned.error
    assert not list(store.variants.iterdir())


def photographs(folder: Path, count: int, size: tuple[int, int] = (120, 80)) -> Path:
    folder.mkdir()
    for number in range(count):
        Image.new("RGB", size, (number, 0, 0)).save(folder / f"{number}.png")
    return folder


@pytest.mark.parametrize(
    ("files", "photographs_in", "named"),
    [
        (("sparse/0/cameras.bin", "sparse/0/images.bin"), "", "/sparse/0"),
        (("sparse/0/cameras.bin", "sparse/0/images.bin"), "images", "/sparse/0"),
        (("transforms.json",), "/**", ""),
        (("transforms.json",), "day 1", None),
        (("sparse/0/cameras.bin",), "", None),
    ],
)
def test_cameras_beside_the_photographs_are_named_with_the_word_that_reads_them(
    of_folder: Callable[..., Conf],
    store: Store,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    files: tuple[str, ...],
    photographs_in: str,
    named: str | None,
) -> None:
    """Trainers of Gaussians read such cameras unasked."""
    scene, lines = tmp_path / "my scene", list[str]()
    for file in files:
        (scene / file).parent.mkdir(parents=True, exist_ok=True)
        (scene / file).write_bytes(bytes(8))
    photographs(scene / "images", 4)
    photographs(scene / "day 1", 4)
    monkeypatch.setattr(job, "run_in_child", lambda *_: {"variant": "k-1"})
    monkeypatch.setattr(build_variants, "log_line", lines.append)
    folder = f"{scene}{photographs_in}" if "*" in photographs_in else str(scene / photographs_in)
    conf = of_folder(Path(folder), factor=1, poses=None)
    build_variants.build(conf, store)
    build_variants.build(of_folder(Path(folder), factor=1, poses="p"), store)
    said = [line.partition("; ")[2] for line in lines]
    word = f"'variant.poses={scene}{named}' takes those that are there"
    assert said == ["" if named is None else word, ""]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "size", "changes", "error"),
    [
        (
            *(2, (120, 80), {}),
            "scene scene: 2 photographs are too few: 1 is held out to test on, and 1 left to train"
            " on, which takes two. Add photographs, or hold none out: variant.test_every=0",
        ),
        (5, (40, 30), {}, "0 photograph(s) can be used.*lower variant.factor to 2"),
        (
            *(5, (120, 80), {"test": ["1", "2", "3", "4"]}),
            "5 photographs are too few: 4 are held out.* or name fewer or others in variant.test",
        ),
    ],
)
def test_a_plan_says_what_no_variant_can_be_made_of(
    of_folder: Callable[..., Conf],
    store: Store,
    tmp_path: Path,
    count: int,
    size: tuple[int, int],
    changes: dict[str, Any],
    error: str,
) -> None:
    conf = of_folder(photographs(tmp_path / "scene", count, size), **changes)
    planned = plan(conf, store, allow_build=False)
    assert re.search(re.sub(r"[()]", r"\\\g<0>", error), planned.error or "")
    with pytest.raises(XrgsError):  # the build says the same, or asks more of SfM
        variant.build(conf.scene, conf.variant, store.variants, store.scenes)


def test_photographs_of_which_too_few_are_trained_on_are_refused_before_sfm(
    of_folder: Callable[..., Conf], store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    conf = of_folder(photographs(tmp_path / "scene", 2))
    monkeypatch.setattr(job, "run_in_child", unexpected)
    planned = plan(conf, store, allow_build=True)
    assert "1 is held out to test on" in str(planned.error)
    assert "HR" not in str(planned.error)
    assert not planned.remembered
    monkeypatch.setattr(job, "run_in_child", fail)  # with every photograph, SfM is tried
    conf.variant.test_every = 0
    assert plan(conf, store, allow_build=True).error == "SfM placed too few views"
    becomes = "2 photographs: 0 held out, 2 to train on, as they are"
    note = "no LR view: 2 training photographs are all HR by variant.min_hr=2; nothing is mixed"
    assert plan(conf, store, allow_build=False).notes == (becomes, note)
    conf.variant.hr_fraction = 1.0  # asked for
    assert plan(conf, store, allow_build=False).notes == (becomes,)
    missing = plan(of_folder(tmp_path / "nowhere"), store, allow_build=False)
    assert "no such folder" in str(missing.error)
    assert not missing.remembered  # it is looked for again without retry=failed


def test_a_variant_that_is_found_says_what_the_folder_has_got_since(
    of_folder: Callable[..., Conf],
    store: Store,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    reported: PlannedVariant,
) -> None:
    scene = photographs(tmp_path / "scene", 4)
    photographs(scene / "store", 1)
    for name in ("cells", "variants"):  # as the store of a sweep in this folder
        (scene / "store" / name).mkdir()
    monkeypatch.setattr(variant, "find", lambda *_: SimpleNamespace(id="k-1"))
    notes = plan(of_folder(scene / "**"), store, allow_build=True).notes
    assert notes == ("images left out: 1 in store (a store of xrgs)", *reported.notes)


def test_images_are_made_again_of_trimmed_variants_alone(
    conf: Conf, store: Store, monkeypatch: pytest.MonkeyPatch, reported: PlannedVariant
) -> None:
    requests = []
    monkeypatch.setattr(job, "run_in_child", lambda *given: requests.append(given[:2]))
    job.restore_images(conf, store, "k-1")
    assert requests == []
    (store.variants / "trimmed-k-1").mkdir()
    job.restore_images(conf, store, "k-1")
    ((work, request),) = requests
    assert work == "variant"
    assert (request["variant"], request["store"]) == ("k-1", str(store.path))
    assert request["conf"]["scene"]["kind"] == "motorcycle"


@pytest.mark.slow
@pytest.mark.skipif(machine() != "x86_64", reason="these instruction sets are of x86-64")
def test_other_instruction_sets_build_the_same_variant(
    compose: Callable[..., Conf], tmp_path: Path
) -> None:
    """The id has a hash of the photographs, cameras and points.

    OpenBLAS and MKL are pinned. Left free, MKL renders other photographs on most processors.
    """
    changes = ("variant.long_side=200", "variant.sfm.reference=false")
    conf = compose("scene=procedural", "scene.views=4", *changes)
    older = {
        "ATEN_CPU_CAPABILITY": "avx2",
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX512F,-AVX512VL",
        "MKL_ENABLE_INSTRUCTIONS": "AVX2",
        "NPY_DISABLE_CPU_FEATURES": "AVX512F AVX512CD AVX512_SKX AVX512_ICL AVX512_SPR X86_V4",
        "OMP_NUM_THREADS": "1",
        "PYTHON_CPU_COUNT": "1",
    }
    built = []
    for name, environment in (("own", {}), ("older", older)):
        store = Store(tmp_path / name)
        store.prepare()
        built.append(build_variants.build(conf, store, environment=environment))
    assert built[0] == built[1]
