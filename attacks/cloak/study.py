"""A whole study: what is checked before it starts, what it will take, and what it
leaves behind.
"""

import json
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import torch
from numpy.typing import NDArray
from torch import Tensor

from attacks.cloak.config import StudyConfig, check_once, fit_config, knowledge_for
from attacks.cloak.figures import figures
from attacks.cloak.kinds.seen import loaded, path_cameras
from attacks.cloak.poisoning import assign
from attacks.cloak.setup import SET, Setup
from attacks.cloak.steps import CLOAKED, Look, StudySteps
from attacks.cloak.tables import tables as summary_tables
from attacks.detectors.base import Detector
from attacks.figures.frame import write_figures
from attacks.figures.tables import sections
from attacks.observe.drawing import annotated
from attacks.observe.rows import CLEAN, SUFFIX, TABLES, by_camera, write_rows
from attacks.observe.views import CAMERAS, cameras_document
from attacks.poisons.base import MANIFEST
from mi_splat import provenance
from mi_splat.cameras.directions import direction_of
from mi_splat.datasets import load_dataset
from mi_splat.errors import InvalidValueError
from mi_splat.fields import check_choice
from mi_splat.io import load_splat
from mi_splat.io.camera_records import describe
from mi_splat.io.documents import save_json, save_png, save_text
from mi_splat.io.images import through_png
from mi_splat.ledger import Done
from mi_splat.scene import GaussianScene, scene_hash
from mi_splat.training.resume import SPLAT

STUDY_FILE = "study.toml"
SUMMARY = "result.json"
TABLE = "table.md"
POISON = "poison.json"


def write_report(
    steps: StudySteps,
    done: Mapping[str, Done],
    detectors: Sequence[Detector],
    folder: Path,
) -> dict[str, Any]:
    """Write rows, clean.ply and cloaked.ply of the first seed, images, cameras,
    tables, and result.json last.
    """
    first = steps.study.seeds[0]
    entry, tables = observed(steps, done, detectors)
    files = {
        name: done[steps.splat(name, first).identity].folder / SPLAT
        for name in (CLEAN, CLOAKED)
    }
    for name, file in files.items():
        shutil.copyfile(file, folder / f"{name}.ply")
    shutil.copyfile(
        done[steps.poisoned(first).identity].folder / MANIFEST, folder / POISON
    )
    written = [
        write_rows(by_camera(table), folder / f"{name}{SUFFIX}").name
        for name, table in tables.items()
    ]
    counted = figures(steps.study, tables, entry["splats"])
    written.append(write_figures(counted, folder).name)
    shown = {name: load_splat(file) for name, file in files.items()}
    jobs = {CLEAN: steps.pictures(), "poisoned": steps.poisoned(first)}
    sets = {name: done[job.identity].folder / SET for name, job in jobs.items()}
    save_png(contact_sheet(steps, shown, detectors[0]), folder / CONTACT)
    save_png(poisoned_sheet(steps, sets, detectors[0]), folder / POISONED_PICTURES)
    save_json(_cameras(steps.setup), folder / CAMERAS, indent=0)
    splats = [f"{name}.ply" for name in files]
    pictures = [CONTACT, POISONED_PICTURES]
    summary = {
        "story": "cloak",
        **entry,
        "files": [*splats, POISON, CAMERAS, STUDY_FILE, *written, *pictures, TABLE],
        **provenance.origin(),
    }
    save_text(sections(summary_tables(counted)), folder / TABLE)
    save_text(study_toml(asdict(steps.study)), folder / STUDY_FILE)
    save_json(summary, folder / SUMMARY)
    return summary


def _cameras(setup: Setup) -> dict[str, Any]:
    """cameras.json: the cameras of the rows, and where the object is in their
    images.
    """
    entries = []
    for view, camera in enumerate(setup.held_out_cameras):
        box = setup.box(camera)
        entries.append(
            {
                **describe(str(view), camera),
                "box": None if box is None else box.tolist(),
            }
        )
    return cameras_document(
        entries, background=list(setup.scene.background), near=setup.near
    )


# Images of a study


CONTACT = "contact.png"
POISONED_PICTURES = "poisoned.png"
"""Both splats from many sides; poisoned training images below their clean ones."""

_LOW = 15
_CELL = 256
_FRAMES = 12
"""Elevation of the cameras of a contact sheet that go around, degrees; pixels of an
image, and images in a row.
"""
_AZIMUTHS = (0, 45, 90, 120, 135, 150, 165, 180, 195, 210, 270, 315)


def contact_sheet(
    steps: StudySteps, splats: Mapping[str, GaussianScene], detector: Detector
) -> NDArray[np.uint8]:
    """Clean above cloaked, along the path over the object and then around it, with what
    the detector reports.
    """
    study = steps.study
    setup = steps.setup
    rows = list[NDArray[np.uint8]]()
    render = setup.renderer()
    path = path_cameras(setup)
    frames = [
        path[index]
        for index in np.linspace(0, len(path) - 1, _FRAMES).round().astype(int)
    ]
    rising = [
        (f"{direction_of(one, setup.centre).elevation:.0f} deg up", one)
        for one in frames
    ]
    around = [
        (f"azimuth {azimuth}", setup.camera(azimuth, _LOW)) for azimuth in _AZIMUTHS
    ]
    for cameras in (rising, around):
        for which, scene in splats.items():
            with torch.no_grad():
                pictures = [through_png(render(scene, view)) for _, view in cameras]
            rows.append(
                _row(
                    study,
                    detector,
                    pictures,
                    [f"{which}, {name}" for name, _ in cameras],
                )
            )
    return np.concatenate(rows)


def _row(
    study: StudyConfig,
    detector: Detector,
    pictures: Sequence[Tensor],
    titles: Sequence[str],
) -> NDArray[np.uint8]:
    """Images beside each other under their titles, with what a detector reports."""
    least = study.evaluation.confidence
    seen = detector.detect(torch.stack(list(pictures)))
    cells = zip(pictures, seen, titles, strict=True)
    return np.concatenate(
        [annotated(*cell, min_confidence=least, width=_CELL) for cell in cells], axis=1
    )


_POISONED = 6
"""Images of each attack in the sheet of poisoned ones."""


def poisoned_sheet(
    steps: StudySteps, folders: Mapping[str, Path], detector: Detector
) -> NDArray[np.uint8]:
    """Training images of each attack, evenly from the lowest to the highest: clean
    above poisoned, with reports.
    """
    study, first = steps.study, steps.study.seeds[0]
    sets = {
        name: load_dataset(folder, split="train", background=study.scene.background)
        for name, folder in folders.items()
    }
    cameras = steps.setup.training_cameras
    owners = steps.setup.owners(first)
    rows = list[NDArray[np.uint8]]()
    for attack in study.attack:
        held = (
            (direction_of(cameras[view], study.centre).elevation, view)
            for view in owners
        )
        mine = sorted(
            (height, view) for height, view in held if owners[view] == attack.name
        )
        chosen = [
            mine[index]
            for index in np.linspace(0, len(mine) - 1, _POISONED).round().astype(int)
        ]
        for name, views in sets.items():
            titles = [
                f"{name}, {attack.name}, {height:.0f} deg" for height, _ in chosen
            ]
            rows.append(
                _row(study, detector, [views[view].image for _, view in chosen], titles)
            )
    return np.concatenate(rows)


def study_toml(snapshot: Mapping[str, Any]) -> str:
    """The file of a study; settings without a value are left out, which stands for
    None.
    """
    return "\n".join([*_lines(snapshot, ""), ""]).lstrip("\n")


def _lines(table: Mapping[str, Any], name: str) -> Iterator[str]:
    """A table: its own keys, then the tables within it."""
    inner = {key: value for key, value in table.items() if _is_table(value)}
    for key, value in table.items():
        if key not in inner and value is not None:
            yield f"{key} = {_inline(value)}"
    for key, value in inner.items():
        within = f"{name}{key}"
        for entry in value if isinstance(value, (list, tuple)) else [value]:
            yield from (
                "",
                f"[[{within}]]" if isinstance(value, (list, tuple)) else f"[{within}]",
            )
            yield from _lines(entry, f"{within}.")


def _is_table(value: Any) -> bool:
    first = value[0] if isinstance(value, (list, tuple)) and value else value
    return isinstance(first, Mapping)


def _inline(value: Any) -> str:
    """A value on one line; TOML writes texts, numbers and truths as JSON does."""
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_inline, value))}]"
    return json.dumps(value, ensure_ascii=False)


def check_study(steps: StudySteps, detectors: Sequence[Detector]) -> None:
    """Refuse a study that cannot be done."""
    study = steps.study
    setup = steps.setup
    check_once(
        "names of attacks",
        tuple(attack.name for attack in study.attack),
        "add [[attack]]",
    )
    for seed in study.seeds:
        assign(setup.training_cameras, setup.poisonings(seed=seed), centre=study.centre)
    _ = setup.held_out_cameras
    points = study.cameras.points + study.training.outliers
    most = study.training.max_gaussians
    if (
        most is not None
        and fit_config(study.training).strategy.adds_gaussians
        and points > most
    ):
        expected = f"at least {points:,}, for cameras.points and training.outliers"
        raise InvalidValueError.of(
            "training.max_gaussians",
            expected,
            f"{most:,}",
            "raise it, or ask for fewer",
        )
    wide = [attack for attack in study.attack if attack.poison_margin > 0]
    # from the margin's cameras its file is to show the benign look
    if wide and study.layers is not None:
        expected = "0 in a study of layers"
        do = "move the edge by `shift` under [layers] making"
        raise InvalidValueError.of(
            f"attack {wide[0].name!r}, poison_margin",
            expected,
            wide[0].poison_margin,
            do,
        )
    for detector in detectors:
        check_choice(
            f"class for {detector.name}", study.scene.class_name, detector.classes
        )
    every = sorted({label for detector in detectors for label in detector.classes})
    for attack in study.attack:
        # who has no such class has no figure of it
        if attack.target_class is not None and every:
            check_choice(
                f"target_class of attack {attack.name!r}, for its detectors",
                attack.target_class,
                every,
            )


def detectors_of(study: StudyConfig, weights: Mapping[str, Path]) -> list[Detector]:
    """The detectors that a study names, in its order."""
    return [loaded(name, weights.get(name)) for name in study.evaluation.detectors]


def observed(
    steps: StudySteps,
    done: Mapping[str, Done],
    detectors: Sequence[Detector],
    looks: Iterable[Look] = (),
) -> tuple[dict[str, Any], dict[str, pl.DataFrame]]:
    """What is seen of the splats of a study, as JSON can hold it, and its tables; of
    jobs that are done.
    """
    parts: dict[str, list[pl.DataFrame]] = {name: [] for name in TABLES}
    for look in (*steps.looked(detectors), *looks):
        for name, table in look.tables(done[look.job.identity]).items():
            parts[name].append(table)
    whole = {name: pl.concat(tables, how="diagonal") for name, tables in parts.items()}
    study = steps.study
    records = [
        _record(name, seed, done[steps.splat(name, seed).identity])
        for name, seed in steps.names()
    ]
    entry = {
        "splats": records,
        "detectors": {detector.name: detector.fingerprint for detector in detectors},
        "seeds": list(study.seeds),
        "study": asdict(study),
        "knowledge": {
            attack.name: knowledge_for(attack.appearance) for attack in study.attack
        },
    }
    return entry, whole


def _record(splat: str, seed: int, done: Done) -> dict[str, Any]:
    """What results say of a splat; `commit` is of the checkout that made it, which may
    be older.
    """
    scene = load_splat(done.folder / SPLAT)
    return {
        **{"splat": splat, "seed": seed, "content": done.content_of(SPLAT)},
        **{
            "gaussians": len(scene),
            "hash": scene_hash(scene),
            "commit": done.record["commit"],
        },
    }
