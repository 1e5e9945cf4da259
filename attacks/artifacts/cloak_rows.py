"""Observations of a study of CLOAK as rows of three tables, and what the tables of an artifact say was observed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import polars as pl

from attacks.artifacts.detection_rows import DETECTION, OBJECT
from attacks.artifacts.rows import Cell, Column, Row, Table
from attacks.artifacts.study_results import trained_splat
from attacks.cloak import setup
from attacks.cloak.config import StudyConfig
from attacks.cloak.observations import (
    DEPTH,
    SCORE,
    Blend,
    Fidelity,
    Observation,
    ObservedSplat,
    StudyRows,
    classes_of,
    frame,
    gaussians_of,
    row_of,
)
from attacks.cloak.study.pipeline import CLEAN, CLOAKED
from mi_splat.assets.mesh import Asset
from mi_splat.cameras import Camera
from mi_splat.errors import InvalidValueError, message

ROWS, FIDELITY, TRANSITION, DETECTIONS = "rows", "fidelity", "transition", "detections"
"""Tables; the last is there where somebody looked at the splats again."""

_SPLAT = (
    Column(name="splat", kind="text", meaning="clean (the control) or cloaked"),
    Column(name="seed", kind="whole", meaning="of the training"),
)
_FIDELITY = (
    *_SPLAT,
    Column(name="view", kind="whole", meaning="number of the camera in cameras.json"),
    Column(name="elevation", kind="number", unit="degrees", meaning="of the camera"),
    Column(name="psnr", kind="number", unit="dB", meaning="of the whole picture against the true one"),
    Column(name="ssim", kind="number", meaning="of the whole picture against the true one"),
)
_TRANSITION = (
    *_SPLAT,
    Column(name="meridian", kind="whole", meaning="number of the meridian"),
    Column(name="elevation", kind="number", unit="degrees", meaning="of the camera"),
    Column(name="depth", kind="number", unit="degrees", meaning="inside the trigger; outside below 0"),
    Column(name="fraction", kind="number", meaning="of the way from the benign to the hidden appearance"),
    Column(name="surroundings_psnr", kind="number", unit="dB", meaning="beside the object, against the true scene"),
    Column(name="appearance_psnr", kind="number", unit="dB", meaning="on the object, against what is wanted there"),
)
_DETECTIONS = (
    *_SPLAT,
    Column(name="detector", kind="text", meaning="name of the detector"),
    Column(name="view", kind="whole", meaning="number of the camera in cameras.json"),
    *DETECTION,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldOutCamera:
    """A camera of the rows.

    Attributes:
        camera: The camera.
        distance: From the centre that directions are measured from, world units.
        box: (4,) x0, y0, x1, y1 of the object in pixels; None where it does not show.
    """

    camera: Camera
    distance: float
    box: tuple[float, ...] | None


def columns(study: StudyConfig) -> dict[str, tuple[Column, ...]]:
    """The columns of the tables of a study."""
    return {ROWS: _columns_of_rows(study), FIDELITY: _FIDELITY, TRANSITION: _TRANSITION, DETECTIONS: _DETECTIONS}


def _columns_of_rows(study: StudyConfig) -> tuple[Column, ...]:
    """Those of the table with a row for each detector and camera: where the camera is, and how sure the detector."""
    box = tuple(
        Column(
            name=name,
            kind="number",
            unit="pixels",
            meaning=f"{name} of the object's box; empty where it does not show",
            optional=True,
        )
        for name in OBJECT
    )
    depths = tuple(
        Column(
            name=f"{DEPTH}{attack.name}",
            kind="number",
            unit="degrees",
            meaning=f"of the camera inside the trigger of attack {attack.name}; outside below 0",
        )
        for attack in study.attack
    )
    scores = tuple(
        Column(
            name=f"{SCORE}{label}",
            kind="number",
            meaning=f"highest confidence of a {label} whose box has an IoU of 0.5 with the object's; 0: none",
        )
        for label in classes_of(study)
    )
    return (
        *_SPLAT,
        Column(name="detector", kind="text", meaning="name of the detector"),
        Column(name="view", kind="whole", meaning="number of the camera in cameras.json, from 0"),
        Column(name="azimuth", kind="number", unit="degrees", meaning="of the camera, from +x towards +y"),
        Column(name="elevation", kind="number", unit="degrees", meaning="of the camera above the ground"),
        Column(name="distance", kind="number", unit="world units", meaning="of the camera from the centre"),
        *box,
        *depths,
        *scores,
        Column(name="any_overlap", kind="number", meaning="the same for the object's own class and an IoU of 0.1"),
        Column(name="any_class", kind="number", meaning="the same for any class and an IoU of 0.5"),
    )


def tables_of(
    study: StudyConfig, observed: Sequence[ObservedSplat], cameras: Sequence[HeldOutCamera]
) -> dict[str, Table]:
    """Everything that was observed, as tables.

    Args:
        study: The study.
        observed: Every splat.
        cameras: Those that the observations number.
    """
    rows: dict[str, list[Row]] = {ROWS: [], FIDELITY: [], TRANSITION: []}
    for item in observed:
        whose: dict[str, Cell] = {"splat": item.trained.splat, "seed": item.trained.seed}
        rows[ROWS] += [{**whose, **_row(one, cameras[one.view])} for one in item.observations]
        rows[FIDELITY] += [{**whose, **_values(one, Fidelity)} for one in item.fidelities]
        rows[TRANSITION] += [{**whose, **_values(one, Blend)} for one in item.blends]
    known = columns(study)
    return {name: Table(columns=known[name], rows=tuple(found)) for name, found in rows.items()}


def study_rows(study: StudyConfig, splats: Sequence[Mapping[str, Any]], tables: Mapping[str, Table]) -> StudyRows:
    """What tables say was observed, as figures are counted from it.

    Args:
        study: The study.
        splats: As its summary lists them.
        tables: The tables.

    Raises:
        InvalidValueError: A row belongs to no splat of the study or is there twice, or one is missing.
    """
    trained = [trained_splat(entry) for entry in splats]
    listed = [(one.splat, one.seed) for one in trained]
    wanted = {(which, seed) for which in (CLEAN, CLOAKED) for seed in study.seeds}
    if set(listed) != wanted or len(listed) != len(wanted):
        got = ", ".join(f"{which} {seed}" for which, seed in listed)
        raise _wrong("splats", "a clean and a cloaked one for each seed", got or "none")
    for name in (ROWS, FIDELITY, TRANSITION):
        if not {(row["splat"], row["seed"]) for row in tables[name].rows} <= wanted:
            raise _wrong(f"table {name}", "rows of the study's splats", "others")
        if name == ROWS and not tables[name].rows:
            raise _wrong(f"table {name}", "rows", "none")
    rows = frame(tables[ROWS].rows)
    _check_complete(study, rows, listed)
    return StudyRows(
        rows=rows,
        fidelity=frame(tables[FIDELITY].rows, Fidelity),
        transition=frame(tables[TRANSITION].rows, Blend),
        gaussians=gaussians_of(asdict(one) for one in trained),
    )


def _check_complete(study: StudyConfig, rows: pl.DataFrame, splats: Sequence[tuple[str, int]]) -> None:
    """Raise unless every detector saw each splat from the same cameras, once from each."""
    seen = Counter(rows.select("splat", "seed", "detector", "view").iter_rows())
    views = sorted({key[3] for key in seen})
    for splat, seed in splats:
        here = {key: number for key, number in seen.items() if key[:2] == (splat, seed)}
        expected = {(splat, seed, name, view) for name in study.evaluation.detectors for view in views}
        if here.keys() != expected or any(number > 1 for number in here.values()):
            lost = sorted(expected - here.keys())
            got = f"none for {lost[0][2]}, view {lost[0][3]}" if lost else "others, or one twice"
            what = f"table {ROWS}, {splat} splat, seed {seed}"
            raise _wrong(what, "one row for each detector and camera", got)


def _row(one: Observation, place: HeldOutCamera) -> dict[str, Cell]:
    box: Sequence[float | None] = place.box or (None,) * len(OBJECT)
    return {**row_of(one), "distance": place.distance, **dict(zip(OBJECT, box, strict=True))}


def _values(one: Any, kind: type[Any]) -> dict[str, Cell]:
    return {name: getattr(one, name) for name in kind.__slots__}


def held_out(study: StudyConfig, target: Asset) -> list[HeldOutCamera]:
    """The cameras of a study, and where its object is in their pictures."""
    centre = setup.centre_of(study)
    found = []
    for camera in setup.held_out_cameras(study, target):
        box = setup.box_of(target, camera)
        distance = sum((float(a) - b) ** 2 for a, b in zip(camera.position, centre, strict=True)) ** 0.5
        corners = None if box is None else tuple(float(value) for value in box)
        found.append(HeldOutCamera(camera=camera, distance=distance, box=corners))
    return found


def _wrong(what: str, expected: str, got: str) -> InvalidValueError:
    return InvalidValueError(message(what, expected, got, "get the artifact again"))
