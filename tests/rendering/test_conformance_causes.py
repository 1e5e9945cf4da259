"""Causes of differences: listed mistakes are named, alone and together, and of mistakes
that no deviation describes nothing else is said.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mi_splat.conformance import (
    Report,
    Setup,
    compare,
    conformance_scenes,
    find_causes,
)
from mi_splat.conformance.deviations import applied
from mi_splat.conformance.setups import C0
from mi_splat.conformance.tolerances import difference, tolerance_of
from mi_splat.oracle import Array, Splat, blend, project

SETUPS = {scene.name: scene.setup for scene in conformance_scenes()}
Draw = Callable[[Setup], Array]


def judged(draw: Draw, setups: dict[str, Setup] = SETUPS) -> Report:
    """The report on the images of a renderer, in bytes."""
    images = {name: in_bytes(draw(setup)) for name, setup in setups.items()}
    left_out = [name for name in SETUPS if name not in setups]
    return compare(images, accept=left_out)


@np.errstate(invalid="ignore")
def in_bytes(image: Array) -> Array:
    found: Array = np.round(np.clip(np.nan_to_num(image), 0, 1) * 255).astype(np.uint8)
    return found


def named(report: Report) -> set[str]:
    return {cause.deviation.key for cause in report.causes}


def image_of(setup: Setup) -> Array:
    return setup.render()[0]


def drawn_with(*keys: str) -> Draw:
    return lambda setup: image_of(applied(setup, keys))


# Mistakes that no deviation describes


def _with(**changes: Any) -> Draw:
    return lambda setup: image_of(replace(setup, **changes))


def _convention(**choices: Any) -> Draw:
    return lambda setup: image_of(
        replace(setup, convention=replace(setup.convention, **choices))
    )


def _file(change: Callable[[Splat], Splat]) -> Draw:
    return lambda setup: image_of(replace(setup, stored=change(setup.stored)))


def _after(change: Callable[[Array], Array]) -> Draw:
    return lambda setup: change(np.clip(image_of(setup), 0, None))


def _sh(change: Callable[[Array], Array]) -> Draw:
    return _file(lambda splat: splat._replace(sh=change(splat.sh)))


def _camera(change: Callable[[Any], Any]) -> Draw:
    return lambda setup: image_of(replace(setup, camera=change(setup.camera)))


def _without_offset(sh: Array) -> Array:
    return np.concatenate([sh[:, :1] - 0.5 / C0, sh[:, 1:]], axis=1)


def _higher_doubled(sh: Array) -> Array:
    return np.concatenate([sh[:, :1], 2 * sh[:, 1:]], axis=1)


def _background_added(setup: Setup) -> Array:
    image, alpha = setup.render()
    added: Array = image + alpha[..., None] * np.array(setup.background)
    return added


def _additive(setup: Setup) -> Array:
    """Every Gaussian added, whatever is in front of it."""
    projected = project(setup.splat, setup.camera)
    shape = (setup.camera.height, setup.camera.width, 3)
    image: Array = np.zeros(shape) + np.array(setup.background)
    for layer in blend(projected, setup.camera, replace(setup.convention, stop=0.0)):
        image[layer.box] += layer.alpha[..., None] * projected.colour[layer.number]
    return image


def _hard(setup: Setup) -> Array:
    """Ellipses of one opacity instead of Gaussians."""
    projected = project(setup.splat, setup.camera)
    image = np.zeros((setup.camera.height, setup.camera.width, 3))
    left = np.ones(image.shape[:2])
    for layer in blend(projected, setup.camera, replace(setup.convention, stop=0.0)):
        opacity = projected.opacity[layer.number]
        inside = layer.alpha > 0.3 * opacity
        alpha = np.where(inside, min(opacity, 0.99), 0.0)
        weight = (alpha * left[layer.box])[..., None]
        image[layer.box] += weight * projected.colour[layer.number]
        left[layer.box] *= 1 - alpha
    whole: Array = image + left[..., None] * np.array(setup.background)
    return whole


UNLISTED: dict[str, Draw] = {
    "opacities squared": _with(opacities=lambda x: (1 / (1 + np.exp(-x))) ** 2),
    "scales half as large again": _with(scales=lambda x: 1.5 * np.exp(x)),
    "scales in the reverse order": _file(
        lambda splat: splat._replace(scales=splat.scales[:, ::-1])
    ),
    "quaternions as w, z, y, x": _file(
        lambda splat: splat._replace(rotations=splat.rotations[:, [0, 3, 2, 1]])
    ),
    "0.5 not added to colours": _sh(_without_offset),
    "higher SH doubled": _sh(_higher_doubled),
    "sixteen levels of colour": _after(lambda image: np.round(image * 15) / 15),
    "tone mapping": _after(lambda image: image / (1 + image)),
    "gamma": _after(lambda image: image**0.7),
    "low-pass filter of 0.6": _convention(low_pass=0.6),
    "cut-off at 2.5 deviations": _convention(cutoff=2.5),
    "near plane at 0.5": _convention(near=0.5),
    "alpha at most 0.9": _convention(max_alpha=0.9),
    "alphas below 1/64 not drawn": _convention(min_alpha=1 / 64),
    "no limit below 0.2 of the Jacobian": _convention(tangent_limit=0.2),
    "focal length 5 % too long": _camera(
        lambda c: replace(c, fx=1.05 * c.fx, fy=1.05 * c.fy)
    ),
    "positions moved": _file(lambda splat: splat._replace(means=splat.means + 0.02)),
    "background added": _background_added,
    "no occlusion": _additive,
    "hard ellipses": _hard,
}


def _doubled_turns(rotations: Array) -> Array:
    unit = rotations / np.linalg.norm(rotations, axis=1, keepdims=True)
    real = 2 * unit[:, :1] ** 2 - 1
    return np.concatenate([real, 2 * unit[:, :1] * unit[:, 1:]], axis=1)


def _blurred(image: Array) -> Array:
    wide = np.pad(image, ((1, 1), (1, 1), (0, 0)), mode="edge")
    rows = wide[:-2] + wide[1:-1] + wide[2:]
    whole: Array = (rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]) / 9
    return whole


def _vignetted(image: Array) -> Array:
    across = np.linspace(-1, 1, image.shape[1])[:, None] ** 2
    along = np.linspace(-1, 1, image.shape[0])[:, None, None] ** 2
    return image * (1 - 0.2 * (across + along))


def _sigmoid(logits: Array) -> Array:
    return 1 / (1 + np.exp(-logits))


HELD_OUT: dict[str, Draw] = {
    "turns doubled": _file(
        lambda splat: splat._replace(rotations=_doubled_turns(splat.rotations))
    ),
    "flattened": _file(
        lambda splat: splat._replace(scales=splat.scales * [1, 1, 0] - [0, 0, 9])
    ),
    "opacities of 80 %": _with(opacities=lambda x: 0.8 * _sigmoid(x)),
    "roots of opacities": _with(opacities=lambda x: _sigmoid(x) ** 0.5),
    "SH of degree 1 at 70 %": _sh(
        lambda sh: np.concatenate([sh[:, :1], 0.7 * sh[:, 1:4], sh[:, 4:]], axis=1)
    ),
    "degree 0 at 80 %": _sh(
        lambda sh: np.concatenate([0.8 * sh[:, :1], sh[:, 1:]], axis=1)
    ),
    "green and blue exchanged": _after(lambda image: image[..., [0, 2, 1]]),
    "more contrast": _after(lambda image: 1.2 * image - 0.1),
    "low-pass filter of 0.45": _convention(low_pass=0.45),
    "low-pass filter of 2": _convention(low_pass=2.0),
    "cut-off at 2.2 deviations": _convention(cutoff=2.2),
    "early stop at 0.05": _convention(stop=0.05),
    "alpha at most 0.95": _convention(max_alpha=0.95),
    "near plane at 0.3": _convention(near=0.3),
    "pixel centres at 0.75": _convention(pixel_centre=0.75),
    "Jacobian at most 0.6 half fields off": _convention(tangent_limit=0.6),
    "focal length 3 % too short": _camera(lambda c: replace(c, fx=0.97 * c.fx)),
    "three pixels too low": _camera(lambda c: replace(c, cy=c.cy + 3)),
    "blurred": _after(_blurred),
    "vignetting": _after(_vignetted),
}
"""As `UNLISTED`, and looked at only after the search was finished, whose limits were
chosen with that list.
"""


SOME = {
    name: SETUPS[name]
    for name in (
        *("quaternion", "activation", "sh_1", "sh_3", "above_1", "background"),
        *("front_to_back", "largest_alpha", "low_pass", "near_plane", "wide_angle"),
        "anisotropic",
    )
}
TOLERANCES = {name: tolerance_of(setup, 8) for name, setup in SOME.items()}


def causes(draw: Draw) -> set[str]:
    """What is named of a renderer's images of some scenes."""
    images = {name: in_bytes(draw(setup)) / 255 for name, setup in SOME.items()}
    assert not all(
        TOLERANCES[name].holds(difference(image, image_of(SOME[name])))
        for name, image in images.items()
    )
    found = find_causes(images, SOME, TOLERANCES)
    return {cause.deviation.key for cause in found}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mistakes", "most"), [(UNLISTED, 2), (HELD_OUT, 1)], ids=["chosen", "held out"]
)
def test_mistakes_that_are_not_listed_hardly_get_a_wrong_cause(
    mistakes: dict[str, Draw], most: int
) -> None:
    """Two of the first list do: without alphas below 1/64 most Gaussians end near
    sqrt(8) standard deviations, and positions that are moved shift the image.
    """
    named = {mistake: causes(draw) for mistake, draw in mistakes.items()}
    wrong = {mistake: keys for mistake, keys in named.items() if keys}
    assert len(wrong) <= most, wrong


FEW = {
    name: SETUPS[name]
    for name in ("quaternion", "sh_1", "sh_3", "above_1", "order", "low_pass")
}


@pytest.mark.parametrize(
    "keys",
    [
        ("order=distance",),
        ("scales=variances",),
        ("low-pass=1", "quaternions=conjugated"),
        ("clamp=0-1", "low-pass=0", "sh-direction=to-camera"),
        ("channels=bgr", "orientation=mirrored"),
    ],
    ids=", ".join,
)
def test_listed_mistakes_are_named(keys: tuple[str, ...]) -> None:
    report = judged(drawn_with(*keys), FEW)
    assert named(report) == set(keys)
    assert report.unexplained == ()
    counts = [len(cause.scenes) for cause in report.causes]
    assert counts == sorted(counts, reverse=True)


@pytest.mark.parametrize(
    "keys",
    [
        ("falloff=normalised", "low-pass=0.075", "scales=255-steps"),
        ("compensation=on", "scales=254-steps"),
    ],
    ids=", ".join,
)
def test_mistakes_that_hide_each_other_are_named(keys: tuple[str, ...]) -> None:
    """As web viewers make them: alone, none of the first three explains much."""
    assert causes(drawn_with(*keys)) == set(keys)


def test_a_right_renderer_has_no_causes() -> None:
    report = judged(image_of, FEW)
    assert report.conforms
    assert report.causes == ()


@pytest.mark.slow
@pytest.mark.parametrize("key", ["sh-degree=2", "clamp=0-1", "order=file"])
def test_a_listed_mistake_is_named_beside_one_that_is_not(key: str) -> None:
    def draw(setup: Setup) -> Array:
        narrow = replace(setup.convention, near=0.5, max_alpha=0.9)
        return image_of(applied(replace(setup, convention=narrow), [key]))

    assert causes(draw) == {key}
