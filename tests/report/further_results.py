"""Results of commands that attack nothing: of detectors, and of the experiments on a study of CLOAK; made up."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from mi_splat import provenance
from mi_splat.io.camera_records import describe
from mi_splat.io.documents import save_json, save_png
from tests.detectors.made import evaluated
from tests.fakes import camera
from tests.report.results import STUDIED, rate


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


def experiment(name: str, found: Any, **given: Any) -> dict[str, Any]:
    """The document of an experiment on `STUDIED`."""
    values = {
        "study": STUDIED.name,
        "experiment": name,
        "settings": given,
        "configuration": asdict(STUDIED),
        **provenance.origin(),
        "found": found,
        "detectors": {"one": "0123"} if "detectors" in given else {},
    }
    made: dict[str, Any] = json.loads(json.dumps(values))
    return made


def write_experiment(name: str, found: Any, **given: Any) -> Callable[[Path], Path]:
    def write(place: Path) -> Path:
        path = place.with_name(f"{name}.json")
        save_json(experiment(name, found, **given), path)
        return path

    return write


DISTANCES = [
    {"splat": splat, "distance": factor, "cameras": cameras, "of": 20, "detector": "one", "found": found}
    for splat, cameras, found in (("clean", "overhead", 20), ("cloaked", "overhead", 2), ("cloaked", "elsewhere", 19))
    for factor in (0.5, 1.0)
]
FORMATS = [
    {"form": form, "cameras": cameras, "of": 20, "psnr": psnr, "detector": "one", "found": found}
    for form, psnr, inside in ((".ply", None, 1), (".splat", 21.5, 18))
    for cameras, found in (("overhead", inside), ("elsewhere", 20))
]
RENDERERS = [
    {"renderer": renderer, "splat": splat, "cameras": name, "of": 20, "psnr": psnr, "detector": "one", "found": found}
    for renderer, psnr, inside in (("tile", None, 1), ("ray", 31.5, 4))
    for splat, name, found in (("clean", "overhead", 20), ("cloaked", "overhead", inside), ("cloaked", "elsewhere", 20))
]
STREET = [
    {"hour": hour, "splat": splat, "cameras": name, "of": 10, "detector": "one", "found": found}
    for hour, inside in (("09:00", 1), ("12:00", 3))
    for splat, name, found in (("clean", "overhead", 10), ("cloaked", "overhead", inside), ("cloaked", "elsewhere", 9))
]
SURROUNDINGS = [
    {"cameras": name, "of": of, "psnr_mean": mean, "psnr_lowest": mean - 1, "psnr_highest": mean + 1}
    for name, of, mean in (("inside the trigger", 12, 31.5), ("elsewhere", 4, 34.0))
]
LIMIT = {
    "one_layer": [
        {
            "sh_degree": 3,
            "emphasis": gain,
            "from": 40.0,
            "to": 40.0 + wide,
            "width": wide,
            "lowest": -0.1,
            "highest": 1.1,
        }
        for gain, wide in ((1.0, 25.0), (3.0, 10.0))
    ],
    "two_layers": [
        {"sh_degree": 3, "lowest": low, "largest_coefficient": size, "from": 40.0, "to": 40.0 + wide, "width": wide}
        for low, size, wide in ((-1.0, 2.0, 15.0), (-10.0, 14.0, 5.0))
    ],
    "bands": [
        {"sh_degree": 3, "band": 8.0, "largest_coefficient": 50.0, "from": 40.0, "to": 43.5, "width": 3.5},
    ],
}
DIRECTIONS = [{"elevation": i, "smallest": part, "mean": 0.9} for i, part in ((1, 0.4), (15, 0.7), (30, 0.5))]
PERFECT = [
    {
        "attack": "overhead",
        "detector": "one",
        "cameras": 40,
        "control_recall": rate(40, 40),
        "trigger_miss_rate": rate(30, 30),
        "nothing_reported": rate(24, 30),
    },
    {
        "attack": "rear",
        "detector": "one",
        "cameras": 10,
        "target_rate": rate(6, 10),
        "control_target_rate": rate(0, 10),
    },
]
GIVEN = {"results": "out/study", "every": 4}


def curve_rows() -> list[dict[str, Any]]:
    """Rates by elevation and by region, of two seeds and together."""
    counts = {"path traced": (20, 19), "clean": (20, 18), "cloaked": (20, 2)}
    return [
        {
            "by": by,
            "cameras": cameras,
            "detector": "one",
            "pictures": pictures,
            "seed": seed,
            "reported": reported,
            "confidence": confidence,
            **rate(found if reported == "own" else 0, of),
        }
        for by, cameras in (
            ("elevation", "0 to 10"),
            ("elevation", "80 to 90"),
            ("azimuth", "0 to 30"),
            ("region", "overhead"),
            ("region", "outside of all triggers"),
        )
        for pictures, (of, found) in counts.items()
        for seed in (None, 0, 1)
        for reported in ("own", "target")
        for confidence in (0.3, 0.5)
    ]


def write_curve(folder: Path, **values: Any) -> Path:
    """What `mi-splat cloak-experiment detection-curve` leaves behind."""
    folder.mkdir(parents=True)
    splats = [{"splat": which, "seed": seed, "hash": "0"} for seed in (0, 1) for which in ("clean", "cloaked")]
    own = {"cameras": 48, "detectors": {"one": "0123"}, "splats": splats, "rates": curve_rows()}
    made = experiment("detection-curve", None, **GIVEN, detectors=["one"], stages="out/stages")
    del made["found"]
    save_json({**made, **own, **values}, folder / "detection-curve.json")
    return folder


FURTHER: dict[str, Callable[[Path], Path]] = {
    "detect": write_detections,
    "evaluate-detector": write_evaluated,
    "cloak-experiment detection-curve": write_curve,
    "cloak-experiment surroundings": write_experiment("surroundings", SURROUNDINGS, **GIVEN),
    "cloak-experiment distance": write_experiment("distance", DISTANCES, **GIVEN, detectors=["one"]),
    "cloak-experiment formats": write_experiment("formats", FORMATS, **GIVEN, detectors=[]),
    "cloak-experiment renderers": write_experiment("renderers", RENDERERS, **GIVEN, detectors=[]),
    "cloak-experiment street": write_experiment("street", STREET, **GIVEN, detectors=[]),
    "cloak-experiment transition-limit": write_experiment("transition-limit", LIMIT, results="out/study"),
    "cloak-experiment paint-direction": write_experiment("paint-direction", DIRECTIONS),
    "cloak-experiment perfect-splat": write_experiment("perfect-splat", PERFECT, every=1, stages="out/stages"),
}
"""By command, in the order of `attacks.report.results.STORIES`."""
