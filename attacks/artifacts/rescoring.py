"""Scoring the splats of an artifact again: needs the splats, the cameras and a detector, and nothing else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import polars as pl

from attacks.artifacts.checking import Checked
from attacks.artifacts.cloak import splat_file
from attacks.artifacts.cloak_rows import study_rows
from attacks.artifacts.contents import CAMERAS, read_object
from attacks.artifacts.figures import Line, moved
from attacks.artifacts.kinds import known_kind
from attacks.artifacts.looking import RATE_TOLERANCE
from attacks.artifacts.packed import OnView
from attacks.artifacts.places import checked_splat, places_of
from attacks.artifacts.rescoring_attacks import rescore_attack
from attacks.artifacts.study_results import study_of
from attacks.cloak.observations import frame, score_cells, scored
from attacks.cloak.rates import ROWS, Rates, rates
from attacks.detectors.base import Detector
from mi_splat.errors import InvalidValueError, message
from mi_splat.scene import GaussianScene


def rescore(
    checked: Checked,
    detectors: Sequence[Detector],
    *,
    splats: Path | None = None,
    every: int = 1,
    rate_tolerance: float = RATE_TOLERANCE,
    on_view: OnView = lambda done, total: None,
) -> list[Line]:
    """Render the splats of an artifact, let detectors look, and say how every rate moved.

    Args:
        checked: The artifact.
        detectors: Those of the artifact or others.
        splats: Folder with the splats; None takes those in the artifact.
        every: Looks from each so manieth camera; the rates of the rows are then those of the same cameras.
        rate_tolerance: How far a rate may move.
        on_view: Told of the progress.

    Returns:
        A line for each detector and rate; grey for a detector that the artifact does not have.

    Raises:
        InvalidValueError: A splat is not there or another one, cameras.json is missing or broken, or the artifact is
            one of many attacks.
    """
    kind = known_kind(checked.contents.kind, checked.found.folder)
    if not kind.rescored:
        do = "pack one of its attacks, from its folder in results/, and score that again"
        got = f"a study of {checked.contents.kind}"
        raise InvalidValueError(message(str(checked.found.folder), "one attack, or a study of CLOAK", got, do))
    outcomes = kind.outcomes
    if outcomes is not None:
        return rescore_attack(
            checked,
            outcomes(checked.contents),
            detectors,
            splats=splats,
            every=every,
            rate_tolerance=rate_tolerance,
            on_view=on_view,
        )
    study = study_of(checked.contents.configuration, "configuration")
    before = study_rows(study, checked.contents.splats, checked.contents.tables).rows
    file = checked.found.folder / CAMERAS
    places, scenes = places_of(read_object(file), str(file)), _scenes(checked, splats)
    views = before["view"].unique().sort().to_list()
    if len(views) > len(places.cameras) or views[-1:] != [len(places.cameras) - 1]:
        do = "get the artifact again"
        raise InvalidValueError(message(str(file), "the cameras of the rows", f"{len(places.cameras)} cameras", do))
    chosen, done, after = views[::every], 0, list[dict[str, Any]]()
    total = len(chosen) * len(detectors) * len(scenes)
    where = {row["view"]: row for row in before.iter_rows(named=True)}
    for entry, scene in zip(checked.contents.splats, scenes, strict=True):
        for one in places.look(scene, detectors, chosen):
            whose = {"splat": entry["splat"], "seed": entry["seed"], "detector": one.detector}
            after.append({**where[one.view], **whose, **score_cells(scored(study, one.confidence))})
            on_view(done := done + 1, total)
    old = rates(study, before.filter(pl.col("view").is_in(chosen)), ("detector",))
    new = rates(study, frame(after), ("detector",))
    return [
        line for one in detectors for line in _moved(old.get((one.name,)), new[one.name,], one, checked, rate_tolerance)
    ]


def _moved(old: Rates | None, new: Rates, detector: Detector, checked: Checked, tolerance: float) -> list[Line]:
    """A line for each rate of one detector."""
    known = checked.contents.detectors.get(detector.name)
    other_weights = known != detector.fingerprint
    return [
        moved(
            f"{detector.name}, {words}",
            None if old is None or known is None else old[name],
            now,
            tolerance=tolerance,
            other_weights=other_weights,
        )
        for name, words in ROWS.items()
        if (now := new[name]) is not None
    ]


def _scenes(checked: Checked, splats: Path | None) -> list[GaussianScene]:
    """The splats of an artifact, each known by its hash."""
    first = min(int(entry["seed"]) for entry in checked.contents.splats)
    found = []
    for entry in checked.contents.splats:
        path = _splat_path(checked.found.folder, splats, entry, is_first=entry["seed"] == first)
        found.append(checked_splat(path, entry))
    return found


def _splat_path(folder: Path, splats: Path | None, entry: Mapping[str, Any], *, is_first: bool) -> Path:
    """The file of a splat: in the artifact, or by the same name or that of a study's results in another folder."""
    name = Path(splat_file(entry)).name
    places = [folder / splat_file(entry)] if splats is None else [splats / name]
    if splats is not None and is_first:
        places.append(splats / f"{entry['splat']}.ply")
    path = next((place for place in places if place.is_file()), None)
    if path is None:
        do = "pass the folder with the splats"
        raise InvalidValueError(message(str(places[0]), "a splat of the artifact", "none", do)).hinted("--splats")
    return path
