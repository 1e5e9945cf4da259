"""Where the files of a set lie, whatever its lists call them.

Sets move between machines: names have another ending or case, backslashes, or begin
with a folder of another computer. A file is only ever looked for in the set's own
folder.
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path, PurePosixPath

from mi_splat.datasets.errors import DatasetError

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
"""Endings of images, in the order in which they are tried where a name has none."""

IMAGES = "images"
MASKS = "masks"
SMALLER = (2, 4, 8)
"""Images that are so many times smaller may lie in images_2, images_4 and images_8."""

_LONGEST_NAME = 255
_DRIVE = re.compile(r"[A-Za-z]:")


class SetFiles:
    """Files of a set by the names in its lists.

    Args:
        start: The folder from which names start.
        above: How many folders above it still belong to the set.
    """

    def __init__(self, start: Path, *, above: int = 0) -> None:
        self.start = start
        self._above = above
        self._listings: dict[Path, dict[str, list[str]]] = {}

    def find(self, name: str, source: str, *, folder: str = IMAGES) -> Path:
        """The file that a list calls `name`; if there is none, where it would be.

        Args:
            name: As the list has it.
            source: The place in the list, for errors.
            folder: Where files of this kind usually lie.

        Raises:
            DatasetError: The name leads out of the set, and no file in the set has its
                last part.
        """
        self._check_lengths(name, source)
        spellings = [name, name.replace("\\", "/")] if "\\" in name else [name]
        inside = [
            self.start / spelling for spelling in spellings if self._is_inside(spelling)
        ]
        for path in inside:
            found = self._existing(path)
            if found is not None:
                return found
        for spelling in spellings:
            for path in self._elsewhere(spelling, folder):
                found = self._existing(path)
                if found is not None:
                    return found
        if inside:
            return inside[0]
        do = "put the set's files into its folder, and name them from there"
        raise DatasetError.of(
            source, "the name of a file in the set", repr(name[:80]), do
        )

    def mask(self, folders: Iterable[Path], name: str) -> Path | None:
        """The mask of an image: NAME.png, the same name, or the same stem with another
        ending.
        """
        relative = PurePosixPath(name.replace("\\", "/"))
        parts = [part for part in relative.parts if part not in ("/", "..")]
        if parts[:1] and (parts[0] == IMAGES or parts[0] in _smaller_folders(IMAGES)):
            parts = parts[1:]
        if not parts:
            return None
        whole = PurePosixPath(*parts)
        for folder in folders:
            for candidate in (whole.with_name(f"{whole.name}.png"), whole):
                found = self._existing(folder / candidate)
                if found is not None:
                    return found
        return None

    def _is_inside(self, name: str) -> bool:
        if _DRIVE.match(name):
            return False
        start = os.path.abspath(self.start)
        if os.path.isabs(name):
            relative = os.path.relpath(name, start)
        else:
            relative = os.path.normpath(name)
        out = ("..",) * (self._above + 1)
        return Path(relative).parts[: len(out)] != out

    def _elsewhere(self, name: str, folder: str) -> Iterator[Path]:
        """Where else a file may lie: in a folder of smaller images, or under the end of
        its path.
        """
        parts = [part for part in PurePosixPath(name).parts if part not in ("/", "..")]
        parts = [part for part in parts if not _DRIVE.fullmatch(part)]
        if not parts:
            return
        if self._is_inside(name) and folder in parts:
            at = parts.index(folder)
            for small in _smaller_folders(folder):
                yield self.start.joinpath(*parts[:at], small, *parts[at + 1 :])
        for count in range(1, len(parts) - 1):
            yield self.start.joinpath(*parts[count:])
        for place in (folder, *_smaller_folders(folder), ""):
            yield self.start / place / parts[-1]

    def _existing(self, path: Path) -> Path | None:
        """The file with this name, one that differs in case, or one with another ending
        of images.
        """
        try:
            if path.is_file():
                return path
        except (OSError, ValueError):  # a name that no file can have
            return None
        names = self._names(path.parent)
        wanted = path.name.lower()
        stem = wanted
        if path.suffix.lower() in SUFFIXES:
            stem = wanted[: -len(path.suffix)]
        for candidate in (
            wanted,
            *(wanted + end for end in SUFFIXES),
            *(stem + end for end in SUFFIXES),
        ):
            if candidate in names:
                return path.with_name(names[candidate][0])
        return None

    def _names(self, folder: Path) -> dict[str, list[str]]:
        """Files of a folder by their names in small letters."""
        if folder not in self._listings:
            listing: dict[str, list[str]] = {}
            try:
                with os.scandir(folder) as entries:
                    names = sorted(entry.name for entry in entries if entry.is_file())
            except OSError:
                names = []
            for name in names:
                listing.setdefault(name.lower(), []).append(name)
            self._listings[folder] = listing
        return self._listings[folder]

    def _check_lengths(self, name: str, source: str) -> None:
        parts = name.replace("\\", "/").split("/")
        longest = max(len(part.encode("utf-8", "replace")) for part in parts)
        if longest > _LONGEST_NAME or len(name) > 4 * _LONGEST_NAME:
            expected = f"the name of a file, parts up to {_LONGEST_NAME} bytes"
            raise DatasetError.of(
                source, expected, f"one of {len(name)} characters", "repair it"
            )


def _smaller_folders(name: str) -> list[str]:
    return [f"{name}_{factor}" for factor in SMALLER]


def is_smaller(path: Path) -> bool:
    """Whether an image lies in a folder of smaller images, such as images_4."""
    small = set(_smaller_folders(IMAGES))
    return any(part in small for part in path.parent.parts)


def image_folder(places: Iterable[Path]) -> Path:
    """The folder of a set's images: the first images/, else the first images_2 or so,
    of some places.
    """
    candidates = list(places)
    for name in (IMAGES, *_smaller_folders(IMAGES)):
        for place in candidates:
            if (place / name).is_dir():
                return place / name
    return candidates[0] / IMAGES


def mask_folders(images: Path) -> list[Path]:
    """Where the masks of a folder of images may lie."""
    end = images.name[len(IMAGES) :] if images.name.startswith(IMAGES) else ""
    return [images.with_name(name) for name in dict.fromkeys((f"{MASKS}{end}", MASKS))]


def unlisted_images(listed: Collection[Path]) -> int:
    """How many images lie beside those of a set, in its folder of images, and are not
    in its lists.

    Folders of other names, such as the train/ and test/ of Blender, hold depth and
    normals, too.
    """
    folders = {path.parent for path in listed}
    if len(folders) != 1 or not next(iter(folders)).name.startswith(IMAGES):
        return 0
    names = {path.name for path in listed}
    try:
        with os.scandir(folders.pop()) as entries:
            there = [entry.name for entry in entries if entry.is_file()]
    except OSError:
        return 0
    images = [name for name in there if Path(name).suffix.lower() in SUFFIXES]
    return sum(name not in names for name in images)
