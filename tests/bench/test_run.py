"""The benchmark as a user runs it, and the results that it computes."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from xrgs.bench import rendering, run, training
from xrgs.bench.loads import Load, random_load
from xrgs.bench.rendering import RenderMethod, RenderTask
from xrgs.bench.settings import Settings
from xrgs.splat.backend import resolve_backend
from xrgs.splat.settings import RasterSettings

#: The type of the fixture `call_command`.
CallCommand = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def smoke(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, dict[str, Any]]:
    """Run a smoke benchmark; return its folder, its text, and its JSON."""
    folder = tmp_path_factory.mktemp("bench")
    settings = Settings(smoke=True, repeats=1, out=str(folder / "o"), json=str(folder / "all.json"))
    text = run.run(settings)
    return folder, text, json.loads((folder / "all.json").read_text())


@pytest.mark.slow
def test_every_backend_is_timed_in_every_part(smoke: tuple[Path, str, dict[str, Any]]) -> None:
    _, out, found = smoke
    backends = {"torch"} if resolve_backend("auto") == "torch" else {"native", "torch"}
    assert {row["method"] for row in found["rows"]} >= backends | {"torch float64"}
    loads = len(run.SMOKE.gaussians) * len(run.SMOKE.sizes)
    for backend in backends:
        rows = [row for row in found["rows"] if row["method"] == backend]
        counts = {row["threads"] for row in rows}
        assert 1 in counts
        assert len(rows) == loads * len(counts)
        for row in rows:
            assert min(row["forward_ms"], row["backward_ms"], row["memory_bytes"]) > 0
            assert row["evaluations"] > row["width"] * row["height"]
            assert row["error"]["image_mean"] < 1e-6
            assert row["error"]["gradient"] < 1e-2
            if backends != {backend} and backend == "torch":
                assert row["times_slower"] > 1
    assert {row["kind"] for row in found["losses"]} == backends | {"kornia"}
    assert {row["kind"] for row in found["optimizers"]} == backends | {"default"}
    assert {row["view"] for row in found["steps"]} == {"HR", "LR"}
    assert {row["views"] for row in found["views"]} == set(run.SMOKE.views)
    assert {row["kind"] for row in found["resizes"]} == backends | {"interpolate"}
    assert set(found["growth"]) == {"gaussians", "pixels"}
    assert {key: len(lines) for key, lines in found["growth_lines"].items()} == {
        "gaussians": len(run.SMOKE.sizes),
        "pixels": len(run.SMOKE.gaussians),
    }
    titles = ["gradient error", "loss, value and gradient", "Adam, one step", "densify"]
    titles += [
        "speed-up",
        "exponent",
        "an LR view's step takes",
        "LR view upsampled",
        "shortcut of a step",
        "growth MB",
    ]
    for title in titles:
        assert title in out


@pytest.mark.slow
def test_higher_cutoffs_cost_accuracy(smoke: tuple[Path, str, dict[str, Any]]) -> None:
    rows = smoke[2]["rows"]
    first = rows[0]["backend"]
    methods = {method["name"]: method for method in smoke[2]["methods"]}
    assert methods[f"{first}, stop at 1e-2"]["settings"]["transmittance_min"] == 1e-2
    largest = [row for row in rows if row["gaussians"] == max(run.SMOKE.gaussians)]
    by_method = {row["method"]: row for row in largest}
    assert by_method[f"{first}, alpha cut 4/255"]["error"]["image_mean"] > 1e-4
    fewer, usual = by_method[f"{first}, alpha cut 4/255"], by_method[first]
    assert fewer["evaluations"] < usual["evaluations"]


@pytest.mark.slow
def test_stages_add_up_to_no_more_than_the_pass(smoke: tuple[Path, str, dict[str, Any]]) -> None:
    native = [row for row in smoke[2]["rows"] if row["backend"] == "native"]
    if not native:
        pytest.skip("the native backend was not built")
    for row in native:
        stages = row["stages_ms"]
        back = {name: ms for name, ms in stages.items() if name.endswith("backward")}
        assert 0 < sum(back.values()) <= row["backward_ms"]
        assert 0 < sum(stages.values()) - sum(back.values()) <= row["forward_ms"]
        assert set(row["ideal_share"]) == set(row["multiply_share"]) <= set(stages)
        assert row["pairs"] > 0
    assert smoke[2]["machine"]["multiply_adds_per_s"]["1"] > 1e8


@pytest.mark.slow
def test_the_files_hold_the_results(smoke: tuple[Path, str, dict[str, Any]]) -> None:
    folder, _, found = smoke
    with (folder / "o" / "bench.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(found["rows"])
    assert float(rows[0]["forward_ms"]) == found["rows"][0]["forward_ms"]
    assert float(rows[0]["image_mean_error"]) == found["rows"][0]["error"]["image_mean"]
    with (folder / "o" / "shortcuts.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    shortcuts = found["shortcuts"]["renders"]
    assert len(rows) == len(shortcuts) + len(found["shortcuts"]["steps"])
    assert float(rows[0]["off_forward_ms"]) == shortcuts[0]["off"]["forward_ms"]
    assert (folder / "o" / "bench.png").read_bytes().startswith(b"\x89PNG")


def test_a_file_is_timed(file: Path, tmp_path: Path) -> None:
    settings = Settings(load=str(file), out=str(tmp_path / "o"), json=str(tmp_path / "a.json"))
    settings.repeats = settings.threads = 1
    text = run.run(settings)
    found = json.loads((tmp_path / "a.json").read_text())
    assert {row["gaussians"] for row in found["rows"]} == {150}
    assert {(row["width"], row["height"]) for row in found["rows"]} == {(40, 30)}
    assert {row["load"] for row in found["rows"]} == {"load"}
    assert "40x30" in text
    assert "steps" not in found
    sizes = {(row["width"], row["height"]) for row in found["shortcuts"]["renders"]}
    assert sizes == {(40, 30), (8, 6)}  # at the file's size, and as an LR view


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--load=none.npz"], "none.npz: cannot be read"),
        (["--save=a.npz"], "--save FILE.npz needs --cell FOLDER and --view NAME"),
        (["--save=a.npz", "--cell=nowhere", "--view=a"], "--cell nowhere: is absent"),
        (["--quality"], "--quality needs --cell FOLDER"),
        (["--quality", "--cell=nowhere"], "--cell nowhere: is absent"),
        (["--repeats=0"], "repeats must be at least 1"),
        (["--against=none"], "--against none: must be the Python executable of an environment"),
    ],
)
def test_bad_arguments_end_in_one_line(
    call_command: CallCommand, arguments: list[str], message: str
) -> None:
    code, out, err = call_command("bench", *arguments)
    assert code != 0
    assert not out
    assert err.startswith("xrgs-bench: ")
    assert message in err
    assert "\n" not in err


def test_float64_is_the_reference_of_errors(load: Load) -> None:
    method = RenderMethod("exact", "torch", dtype=torch.float64)
    found = rendering.errors(load, [method])["exact"]
    assert max(found.values()) < 1e-12
    assert rendering.describe(method)["dtype"] == "float64"


def test_errors_tell_wrong_settings_from_right_ones(load: Load) -> None:
    wrong = RasterSettings(eps2d=0.6)
    found = rendering.errors(
        load, [RenderMethod("right", "torch"), RenderMethod("wrong", "torch", wrong)]
    )
    for name, most, least in (("image_mean", 1e-6, 1e-3), ("gradient", 1e-3, 1e-2)):
        assert found["right"][name] < most
        assert found["wrong"][name] > least


def test_loads_too_large_for_torch_are_left_out() -> None:
    large = random_load(10, 600, 500, seed=0)
    assert rendering.time_load(large, [RenderMethod("torch", "torch")], [1], repeats=1) == []


def test_a_rendering_gives_six_gradients(load: Load) -> None:
    one = RenderTask(load, RenderMethod("torch", "torch"), 1)
    one.forward()
    gradients = one.backward()
    assert [g.shape for g in gradients] == [p.shape for p in load.parameters]
    assert all(g.abs().max() > 0 for g in gradients)


def test_a_step_trains_and_keeps_its_gaussians(load: Load) -> None:
    step = training.TrainingStep(load, "torch", 1)
    losses = []
    for _ in range(3):
        before = step.gaussians.means.detach().clone()
        for part in step.parts():
            part()
        losses.append(step.value.item())
        assert len(step.gaussians) == len(load)
        assert not torch.equal(step.gaussians.means, before)
    assert losses[0] > losses[-1]


def test_our_loss_and_the_one_of_kornia_agree() -> None:
    image, photograph = torch.rand(2, 20, 24, 3, generator=torch.Generator().manual_seed(0))
    image.requires_grad_()
    (ours,), (theirs,) = (
        make()
        for make in (
            training._our_loss(image, photograph, "torch", 1),
            training._kornia_loss(image, photograph, 1),
        )
    )
    torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-7)
