"""A study's splats elsewhere: from other distances, after other files, in other renderers, on a street in the sun.

Each is a set of conditions (`attacks.observe.conditions`). Under each of them it is counted from how many held-out
cameras detectors find the object: well inside the hiding trigger, and outside of all triggers. An occluder hides from
cameras above it and not from those beneath it. Layers need large coefficients, which coarse formats do not keep, and
colours below 0 and above 1, which not all renderers cut where 3D Gaussian Splatting does; on another road, under
another light, they show what they did before, for a splat is not lit.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch

from attacks.cloak import setup
from attacks.cloak.appearances import grown
from attacks.cloak.config import StudyConfig
from attacks.cloak.kinds.compared import margin_of
from attacks.cloak.layers import object_rows
from attacks.detectors.base import Detector
from attacks.observe.conditions import (
    FORMATS,
    Condition,
    SunTable,
    colour_clamps,
    distances,
    file_forms,
    on_background,
    rendered,
    street_hours,
)
from attacks.observe.views import detect_views
from mi_splat.cameras import Camera, RenderFn
from mi_splat.capture.path_tracer import scalar_variant
from mi_splat.comparison.methods import load_method
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.images import through_png
from mi_splat.metrics import psnr
from mi_splat.rendering import RenderSettings
from mi_splat.scene import GaussianScene

FACTORS = (0.5, 0.6, 0.7, 0.8, 1.0, 1.25, 1.5, 2.0)
"""Distances in units of the study's."""
STREET = SunTable(scene="scenes/mixed/car_among_meshes.xml", hours=(7.0, 9.5, 12.0, 14.5, 17.0), samples=8)
"""At the equinox."""
HOUSES = 4.0
"""Cameras farther north than this, in world units, would stand in the houses of the street."""
_OWN, _OTHERS = ("tile", "tile-antialiased", "ray", "ray-to-mean"), ("volprim",)

Groups = Mapping[str, Sequence[Camera]]
Counts = list[dict[str, Any]]
"""From how many cameras the object is found, for each condition, splat, group of cameras and detector."""


def measure_distances(
    study: StudyConfig,
    splats: Mapping[str, GaussianScene],
    detectors: Sequence[Detector],
    *,
    render: RenderFn,
    every: int = 4,
) -> Counts:
    """Counts from cameras that stand nearer or farther away.

    Args:
        study: The study.
        splats: Its splats by name, for instance clean and cloaked.
        detectors: Those that look.
        render: The renderer.
        every: Each so manieth of the held-out cameras is used.

    Raises:
        InvalidValueError: The study has no appearance that is seen from all around, or `every` is not positive.
    """
    groups, conditions = camera_groups(study, every), distances(render, FACTORS, setup.centre_of(study))
    counts: Counts = []
    for name, splat in splats.items():
        for factor, condition in zip(FACTORS, conditions, strict=True):
            ids = {"splat": name, "distance": factor}
            counts += _counted(study, condition, splat, groups, detectors, ids=ids)
    return counts


def measure_formats(
    study: StudyConfig, splat: GaussianScene, detectors: Sequence[Detector], *, render: RenderFn, every: int = 4
) -> Counts:
    """Counts, and the PSNR to the splat's own pictures, after file formats, roundings and cuts of colours.

    Args:
        study: The study.
        splat: Its cloaked splat.
        detectors: Those that look.
        render: The renderer.
        every: Each so manieth of the held-out cameras is used.

    Raises:
        InvalidValueError: The study has no appearance that is seen from all around, or `every` is not positive.
    """
    groups, plain = camera_groups(study, every), rendered("", render)
    forms = file_forms(render, files=FORMATS, float16=True, sh_degrees=range(splat.degree))
    counts: Counts = []
    for form in (*forms, *colour_clamps(render)):
        counts += _counted(study, form, splat, groups, detectors, ids={"form": form.name}, plain=plain)
    return counts


def renderers_of(settings: RenderSettings) -> list[Condition]:
    """The renderers, as `mi_splat.comparison` names them; the first is the one that splats are trained with.

    Args:
        settings: Background and near plane.
    """
    black = replace(settings, background=(0.0, 0.0, 0.0))
    return [
        *(rendered(name, load_method(name, settings).render) for name in _OWN),
        *(rendered(name, on_background(load_method(name, black).render, settings.background)) for name in _OTHERS),
    ]


def measure_renderers(
    study: StudyConfig,
    splats: Mapping[str, GaussianScene],
    detectors: Sequence[Detector],
    renderers: Sequence[Condition],
    *,
    every: int = 4,
) -> Counts:
    """Counts in other renderers, and the PSNR to the pictures of the first.

    Args:
        study: The study.
        splats: Its splats by name, for instance clean and cloaked.
        detectors: Those that look.
        renderers: Those of `renderers_of`.
        every: Each so manieth of the held-out cameras is used.

    Raises:
        InvalidValueError: The study has no appearance that is seen from all around, or `every` is not positive.
    """
    groups, counts = camera_groups(study, every), list[dict[str, Any]]()
    for renderer in renderers:
        for name, splat in splats.items():
            ids = {"renderer": renderer.name, "splat": name}
            counts += _counted(study, renderer, splat, groups, detectors, ids=ids, plain=renderers[0])
    return counts


def measure_street(
    study: StudyConfig,
    splats: Mapping[str, GaussianScene],
    detectors: Sequence[Detector],
    *,
    every: int = 4,
    sun: SunTable = STREET,
) -> Counts:
    """Counts on a path-traced street of meshes, by the hour of the day.

    Args:
        study: The study, with layers.
        splats: Its splats by name, for instance clean and cloaked; the object is cut out of each.
        detectors: Those that look.
        every: Each so manieth of the held-out cameras is used.
        sun: Where and when; its scene has the parameter car, too.

    Raises:
        InvalidValueError: The study has no layers, or no appearance that is seen from all around.
    """
    if study.layers is None:
        do = "take a study with [layers], whose object is known Gaussian by Gaussian"
        raise InvalidValueError(message("study", "layers", "none", do))
    target = setup.target_of(study.scene)
    groups = {
        name: [camera for camera in cameras if float(camera.position[1]) < HOUSES]
        for name, cameras in camera_groups(study, every).items()
    }
    hours = list(street_hours(sun, lambda splat: splat.select(object_rows(study, splat, target)), parameter="car"))
    counts: Counts = []
    for name, splat in splats.items():
        for hour in hours:
            ids = {"splat": name, "hour": hour.name}
            counts += _counted(study, hour, splat, groups, detectors, ids=ids)
    return counts


def _counted(
    study: StudyConfig,
    condition: Condition,
    splat: GaussianScene,
    groups: Groups,
    detectors: Sequence[Detector],
    *,
    ids: Mapping[str, Any],
    plain: Condition | None = None,
) -> Counts:
    """Counts of one splat under one condition; with the PSNR to its pictures under another, if one is given."""
    shown, render = condition.show(splat)
    box_of, rows = partial(setup.box_of, setup.target_of(study.scene)), list[dict[str, Any]]()
    for name, cameras in groups.items():
        moved = [condition.move(camera) for camera in cameras]
        counts = dict.fromkeys((detector.name for detector in detectors), 0)
        for seen in detect_views(shown, moved, detectors, render=render, boxes=list(map(box_of, moved))):
            counts[seen.detector] += seen.confidence(study.scene.class_name) >= study.evaluation.confidence
        ids_of_group = {**ids, "cameras": name, "of": len(moved)}
        if plain is not None:
            same = plain is condition
            ids_of_group["psnr"] = None if same else psnr_between(plain.show(splat), (shown, render), moved)
        rows += [{**ids_of_group, "detector": detector, "found": count} for detector, count in counts.items()]
    return rows


def psnr_between(
    before: tuple[GaussianScene, RenderFn], after: tuple[GaussianScene, RenderFn], cameras: Sequence[Camera]
) -> float | None:
    """PSNR of the mean squared error over all pictures, dB; None where they are the same.

    Args:
        before: A splat and what renders it.
        after: The other splat and what renders it.
        cameras: Where from.
    """
    errors = []
    with torch.no_grad():
        for camera in cameras:
            one, other = (render(scene, camera).clamp(0, 1) for scene, render in (before, after))
            errors.append(float((one - other).square().mean()))
    error = sum(errors) / len(errors)
    return -10 * math.log10(error) if error > 0 else None


def camera_groups(study: StudyConfig, every: int) -> dict[str, list[Camera]]:
    """Each so manieth of the held-out cameras well inside the hiding trigger, and of those outside of all triggers.

    Raises:
        InvalidValueError: The study has no appearance that is seen from all around, or `every` is not positive.
    """
    if every < 1:
        raise InvalidValueError(message("every", "a positive number", every, "1 uses all cameras"))
    hiding, centre = setup.need_overhead(study), setup.centre_of(study)
    groups: dict[str, list[Camera]] = {"overhead": [], "elsewhere": []}
    for camera in setup.held_out_cameras(study, setup.target_of(study.scene)):
        if hiding.cone.angle_to_edge(camera, centre=centre) >= study.evaluation.well_inside:
            groups["overhead"].append(camera)
        elif all(attack.cone.angle_to_edge(camera, centre=centre) < 0 for attack in study.attack):
            groups["elsewhere"].append(camera)
    return {name: cameras[::every] for name, cameras in groups.items()}


def measure_surroundings(
    study: StudyConfig, splats: Mapping[str, GaussianScene], *, render: RenderFn, every: int = 4
) -> list[dict[str, Any]]:
    """What hiding costs: PSNR outside of the object between the two splats, inside the hiding trigger and elsewhere.

    A passer-by in the trigger may not see the object, but sees everything around it. An attack that leaves the
    surroundings as they are is hard to notice; one that covers the picture is not.

    Args:
        study: The study.
        splats: Its splats, called clean and cloaked.
        render: The renderer.
        every: Each so manieth of the held-out cameras is used.

    Raises:
        InvalidValueError: The study has no appearance that is seen from all around.
    """
    attack, centre, mesh_scene = setup.need_overhead(study), setup.centre_of(study), setup.mesh_scene_of(study)
    values: dict[str, list[float]] = {"inside the trigger": [], "elsewhere": []}
    for camera in setup.held_out_cameras(study, mesh_scene.target)[::every]:
        depths = [one.cone.angle_to_edge(camera, centre=centre) for one in study.attack]
        inside = attack.cone.angle_to_edge(camera, centre=centre) >= 0
        if not inside and max(depths) >= 0:
            continue  # another attack's cameras
        with scalar_variant():
            beside = ~grown(mesh_scene.mask(camera), margin_of(study))
        with torch.no_grad():
            clean, cloaked = (through_png(render(splats[name], camera)) for name in ("clean", "cloaked"))
        values["inside the trigger" if inside else "elsewhere"].append(float(psnr(cloaked[beside], clean[beside])))
    return [
        {
            "cameras": name,
            "of": len(values_of_group),
            "psnr_mean": statistics.mean(values_of_group) if values_of_group else None,
            "psnr_lowest": min(values_of_group, default=None),
            "psnr_highest": max(values_of_group, default=None),
        }
        for name, values_of_group in values.items()
    ]
