"""The conditions under which an attacked splat is judged: other renderers, other files, a street under the sun."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from attacks.dagger.jobs import AttackScene
from attacks.observe.conditions import SunTable, fewer_bands, half_precision, street_at, through_file
from attacks.rendering_studies.config import JudgeTable
from mi_splat.cameras import Camera, RenderFn
from mi_splat.comparison.methods import load_method
from mi_splat.errors import InvalidValueError, message
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene import GaussianScene
from mi_splat.sun import clock

Change = Callable[[GaussianScene], GaussianScene]


@dataclass(frozen=True, slots=True, kw_only=True)
class Condition:
    """One way to look at a splat, itself a `RenderFn`.

    Attributes:
        render: What makes the picture.
        change: What becomes of the whole scene before.
    """

    render: RenderFn
    change: Change = lambda scene: scene

    def __call__(self, scene: GaussianScene, camera: Camera) -> Tensor:
        """The picture of a scene under this condition, (H, W, 3) sRGB."""
        return self.render(self.change(scene), camera)


def condition_names(judge: JudgeTable) -> tuple[str, ...]:
    """Names of the conditions of a study, in the order of its tables; none where the attack's own renderer judges."""
    return tuple(_makers(judge))


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
    return {word: make(place, name) for word, make in _makers(judge).items()}


def settings_of(place: AttackScene) -> RenderSettings:
    """Background and near plane of a scene."""
    return place.render.settings if isinstance(place.render, Renderer) else RenderSettings()


def _makers(judge: JudgeTable) -> dict[str, Callable[[AttackScene, str], Condition]]:
    """What makes each condition, for a scene and the id of its object."""
    changes: dict[str, Change] = {suffix: partial(through_file, suffix=suffix) for suffix in judge.files}
    if judge.float16:
        changes["SH in float16"] = half_precision
    changes |= {f"SH of degree {degree}": partial(fewer_bands, degree=degree) for degree in judge.sh_degrees}
    makers: dict[str, Callable[[AttackScene, str], Condition]] = {
        **{method: partial(_in_renderer, method=method) for method in judge.renderers},
        **{name: partial(_after, change=change) for name, change in changes.items()},
    }
    if judge.sun is not None:
        makers |= {clock(hour): partial(_on_street, sun=judge.sun, hour=hour) for hour in judge.sun.hours}
    return makers


def _in_renderer(place: AttackScene, _: str, *, method: str) -> Condition:
    return Condition(render=load_method(method, settings_of(place)).render)


def _after(place: AttackScene, _: str, *, change: Change) -> Condition:
    return Condition(render=Renderer(settings_of(place)), change=change)


def _on_street(place: AttackScene, name: str, *, sun: SunTable, hour: float) -> Condition:
    """The object alone, on a street of meshes."""
    rows, street = place.objects[name], street_at(sun, hour)
    alone, inside = place.scene.select(rows), street.splats.scene
    if len(inside) != len(alone) or not torch.equal(inside.means, alone.means):
        expected, do = f"the Gaussians of {name} and no others", "name the file of that object in the scene"
        raise InvalidValueError(message(sun.scene, expected, f"{len(inside):,} Gaussians", do))
    return Condition(render=street, change=lambda scene: scene.select(rows))
