"""Reads cameras and points from the user's files instead of running SfM: `variant.poses`.

The files are a COLMAP model or a transforms.json. A pose belongs to the photograph whose path ends
with the same folders and name; suffixes are ignored.
"""

from __future__ import annotations

import hashlib
import unicodedata
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from xrgs.errors import UnreadableError, XrgsError
from xrgs.mixture.photographs import PhotoCollection, Photograph
from xrgs.mixture.poses import colmap, transforms
from xrgs.mixture.poses.given import (
    check_camera,
    check_places,
    moved_points,
    of_other_pictures,
    off_centre,
    own_world,
    rounding,
    same_shape,
)
from xrgs.mixture.views import MIN_POINTS, Reconstruction
from xrgs.photos import foreign, images
from xrgs.photos.lens import Lens, quarter_turn
from xrgs.photos.scenes import Scene
from xrgs.runtime.text import listed
from xrgs.safeio.files import is_transient
from xrgs.safeio.hashing import file_digest
from xrgs.safeio.paths import user_path
from xrgs.safeio.sanitize import for_line
from xrgs.splat.normalize import camera_positions

#: EXIF orientation -> clockwise quarter turns of the stored pixels; other orientations mirror.
_QUARTERS = {1: 0, 3: 2, 6: 1, 8: 3}
#: Fraction of a photograph's pixels; if undistortion keeps fewer, a note names the photograph.
_LEAST_KEPT = 0.9


def fingerprint(path: str) -> str:
    """Hash the files of the poses, independent of their folder: 64 hexadecimal digits of a SHA-256.

    It raises as `read_poses` does.
    """
    sha256 = hashlib.sha256()
    with _errors_named(path):
        source = _source(path)
        found = colmap.files(source) if isinstance(source, Path) else transforms.files(source)
        for file in found:
            sha256.update(f"{file.name}\0{file_digest(file)}\n".encode())
    return sha256.hexdigest()


@contextmanager
def _errors_named(path: str) -> Iterator[None]:
    """Prefix each error with the config's key; raise `UnreadableError` for transient errors."""
    try:
        yield
    except OSError as error:
        kind = UnreadableError if is_transient(error) else XrgsError
        raise kind(f"variant.poses={path}: {error.filename}: {error.strerror}") from error
    except UnreadableError:
        raise
    except XrgsError as error:
        raise XrgsError(f"variant.poses={path}: {error}") from error


def _source(path: str) -> Path | list[Path]:
    """Return the folder of COLMAP models, or the list of transforms.json files."""
    root = user_path(path)
    if not root.exists():
        raise XrgsError("no such folder or file")
    if not root.is_dir():
        foreign.check_file(root)
        return [root]
    if parts := transforms.in_folder(root):
        return parts
    if colmap.files(root):
        return root
    raise XrgsError(
        "it must have a transforms.json, or cameras, images and points3D (which may be missing), "
        "all .bin or all .txt; COLMAP's folder is often called sparse/0"
        f"{foreign.in_folder(root)}"
    )


def with_masks(scene: Scene, path: str | None) -> Scene:
    """Add the masks of `variant.poses` to a scene without masks; raises as `read_poses` does."""
    if path is None:
        return scene
    with _errors_named(path):
        source = _source(path)
        masks = {} if isinstance(source, Path) else transforms.masks(source)
        if not masks:
            return scene
        if scene.masks:
            note = "mask_path of variant.poses is not read, since scene.masks has masks"
            return replace(scene, notes=(*scene.notes, note))
        found, names = match_names(list(masks), list(scene.files.items())), list(scene.files)
    given = {names[i]: masks[pose] for pose, i in found.items()}
    note = f"the masks of {len(given)} photographs are those of mask_path in variant.poses"
    return replace(scene, masks=given, notes=(*scene.notes, note))


def read_poses(path: str, photos: PhotoCollection) -> Reconstruction:
    """Read the cameras of the HR views, and all points, from `variant.poses`.

    Raises:
        UnreadableError: A file can't be read at the moment.
        XrgsError: The files are malformed, a camera model is not supported, no photograph has the
            name of an image, or there are too few points (but none at all are accepted).
    """
    content = fingerprint(path)
    with _errors_named(path):
        source = _source(path)
        if isinstance(source, Path):
            given, in_folder = colmap.read(source), []
        else:
            given = transforms.read(source)
            names = listed([file.name for file in source])
            in_folder = [f"variant.poses: {names} is read"] if user_path(path).is_dir() else []
        with np.errstate(over="ignore"):  # training uses float32
            usable = np.isfinite(given.points.astype(np.float32)).all(axis=1)
        points = given.points[usable]
        if len(given.points) and len(points) < max(MIN_POINTS, len(given.points)):
            raise XrgsError(
                f"{len(points)} of {len(given.points)} points are usable; at least {MIN_POINTS} "
                "points, all of them finite, are needed to begin training with"
            )
        found = match_names(given.names, [(photo.name, photo.path) for photo in photos.all])
        cameras = {i: given.camera(name, _stored(photos[i])) for name, i in found.items()}
        turned = _turned_by_exif({i: lens for i, (lens, _) in cameras.items()}, photos)
        cameras |= {i: _upright(*cameras[i], photos[i]) for i in turned}
        for i, (lens, _) in cameras.items():
            check_camera(lens, photos[i])
        given_lenses = {i: lens for i, (lens, _) in cameras.items()}
        names_of = {i: name for name, i in found.items()}
        in_folder += off_centre(given_lenses, photos)
        in_folder += of_other_pictures(given_lenses, names_of, photos, user_path(path))
        viewmats, moved = own_world({i: viewmat for i, (_, viewmat) in cameras.items()})
        points, rounded = _moved_points(points, viewmats, moved)
        lenses = {i: photos[i].to_hr(lens) for i, (lens, _) in cameras.items()}
        kept = {i: lens.kept() for i, lens in lenses.items()}
    notes = _notes(given.names, found, photos, lenses, kept, turned)
    none = np.zeros(0, np.intp)
    return Reconstruction(
        lenses,
        viewmats,
        points,
        given.colors[: len(points)],
        {i: none if rounded else given.observed.get(name, none) for name, i in found.items()},
        {
            "poses": content,
            "images": len(photos),
            "registered": len(lenses),
            "points": len(points),
            **given.report,
            "notes": [for_line(note) for note in (*in_folder, *given.notes, *rounded, *notes)],
        },
        moved,
    )


def _moved_points(
    points: NDArray[np.float64],
    viewmats: Mapping[int, NDArray[np.float64]],
    to: NDArray[np.float64],
) -> tuple[NDArray[np.float64], list[str]]:
    """Move points to the world of the cameras; if they are rounded too coarsely, drop all of them.

    A note says if they were dropped.
    """
    own, notes = moved_points(points, to), []
    if step := rounding(points, own):
        far = float(np.abs(points).max())
        notes.append(
            f"the points of variant.poses are not used: 32 bits round them to steps of {step:.2g}, "
            f"since they are {far:.2g} from the origin; save them in 64 bits (double)"
        )
        own = own[:0]
    centres = camera_positions(np.stack([*viewmats.values()]))
    check_places(centres, own, float(np.linalg.norm(to[:3, 3])))
    return own, notes


def _stored(photo: Photograph) -> tuple[int, int]:
    """Return the stored width and height of a photograph, before applying the EXIF orientation."""
    return images.turned_size(photo.size, photo.orientation)


def _turned_by_exif(lenses: Mapping[int, Lens], photos: PhotoCollection) -> set[int]:
    """Return the indices of photographs whose cameras need the EXIF rotation.

    COLMAP, nerfstudio and instant-ngp ignore EXIF and use the stored pixels, but the user may have
    given them upright copies. The shape of a camera shows which, unless the photograph is square or
    EXIF turns it by 180 degrees. Such cameras are treated as the others; if all are such cameras,
    the pixels are assumed to be as stored.
    """
    stored, upright, either = set[int](), set[int](), set[int]()
    for i, lens in lenses.items():
        shape, photo = (lens.width, lens.height), photos[i]
        if photo.orientation != 1 and same_shape(shape, _stored(photo)):
            (either if same_shape(shape, photo.size) else stored).add(i)
        elif photo.orientation != 1:
            upright.add(i)
    return stored if upright and not stored else stored | either


def _upright(
    lens: Lens, viewmat: NDArray[np.float64], photo: Photograph
) -> tuple[Lens, NDArray[np.float64]]:
    """Apply the EXIF rotation of a photograph to its camera and pose."""
    quarters = _QUARTERS.get(photo.orientation)
    if quarters is None:
        raise XrgsError(
            f"EXIF's orientation {photo.orientation} mirrors {photo.name}, and no camera shows a "
            "mirrored picture: remove the tag, or place upright copies of the photographs"
        )
    turn = np.eye(4)
    turn[:2, :2] = quarter_turn(quarters)
    return lens.turned(quarters), turn @ viewmat


def _notes(
    names: Sequence[str],
    found: Mapping[str, int],
    photos: PhotoCollection,
    lenses: Mapping[int, Lens],
    kept: Mapping[int, float],
    turned: Collection[int],
) -> list[str]:
    notes = []
    if unused := [name for name in names if name not in found]:
        notes.append(f"{len(unused)} poses fit no photograph, or several: {listed(unused)}")
    if turned:
        names_of_turned = [photos.names[i] for i in sorted(turned)]
        notes.append(
            f"EXIF turns {len(turned)} photographs, and their poses were turned with them, since "
            f"the pixels that were posed are taken to be as stored: {listed(names_of_turned)}"
        )
    if cut := sorted(i for i, share in kept.items() if share < _LEAST_KEPT):
        models = ", ".join(sorted({lenses[i].model for i in cut}))
        shares = [kept[i] for i in cut]
        notes.append(
            f"undistortion keeps {min(shares):.0%} to {max(shares):.0%} of {len(cut)} photographs "
            f"with cameras {models}: {listed([photos.names[i] for i in cut])}"
        )
    return notes


def match_names(poses: Sequence[str], photographs: Sequence[tuple[str, Path]]) -> dict[str, int]:
    """Find the photograph of each pose by comparing the ends of their paths.

    `poses` are the names of images, with folders and suffix, and `photographs` name and file.

    Returns:
        Name of a pose -> index of its photograph. If several poses match a photograph, it gets the
        pose that shares the most folders with it. Poses that match several photographs are left
        out.

    Raises:
        XrgsError: No pose matches a photograph, or two poses match a photograph equally well.
    """
    if not poses:
        raise XrgsError("it has no image: the program that wrote it placed no photograph")
    photographs = [(_composed(name), Path(_composed(str(file)))) for name, file in photographs]
    ends: dict[str, set[int]] = {}  # end of a path -> its photographs
    for i, (name, file) in enumerate(photographs):
        for end in (name, file.stem):
            ends.setdefault(end, set()).add(i)
    fits: dict[int, list[tuple[int, str]]] = {}
    for pose in poses:
        scores: dict[int, int] = {}
        for parts in _readings(pose):
            same_end = set().union(*(ends.get("_".join(parts[n:]), ()) for n in range(len(parts))))
            scores = scores or {
                i: score for i in same_end if (score := _shared(parts, *photographs[i]))
            }
        best = [i for i, score in scores.items() if score == max(scores.values())]
        if len(best) == 1:
            fits.setdefault(best[0], []).append((scores[best[0]], pose))
    if not fits:
        names = [name for name, _ in photographs]
        similar = [m for p in poses[:1] for m in get_close_matches(Path(p).stem, names, 1, 0.0)]
        example = f": {poses[0]} is not {similar[0]}" if similar else ""
        why = f"none of its {len(poses)} images has the name of a photograph{example}"
        raise XrgsError(f"{why}; rename them")
    found = {}
    for i, claims in fits.items():
        most = max(score for score, _ in claims)
        first, *others = [pose for score, pose in claims if score == most]
        if others:
            raise XrgsError(
                f"two of its images, {first} and {others[0]}, have the name of the photograph "
                f"{photographs[i][0]}; rename them, or remove one"
            )
        found[first] = i
    return found


def _readings(path: str) -> list[tuple[str, ...]]:
    """Return folders and name of a path from any operating system: without and with its suffix.

    Blender and other programs omit the suffix, so that what looks like one may be part of the name,
    as in 05.01.2024_7. Digits always are: .0001 of frame.0001 is no suffix.
    """
    pure = PurePosixPath(_composed(path.replace("\\", "/")))
    if pure.suffix[1:].isdigit() or not pure.name:
        return [pure.parts]
    return list(dict.fromkeys([pure.with_suffix("").parts, pure.parts]))


def _composed(text: str) -> str:
    """Compose letters and accents: macOS writes them apart into names of files."""
    return unicodedata.normalize("NFC", text)


def _shared(pose: Sequence[str], name: str, file: Path) -> int:
    """Return the number of parts at the end of a pose's path that agree with the photograph.

    The name of a photograph includes its folders below `scene.path`: the view of rig1/0004.jpg is
    rig1_0004. If the pose has folders, these must agree.
    """
    own = file.with_suffix("").parts
    shared = 0
    while shared < min(len(own), len(pose)) and own[-1 - shared] == pose[-1 - shared]:
        shared += 1
    below = next((n for n in range(1, len(own)) if "_".join(own[-n:]) == name), 1)
    if shared >= min(below, len(pose)):
        return shared
    return next((n for n in range(len(pose), 0, -1) if "_".join(pose[-n:]) == name), 0)
