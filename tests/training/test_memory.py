"""The memory of training: what is kept, every tensor once, and what autograd saves."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import pytest
import torch

from tests.conftest import composed
from tests.training.conftest import same
from xrgs.splat.gaussians import PARAMETERS
from xrgs.splat.rendering import Render
from xrgs.training import memory
from xrgs.training.components import Step, TrainingView
from xrgs.training.dataset import Dataset
from xrgs.training.loop import train
from xrgs.training.memory import OnDemand, TrainingMemory, tensors_in
from xrgs.training.recorder import TrainingResult


@dataclass
class Holder:
    tensor: torch.Tensor
    others: dict[str, list[torch.Tensor]]
    function = print


def render(buffer_bytes: int) -> Render:
    empty = torch.empty(0)
    return Render(empty, empty, empty, 0, buffer_bytes, 0)


def step(data: Dataset, view: int = 0) -> Step:
    return Step(0, 1, data.train[view])


def test_tensors_are_found_in_items_and_attributes_all_the_way() -> None:
    a, b, c = (torch.zeros(n) for n in (1, 2, 3))
    a.requires_grad_().grad = torch.zeros(1)
    holder = Holder(a, {"b": [b]})
    holder.others["self"] = [holder]  # type: ignore[list-item]
    found = [id(t) for t in tensors_in((holder, SimpleNamespace(c={"c": (c,)}), None, 1, "text"))]
    assert sorted(found) == sorted(map(id, (a, a.grad, b, c)))


def test_tensors_that_share_memory_count_once_and_buffers_are_added(data: Dataset) -> None:
    base = torch.zeros(100)
    counted = TrainingMemory([base, base[10:20], base.view(10, 10)], torch.zeros(5).double())
    with counted.of_forward(step(data), 1, 0):
        pass
    counted.record(render(1000))
    assert counted.largest_bytes == 400 + 40 + 1000


def test_what_autograd_saves_counts_and_what_a_forward_pass_drops_does_not(data: Dataset) -> None:
    """Or a count would depend on which of its addresses are used again."""
    x = torch.rand(50, requires_grad=True)
    counted = TrainingMemory(x)
    with counted.of_forward(step(data), 1, 0):
        (x.exp() * x.cos()).sum()  # dropped
        y = x.exp()  # saves its result
        z = y * 2.0 + 1  # saves nothing
        loss = (z * z).sum()  # saves z
    torch.autograd.backward(loss)
    counted.record(render(0))
    assert counted.largest_bytes == 4 * 50 * (1 + 1 + 2)  # x, its gradient; y and z


def test_steps_alike_are_counted_once_until_the_gaussians_change(data: Dataset) -> None:
    held: list[torch.Tensor] = []
    counted = TrainingMemory(held)

    def count(gaussians: int, view: int, elements: int) -> int:
        held[:] = [torch.zeros(elements)]
        with counted.of_forward(step(data, view), gaussians, 0):
            pass
        counted.record(render(0))
        return counted.largest_bytes

    assert count(10, 0, 100) == 400
    assert count(10, 0, 200) == 400  # taken for the same
    assert count(11, 0, 50) == 400  # counted, and less
    assert count(12, 0, 300) == 1200


def test_values_are_kept_as_far_as_the_bytes_go(
    data: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[str] = []

    def make(view: TrainingView) -> torch.Tensor:
        made.append(view.name)
        return view.image * 2

    monkeypatch.setattr(memory, "KEPT_BYTES", 4 * 3 * (60 * 60 + 12 * 12))  # of v0 and v1
    values = OnDemand(make, data.train)
    assert list(values.kept) == ["v0", "v1"]
    made.clear()
    for view in data.train:
        assert torch.equal(values[view.name], view.image * 2)
    assert made == ["v2", "v3"]
    assert [id(tensor) for tensor in tensors_in(values)] == [
        id(values["v1"]),
        id(values["v0"]),
    ]


@pytest.mark.slow
def test_what_is_not_kept_changes_no_bit_and_takes_less_memory(
    data: Dataset, monkeypatch: pytest.MonkeyPatch, trained: TrainingResult
) -> None:
    """And what components hold counts."""
    holding = "+ablation=[consistency,region_weighting,resolution_schedule]"
    conf = composed("train.steps=40", "splat.backend=auto", holding)
    kept = train(data, conf)
    monkeypatch.setattr(memory, "KEPT_BYTES", 0)
    anew = train(data, conf)
    assert same(kept.gaussians, anew.gaussians)
    assert kept.history == anew.history
    # More than the mean and variance of each photograph: what components keep counts too.
    moments = sum(2 * 4 * view.image.numel() for view in data.train)
    assert kept.memory_bytes - anew.memory_bytes > moments
    model = sum(trained.gaussians[name].nbytes for name in PARAMETERS)
    photographs = sum(view.pixels.nbytes for view in (*data.train, *data.test))
    assert trained.memory_bytes > 4 * model + photographs  # gradients and two moments
