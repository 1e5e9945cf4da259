"""A folder of every kind of result that a page can show, written by the library's own
code or copied from docs.
"""

import json
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch

from attacks.bench.row import figures as bench_figures
from attacks.cli import main
from attacks.dagger.attack import attack
from attacks.dagger.config import DaggerConfig
from attacks.dagger.report import write_report
from attacks.figures.frame import (
    MEASURE,
    Figures,
    key_of,
    read_figures,
    write_figures,
)
from attacks.figures.rate import Rate
from attacks.objectives.relabel import relabel
from attacks.observe.conditions import OWN
from attacks.observe.rows import frame_of, write_rows
from mi_splat import provenance
from mi_splat.audit.files import write as write_files
from mi_splat.audit.image_files import document_of_images, image_names
from mi_splat.audit.image_files import write_image_audit as write_images
from mi_splat.audit.image_splits import Split
from mi_splat.audit.images import ImageAudit
from mi_splat.datasets import load_dataset
from mi_splat.io import save_splat
from mi_splat.io.documents import save_json, save_png
from mi_splat.io.folders import write_manifest
from tests.audit.accounts import account, cone
from tests.dagger.toy import quick
from tests.datasets.sets import VIEWS, write_transforms
from tests.fakes import CoarseDetector, ColourDetector, blobs, camera, toy_scene
from tests.project.documented_commands import ROOT

ARTIFACTS = ROOT / "docs" / "artifacts"
FAILED = "cloak_car_layers_shadow"
TWO_SEEDS = "cloak_car_layers_ground"
"""Studies of CLOAK: one seed, not stealthy, and its stop sign is never reported; two
seeds.
"""
_VIEW = ("--distance", "3", "--size", "24", "--background", "white", "--force")


class BlindDetector(CoarseDetector):
    """Reports nothing."""

    min_confidence = 2.0


def change(path: Path, **values: Any) -> None:
    """Give keys of a JSON other values."""
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))


def write_dagger(
    folder: Path, *, views: int = 1, noise_draws: int = 5, **origin: Any
) -> Path:
    """What an attack on a toy scene leaves behind, as if the command had written it."""
    scene, mask = toy_scene()
    cameras = [camera(offset=0.4 * i) for i in range(views)]
    config = DaggerConfig(eps=(12.0,), noise_draws=noise_draws)
    write_report(
        attack(
            scene,
            mask,
            cameras,
            ColourDetector(),
            relabel("person"),
            render=blobs,
            config=config,
        ),
        folder,
    )
    change(
        folder / "result.json",
        **{"scene": "toy.xml", "selection": {"object": "thing"}, **origin},
    )
    write_manifest(folder)
    return folder


def write_eot(folder: Path) -> Path:
    write_report(quick(), folder)
    change(
        folder / "result.json",
        scene="toy.xml",
        selection={"object": "thing"},
        cameras=["front"],
    )
    return folder


def cloak_record(name: str = FAILED) -> dict[str, Any]:
    """What result.json of a study of CLOAK holds."""
    record: dict[str, Any] = json.loads((ARTIFACTS / name / "result.json").read_text())
    return {**record, **provenance.origin()}


def write_shipped(file: str, folder: Path, most: int | None = None) -> Path:
    """A result of docs as if it had just been written, without its rows and with so
    many entries of each list.
    """
    folder.mkdir()
    shipped = ARTIFACTS / file
    record = json.loads((shipped / "result.json").read_text())
    record = {
        key: value[:most] if isinstance(value, list) else value
        for key, value in record.items()
    }
    save_json({**record, **provenance.origin()}, folder / "result.json")
    write_figures(read_figures(shipped), folder)
    return folder


def write_cloak(folder: Path, name: str = FAILED, **changed: Rate | None) -> Path:
    """A study of CLOAK without its rows, an image, and with some rates changed."""
    folder.mkdir(parents=True)
    save_png(np.full((20, 60, 3), 120, np.uint8), folder / "contact.png")
    record = {**cloak_record(name), "files": ["contact.png"]}
    save_json(record, folder / "result.json")
    figures = dict(read_figures(ARTIFACTS / name))
    for measure, rate in changed.items():
        key = key_of({MEASURE: measure})
        figures.pop(key, None)
        if rate is not None:
            figures[key] = rate
    write_figures(Figures(figures), folder)
    return folder


def write_cloak_study(folder: Path) -> Path:
    folder.mkdir(parents=True)
    points = {}
    figures = []
    for value, name in (("shadow", FAILED), ("ground", TWO_SEEDS)):
        labels = {"part": "layers", "value": value}
        points[f"layers: {value}"] = {**labels, **cloak_record(name)}
        shipped = read_figures(ARTIFACTS / name)
        figures.append(shipped.labelled(part="layers", setting=value))
    record = {
        "story": "cloak-study",
        "study": "cloak",
        "name": "tiny",
        "question": "",
        "points": points,
    }
    save_json({**record, **provenance.origin()}, folder / "result.json")
    write_figures(Figures.together(figures), folder)
    return folder


def _write_by_command(folder: Path, *words: str | Path) -> Path:
    """What a command leaves behind that a detector of colours and one that is blind
    take part in.
    """
    detectors = [ColourDetector(), BlindDetector()]
    with patch("attacks.cli.options.load_detectors", lambda *_: detectors):
        assert main([*map(str, words), "--out", str(folder)]) == 0
    return folder


def _toy_file(folder: Path, name: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    save_splat(toy_scene()[0], folder / name)
    return folder / name


def write_evaluation(folder: Path) -> Path:
    clean = _toy_file(folder.parent / "splats", "clean.ply")
    attacked = clean.with_name("attacked.ply")
    if not attacked.is_file():
        shutil.copyfile(
            write_dagger(folder.parent / "attack of it") / "attacked.ply", attacked
        )
    aim = ("--target", "person", "--cameras", "orbit:12@0")
    return _write_by_command(folder, "evaluate", clean, attacked, *aim, *_VIEW)


def write_audit(folder: Path) -> Path:
    """One cone that contradicts the rest, one that differs, and a number that is
    none.
    """
    scene = toy_scene()[0]
    write_files(
        account(cone("contradicted", gain=0.7), cone("differs"), count=len(scene)),
        scene,
        folder,
        source="toy.ply",
    )
    finding = {
        "rule": "not-finite",
        "severity": "error",
        "reason": "Nothing shows",
        "rows": [3],
        "count": 1,
    }
    change(folder / "result.json", lint=[finding])
    write_manifest(folder)
    return folder


def write_image_audit(folder: Path) -> Path:
    """Two groups of three images, one of which belongs to neither."""
    images = folder.with_name(f"{folder.name}-set")
    write_transforms(images, VIEWS)
    views = load_dataset(images, split=None)
    decided = torch.tensor([True, True, False, True, True, True])
    split = Split(
        smaller=torch.tensor([True, True, False, False, False, False]),
        decided=decided,
        scores=torch.linspace(0.6, -0.6, 6),
        step=0.9,
        spread=0.1,
        gain=0.05,
        edge=3.0,
        difference=0.1,
        pair=(0, 5),
    )
    audit = ImageAudit(count=6, points=1234, split=split)
    write_images(
        audit,
        views,
        folder,
        account=document_of_images(audit, image_names(views)),
        source="set",
    )
    return folder


def write_bench(folder: Path) -> Path:
    """A row of a suite of which one column is filled: half of twelve views hold."""
    folder.mkdir()
    suite = {"name": "tiny", "digest": "0" * 32}
    rows: list[dict[str, Any]] = [
        {
            "attack": f"camera {view}",
            "seed": 0,
            "splat": splat,
            "view": 0,
            "azimuth": 30.0 * view,
            "elevation": 10.0,
        }
        | {
            "original": "car",
            "score": score,
            "original_score": score,
            "detector": "fake_colour",
            "condition": OWN,
        }
        for view in range(12)
        for splat, score in (
            ("clean", 0.9),
            ("attacked", 0.1 if view % 2 else 0.9),
            ("noise", 0.9),
        )
    ]
    attacks = {
        row["attack"]: {
            "column": "one_view",
            "labels": {"view": row["attack"]},
            "knows": False,
        }
        for row in rows
    }
    record: dict[str, Any] = {
        "attacks": attacks,
        "suite": suite,
        "defence": "",
        "missing": {},
    }
    record |= {
        "detector": {"name": "fake_colour"},
        "cpu_seconds": {"all": 1.0},
        **provenance.origin(),
    }
    table = frame_of(rows)
    save_json({"story": "bench", **record}, folder / "result.json")
    write_figures(bench_figures(record, {"rows": table}), folder)
    write_rows(table, folder / "rows.csv.xz")
    write_manifest(folder)
    return folder


MAKERS: dict[str, Callable[[Path], Path]] = {
    "study": partial(write_shipped, "dagger_eot_pairs"),
    "dagger": write_dagger,
    "dagger-eot": write_eot,
    "cloak": write_cloak,
    "cloak-study": write_cloak_study,
    "audit": write_audit,
    "image-audit": write_image_audit,
    "bench": write_bench,
    "poison-study": partial(write_shipped, "m_ifgsm_sparse", most=30),
    "evaluate": write_evaluation,
}
"""By the command that writes it."""
