"""The shipped objects: GLB files in this folder, which `python -m
scenes.recipes.objects` writes in a checkout.
"""

from collections.abc import Mapping
from pathlib import Path

from mi_splat.errors import InvalidValueError, nearest

FOLDER = Path(__file__).parent
SUFFIX = ".glb"
OBJECTS = (
    "car",
    "person",
    "stop sign",
    "elephant",
    "bird",
    "tv",
    "train",
    "suitcase",
    "fire hydrant",
    "house",
)
"""The names are COCO's, but for the house, which COCO does not know."""


def object_file(name: str, what: str = "object") -> Path:
    """The GLB file of a shipped object, or a user's own."""
    shipped = {known: shipped_file(known) for known in OBJECTS}
    return chosen_file(name, shipped, what, f"a {SUFFIX} file")


def shipped_file(name: str) -> Path:
    """A file of this folder."""
    return FOLDER / f"{name.replace(' ', '_')}{SUFFIX}"


def chosen_file(
    name: str, shipped: Mapping[str, Path], what: str, expected: str
) -> Path:
    """A shipped file by its name, or a user's own by its path."""
    if name in shipped:
        return shipped[name]
    path = Path(name)
    if path.is_file():
        return path
    names = ", ".join(shipped)
    do = nearest(name, shipped, "check the path")
    raise InvalidValueError.of(what, f"{expected}, or one of {names}", name, do)
