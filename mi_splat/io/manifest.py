"""manifest.json: the SHA-256 and the length of every file of a result, so that nobody changes one unseen.

The SHA-256 of manifest.json itself stands for the whole result: whoever knows it knows every byte.
"""

import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mi_splat.errors import InvalidValueError
from mi_splat.io.atomic import is_temporary
from mi_splat.io.documents import save_json, sha256
from mi_splat.io.parsing import DocumentReader

MANIFEST = "manifest.json"
_PART = r"(?!\.)[^/\\:\x00-\x1f]{1,200}"
_NAME = re.compile(rf"(?:{_PART}/){{0,5}}{_PART}")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_DO = "get the result again"


@dataclass(frozen=True, slots=True, kw_only=True)
class Manifest:
    """What manifest.json says."""

    sha256: str  # of manifest.json, hexadecimal: what the result is called by
    files: Mapping[str, tuple[str, int]]  # by the name of each file its SHA-256 and its length in bytes
    without: tuple[str, ...] = ()  # names of folders beside it that are no part of the result


def write_manifest(folder: Path, *, without: Collection[str] = ()) -> str:
    """Write manifest.json of all files in a folder of results."""
    files = {name: {"sha256": sha256(path), "bytes": path.stat().st_size} for name, path in files_in(folder, without)}
    save_json({"without": sorted(without), "files": files}, folder / MANIFEST)
    return sha256(folder / MANIFEST)


def files_in(folder: Path, without: Collection[str] = ()) -> Iterator[tuple[str, Path]]:
    """Name and path of every file in a folder of results but manifest.json, in the order of the names."""
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        left_out = name == MANIFEST or is_temporary(path.name) or name.split("/")[0] in without
        if not left_out and (path.is_symlink() or not path.is_dir()):
            yield name, path


def read_manifest(folder: Path) -> Manifest:
    """What manifest.json in a folder says."""
    path = folder / MANIFEST
    values = DocumentReader(do=_DO).read_json(path)
    files, without = values.get("files"), values.get("without")
    if not (isinstance(files, dict) and isinstance(without, list)):
        raise InvalidValueError.of(str(path), "files, and folders without", "something else", _DO)
    return Manifest(
        sha256=sha256(path),
        files={name: _entry(name, entry, path) for name, entry in files.items()},
        without=tuple(map(str, without)),
    )


def _entry(name: str, entry: Any, path: Path) -> tuple[str, int]:
    """What stands under the name of a file, which leads nowhere but into the folder."""
    if not _NAME.fullmatch(name):
        raise InvalidValueError.of(str(path), "names of files in its folder", name[:80], _DO)
    digest, length = (entry.get(key) if isinstance(entry, dict) else None for key in ("sha256", "bytes"))
    if not (isinstance(digest, str) and _SHA256.fullmatch(digest) and type(length) is int and length >= 0):
        raise InvalidValueError.of(str(path), f"sha256 and bytes of {name}", repr(entry)[:80], _DO)
    return digest, length
