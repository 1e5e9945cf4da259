"""What a study of CLOAK left behind, read back for an artifact: its summary, its observations, its splats."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from attacks.artifacts.contents import read_object
from attacks.cloak.config import StudyConfig
from attacks.cloak.observations import Blend, Fidelity, Observation, ObservedSplat
from attacks.cloak.study import dependencies
from attacks.cloak.study.cache import DONE, content_of
from attacks.cloak.study.run import SUMMARY
from attacks.cloak.study.trained_splats import SPLAT_STAGES, TrainedSplat
from mi_splat.assets import ASSETS
from mi_splat.errors import InvalidValueError, message
from mi_splat.fields import decode
from mi_splat.training.resume import SPLAT

OBSERVATIONS = "observations.json"


def study_of(configuration: Mapping[str, Any], where: str) -> StudyConfig:
    """The study in an artifact. Rates need no mesh: one of a mesh file stands there as if it had an asset's.

    Args:
        configuration: As `dataclasses.asdict` gives it.
        where: What holds it, for errors.

    Raises:
        InvalidValueError: It is none of this version.
    """
    values = stated(configuration)
    scene = values.get("scene")
    if isinstance(scene, dict) and isinstance(scene.get("object"), str) and scene["object"] not in ASSETS:
        values["scene"] = {**scene, "object": next(iter(ASSETS))}
    return decode(StudyConfig, values, where)


def stated(value: Any) -> Any:
    """A JSON value without the keys whose value is null, which stand for what a study's file does not state."""
    if isinstance(value, Mapping):
        return {key: stated(entry) for key, entry in value.items() if entry is not None}
    return [stated(entry) for entry in value] if isinstance(value, list) else value


def configuration_of(study: Mapping[str, Any]) -> dict[str, Any]:
    """The study as an artifact holds it: of a mesh file its name alone, since its folder is a matter of one machine."""
    scene = study["scene"]
    return {**study, "scene": {**scene, "object": Path(scene["object"]).name}}


def observed_splats(summary: Mapping[str, Any], stages: Path) -> list[ObservedSplat]:
    """Everything that was observed of each splat of a finished study.

    Args:
        summary: Its summary.json.
        stages: Folder of its stages.

    Raises:
        InvalidValueError: The observations of a splat are not there, or have been changed.
    """
    study = decode(StudyConfig, stated(summary["study"]), SUMMARY)
    found = [_finished_looks(study, entry, summary["detectors"], stages) for entry in summary["splats"]]
    # A clean splat may have been compared with the pictures of several studies, a cloaked one with those of its own.
    shared = [pictures for pictures in found[-1] if all(pictures in looks for looks in found)]
    if not shared:
        expected, do = "observations that were compared with the same pictures", "do the study again"
        raise InvalidValueError(message(str(stages), expected, "none", do)).hinted("--stages")
    return [
        _rebuilt(entry, read_object(looks[shared[0]].parent / OBSERVATIONS))
        for entry, looks in zip(summary["splats"], found, strict=True)
    ]


def stage_splat(content: str, stages: Path) -> Path | None:
    """The splat of a stage, by its content; None if it is not there."""
    for kind in SPLAT_STAGES:
        for done, values in _finished(kind, stages):
            if values.get("content") == content:
                return done.parent / SPLAT
    return None


def _finished_looks(
    study: StudyConfig, entry: Mapping[str, Any], detectors: Mapping[str, str], stages: Path
) -> dict[tuple[str, ...], Path]:
    """done.json of each stage in which one splat was observed, by the content of what it was compared with."""
    asked = dependencies.of_observations(study, "", entry["content"], [], detectors)
    wanted = json.loads(json.dumps({key: asked[key] for key in asked if key not in ("source", "true_pictures")}))
    found = {}
    for done, values in _finished("observations", stages):
        depends_on = values.get("depends_on", {})
        if all(depends_on.get(key) == value for key, value in wanted.items()):
            if content_of(done.parent, ("**/*",)) != values.get("content"):
                do = "make the result again"
                raise InvalidValueError(message(str(done.parent), "what the study wrote", "other bytes", do))
            found[tuple(depends_on.get("true_pictures", ()))] = done
    if not found:
        expected = f"the observations of the {entry['splat']} splat, seed {entry['seed']}"
        do = "pass the folder of stages that the study was done with"
        raise InvalidValueError(message(str(stages), expected, "none", do)).hinted("--stages")
    return found


def _finished(kind: str, stages: Path) -> Iterator[tuple[Path, dict[str, Any]]]:
    """done.json of each finished stage of a kind, and what it says."""
    for done in sorted(stages.glob(f"{kind}-*/{DONE}")):
        yield done, read_object(done)


def _rebuilt(entry: Mapping[str, Any], values: Mapping[str, Any]) -> ObservedSplat:
    return ObservedSplat(
        trained=trained_splat(entry),
        observations=tuple(Observation(**one) for one in values["observations"]),
        fidelities=tuple(Fidelity(**one) for one in values["fidelities"]),
        blends=tuple(Blend(**one) for one in values["blends"]),
    )


def trained_splat(entry: Mapping[str, Any]) -> TrainedSplat:
    """A splat as a summary lists it, its file apart.

    Raises:
        InvalidValueError: It lacks a part.
    """
    try:
        return TrainedSplat(
            splat=str(entry["splat"]),
            seed=int(entry["seed"]),
            file=Path(),
            content=str(entry["content"]),
            gaussians=int(entry["gaussians"]),
            hash=str(entry["hash"]),
            commit=entry.get("commit"),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise InvalidValueError(message("splats", "splats of a study", repr(error), "make it again")) from error


def detectors_of(folder: Path) -> tuple[str, ...]:
    """Names of the detectors of a finished study.

    Raises:
        InvalidValueError: The folder holds none.
    """
    found = read_object(folder / SUMMARY).get("detectors")
    if not isinstance(found, dict):
        raise InvalidValueError(message(str(folder / SUMMARY), "a summary of a study", "none", "pass another folder"))
    return tuple(map(str, found))
