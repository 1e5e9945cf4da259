"""The conditions under which an attacked splat is judged: other renderers, other files, a street under the sun."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from attacks.dagger.jobs import AttackScene
from attacks.evaluation.file_forms import fewer_bands, half_precision, through_file
from attacks.rendering_studies.config import JudgeTable, SunTable
from mi_splat.cameras import RenderFn
from mi_splat.comparison.methods import load_method
from mi_splat.errors import InvalidValueError, message
from mi_splat.mixed_scenes import MixedScene
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene import GaussianScene
from mi_splat.sun import clock, sun_direction

Change = Callable[[GaussianScene], GaussianScene]


@dataclass(frozen=True, slots=True, kw_only=True)
class Condition:
    """One way to look at a splat.

    Attributes:
        name: What tables call it.
        render: What makes the picture.
        change: What becomes of the whole scene before.
    """

    name: str
    render: RenderFn
    change: Change = lambda scene: scene


def condition_names(judge: JudgeTable) -> tuple[str, ...]:
    """Names of the conditions of a study, in the order of its tables; none where the attack's own renderer judges."""
    hours = () if judge.sun is None else judge.sun.hours
    return (
        *judge.renderers,
        *judge.files,
        *(["SH in float16"] if judge.float16 else []),
        *(f"SH of degree {degree}" for degree in judge.sh_degrees),
        *map(clock, hours),
    )


def conditions_of(judge: JudgeTable, place: AttackScene, name: str, settings: RenderSettings) -> dict[str, Condition]:
    """The conditions of a study on one of its scenes, by name.

    Args:
        judge: What the study asks for.
        place: The scene.
        name: Id of the object that is attacked.
        settings: Background and near plane of the scene.

    Raises:
        InvalidValueError: A renderer, a format or an hour cannot be.
        MiSplatError: The street of meshes cannot be read, or does not hold the object alone.
    """
    found = [Condition(name=word, render=load_method(word, settings).render) for word in judge.renderers]
    own = Renderer(settings)
    changes: dict[str, Change] = {suffix: functools.partial(_stored, suffix=suffix) for suffix in judge.files}
    if judge.float16:
        changes["SH in float16"] = half_precision
    for degree in judge.sh_degrees:
        changes[f"SH of degree {degree}"] = functools.partial(fewer_bands, degree=degree)
    found += [Condition(name=word, render=own, change=change) for word, change in changes.items()]
    if judge.sun is not None:
        found += _hours(judge.sun, place, name)
    return {condition.name: condition for condition in found}


def _stored(scene: GaussianScene, *, suffix: str) -> GaussianScene:
    return through_file(scene, suffix)


def _hours(sun: SunTable, place: AttackScene, name: str) -> list[Condition]:
    """The object on a street of meshes, hour by hour."""
    rows = place.objects[name]
    alone = place.scene.select(rows)
    found = []
    for hour in sun.hours:
        east, north, up = sun_direction(hour, latitude=sun.latitude, declination=sun.declination)
        street = MixedScene(Path(sun.scene), samples=sun.samples, sun_x=east, sun_y=north, sun_z=up)
        inside = street.splats.scene
        if len(inside) != len(alone) or not torch.equal(inside.means, alone.means):
            expected, do = f"the Gaussians of {name} and no others", "name the file of that object in the scene"
            raise InvalidValueError(message(sun.scene, expected, f"{len(inside):,} Gaussians", do))

        def cut_out(scene: GaussianScene, degree: int = inside.degree) -> GaussianScene:
            return scene.select(rows).with_degree(degree)

        found.append(Condition(name=clock(hour), render=street, change=cut_out))
    return found
