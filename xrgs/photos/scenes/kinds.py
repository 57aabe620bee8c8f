"""The kinds of scenes, and the digest of the code of each."""

from __future__ import annotations

from xrgs.photos.scenes.folder import FolderScene
from xrgs.photos.scenes.motorcycle import Motorcycle
from xrgs.photos.scenes.procedural import ProceduralScene
from xrgs.photos.scenes.scene import SceneKind
from xrgs.photos.scenes.video import VideoScene
from xrgs.safeio.code import CodeFolders, code_digest
from xrgs.safeio.refactorings import canonical

_FOLDER = "photos/scenes"


def code_of(kind: str) -> str:
    """Return the digest of the code that provides the photographs of a kind of scenes.

    It covers every file of `photos/` except those of other kinds and of `download/`.
    """
    code = CodeFolders(
        folders=("photos",),
        whole_parts=("photos/download",),
        folders_of_parts=(_FOLDER,),
        parts=frozenset(f"{_FOLDER}/{name}.py" for name in KINDS),
        registries=frozenset({f"{_FOLDER}/kinds.py"}),
    )
    files = (*code.core(), *code.part(f"{_FOLDER}/{kind}.py"))
    return canonical("variant/scene", code_digest(*files))


#: The kinds of scenes by `scene.kind`; each is in the module of its name.
KINDS: dict[str, SceneKind] = {
    "procedural": ProceduralScene(code_of),
    "motorcycle": Motorcycle(),
    "folder": FolderScene(),
    "video": VideoScene(code_of),
}
#: Kinds that render or extract their photographs. Their own `digest` includes their code.
MADE = ("procedural", "video")
