"""What one detector reports on one attacked splat under one condition: clean, attacked, and with noise of its size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch import Generator, Tensor

from attacks.budgets import Budget
from attacks.gaussian_subset import GaussianSubset
from attacks.limits import NormName
from attacks.observe.conditions import OWN, Condition, SunTable, Viewing, condition_of, rendered
from attacks.observe.look import look, report_cells, seen_from
from attacks.observe.rows import ATTACKED, CLEAN, NOISE
from attacks.observe.views import ViewDetections, object_boxes
from attacks.studies.attack import distribution
from attacks.studies.scenes import AttackScene, attack_scene, detectors_of
from attacks.transformations.config import Transformations
from attacks.transformations.draws import changing
from mi_splat.attributes import ATTRIBUTES, Attribute
from mi_splat.cameras import Camera
from mi_splat.errors import InvalidValueError, message
from mi_splat.io import load_splat
from mi_splat.scene import GaussianScene

if TYPE_CHECKING:
    from mi_splat.ledger import Out

HELD_OUT = "held-out views"
"""Name of the condition of looks from a region."""
_ANY = 1e9
"""A radius that binds nothing: noise has the size of the attack."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """One look.

    Attributes:
        object: Id of the object; with spaces for its underscores it is the object's class.
        target: Class wanted; None for none.
        detector: Name of the one that looks.
        attributes: What the attack could change.
        norm: Norm of its balls.
        seed: Of the noise, and of the views.
        fingerprints: Of the detector, if its weights are in no file.
    """

    object: str
    target: str | None
    detector: str
    attributes: tuple[Attribute, ...]
    norm: NormName
    seed: int
    fingerprints: tuple[str, ...] = ()

    @property
    def original(self) -> str:
        """The object's class."""
        return self.object.replace("_", " ")


@dataclass(frozen=True, slots=True, kw_only=True)
class FixedLook(Look):
    """A look through the cameras that were attacked.

    Attributes:
        eps: Radii of the attack's balls, which noise stays in: one for all attributes, or one for each.
        camera: See `attacks.studies.attack.FixedAttack`.
        views: See there.
        condition: How the splat is looked at, see `attacks.observe.conditions`.
        sun: The street of meshes, if the condition is an hour.
    """

    eps: tuple[float, ...]
    camera: int = 0
    views: int = 1
    condition: str = ""
    sun: SunTable | None = None

    @property
    def shown(self) -> str:
        """What the condition is called in rows."""
        return self.condition or OWN


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawnLook(Look):
    """A look from held-out views of a region.

    Attributes:
        sh_degree: Highest degree of the SH coefficients that the attack could change; None is the splat's.
        transformations: The views.
        views: Their number.
    """

    sh_degree: int | None
    transformations: Transformations
    views: int

    @property
    def shown(self) -> str:
        """What the condition is called in rows."""
        return HELD_OUT


def run(config: FixedLook | DrawnLook, inputs: Mapping[str, Path], out: Out) -> list[dict[str, Any]]:
    """Look, and return a row for each splat and view."""
    scene = attack_scene(inputs["scene"])
    saved = load_splat(inputs["attacked"])
    shown = _fixed(config, scene, saved) if isinstance(config, FixedLook) else _drawn(config, scene, saved)
    splats, boxes, condition = shown
    (detector,) = detectors_of((config.detector,), inputs)
    directions = seen_from(scene.centre(config.object))

    def cells(seen: ViewDetections) -> dict[str, Any]:
        reported = report_cells(seen.detections, seen.box, original=config.original, target=config.target)
        return {**directions(seen), **reported}

    looked = look([condition], splats, list(boxes), [detector], boxes=boxes.__getitem__, cells=cells)
    return [{**row, "condition": config.shown} for row in looked.rows.iter_rows(named=True)]


_Looked = tuple[dict[str, GaussianScene], dict[Camera, Tensor], Condition]


def _fixed(config: FixedLook, scene: AttackScene, saved: GaussianScene) -> _Looked:
    rows = scene.rows(config.object)
    clean, attacked = clean_and_attacked(scene.splat, rows, saved, config.attributes)
    reference, moved = (subset.parameters(config.attributes) for subset in (clean, attacked))
    radii = config.eps if len(config.eps) > 1 else config.eps * len(config.attributes)
    budget = Budget(radius=dict(zip(config.attributes, radii, strict=True)), norm=config.norm)
    noisy = clean.applied(budget.noise(moved, reference, Generator().manual_seed(config.seed + 1)))
    boxes = {}
    cameras = scene.views(config.object, camera=config.camera, count=config.views, seed=config.seed)
    for camera, box in zip(cameras, object_boxes(scene.splat, rows, cameras, render=scene.renderer("")), strict=True):
        if box is None:
            do = "choose another camera or seed"
            raise InvalidValueError(message(config.object, "a view that shows the object", "none of it", do))
        boxes[camera] = box
    splats = {CLEAN: clean.scene, ATTACKED: attacked.scene, NOISE: noisy}
    viewing = Viewing(
        settings=scene.settings,
        centre=scene.centre(config.object),
        alone=lambda splat: splat.select(rows),
        sun=config.sun,
    )
    return splats, boxes, condition_of(config.condition, viewing)


def _drawn(config: DrawnLook, scene: AttackScene, attacked: GaussianScene) -> _Looked:
    views = distribution(scene, config.object, config.transformations).views(config.seed, config.views)
    splats = {CLEAN: scene.splat, ATTACKED: attacked, NOISE: _noisy(scene, attacked, config)}
    render = changing(scene.renderer(""), {view.camera: view.change for view in views})
    return splats, {view.camera: view.box for view in views}, rendered(HELD_OUT, render)


def _noisy(scene: AttackScene, attacked: GaussianScene, config: DrawnLook) -> GaussianScene:
    """The clean scene with random noise as large as the attack, on what the attack could change."""
    rows = scene.rows(config.object)
    clean = GaussianSubset.of(scene.splat.with_degree(max(attacked.degree, scene.splat.degree)), rows)
    reference = clean.parameters(config.attributes)
    moved = GaussianSubset.of(attacked, rows).parameters(config.attributes)
    bands = slice(None if config.sh_degree is None else (config.sh_degree + 1) ** 2)
    budget = Budget(radius=dict.fromkeys(config.attributes, _ANY), norm=config.norm)
    after, before = ({name: _part(name, values[name], bands) for name in values} for values in (moved, reference))
    noise = budget.noise(after, before, Generator().manual_seed(config.seed + 1))
    for name, value in reference.items():
        reference[name] = value.clone()
        _part(name, reference[name], bands)[...] = noise[name]
    return clean.applied(reference)


def _part(name: str, value: Tensor, bands: slice) -> Tensor:
    return value[:, bands] if name == "sh" else value


def clean_and_attacked(
    scene: GaussianScene, rows: slice, saved: GaussianScene, attributes: Sequence[str]
) -> tuple[GaussianSubset, GaussianSubset]:
    """An object in the clean scene, with as many coefficients as the attacked one has, and in the attacked scene.

    Args:
        scene: The clean scene.
        rows: The object.
        saved: Its Gaussians after the attack, as they were loaded from their file.
        attributes: What of them was attacked; all else is taken from the clean scene.
    """
    clean = GaussianSubset.of(scene.with_degree(max(saved.degree, scene.degree)), rows)
    values = {
        name: whole.clone().index_put((clean.rows,), part)
        for name, whole, part in zip(ATTRIBUTES, clean.scene.tensors(), saved.tensors(), strict=True)
        if name in attributes
    }
    return clean, GaussianSubset.of(clean.scene.replace(**values), rows)
