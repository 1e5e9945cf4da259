"""`mi-splat detectors`: the detectors, their classes, and whether their weights are on this machine.

Neither torch nor a detector's own library is imported for it.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from attacks.cli.options import DetectorsOptions
from attacks.detectors.errors import DetectorError
from attacks.detectors.registry import DETECTORS
from mi_splat.cli.console import show, show_json

SHOWN = 8


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
    """List the detectors."""
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
