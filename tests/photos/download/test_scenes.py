"""`xrgs-data download` from a server on the loopback interface."""

from __future__ import annotations

import hashlib
import io
import socket
import stat
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from xrgs import config
from xrgs.photos.download import scenes as scenes_module
from xrgs.photos.download.scenes import UnpackError, unpack

Run = Callable[..., tuple[int, str, str]]
GOOD = {"set/fern/images/a.png": b"a" * 50, "set/fern/poses.npy": b"p", "set/room/b.png": b"b"}


def photograph(grey: int) -> bytes:
    picture = io.BytesIO()
    Image.new("L", (8, 6), grey).save(picture, "PNG")
    return picture.getvalue()


@pytest.fixture(scope="module")
def llff() -> bytes:
    """An archive laid out as LLFF's, with two scenes of tiny photographs."""
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as made:
        for name in ("fern/images_4/0.png", "fern/images_4/1.png", "room/images/0.png"):
            made.writestr(f"nerf_llff_data/{name}", photograph(int(name[-5])))
        made.writestr("nerf_llff_data/room/images/1.png", photograph(1))
        made.writestr("nerf_llff_data/fern/poses_bounds.npy", b"poses")
        made.writestr("__MACOSX/nerf_llff_data/._fern", b"")
    return archive.getvalue()


def test_only_the_named_scenes_are_unpacked_and_existing_ones_kept(
    xrgs_data: Run, server: Any, tmp_path: Path, llff: bytes
) -> None:
    server.content, server.cuts = llff, [100]
    url = f"--url={server.url}"
    code, out, err = xrgs_data("download", "llff", "fern", url, "--data-root=here")
    assert code == 0, err
    assert "not verified: none in config" in out
    assert "here/fern: 2 photographs" in out
    assert [f.name for f in sorted((tmp_path / "here").iterdir())] == [".downloads", "fern"]
    mine = tmp_path / "here" / "fern" / "images_4" / "0.png"
    Image.new("RGB", (4, 3), "red").save(mine)
    before = mine.read_bytes()
    code, out, err = xrgs_data("download", "llff", "fern", "room", url, "--data-root=here")
    assert code == 0, err
    assert "here/fern: there already" in out
    assert "here/room: 2 photographs" in out
    assert mine.read_bytes() == before
    assert server.asked == [None, "bytes=100-"]


def test_the_hash_of_the_first_use_is_verified_later(
    xrgs_data: Run, server: Any, tmp_path: Path, llff: bytes
) -> None:
    server.content, digest = llff, hashlib.sha256(llff).hexdigest()
    url, archive = f"--url={server.url}", tmp_path / "data/llff/.downloads/nerf_llff_data.zip"
    record = archive.with_name("nerf_llff_data.zip.sha256")
    code, out, err = xrgs_data("download", "llff", "fern", url)
    assert code == 0, err
    assert f"not verified: none in config. It is {digest}" in out
    assert f"--sha256 {digest}" in out
    assert record.read_text() == f"{digest}  nerf_llff_data.zip\n"  # as `sha256sum -c` reads it

    server.content = llff + b"changed"  # still a zip archive
    archive.write_bytes(server.content)
    code, _, err = xrgs_data("download", "llff", "room", url)
    assert code == 1
    assert f"not {digest}, the sha256 at first use in {Path('data', 'llff')}" in err
    archive.unlink()
    code, _, err = xrgs_data("download", "llff", "room", url)
    assert code == 1
    assert f"expected {digest}" in err
    assert record.name in err
    assert not archive.exists()

    changed = hashlib.sha256(server.content).hexdigest()
    code, out, err = xrgs_data("download", "llff", "room", url, f"--sha256={changed}")
    assert code == 0, err
    assert f"sha256 verified: {changed}" in out
    assert record.read_text().startswith(changed)


def test_an_archive_that_can_not_be_unpacked_is_not_trusted(
    xrgs_data: Run, server: Any, tmp_path: Path, llff: bytes
) -> None:
    server.content = llff[:-30]
    code, _, err = xrgs_data("download", "llff", "fern", f"--url={server.url}")
    assert code == 1
    assert "not a complete zip archive" in err
    (tmp_path / "data/llff/.downloads/nerf_llff_data.zip").unlink()
    server.content, server.etag = llff, '"mended"'
    code, _, err = xrgs_data("download", "llff", "fern", f"--url={server.url}")
    assert code == 0, err


def test_offline_says_what_to_do_by_hand(
    xrgs_data: Run, tmp_path: Path, llff: bytes, pauses: list[float]
) -> None:
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))  # it does not listen, and nobody else can
        url = f"http://127.0.0.1:{held.getsockname()[1]}/x.zip"
        code, _, err = xrgs_data("download", "llff", "fern", f"--url={url}")
    assert code == 1
    archive = Path("data", "llff", ".downloads", "nerf_llff_data.zip")
    for text in (url, "refused", "By hand", str(archive), "drive.google.com"):
        assert text in err
    (tmp_path / archive).write_bytes(llff)
    code, _, err = xrgs_data("download", "llff", "fern", f"--url={url}")
    assert code == 0, err
    assert (tmp_path / "data" / "llff" / "fern" / "images_4" / "1.png").is_file()


def test_a_folder_in_the_way_is_left_alone(
    xrgs_data: Run, server: Any, tmp_path: Path, llff: bytes
) -> None:
    server.content = llff
    folder = tmp_path / "data" / "llff" / "fern"
    folder.mkdir(parents=True)
    (folder / "notes.txt").write_text("mine")
    code, _, err = xrgs_data("download", "llff", f"--url={server.url}")
    assert code == 1
    assert "fern is in the way" in err
    assert [f.name for f in folder.iterdir()] == ["notes.txt"]
    assert server.asked == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["download", "llff", "ferm"], "fern"),
        (["download", "llff", "fern", "--url=ftp://x"], "ftp://x"),
        (["lpips", "--from", "gone"], "gone"),
        (["inspect", "scene=nope"], "scene=nope"),
    ],
    ids=str,
)
def test_a_mistake_is_one_line(xrgs_data: Run, arguments: list[str], named: str) -> None:
    code, out, err = xrgs_data(*arguments)
    assert code == 1
    assert out == ""
    line = err.splitlines()[-1]  # what comes before is the progress of the work
    assert line.startswith("xrgs-data: ")
    assert named in line


def test_every_scene_of_the_archive_can_be_named_in_a_sweep() -> None:
    from omegaconf import OmegaConf

    known = {file.stem for file in (config.CONF_DIR / "scene" / "llff").glob("*.yaml")}
    assert known == set(OmegaConf.load(config.CONF_DIR / "data" / "llff.yaml").scenes)


def archive(tmp_path: Path, extra: dict[str | zipfile.ZipInfo, bytes] | None = None) -> Path:
    file = tmp_path / "set.zip"
    with zipfile.ZipFile(file, "w") as made:
        made.mkdir("set/fern")
        for name, content in (GOOD | (extra or {})).items():
            made.writestr(name, content)
    return file


def names(folder: Path) -> list[str]:
    return sorted(f.relative_to(folder).as_posix() for f in folder.rglob("*") if f.is_file())


def test_one_folder_is_written_and_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "data" / "fern"
    unpack(archive(tmp_path), "set/fern", target)
    assert names(tmp_path / "data") == ["fern/images/a.png", "fern/poses.npy"]
    assert (target / "images" / "a.png").read_bytes() == b"a" * 50
    assert [f.name for f in target.parent.iterdir()] == ["fern"]
    (tmp_path / "plain").mkdir()
    assert target.stat().st_mode == (tmp_path / "plain").stat().st_mode  # not TemporaryDirectory's


def test_an_empty_folder_may_be_filled_and_no_other(tmp_path: Path) -> None:
    target = tmp_path / "fern"
    target.mkdir()
    unpack(archive(tmp_path), "set/fern", target)
    (target / "mine.txt").write_text("kept")
    with pytest.raises(UnpackError, match="can't be unpacked into"):
        unpack(archive(tmp_path), "set/fern", target)
    assert (target / "mine.txt").read_text() == "kept"
    assert len(list(tmp_path.glob(".*"))) == 0


def test_a_name_that_leads_out_is_refused(tmp_path: Path) -> None:
    file = archive(tmp_path, {"set/fern/../../out.txt": b"x"})
    with pytest.raises(UnpackError, match=r"set\.zip: .* in it leads out of its folder"):
        unpack(file, "set/fern", tmp_path / "deep" / "fern")
    assert names(tmp_path) == ["set.zip"]


@pytest.mark.parametrize("name", ["../out.txt", "/out.txt", "set/room/../../../out.txt"])
def test_names_outside_of_the_folder_are_not_written(tmp_path: Path, name: str) -> None:
    unpack(archive(tmp_path, {name: b"x"}), "set/fern", tmp_path / "deep" / "fern")
    assert names(tmp_path) == ["deep/fern/images/a.png", "deep/fern/poses.npy", "set.zip"]


def test_a_link_becomes_a_plain_file(tmp_path: Path) -> None:
    link = zipfile.ZipInfo("set/fern/link")
    link.create_system = 3  # unix: the mode counts
    link.external_attr = (stat.S_IFLNK | 0o644) << 16
    unpack(archive(tmp_path, {link: b"/etc/passwd"}), "set/fern", tmp_path / "fern")
    assert (tmp_path / "fern" / "link").read_bytes() == b"/etc/passwd"
    assert not (tmp_path / "fern" / "link").is_symlink()


def test_a_file_larger_than_declared_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "set.zip"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as made:
        made.writestr("set/fern/zeros.png", bytes(1 << 20))
    content = file.read_bytes()
    declared = (1 << 20).to_bytes(4, "little")
    file.write_bytes(content.replace(declared, (99).to_bytes(4, "little")))
    with pytest.raises(UnpackError, match="not a complete zip archive"):
        unpack(file, "set/fern", tmp_path / "fern")
    assert names(tmp_path) == ["set.zip"]


@pytest.mark.parametrize("limit", ["_MAX_BYTES", "_MAX_FILES"])
def test_too_many_files_or_bytes_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str
) -> None:
    monkeypatch.setattr(scenes_module, limit, 1)
    with pytest.raises(UnpackError, match="unpacks to 2 files and 51 bytes; at most"):
        unpack(archive(tmp_path), "set/fern", tmp_path / "fern")


@pytest.mark.parametrize("damage", ["cut", "flip", "encrypted"])
def test_a_damaged_archive_leaves_nothing_behind(tmp_path: Path, damage: str) -> None:
    file = archive(tmp_path)
    content = bytearray(file.read_bytes())
    if damage == "cut":
        content = content[:-30]
    elif damage == "flip":
        content[content.index(b"aaaa")] ^= 1
    else:
        content[content.index(b"PK\x01\x02", content.index(b"PK\x01\x02") + 1) + 8] |= 1
    file.write_bytes(content)
    with pytest.raises(UnpackError, match=r"set\.zip: not a complete zip archive"):
        unpack(file, "set/fern", tmp_path / "fern")
    assert [f.name for f in tmp_path.iterdir()] == ["set.zip"]
