"""The conditions that a rendering study judges under, as its table names them."""

from __future__ import annotations

from typing import Any

import torch

from attacks.dagger.jobs import AttackScene
from attacks.observe.conditions import Condition, SunTable, file_forms, rendered, renderers, street_at
from attacks.rendering_studies.config import JudgeTable
from mi_splat.errors import InvalidValueError, message
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.sun import clock


def condition_names(judge: JudgeTable) -> tuple[str, ...]:
    """Names of the conditions of a study, in the order of its tables; none where the attack's own renderer judges."""
    forms = file_forms(lambda scene, camera: scene.means, **_forms(judge))
    hours = () if judge.sun is None else judge.sun.hours
    return (*judge.renderers, *(form.name for form in forms), *map(clock, hours))


def conditions_of(judge: JudgeTable, place: AttackScene, name: str) -> dict[str, Condition]:
    """The conditions of a study on one of its scenes, by name.

    Args:
        judge: What the study asks for.
        place: The scene.
        name: Id of the object that is attacked.

    Raises:
        InvalidValueError: There is no such renderer.
        MiSplatError: The street of meshes cannot be read, or does not hold the object alone.
    """
    settings = settings_of(place)
    conditions = [*renderers(judge.renderers, settings), *file_forms(Renderer(settings), **_forms(judge))]
    if judge.sun is not None:
        conditions += [_on_street(place, name, sun=judge.sun, hour=hour) for hour in judge.sun.hours]
    return {condition.name: condition for condition in conditions}


def settings_of(place: AttackScene) -> RenderSettings:
    """Background and near plane of a scene."""
    return place.render.settings if isinstance(place.render, Renderer) else RenderSettings()


def _forms(judge: JudgeTable) -> dict[str, Any]:
    return {"files": judge.files, "float16": judge.float16, "sh_degrees": judge.sh_degrees}


def _on_street(place: AttackScene, name: str, *, sun: SunTable, hour: float) -> Condition:
    """The object alone, on a street of meshes."""
    rows, street = place.objects[name], street_at(sun, hour)
    alone, inside = place.scene.select(rows), street.splats.scene
    if len(inside) != len(alone) or not torch.equal(inside.means, alone.means):
        expected, do = f"the Gaussians of {name} and no others", "name the file of that object in the scene"
        raise InvalidValueError(message(sun.scene, expected, f"{len(inside):,} Gaussians", do))
    return rendered(clock(hour), street, lambda scene: scene.select(rows))
