"""What a study that left results behind had otherwise than the one asked for, told setting by setting."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from attacks.cloak.study.attack_config import AttackConfig
from attacks.cloak.study.config import CameraConfig, EvaluationConfig, SceneConfig, StudyConfig, TrainingConfig
from mi_splat.io.parsing import DocumentReader

_SECTIONS: dict[str, Any] = {
    "scene": SceneConfig,
    "cameras": CameraConfig,
    "attack": AttackConfig,
    "training": TrainingConfig,
    "evaluation": EvaluationConfig,
}


def snapshot(study: StudyConfig) -> dict[str, Any]:
    """The study as JSON can hold it."""
    return dataclasses.asdict(study)


def differences(file: Path, study: StudyConfig) -> list[str]:
    """What the study in a file has otherwise, in words; nothing if it is the same study.

    A study written by an older version of this project may lack settings; they count as their defaults, which are what
    was done before there was a setting.

    Args:
        file: The `study.json` of earlier results.
        study: The study that is asked for.

    Raises:
        InvalidValueError: The file cannot be read.
    """
    there = dict(_flat(DocumentReader(expected="a study", do="choose another folder").read_json(file)))
    wanted = dict(_flat(json.loads(json.dumps(snapshot(study)))))
    found = []
    for name in {**there, **wanted}:
        old, new = (values.get(name, _default(name)) for values in (there, wanted))
        if old != new:
            found.append(f"{name} {old} and not {new}")
    return found


def _flat(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Names with dots and values of nested settings; several attacks are numbered."""
    for key, value in values.items():
        name = f"{prefix}{key}"
        if isinstance(value, dict):
            yield from _flat(value, f"{name}.")
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            for number, entry in enumerate(value):
                yield from _flat(entry, f"{name}.{number}.")
        else:
            yield name, value


def _default(name: str) -> Any:
    """The default of a setting, as JSON gives it back; None where it has none."""
    section, _, key = name.partition(".")
    kind = _SECTIONS.get(section)
    for field in dataclasses.fields(kind) if kind is not None else ():
        if field.name == key.rpartition(".")[2] and field.default is not dataclasses.MISSING:
            return json.loads(json.dumps(field.default))
    return None
