"""What loading and saving splat files may raise or warn of, and what to do about
failures of the operating system.
"""

import errno
import os

from mi_splat.errors import InvalidValueError, MiSplatError


class SplatFileError(MiSplatError):
    """A splat file cannot be read or written; the message says what was expected, what
    was found and what to do.
    """


class SplatFileWarning(UserWarning):
    """A splat file was read, but not all of it."""


class SplatLossWarning(UserWarning):
    """A splat file was written, but its format cannot hold all of the scene."""


_ADVICE = {
    errno.ENOENT: "check the path",
    errno.ENOTDIR: "check the path",
    errno.EISDIR: "name a file inside the folder",
    errno.EACCES: "change its permissions or use another path",
    errno.EPERM: "change its permissions or use another path",
    errno.EROFS: "use a path on a disk that can be written",
    errno.ENOSPC: (
        "free some space or use another disk; a file that was there before is unchanged"
    ),
    errno.EDQUOT: (
        "free some space or use another disk; a file that was there before is unchanged"
    ),
    errno.ENAMETOOLONG: "use a shorter name",
}

_PHOTOGRAPHS = (
    ".jpg",
    ".jpeg",
    ".png",
    ".webp",
    ".bmp",
    ".tif",
    ".tiff",
    ".heic",
    ".heif",
    ".avif",
)


LFS_POINTER = b"version https://git-lfs"
"""First bytes of the file that stands for a large one in a clone of Git without Git
LFS.
"""
LFS_ADVICE = (
    "a Git LFS pointer instead of the file",
    "run `git lfs pull` in the folder that it came from",
)
"""What was found in place of a file, and what to do about it."""


def path_name(value: object) -> str:
    """A path, as text or as `pathlib` has it, as text."""
    name = os.fspath(value) if isinstance(value, str | os.PathLike) else None
    if not isinstance(name, str):
        raise InvalidValueError.of(
            "path", "the name of a file", type(value).__name__, "pass a str or a Path"
        )
    return name


def from_os_error(path: str, expected: str, error: OSError) -> SplatFileError:
    """The SplatFileError for a failure that the operating system reported."""
    got = error.strerror or str(error)
    do = _ADVICE.get(error.errno or 0, "check the disk and try again")
    if error.errno == errno.EISDIR:
        return SplatFileError.of(path, expected, "a folder", folder_advice(path, do))
    return SplatFileError.of(path, expected, got, do)


def folder_advice(folder: str | os.PathLike[str], otherwise: str) -> str:
    """What to do about a folder that cannot be read as it is: photographs need cameras
    first.
    """
    if os.path.isdir(folder) and any(
        name.lower().endswith(_PHOTOGRAPHS) for name in os.listdir(folder)
    ):
        do = (
            "find the cameras of the photographs first, with `mi-splat prepare"
            f" {os.fspath(folder)} --out SET`"
        )
        return f"{do}: see docs/how-to/photographs.md"
    return otherwise
