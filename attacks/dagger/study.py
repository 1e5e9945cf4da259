"""Studies: many attacks, one table. `python -m attacks.dagger.study dagger --seeds 3 --out out/studies/dagger`.

Every job leaves one JSON in `jobs/`, and a job whose JSON is there and belongs to the same scene, detector and settings
is not done again: an interrupted study goes on where it stopped. The tables are made from the JSONs.

Seed 0 looks from the scene's own camera and starts at the clean splat. Every other seed turns the camera about the
object by up to 6 degrees, moves it by up to 5 %, and starts at a random point of the ball. The seed also draws the
random-noise control.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro
from tyro.conf import Positional

from attacks.budgets import NormName
from attacks.dagger.attack import Attribute
from attacks.dagger.jobs import AttackScene, Job, JobRunner
from attacks.dagger.tables import write_tables
from mi_splat.errors import InvalidValueError, MiSplatError, message
from mi_splat.io.documents import save_json

PAIRS = (
    ("car_street", "car", "person"),
    ("car_street", "car", "elephant"),
    ("car_street", "car", "stop sign"),
    ("stop_sign", "stop_sign", "tv"),
    ("stop_sign", "stop_sign", "train"),
    ("stop_sign", "stop_sign", "bird"),
)
"""The paper's six pairs: scene, id of the object in it, class wanted."""

CAMERAS = 6
"""Cameras of each of these scenes; the tables look through the first one unless they say otherwise."""

OTHERS: dict[Attribute, tuple[float, ...]] = {
    "means": (0.01, 0.03),
    "scales": (0.3, 0.7),
    "rotations": (0.1, 0.3),
    "opacities": (1.0, 3.0),
}
"""Budgets (linf) of the attributes that the paper leaves unreported: metres, log metres, quaternion parts, logits."""


def dagger_jobs(seeds: int) -> list[Job]:
    """The paper's table, other cameras, smaller balls, linf, a ball per Gaussian, hiding, every other attribute."""
    grid: list[tuple[str, Attribute, NormName, Sequence[float]]] = [
        ("pairs", "sh", "l2", (5.0,)),
        ("curve", "sh", "l2", (0.5, 1.0, 2.0)),
        ("linf", "sh", "linf", (0.02, 0.05, 0.1)),
        ("per_gaussian", "sh", "l2_per_gaussian", (0.1, 0.3)),
        *((name, name, "linf", radii) for name, radii in OTHERS.items()),
    ]
    jobs = [
        Job(group=group, scene=scene, object=name, target=target, attribute=attribute, eps=eps, norm=norm, seed=seed)
        for group, attribute, norm, radii in grid
        for eps in radii
        for scene, name, target in PAIRS
        for seed in range(seeds)
    ]
    hiding = [
        Job(group="hide", scene=scene, object=name, target=None, eps=eps, seed=seed)
        for eps in (0.5, 1.0, 2.0, 5.0)
        for scene, name in dict.fromkeys((scene, name) for scene, name, _ in PAIRS)
        for seed in range(seeds)
    ]
    cameras = [
        Job(group="cameras", scene=scene, object=name, target=target, camera=camera, seed=seed)
        for scene, name, target in PAIRS
        for camera in range(1, CAMERAS)
        for seed in range(seeds)
    ]
    views = [
        Job(group="views", scene=scene, object=name, target=target, views=0, eps=eps, seed=seed)
        for eps in (2.0, 5.0)
        for scene, name, target in PAIRS
        for seed in range(seeds)
    ]
    return jobs + cameras + hiding + views


def run(
    jobs: Sequence[Job],
    out: Path,
    execute: Callable[[Job], dict[str, Any]],
    *,
    fingerprint: Callable[[Job], str],
    on_job: Callable[[Job], None] | None = None,
) -> list[dict[str, Any]]:
    """Do what is not done yet.

    Args:
        jobs: The study.
        out: Folder of the study; its JSONs go to `jobs/` below it.
        execute: Does one job and returns its result, ready for JSON.
        fingerprint: What a job's result depends on besides the job; a stored result with another one is done again.
        on_job: Called after every job.

    Returns:
        One record for each job: `job`, `fingerprint` and `result`.
    """
    folder, records = out / "jobs", []
    folder.mkdir(parents=True, exist_ok=True)
    for job in jobs:
        path, mark = folder / f"{job.name}.json", fingerprint(job)
        record = _stored(path)
        if record is None or record["job"] != dataclasses.asdict(job) or record["fingerprint"] != mark:
            record = {"job": dataclasses.asdict(job), "fingerprint": mark, "result": execute(job)}
            save_json(record, path)
        records.append(record)
        if on_job is not None:
            on_job(job)
    return records


def _stored(path: Path) -> dict[str, Any] | None:
    try:
        record = json.loads(path.read_text())
    except (FileNotFoundError, json.JSONDecodeError):
        return None
    complete = isinstance(record, dict) and {"job", "fingerprint", "result"} <= set(record)
    return record if complete else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """Many attacks and one table: the paper's pairs, smaller balls, other norms, hiding, every other attribute."""

    study: Positional[Literal["dagger"]]
    """Which study."""
    seeds: int = 3
    """Number of seeds."""
    groups: tuple[str, ...] = ()
    """Tables to make, all if none is named."""
    scenes: Path = Path("scenes")
    """Folder with the scene files."""
    detector: str = "fasterrcnn_small"
    """Name of the detector."""
    weights: Path | None = None
    """Its weights; the shipped ones if None."""
    out: Path = Path("out/studies/dagger")
    """Folder for the results."""


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line of the studies; returns the exit status."""
    try:
        return conduct(tyro.cli(Options, args=arguments, prog="python -m attacks.dagger.study"))
    except MiSplatError as error:
        sys.stderr.write(f"attacks.dagger.study: {error}\n")
        return 1


def conduct(options: Options) -> int:
    """Run a study with a progress bar and write its tables."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from attacks.detectors import load_detector

    jobs = dagger_jobs(options.seeds)
    known = tuple(dict.fromkeys(job.group for job in jobs))
    for group in options.groups:
        if group not in known:
            raise InvalidValueError(message("groups", f"some of {', '.join(known)}", group, "name one of these"))
    jobs = [job for job in jobs if not options.groups or job.group in options.groups]
    detector = load_detector(options.detector, weights=options.weights)
    job_runner = JobRunner(lambda name: _from_xml(options.scenes / f"{name}.xml"), detector)
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("attacks", total=len(jobs))

        def advance(job: Job) -> None:
            progress.update(task, advance=1, description=job.name)

        records = run(jobs, options.out, job_runner.execute, fingerprint=job_runner.fingerprint, on_job=advance)
    for path in write_tables(records, options.out):
        sys.stdout.write(f"{path}\n")
    return 0


def _from_xml(path: Path) -> AttackScene:
    from mi_splat.rendering import Renderer
    from mi_splat.scene_files import read_scene

    loaded = read_scene(path)
    return AttackScene(
        scene=loaded.scene,
        objects=loaded.objects,
        cameras=tuple(loaded.cameras.values()),
        render=Renderer(loaded.settings),
    )


if __name__ == "__main__":
    sys.exit(main())
