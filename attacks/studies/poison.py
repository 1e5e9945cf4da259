"""Studies of attacks on training pictures: what a victim pays, sees, and can do about it.

Every point takes pictures of a scene, poisons them, and trains a victim on both sets: the clean one is the control.
With a defence both are trained once more: what a defence costs on clean pictures may be more than it saves.

    study = "poison"
    cameras = { size = 128 }
    training = { iterations = 30000, max_gaussians = "none" }
    poison = { kind = "poison-splat", steps = 12000 }
    detectors = ["fasterrcnn_small"]

    [matrix]
    seed = [0, 1, 2]
    "poison.eps" = [8, 16, 24]

    [[case]]
    name = "blur"
    defence = { filter = { name = "blur" } }

Every key is an attribute of `attacks.studies.poison_jobs.PoisonPoint`.
"""

from __future__ import annotations

import math
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from attacks.cloak.kinds.seen import SeenConfig
from attacks.cloak.kinds.trained import COST
from attacks.cloak.steps import Look
from attacks.observe.look import camera_cells
from attacks.observe.rates import reported
from attacks.observe.rows import DETECTIONS, FIDELITY, ROWS, by_camera, frame_of
from attacks.poisons.measured import CENTRES, COUNT, SPEED
from attacks.poisons.poisoned import SHEET
from attacks.studies.plan import Work, write_study
from attacks.studies.poison_figures import figures, summary_tables
from attacks.studies.poison_jobs import CLASSIFIED, DEFENDED, PoisonAttempt, TrainedVictim, attempt_of
from attacks.studies.study_file import Study
from attacks.tables import sections
from mi_splat import provenance
from mi_splat.cameras import Camera
from mi_splat.directions import Point, direction_of
from mi_splat.errors import InvalidValueError
from mi_splat.io.parsing import read_json
from mi_splat.ledger import Done
from mi_splat.ledger.plans import Result

STORY, PICTURES = "poison-study", "pictures"


class PoisonWork(Work):
    """The jobs of a study of attacks on training pictures.

    Raises:
        MiSplatError: A setting cannot be; before any job is done.
    """

    def __init__(self, study: Study) -> None:
        self.study = study
        if study.judges or any(point.bisected for point in study.points):
            raise InvalidValueError.of(study.name, "no judge and no bisect", "one", "leave it out")
        self.attempts: list[PoisonAttempt] = [attempt_of(point, study.name) for point in study.points]

    def write(self, results: Mapping[str, Result], out: Path) -> list[Path]:
        """As in `Work`."""
        done = {key: left for attempt in self.attempts for key, left in attempt.done(results).items()}
        victims, paths = list[dict[str, Any]](), list[Path]()
        rows: dict[str, list[dict[str, Any]]] = {FIDELITY: [], ROWS: []}
        for attempt in self.attempts:
            for victim in attempt.victims:
                if {victim.trained.identity, victim.measured.identity} <= done.keys():
                    victims.append(_told(attempt, victim, done))
                    for name, of_victim in _rows(attempt, victim, done):
                        rows[name] += of_victim
            paths += _pictures(attempt, done, out / PICTURES)
        tables = {name: by_camera(frame_of(of_table)) for name, of_table in rows.items() if of_table}
        looks = [look.job.config for attempt in self.attempts for victim in attempt.victims for look in victim.looks]
        record: dict[str, Any] = {
            "story": STORY,
            **self.study.named,
            "seeds": sorted({victim["seed"] for victim in victims}),
            "detectors": {seen.detector: seen.fingerprint for seen in looks if isinstance(seen, SeenConfig)},
            "victims": victims,
            **provenance.origin(),
        }
        record |= figures(record, tables)
        return [*paths, *write_study(self.study, record, sections(summary_tables(record)), tables, out)]


def _told(attempt: PoisonAttempt, victim: TrainedVictim, done: Mapping[str, Done]) -> dict[str, Any]:
    """What is known of a victim, its rows apart."""
    trained, measured = done[victim.trained.identity], done[victim.measured.identity]
    named = {"part": attempt.part, "value": attempt.value, "seed": attempt.options.seed, "splat": victim.splat}
    told = {**named, "defended": victim.defended, **read_json(measured.folder / COUNT)}
    return {**told, **read_json(trained.folder / COST), **read_json(measured.folder / SPEED)}


def _rows(
    attempt: PoisonAttempt, victim: TrainedVictim, done: Mapping[str, Done]
) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """How true a victim's splat is, and what classifiers take its object for; by the table that they belong to."""
    cells: dict[str, Any] = {"attack": attempt.title, "seed": attempt.options.seed, "splat": victim.splat}
    condition = DEFENDED if victim.defended else None
    yield FIDELITY, [{**cells, "condition": condition, **row} for row in done[victim.measured.identity].rows]
    for look in victim.looks:
        if look.job.identity in done:
            rows = _seen(attempt, look, done[look.job.identity])
            yield ROWS, [{**cells, "condition": look.condition, **row} for row in rows]


def _seen(attempt: PoisonAttempt, look: Look, done: Done) -> Iterable[Mapping[str, Any]]:
    """What was seen, picture by picture; a success is an object that is misread, or reported with less confidence."""
    if look.job.kind == CLASSIFIED:
        cells = [_camera_cells(camera, attempt.centre) for camera in attempt.cameras(look.condition)]
        return [{**row, **cells[row["view"]]} for row in done.rows]
    missed = ~reported("original_score", attempt.options.evaluation.confidence)
    (table,) = (table for name, table in look.tables(done).items() if name != DETECTIONS)
    return table.with_columns(success=missed).iter_rows(named=True)


def _camera_cells(camera: Camera, centre: Point) -> dict[str, Any]:
    """Where a camera is, as rows of detectors say it."""
    distance = math.dist(camera.position.tolist(), centre)
    return {**camera_cells(camera, None, direction_of(camera, centre)), "distance": distance}


def _pictures(attempt: PoisonAttempt, done: Mapping[str, Done], folder: Path) -> list[Path]:
    """Copy the pictures of a point with seed 0: what was done to the set, and where each splat has its Gaussians."""
    if attempt.options.seed != 0:
        return []
    shown = {
        f"{victim.splat}{' defended' * victim.defended} centres": (victim.measured, CENTRES)
        for victim in attempt.victims
    }
    if attempt.poisoned is not None:
        shown["poisoned"] = (attempt.poisoned, SHEET)
    paths = []
    for name, (job, file) in shown.items():
        if job.identity in done and (done[job.identity].folder / file).is_file():  # CLOAK leaves no sheet
            folder.mkdir(exist_ok=True)
            to = folder / (re.sub(r"[^0-9A-Za-z.]+", "-", f"{attempt.title} {name}") + ".png")
            paths.append(Path(shutil.copyfile(done[job.identity].folder / file, to)))
    return paths
