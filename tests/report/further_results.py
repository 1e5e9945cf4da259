"""Results of commands that attack nothing: of detectors; made up."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mi_splat import provenance
from mi_splat.io.camera_records import describe
from mi_splat.io.documents import save_json, save_png
from tests.detectors.made import evaluated
from tests.fakes import camera


def write_detections(folder: Path, **values: Any) -> Path:
    """What `mi-splat detect` leaves behind: two pictures, two detectors."""
    folder.mkdir(parents=True)
    save_png(np.full((20, 30, 3), 120, np.uint8), folder / "photo-one.png")
    looks = [
        {
            "source": source,
            "camera": place,
            "detector": detector,
            "size": [30, 20],
            "detections": [{"label": "car", "score": 0.9, "box": [1, 2, 3, 4]}] if detector == "one" else [],
            "picture": f"{Path(source).stem}-{detector}.png",
        }
        for source, place in (("photo.png", None), ("a.ply", describe("orbit-00", camera())))
        for detector in ("one", "two")
    ]
    found = {
        "story": "detect",
        "min_confidence": 0.3,
        "view": {"cameras": ["orbit:1@0"], "size": [30, 20]},
        "pictures": looks,
    }
    prints = {"fingerprints": {"one": "0123", "two": "4567"}}
    save_json({**found, **prints, **provenance.origin(), **values}, folder / "result.json")
    return folder


def write_evaluated(folder: Path, *names: str) -> Path:
    """What `mi-splat evaluate-detector` leaves behind, by the library's own code on made-up detections."""
    folder.mkdir(parents=True)
    record, looked = evaluated(*names)
    save_json({**record, "data": "out/data", **provenance.origin()}, folder / "result.json")
    looked.write(folder)
    return folder


FURTHER: dict[str, Callable[[Path], Path]] = {
    "detect": write_detections,
    "evaluate-detector": write_evaluated,
}
"""By command, in the order of `attacks.report.results.STORIES`."""
