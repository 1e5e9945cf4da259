"""The study of DAGGER: which pairs, balls, norms, cameras and attributes, and a ledger of what is done.

Every job leaves one JSON in `jobs/`, and a job whose JSON is there and belongs to the same settings, scene and detector
is not done again: an interrupted study goes on where it stopped. The tables are made from the JSONs.

Seed 0 looks from the scene's own camera and starts at the clean splat. Every other seed turns the camera about the
object by up to 6 degrees, moves it by up to 5 %, and starts at a random point of the ball. The seed also draws the
random-noise control.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar, cast

from attacks.dagger.config import DaggerConfig
from attacks.dagger.jobs import Job
from attacks.limits import NormName
from mi_splat.attributes import Attribute
from mi_splat.errors import InvalidValueError
from mi_splat.io.atomic import sweep_temporary
from mi_splat.io.documents import save_json
from mi_splat.io.folders import own_folder
from mi_splat.io.parsing import read_json

JOBS = "jobs"
"""Folder of the ledger."""

PAIRS = (
    ("car_street", "car", "person"),
    ("car_street", "car", "elephant"),
    ("car_street", "car", "stop sign"),
    ("stop_sign", "stop_sign", "tv"),
    ("stop_sign", "stop_sign", "train"),
    ("stop_sign", "stop_sign", "bird"),
)
"""The paper's six pairs: scene, id of the object in it, target class."""

OBJECTS = tuple(dict.fromkeys((scene, name) for scene, name, _ in PAIRS))
"""Scene and id of every object."""

CAMERAS = 6
"""Cameras of each of these scenes; the tables look through the first one unless they say otherwise."""

BALLS: tuple[tuple[str, Attribute, NormName, tuple[float, ...]], ...] = (
    ("pairs", "sh", "l2", (5.0,)),
    ("curve", "sh", "l2", (0.5, 1.0, 2.0)),
    ("linf", "sh", "linf", (0.02, 0.05, 0.1)),
    ("per_gaussian", "sh", "l2_per_gaussian", (0.1, 0.3)),
    ("means", "means", "linf", (0.01, 0.03)),
    ("scales", "scales", "linf", (0.3, 0.7)),
    ("rotations", "rotations", "linf", (0.1, 0.3)),
    ("opacities", "opacities", "linf", (1.0, 3.0)),
)
"""Group, attribute, norm and radii. The paper reports the first; the others stand for what it leaves unreported."""


def study_jobs(seeds: int) -> list[Job]:
    """The paper's pairs, smaller balls, other norms and attributes; other cameras; hiding; all cameras at once."""
    balls = [
        Job(group=group, scene=scene, object=name, target=target, config=_config(seed, eps, attribute, norm))
        for group, attribute, norm, radii in BALLS
        for eps in radii
        for scene, name, target in PAIRS
        for seed in range(seeds)
    ]
    cameras = [
        Job(group="cameras", scene=scene, object=name, target=target, camera=camera, config=_config(seed))
        for scene, name, target in PAIRS
        for camera in range(1, CAMERAS)
        for seed in range(seeds)
    ]
    hiding = [
        Job(group="hide", scene=scene, object=name, target=None, config=_config(seed, eps))
        for eps in (0.5, 1.0, 2.0, 5.0)
        for scene, name in OBJECTS
        for seed in range(seeds)
    ]
    views = [
        Job(group="views", scene=scene, object=name, target=target, views=0, config=_config(seed, eps))
        for eps in (2.0, 5.0)
        for scene, name, target in PAIRS
        for seed in range(seeds)
    ]
    return balls + cameras + hiding + views


def _config(seed: int, eps: float = 5.0, attribute: Attribute = "sh", norm: NormName = "l2") -> DaggerConfig:
    return DaggerConfig(attributes=(attribute,), eps=(eps,), norm=norm, seed=seed, random_start=seed > 0)


class NamedJob(Protocol):
    """A frozen dataclass that says all about one attack of a study."""

    @property
    def name(self) -> str:
        """File name, unique within a study."""
        ...


AnyJob = TypeVar("AnyJob", bound=NamedJob)


def run_jobs(
    jobs: Sequence[AnyJob],
    out: Path,
    run: Callable[[AnyJob], dict[str, Any]],
    *,
    fingerprint: Callable[[AnyJob], str],
    on_job: Callable[[AnyJob], None] | None = None,
    ledger: str = JOBS,
) -> list[dict[str, Any]]:
    """Run what is not done yet.

    Args:
        jobs: The study.
        out: Folder of the study.
        run: Runs one job and returns its result, ready for JSON.
        fingerprint: What a job's result depends on besides the job; a stored result with another one is done again.
        on_job: Called after every job.
        ledger: Folder in `out` that the JSONs go to.

    Returns:
        One record for each job: `job`, `fingerprint` and `result`.
    """
    folder, records = out / ledger, []
    with own_folder(out, JOBS, ledger):
        folder.mkdir(parents=True, exist_ok=True)
        sweep_temporary(folder)
        for job in jobs:
            path = folder / f"{job.name}.json"
            key = {"job": as_json(job), "fingerprint": fingerprint(job)}
            record = _stored(path)
            if record is None or {name: record[name] for name in key} != key:
                record = {**key, "result": run(job)}
                save_json(record, path)
            records.append(record)
            if on_job is not None:
                on_job(job)
    return records


def run_with_file(
    job: AnyJob, out: Path, run: Callable[[AnyJob], dict[str, Any]], *, fingerprint: Callable[[AnyJob], str], file: Path
) -> dict[str, Any]:
    """`run_jobs` of one job whose record is worth nothing without a file that it leaves.

    Args:
        job: The job.
        out: Folder of the study.
        run: Runs it and writes the file.
        fingerprint: See `run_jobs`.
        file: What it leaves.
    """
    if not file.is_file():
        (out / JOBS / f"{job.name}.json").unlink(missing_ok=True)
    (record,) = run_jobs([job], out, run, fingerprint=fingerprint)
    return record


def as_json(job: NamedJob) -> dict[str, Any]:
    """A job with its full configuration, as a JSON file gives it back."""
    values: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(cast(Any, job))))
    return values


def stored_records(out: Path) -> list[dict[str, Any]]:
    """Every whole record of a study's ledger, by the names of the files."""
    found = (_stored(path) for path in sorted((out / JOBS).glob("*.json")))
    return [record for record in found if record is not None]


def _stored(path: Path) -> dict[str, Any] | None:
    """The record in a file; None if there is none, or not a whole one."""
    try:
        record = read_json(path)
    except InvalidValueError:
        return None
    return record if {"job", "fingerprint", "result"} <= set(record) else None
