"""The card of a detector that was got: its origin, its licences, and the hashes that tell that it is whole."""

from __future__ import annotations

import json
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from attacks.detectors.classes import COCO_CLASSES
from attacks.detectors.coco.sources import CARD, GRAPH, WEIGHTS, PublishedDetector, folder_of
from mi_splat.io.documents import sha256


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
    folder = folder_of(detector.name)
    try:
        found = json.loads((folder / CARD).read_text())
        published, written = found["sha256_published"], found["sha256"]
        if published != {file.member: file.sha256 for file in detector.files}:
            return "its card is of another version"
        return next((f"{name} has changed" for name in (WEIGHTS, GRAPH) if sha256(folder / name) != written[name]), "")
    except (OSError, ValueError, KeyError, TypeError) as error:
        return f"it is not there ({type(error).__name__})"
