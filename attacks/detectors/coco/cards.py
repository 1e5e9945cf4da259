"""The card of a detector that was got: its origin, its licences, and the hashes that tell that it is whole."""

from __future__ import annotations

from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from attacks.detectors.classes import COCO_CLASSES
from attacks.detectors.coco.sources import CARD, GRAPH, WEIGHTS, PublishedDetector, folder_of
from attacks.detectors.errors import DetectorError
from mi_splat.io.documents import sha256
from mi_splat.io.fields import Fields
from mi_splat.io.parsing import DocumentReader

_CARD = DocumentReader(
    expected="the card of a detector", do="get the detector again: mi-splat detectors --get", error=DetectorError
)


def card(detector: PublishedDetector, folder: Path, origin: str) -> dict[str, Any]:
    """What is known of a detector, as JSON can hold it.

    Args:
        detector: Which.
        folder: Where its weights and its graph have been written.
        origin: What it was taken from.
    """
    return {
        "detector": detector.name,
        "architecture": detector.architecture,
        "parameters_millions": detector.parameters,
        "input_size": list(detector.input_size),
        "classes": list(COCO_CLASSES),
        "coco_map_percent": detector.coco_map,
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


def page(card: dict[str, Any]) -> str:
    """A card as a page."""
    height, width = card["input_size"]
    rows = [
        ("network", f"{card['architecture']}, {card['parameters_millions']:g} million parameters"),
        ("input", f"{height} x {width} pixels"),
        ("classes", f"the {len(card['classes'])} of COCO"),
        ("mAP on COCO, as published", f"{card['coco_map_percent']:g} %; not measured here"),
        ("package", f"{card['package']} {card['version']}, taken from {card['taken_from']} on {card['date']}"),
        ("licence that the package states", card["package_licence"]),
        ("trained by", card["source"]),
        ("licence that this source states", card["source_licence"]),
        *((f"sha256 of {name}", f"`{value}`") for name, value in card["sha256_published"].items()),
        *((f"sha256 of {name}, made of them", f"`{value}`") for name, value in card["sha256"].items()),
    ]
    lines = [f"# {card['detector']}", "", "Trained on COCO by others; no part of mi-splat. What it may be used for is"]
    lines += [
        "between you and its authors.",
        "",
        "| | |",
        "|---|---|",
        *(f"| {name} | {value} |" for name, value in rows),
    ]
    return "\n".join(lines) + "\n"


def flaw(detector: PublishedDetector) -> str:
    """What is wrong with a detector's folder; empty if it is there and whole."""
    try:
        check_files(detector, folder_of(detector.name))
    except DetectorError as error:
        return str(error)
    return ""


def check_files(detector: PublishedDetector, folder: Path) -> None:
    """Raise unless the files of a detector are those of its card, and the card is of this version.

    Args:
        detector: Which.
        folder: Where its weights, its graph and its card are.

    Raises:
        DetectorError: A file is missing, broken or another one.
    """
    card = Fields(_CARD.read_json(folder / CARD), str(folder / CARD), DetectorError, _CARD.do)
    published = {file.member: file.sha256 for file in detector.files}
    if dict(card.object("sha256_published").values) != published:
        raise _CARD.broken(str(folder / CARD), "that of another version", f"the card of {detector.spec}")
    written = card.object("sha256")
    for name in (WEIGHTS, GRAPH):
        try:
            found = sha256(folder / name)
        except OSError as error:
            expected = "a file that can be read"
            raise _CARD.broken(str(folder / name), error.strerror or str(error), expected) from error
        if found != written.text(name):
            raise _CARD.broken(str(folder / name), found, f"sha256 {written.text(name):.80}, as its card says")
