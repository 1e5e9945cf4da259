"""What a process does with Mitsuba first: its log goes to stderr, and its own folder is
searched for plugins first.
"""

import os
import platform
import re
import sys
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

from mi_splat.errors import MiSplatError, printable

MINIMUM_LLVM = 17

_FOLDERS = (
    "/usr/lib/*-linux-gnu",
    "/usr/lib/llvm-*/lib",
    "/usr/lib64",
    "/usr/lib64/llvm*/lib",
    "/usr/lib",
    "/usr/lib/llvm*/lib",
    "/usr/local/lib",
    "/opt/homebrew/opt/llvm*/lib",
    "/usr/local/opt/llvm*/lib",
)
_NAME = re.compile(
    r"^libLLVM(?:-(?P<dash>\d+)[\d.]*)?\.(?:so(?:\.(?P<dot>\d+)[\d.]*)?|dylib)$"
)


class LLVMError(MiSplatError):
    """No libLLVM of this machine can be used; the message says what to install."""


def llvm_hint() -> str:
    """One line that says how to install a libLLVM that Dr.Jit can use, for the systems
    we know.
    """
    return (
        f"install libLLVM >= {MINIMUM_LLVM} (Debian/Ubuntu: apt install libllvm19;"
        " Fedora: dnf install llvm-libs; Arch: pacman -S llvm-libs; macOS: brew"
        " install llvm; conda: conda install -c conda-forge libllvm19) or point"
        " DRJIT_LIBLLVM_PATH at one"
    )


def llvm_version(path: Path) -> int | None:
    """Major version of a libLLVM shared library, read off its file name, its link's
    target or its folder.
    """
    for candidate in (path, Path(os.path.realpath(path))):
        match = _NAME.match(candidate.name)
        if match and (match["dash"] or match["dot"]):
            number = int(match["dash"] or match["dot"])
            if not (match["dash"] is None and number == 1):  # libLLVM.so.1 says nothing
                return number
    folder = re.search(r"llvm(?:@|-)?(\d+)", str(Path(os.path.realpath(path)).parent))
    folder = folder or re.search(r"/llvm/(\d+)", os.path.realpath(path))
    if folder:
        return int(folder[1])
    return None


def find_llvm(folders: Iterable[Path] | None = None) -> Path | None:
    """The newest libLLVM of version 17 or later on this machine, or None."""
    if folders is None:
        folders = [
            match for pattern in _FOLDERS for match in Path("/").glob(pattern[1:])
        ]
        if "CONDA_PREFIX" in os.environ:
            folders = [*folders, Path(os.environ["CONDA_PREFIX"]) / "lib"]
    libraries: list[tuple[int, str]] = []
    for folder in folders:
        for path in folder.glob("libLLVM*"):
            version = llvm_version(path) if _NAME.match(path.name) else None
            if version is not None and version >= MINIMUM_LLVM and path.exists():
                libraries.append((version, str(path)))
    if libraries:
        return Path(max(libraries)[1])
    return None


def prepare_llvm() -> Path | None:
    """Point Dr.Jit at a usable libLLVM unless the environment already names one; call
    it before the first array.
    """
    named = os.environ.get("DRJIT_LIBLLVM_PATH")
    if named:
        path = Path(named)
        version = llvm_version(path)
        if not path.exists():
            raise LLVMError.of(
                "DRJIT_LIBLLVM_PATH",
                "a libLLVM shared library",
                f"missing {named}",
                llvm_hint(),
            )
        if version is not None and version < MINIMUM_LLVM:
            raise LLVMError.of(
                "DRJIT_LIBLLVM_PATH",
                f"LLVM >= {MINIMUM_LLVM}",
                f"LLVM {version}",
                llvm_hint(),
            )
        return path
    library = find_llvm()
    if library is not None:
        os.environ["DRJIT_LIBLLVM_PATH"] = str(library)
    elif platform.system() == "Linux":
        raise LLVMError.of(
            "libLLVM",
            f"version {MINIMUM_LLVM} or later",
            "none on this machine",
            llvm_hint(),
        )
    return library


def set_up_mitsuba() -> None:
    """Send what Mitsuba logs to stderr, and take its plugins from its own folder, not
    from the working directory.
    """
    import mitsuba as mi

    _search_own_folder_first()
    logger = mi.logger()
    for number in reversed(range(logger.appender_count())):
        appender = logger.appender(number)
        if isinstance(appender, mi.StreamAppender) and not appender.logs_to_file():
            logger.remove_appender(appender)
            logger.add_appender(_appender())


@cache
def _search_own_folder_first() -> None:
    """Mitsuba looks for `plugins/NAME.so` in the working directory otherwise, and runs
    what it finds there.
    """
    import mitsuba as mi

    mi.file_resolver().prepend(str(Path(str(mi.__file__)).parent))


@cache
def _appender() -> Any:
    """The receiver of log lines; its class needs Mitsuba."""
    import mitsuba as mi

    # Mitsuba's classes have no types for mypy
    class StderrAppender(mi.Appender):  # type: ignore[misc]
        """Writes every line of the log to stderr."""

        def append(self, level: object, text: str) -> None:
            """Write one line."""
            sys.stderr.write(f"{printable(text)}\n")

        def log_progress(self, *_: object) -> None:
            """Show no progress; the commands show their own."""

    return StderrAppender()
