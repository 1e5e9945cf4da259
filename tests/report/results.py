"""Folders of results for the tests of pages: written by the library's own code on toy scenes, or made up."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from attacks.cloak.config import AttackConfig, CameraConfig, EvaluationConfig, StudyConfig
from attacks.cloak.rates import RATES
from attacks.cloak.study import SUMMARY
from attacks.dagger.attack import attack
from attacks.dagger.config import DaggerConfig
from attacks.dagger.report import write_report
from attacks.objectives import relabel
from attacks.rate import Rate
from mi_splat import provenance
from mi_splat.io.documents import save_json, save_png
from mi_splat.io.manifest import write_manifest
from tests.fakes import ColourDetector, blobs, camera, toy_scene

STUDIED = StudyConfig(
    name="hidden_car",
    seeds=(0, 1),
    cameras=CameraConfig(train=30, size=64, distance=7.0),
    attack=(
        AttackConfig(name="overhead", elevation=(50.0, 90.0), appearance="paint", texture="road"),
        AttackConfig(name="rear", elevation=(0.0, 40.0), azimuth=(180.0, 30.0), target_class="stop sign"),
    ),
    evaluation=EvaluationConfig(detectors=("one", "two")),
)


def write_dagger(folder: Path, *, views: int = 1, noise_draws: int = 5, **origin: Any) -> Path:
    """What an attack on a toy scene leaves behind, as if the command had written it."""
    scene, mask = toy_scene()
    cameras = [camera(offset=0.4 * i) for i in range(views)]
    config = DaggerConfig(eps=(12.0,), noise_draws=noise_draws)
    found = attack(scene, mask, cameras, ColourDetector(), relabel("person"), render=blobs, config=config)
    write_report(found, folder)
    change(folder / "result.json", **{"scene": "toy.xml", "selection": {"object": "thing"}, **origin})
    write_manifest(folder)
    return folder


def change(path: Path, **values: Any) -> None:
    """Give keys of a JSON other values."""
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))


def rate(successes: int, total: int) -> dict[str, Any]:
    return Rate(successes=successes, total=total).as_dict()


def rates(missed: int, of: int = 40) -> dict[str, Any]:
    """Rates of a study, as far as they matter here."""
    found = {name: rate(missed, of) for name in RATES}
    return {**found, "control_recall": rate(of - 1, of), "target_rate": rate(0, of), "control_target_rate": rate(0, of)}


def cloak_summary(study: StudyConfig = STUDIED, missed: int = 36) -> dict[str, Any]:
    """What result.json of a study holds, made up."""
    names = study.evaluation.detectors
    by_detector = {name: rates(missed // 2, 20) for name in names}
    bands = [
        {"from": 5.0 * i, "to": 5.0 * i + 5, "clean": rate(9, 10), "cloaked": rate(0 if i > 9 else 9, 10)}
        for i in range(18)
    ]
    return {
        "story": "cloak",
        **rates(missed),
        "benign_psnr_drop": 1.0,
        "benign_psnr": {"clean": 34.0, "cloaked": 33.0},
        "benign_ssim": {"clean": 0.92, "cloaked": 0.91},
        "transition_degrees": 9.7,
        "transition": {"from": 35.0, "to": 44.7, "meridians": [9.0, None]},
        "stealth": {
            "surroundings_psnr": {"clean": 36.7, "cloaked": 32.3},
            "surroundings_psnr_drop": 4.4,
            "appearance_psnr": {"clean": 12.6, "cloaked": 27.9},
            "stealthy": False,
        },
        "gaussians": {"clean": [1000], "cloaked": [1200]},
        "gaussians_ratio": 1.2,
        "by_detector": by_detector,
        "by_seed": {str(seed): by_detector for seed in study.seeds},
        "by_attack": {
            "overhead": {name: {**rates(18, 20), "target_rate": None} for name in names},
            "rear": {name: {**rates(18, 20), "trigger_miss_rate": None} for name in names},
        },
        "by_elevation": dict.fromkeys(names, bands),
        "files": ["contact.png"],
        "splats": [],
        "detectors": dict.fromkeys(names, "0123"),
        "seeds": list(study.seeds),
        "study": json.loads(json.dumps(asdict(study))),
        **provenance.origin(),
        "seconds": 61.0,
    }


def write_cloak(folder: Path, study: StudyConfig = STUDIED, **values: Any) -> Path:
    folder.mkdir(parents=True)
    save_png(np.full((20, 60, 3), 120, np.uint8), folder / "contact.png")
    save_json({**cloak_summary(study), **values}, folder / SUMMARY)
    return folder


def write_variations(folder: Path) -> Path:
    folder.mkdir(parents=True)
    points = {
        f"sh_degree: {i}": {"part": "sh_degree", "value": str(i), **cloak_summary(missed=8 * i + 4)} for i in range(4)
    }
    record = {"story": "cloak-study", "study": "cloak", "name": "tiny", "question": "", "points": points}
    save_json({**record, **provenance.origin()}, folder / "result.json")
    return folder


def write_evaluation(folder: Path, **values: Any) -> Path:
    """What `mi-splat evaluate` leaves behind, made up."""
    folder.mkdir(parents=True)
    one = {"original": "car", "target": "person", "views": 24, "psnr": 31.5, "missed": rate(20, 23)}
    found = {"found_clean": rate(23, 24), "found_attacked": rate(4, 24)}
    aimed = {"target_clean": rate(0, 24), "target_attacked": rate(18, 24)}
    document = {
        "story": "evaluate",
        "clean": "clean.ply",
        "attacked": "out/attacked.ply",
        "selection": "the Gaussians that differ",
        "object_gaussians": 30,
        "min_confidence": 0.5,
        "fingerprints": {"fasterrcnn_small": "0123"},
        "detectors": {"fasterrcnn_small": {**one, **found, **aimed}},
        "warnings": ["1 of 24 cameras are those that were attacked"],
        "cameras": [{"name": f"camera {i}"} for i in range(24)],
        **provenance.origin(),
    }
    save_json({**document, **values}, folder / "result.json")
    return folder
