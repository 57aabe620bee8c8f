"""The JSON files of a store, each a typed struct: these types document and check the format.

`xrgs.safeio.records.read_struct` decodes them. A file of another type is "damaged: FILE: FIELD",
and fields that are not listed here are ignored, so that newer versions may add some.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from msgspec import Meta, Struct

#: The name of a folder or a file, without slashes.
Name = Annotated[str, Meta(min_length=1, max_length=251, pattern=r"^(?!\.{1,2}$)[^/\\\x00-\x1f]+$")]
#: The path of a file in the cell's folder, with `/`, that does not lead out of it.
Inside = Annotated[
    str,
    Meta(
        min_length=1,
        max_length=1000,
        pattern=r"^(?!.*(^|/)\.{1,2}(/|$))[^/\\\x00-\x1f][^\x00-\x1f\\]*$",
    ),
]
Label = Annotated[str, Meta(max_length=2000)]
Count = Annotated[int, Meta(ge=0, le=(1 << 63) - 1)]
#: No measured value comes near the bound. With it no mean or square leaves the range of a float.
Number = Annotated[float, Meta(ge=-1e30, le=1e30)]


class FileEntry(Struct, frozen=True):
    """Size and hash of a file."""

    bytes: Count
    sha256: str


class Status(Struct, frozen=True):
    """`status.json`: how a cell ended. It is written last, after all other files of the cell."""

    state: Literal["done", "failed"]
    reason: str = ""
    """Why the cell failed."""
    views: tuple[Name, ...] = ()
    """The scored views, in the order of `scores.csv`."""
    files: dict[Inside, FileEntry] = {}
    """Every file of the cell that is a result, by its path."""
    trimmed: dict[Inside, FileEntry] = {}
    """Files that `xrgs-store trim` has removed."""
    scored_by: dict[str, str] = {}
    """The digest of the code of each score, and of the `protocol`, that `scores.csv` is from."""


class Identity(Struct, frozen=True):
    """`identity.json`: every value that can change a trained number. The id is its digest."""

    variant: Name
    seed: Count
    train: dict[str, Any]
    splat: dict[str, Any]
    components: dict[str, Any]
    """The settings of the components that are on."""
    arithmetic: str = "not recorded"
    code: dict[str, str] = {}
    """The digest of each part of the program that trains: `core`, `native`, components."""


class Summary(Struct, frozen=True):
    """`summary.json`: the figures of a whole cell."""

    training_time_s: Number
    render_time_ms: Number
    gaussians: Count
    memory_bytes: Number
    evaluations: Number
    """Alpha evaluations of the training: pairs of a pixel and a Gaussian."""
    steps: Count
    peak_rss_bytes: Number | None = None
    grow_grad2d: Number | None = None
    """The growth threshold of densification, which count matching searches for."""
    work: dict[str, Number] = {}
    """Sums of the work that the steps did and left out (`xrgs.training.recorder`)."""
    stage_seconds: dict[str, Number] = {}
    found: tuple[str, ...] = ()
    """What components found out about the photographs, for example `formation: LR views: ...`."""


class Provenance(Struct, frozen=True):
    """`provenance.json`: where, when and with which software a cell was trained."""

    xrgs: str
    """Version of the package."""
    git: str | None
    """Commit of the checkout that the package is or was built from; None if unknown."""
    git_diff_sha256: str | None
    """Hash of what differed from the commit; None if nothing did, or nothing is known."""
    python: str
    packages: dict[str, str]
    platform: str
    threads: Count
    backend: str
    started: str
    """Time in ISO 8601, UTC."""
    cores: Count = 0
    arithmetic: str = "not recorded"
    lpips_weights_sha256: str | None = None
    cpu: str | None = None
    gpu: str | None = None
    """The GPU that trained the cell; None where the processor did."""
    instruction_set: str | None = None
    machines_in_turn: str = ""
    """The machines that trained the cell one after another, where they were several."""


class RecordedCell(Struct, frozen=True):
    """One cell in the record of a sweep."""

    cell_id: Name | None
    """None while the variant is not built, or the number of Gaussians to match is not known."""
    label: Label
    condition: Label
    scene: Label
    variant_seed: Count
    seed: Count
    variant_id: Name | None
    baseline_id: Name | None
    """The cell that this one is compared with."""
    planned_id: str | None = None
    """An id of the plan of the cell, known before any cell is trained."""
    error: str | None = None
    """Why the cell can't be trained."""
    state: Literal["unknown", "not placed"] | None = None
    """`not placed` where SfM has placed too few photographs of its scene. Earlier versions also
    wrote `unknown`."""


class SweepRecord(Struct, frozen=True):
    """`sweeps/<sweep id>.json`: which cells a sweep compares."""

    version: Literal[1]
    command: tuple[str, ...]
    """The arguments of `xrgs-sweep`."""
    cells: tuple[RecordedCell, ...]
    digest: str = ""
    """Hash of the cells."""
