"""What there is to see of a file or of a folder with results, as an exhibit: splats, cameras, triggers, detections."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from PIL import ImageDraw
from torch import Tensor

from attacks.cloak.config import AttackConfig, StudyConfig
from attacks.cloak.setup import Setup
from attacks.detectors.base import Detections, Detector
from attacks.observe.drawing import draw_detections
from mi_splat.audit.files import HEAT
from mi_splat.bounds import bounds
from mi_splat.cameras import Camera
from mi_splat.directions import UP, Point
from mi_splat.errors import InvalidValueError, MiSplatError, message
from mi_splat.fields import decode
from mi_splat.io.camera_records import camera_of
from mi_splat.io.folders import RECORD, splat_in
from mi_splat.io.parsing import read_json
from mi_splat.rendering import RenderSettings
from mi_splat.scene import GaussianScene, scene_hash
from mi_splat.scene_files import open_scene
from mi_splat.viewer.exhibit import Exhibit, Inspector, ShownSplat, exhibit_of_file
from mi_splat.viewer.lines import Lines, arc, frustums
from mi_splat.viewer.orbit import Orbit, orbit_of

ATTACKED = "attacked.ply"


def open_exhibit(path: Path, *, clean: Path | None = None, up: Point = UP) -> Exhibit:
    """A splat, a scene XML, or a folder that `mi-splat dagger`, `dagger-eot`, `cloak` or `audit` has written.

    Args:
        path: The file or the folder.
        clean: Splat file or scene XML to compare with. Of a folder of `mi-splat dagger` it is found, if it lies among
            the scenes of the working folder; a folder of `mi-splat cloak` has its own. Of an audit, the splat that was
            audited, if it is not any more where it was.
        up: (3,) direction that is up in splats and scenes.

    Raises:
        MiSplatError: It is none of these, a file in it is missing or broken, or the clean scene is not the one that was
            attacked.
    """
    if not path.is_dir() or (splat_in(path) and not (path / RECORD).is_file()):
        exhibit = exhibit_of_file(path, clean=clean, up=up)
        counts = [len(splat.scene) for splat in exhibit.splats]
        if len(set(counts)) > 1:
            got, do = f"{counts[0]:,} and {counts[1]:,}", "pass the scene that was attacked"
            raise InvalidValueError(message("the scenes", "the same Gaussians in both", got, do))
        return exhibit
    if tuple(up) != UP:
        do = "view the splats in it, the attacked one with --clean"
        raise InvalidValueError(message("up", "z for a folder of results", up, do))
    if not (path / RECORD).is_file():
        do = "pass a finished result, or a .ply or .xml file"
        raise InvalidValueError(message(str(path), f"{RECORD} of mi-splat dagger, cloak or audit in it", "none", do))
    record = read_json(path / RECORD)
    if record.get("story") == "audit":
        return _exhibit_of_audit(path, record, clean)
    if record.get("story") != "cloak":
        return _exhibit_of_attack(path, record, clean)
    if clean is not None:
        raise InvalidValueError(message("clean", "nothing, since a study has its own", clean, "leave it out"))
    return _exhibit_of_study(path, record)


def _exhibit_of_attack(folder: Path, record: Mapping[str, Any], clean: Path | None) -> Exhibit:
    """The clean and the attacked splat of a DAGGER result, from the cameras that were attacked or that judged it."""
    rendered = dict[str, Any]()
    try:
        first = record["views"][0]["detector"]  # every detector looked from the same cameras
        views = [camera_of(view["camera"]) for view in record["views"] if view["detector"] == first]
        expected, kind = str(record["scene_hash"]), "held-out" if "reference" in record else "attacked"
        if "near" in record:  # not known of a result from Python whose pictures a function made
            red, green, blue = map(float, record["background"])
            rendered = {"near": float(record["near"]), "background": (red, green, blue)}
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        do = "make the result again with mi-splat dagger"
        raise InvalidValueError(message(str(folder / RECORD), "a result of DAGGER", repr(error), do)) from error
    splat = _clean_splat(folder, expected, clean, recorded=record.get("scene"))
    attacked = open_scene(folder / ATTACKED).scene
    middle, of_scene = middle_of_change(splat.scene, attacked), exhibit_of_file(splat.path)
    orbits = {f"{kind} view {number}": orbit_of(camera, middle) for number, camera in enumerate(views)}
    cameras = {name: orbit for name, orbit in orbits.items() if orbit is not None}
    cones = Lines(segments=frustums(views, 0.1 * bounds(splat.scene)[1]), colour="#ffa500")
    return Exhibit(
        title=str(folder),
        splats=(
            splat,
            ShownSplat(name="attacked", scene=attacked, path=folder / ATTACKED, file_settings=RenderSettings()),
        ),
        settings=replace(splat.file_settings, **rendered),
        start=next(iter(cameras.values()), of_scene.start),
        size=(views[0].width, views[0].height),
        cameras={**cameras, **of_scene.cameras},
        lines={f"{kind.capitalize()} cameras": cones},
    )


def middle_of_change(clean: GaussianScene, attacked: GaussianScene) -> Point:
    """(3,) mean of the Gaussians that an attack has changed, world units: the middle of the attacked object.

    Raises:
        InvalidValueError: The scenes have different numbers of Gaussians.
    """
    if len(clean) != len(attacked):
        do = "pass the scene that was attacked"
        raise InvalidValueError(message("attacked.ply", f"{len(clean)} Gaussians", len(attacked), do))
    degree = max(clean.degree, attacked.degree)
    pairs = zip(clean.with_degree(degree).tensors(), attacked.with_degree(degree).tensors(), strict=True)
    rows = [(before - after).abs().reshape(len(before), -1).amax(1) for before, after in pairs]
    changed = torch.stack(rows).amax(0) > 1e-4  # a file rounds
    if not bool(changed.any()):
        return bounds(clean)[0]
    x, y, z = clean.means[changed].double().mean(0).tolist()
    return x, y, z


def _clean_splat(folder: Path, expected: str, clean: Path | None, *, recorded: object) -> ShownSplat:
    """The scene with this hash: the one that is named, the one that the result names, or one of those near by."""
    named = [Path(recorded)] if isinstance(recorded, str) and Path(recorded).is_file() else []
    near = (path for base in (folder, folder.parent, Path(), Path("scenes")) for path in sorted(base.glob("*.xml")))
    for path in [clean] if clean is not None else [*named, *near]:
        try:
            loaded = open_scene(path)
        except MiSplatError:
            if clean is not None:
                raise
            continue
        if scene_hash(loaded.scene) == expected:
            return ShownSplat(name="clean", scene=loaded.scene, path=path, file_settings=loaded.settings)
        if clean is not None:
            do = "pass the scene that was attacked"
            raise InvalidValueError(message(f"clean scene {clean}", f"the hash {expected}", "another", do))
    text = message(f"clean scene of {folder}", f"the hash {expected}", "no such scene here", "name the clean scene")
    raise InvalidValueError(text).hinted("--clean")


# An audit


def _exhibit_of_audit(folder: Path, record: Mapping[str, Any], audited: Path | None) -> Exhibit:
    """The splat beside its heat, from the cameras that prove a look."""
    try:
        path = audited or Path(record["file"])
        x, y, z = map(float, max(record["objects"], key=lambda item: item["evidence"])["centre"])
        views = {str(values["name"]): camera_of(values) for values in record["cameras"]}
        count = int(record["gaussians"])
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        do = "make the result again with mi-splat audit"
        raise InvalidValueError(message(str(folder / RECORD), "an audit", repr(error), do)) from error
    if not path.exists():
        text = message(f"the splat of {folder}", f"the file {path}", "nothing there", "name the splat that was audited")
        raise InvalidValueError(text).hinted("--clean")
    exhibit = exhibit_of_file(path, name="audited")
    splats, heat = exhibit.splats, folder / HEAT
    if len(splats[0].scene) != count:
        do = "name the splat that was audited"
        got = f"{len(splats[0].scene):,}"
        raise InvalidValueError(message(str(path), f"{count:,} Gaussians", got, do)).hinted("--clean")
    if heat.is_file():
        hot = ShownSplat(name="heat", scene=open_scene(heat).scene, path=heat, file_settings=splats[0].file_settings)
        splats = (*splats, hot)
    orbits = {name: orbit_of(camera, (x, y, z)) for name, camera in views.items()}
    cameras = {name: orbit for name, orbit in orbits.items() if orbit is not None}
    distance = min((orbit.distance for orbit in cameras.values()), default=1.0)
    lines = Lines(segments=frustums(list(views.values()), 0.1 * distance), colour="#ffa500")
    return replace(
        exhibit,
        title=str(folder),
        splats=splats,
        start=next(iter(cameras.values()), exhibit.start),
        cameras={
            **cameras,
            **{f"{name} of the file" if name in cameras else name: orbit for name, orbit in exhibit.cameras.items()},
        },
        lines={"Cameras that prove it": lines} if views else {},
    )


# A study of CLOAK

REGION_RADIUS = 0.5
"""Radius of the sphere that regions of directions are drawn on, in distances of the cameras."""
_COLOURS = ("#ffa500", "#00d0ff", "#ff60d0", "#a0ff40")


def _exhibit_of_study(folder: Path, record: Mapping[str, Any]) -> Exhibit:
    """The clean and the cloaked splat of a study."""
    if not isinstance(record.get("study"), dict):
        expected, do = "a study of CLOAK", "make it again with mi-splat cloak"
        raise InvalidValueError(message(f"{folder}", expected, "one without its study", do))
    study = decode(StudyConfig, record["study"], f"the study of {folder}")
    loaded = {name: open_scene(folder / f"{name}.ply") for name in ("clean", "cloaked")}
    centre, cameras = study.centre, Setup(study).training_cameras
    distance = math.dist(cameras[0].position.tolist(), centre)
    start = Orbit(target=centre, azimuth=30.0, elevation=15.0, distance=distance, fov=study.cameras.fov)
    regions = {
        f"Trigger {attack.name}": Lines(segments=region(attack, centre, REGION_RADIUS * distance), colour=colour)
        for attack, colour in zip(study.attack, itertools.cycle(_COLOURS))
    }
    return Exhibit(
        title=f"{study.name} ({folder})",
        splats=tuple(
            ShownSplat(name=name, scene=splat.scene, path=folder / f"{name}.ply", file_settings=splat.settings)
            for name, splat in loaded.items()
        ),
        settings=RenderSettings(background=study.scene.background),
        start=start,
        size=(study.cameras.size, study.cameras.size),
        cameras={"start": start, **{f"inside {attack.name}": _inside(attack, start) for attack in study.attack}},
        lines={**regions, **_cameras(study, cameras, 0.04 * distance)},
        describe=lambda camera: tuple(_position(attack, camera, centre) for attack in study.attack),
    )


def region(attack: AttackConfig, centre: Point, radius: float) -> torch.Tensor:
    """(S, 2, 3) edges of the directions from which an attack is to be seen, on a sphere.

    Args:
        attack: Whose.
        centre: (3,) of the sphere, world units.
        radius: Of the sphere, world units.
    """
    low, high = attack.elevation
    middle, half = attack.azimuth or (180.0, 180.0)
    west, east = middle - half, middle + half
    parts = [
        arc(centre, radius, (west, elevation), (east, elevation))
        for elevation in (low, high)
        if -90 < elevation < 90  # at a pole a parallel is a point
    ]
    edges = (west, east) if attack.azimuth else tuple(west + 45.0 * i for i in range(8))
    parts += [arc(centre, radius, (azimuth, low), (azimuth, high)) for azimuth in edges]
    return torch.cat(parts)


def _inside(attack: AttackConfig, start: Orbit) -> Orbit:
    """A camera well inside a trigger."""
    azimuth = start.azimuth if attack.azimuth is None else attack.azimuth[0]
    return replace(start, azimuth=azimuth, elevation=sum(attack.elevation) / 2)


def _cameras(study: StudyConfig, cameras: list[Camera], length: float) -> dict[str, Lines]:
    """The training cameras, those whose pictures were poisoned apart."""
    centre, seed = study.centre, study.seeds[0]
    triggers = [attack.trigger(seed, study.attack) for attack in study.attack]
    poisoned = torch.stack([trigger.holds(cameras, centre=centre) for trigger in triggers]).any(0).tolist()
    groups = {"Poisoned cameras": ("#ff4040", True), "Other training cameras": ("#f0f0f0", False)}
    return {
        name: Lines(
            segments=frustums([camera for camera, is_in in zip(cameras, poisoned, strict=True) if is_in is of], length),
            colour=colour,
        )
        for name, (colour, of) in groups.items()
    }


def _position(attack: AttackConfig, camera: Camera, centre: Point) -> str:
    """Where a camera stands to a trigger, in words."""
    if math.dist(camera.position.tolist(), centre) == 0:
        return f"Trigger {attack.name}: the camera stands at the centre"
    degrees = attack.cone.angle_to_edge(camera, centre=centre)
    return f"Trigger {attack.name}: {abs(degrees):.1f}° {'inside' if degrees >= 0 else 'outside'}"


# What a detector reports

MIN_CONFIDENCE = 0.3
"""Confidence from which a detection is shown."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class DetectorInspection:
    """What a detector reports on one picture.

    Attributes:
        detections: All of it.
        min_confidence: Confidence from which a detection is shown.
    """

    detections: Detections
    min_confidence: float = MIN_CONFIDENCE

    @property
    def text(self) -> str:
        """Classes and confidences, best first."""
        rows = zip(self.detections.labels, self.detections.scores.tolist(), strict=True)
        shown = [f"{label} {score:.1%}" for label, score in rows if score >= self.min_confidence]
        return ", ".join(shown) or f"nothing at {self.min_confidence:.0%} or more"

    def draw(self, draw: ImageDraw.ImageDraw, scale: float) -> None:
        """As in `mi_splat.viewer.exhibit.Inspection`."""
        draw_detections(draw, self.detections, scale=scale, min_confidence=self.min_confidence)


def detector_inspector(detector: Detector, *, min_confidence: float = MIN_CONFIDENCE) -> Inspector:
    """Lets a detector look at the pictures of a page, as it looks at those of an evaluation."""

    def inspect(picture: Tensor) -> DetectorInspection:
        (detections,) = detector.detect(picture[None])
        return DetectorInspection(detections=detections, min_confidence=min_confidence)

    return inspect
