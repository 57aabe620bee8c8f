"""Recognises files of other programs that users give as poses, for messages with advice."""

from __future__ import annotations

from pathlib import Path

from xrgs.errors import XrgsError
from xrgs.runtime.text import listed
from xrgs.safeio.files import list_names

_AS_COLMAP = "export the cameras in COLMAP's format from the program that made it"
_UNPACK = "unpack it, and give the folder"
_FOLDER = "give the folder that it is in"
#: The suffix of COLMAP's databases, their usual name, and the first bytes of an SQLite database.
#: Windows writes Thumbs.db into folders of photographs, which is none.
_DATABASE, _DATABASE_NAME, _SQLITE = ".db", "database.db", b"SQLite format 3\0"
#: End of a file's name with its dot, or a whole name, in lower case -> what the file is, and what
#: to do with it.
_ENDINGS = {
    "reconstruction.json": ("a file of OpenSfM", _AS_COLMAP),
    **dict.fromkeys(("sfm_data.json", "sfm_data.bin"), ("a file of OpenMVG", _AS_COLMAP)),
    **dict.fromkeys((".zip", ".7z", ".rar", ".tar", ".tgz", ".gz", ".xz"), ("an archive", _UNPACK)),
    ".xml": ("an .xml file, as Metashape's cameras are", _AS_COLMAP),
    ".xmp": ("an .xmp file, as RealityScan's cameras are", _AS_COLMAP),
    **dict.fromkeys((".psx", ".psz"), ("a project of Metashape", _AS_COLMAP)),
    **dict.fromkeys((".rcproj", ".rsproj"), ("a project of RealityScan", _AS_COLMAP)),
    ".out": ("a file of Bundler", _AS_COLMAP),
    ".nvm": ("a file of VisualSFM", _AS_COLMAP),
    **dict.fromkeys((".sfm", ".mg"), ("a file of Meshroom", _AS_COLMAP)),
    **dict.fromkeys((".abc", ".fbx", ".usdz"), ("a scene of an animation program", _AS_COLMAP)),
    ".csv": ("a table", _AS_COLMAP),
    ".npy": ("an array of numpy, as LLFF's poses_bounds.npy is", _AS_COLMAP),
    ".npz": ("arrays of numpy", _AS_COLMAP),
    _DATABASE: ("COLMAP's database, which has no poses", "give the folder of its model, sparse/0"),
    ".ply": ("a file of points, which has no cameras", _FOLDER),
    **dict.fromkeys((".bin", ".txt"), ("one file", _FOLDER)),
}
#: A key of a .json file -> the program that writes it.
_KEYS = {
    "sfm_data_version": "OpenMVG",
    "featuresFolders": "Meshroom",
    "camera_models": "Polycam",
    "shots": "OpenSfM",
    "img_name": "3D Gaussian Splatting",
}


def kind(file: Path) -> str:
    """Describe a file of another program, such as `an archive`; empty if it is unknown."""
    return _ENDINGS[ending][0] if (ending := _ending(file)) else ""


def check_file(file: Path) -> None:
    """Raise XrgsError for a file of another program, which can't be a transforms.json."""
    if ending := _ending(file):
        what, todo = _ENDINGS[ending]
        raise XrgsError(f"it is {what}, and not a folder of COLMAP's or a transforms.json; {todo}")


def _ending(file: Path) -> str:
    """Return the key of a file in `_ENDINGS`; empty if it has none."""
    return next((ending for ending in _ENDINGS if _ends(file, ending)), "")


def _ends(file: Path, ending: str) -> bool:
    """Return whether a file's name ends so, and a database is one of COLMAP's."""
    name = file.name.lower()
    if not ending.startswith("."):
        return name == ending
    if ending != _DATABASE or name == _DATABASE_NAME:
        return name.endswith(ending)
    return name.endswith(ending) and _is_sqlite(file)


def _is_sqlite(file: Path) -> bool:
    try:
        with file.open("rb") as stream:
            return stream.read(len(_SQLITE)) == _SQLITE
    except OSError:
        return False


def in_folder(folder: Path) -> str:
    """Name a folder's files of other programs, as the end of a message; empty if it has none."""
    found: dict[str, list[str]] = {}  # what to do -> names
    for name in list_names(folder):
        ending = _ending(folder / name)
        if ending and ending not in (".bin", ".txt", ".ply", ".csv"):
            found.setdefault(_ENDINGS[ending][1], []).append(name)
    return "".join(f"; {listed(names)} can't be read: {todo}" for todo, names in found.items())


def of_json(content: object) -> str:
    """Name the program that wrote a .json, as the end of a message; empty if it is unknown."""
    first = content[0] if isinstance(content, list) and content else content
    programs = [p for key, p in _KEYS.items() if isinstance(first, dict) and key in first]
    return f": it is of {programs[0]}; {_AS_COLMAP}" if programs else ""
