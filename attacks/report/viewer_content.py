"""The content of the viewer for a file, a data set or the folder of a result."""

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from PIL import ImageDraw

from attacks.cloak.config import AttackConfig, StudyConfig, recorded_study
from attacks.cloak.own_pictures import RECORD as POISONED
from attacks.cloak.setup import Setup
from attacks.detectors.base import Detections, Detector
from attacks.observe.comparison import largest_changes
from attacks.observe.drawing import draw_detections
from attacks.observe.views import CAMERAS
from mi_splat.audit.files import HEAT
from mi_splat.cameras.camera import Camera
from mi_splat.cameras.directions import UP, Point
from mi_splat.cameras.framing import bounds
from mi_splat.datasets import is_dataset, load_dataset
from mi_splat.errors import InvalidValueError, MiSplatError, message, one_line
from mi_splat.io.camera_records import OF, camera_of
from mi_splat.io.folders import RECORD, check_links, splat_in
from mi_splat.io.parsing import read_json
from mi_splat.render.renderer import RenderSettings
from mi_splat.render.scene_files import open_scene
from mi_splat.scene import GaussianScene, scene_hash
from mi_splat.training.resume import CONFIG, poses_digest
from mi_splat.viewer.content import (
    Content,
    Inspector,
    ShownSplat,
    content_of_dataset,
    content_of_file,
    with_cameras,
)
from mi_splat.viewer.orbit import Orbit, orbit_of

ATTACKED = "attacked.ply"
_BROKEN = (LookupError, TypeError, ValueError, AttributeError)
"""What reading a record raises that lacks something, or has something else in its
place.
"""


def open_content(
    path: Path,
    *,
    clean: Path | None = None,
    up: Point | None = None,
    cameras: Path | None = None,
    background: tuple[float, float, float] | None = None,
) -> Content:
    """A splat, scene XML, data set, or folder of `train`, `dagger`, `evaluate`, `cloak`
    or `audit`.
    """
    content = _opened(path, clean, background or (0.0, 0.0, 0.0))
    run = path / CONFIG
    if run.is_file() and content.photographs is None:
        content, set_of_training = _rendered_as_trained(content, read_json(run))
        cameras = cameras or set_of_training
    if background is not None:
        content = replace(
            content, settings=replace(content.settings, background=background)
        )
    if cameras is not None:
        content = with_cameras(content, cameras)
    if up is None:
        up = recorded_up(path)
        if tuple(up) == UP and content.file_up is not None:
            up = content.file_up.direction
    return content.turned(up)


def recorded_up(path: Path) -> Point:
    """(3,) direction that was up when a folder was made: a result, or a poisoned set; z
    if it does not say.
    """
    for file in (path / RECORD, path / POISONED):
        try:
            x, y, z = (
                map(float, read_json(file).get("up") or UP) if file.is_file() else UP
            )
        except (TypeError, ValueError, AttributeError) as error:
            raise InvalidValueError.of(
                f"{file}: up", "three numbers", repr(error), "pass --up"
            ) from error
        if (x, y, z) != UP:
            return x, y, z
    return UP


def _rendered_as_trained(
    content: Content, run: Mapping[str, Any]
) -> tuple[Content, Path | None]:
    """The splat of a training with its near plane and background, and its data set, if
    that is where it was.
    """
    values = run.get("settings") or {}
    usual = content.settings
    try:
        red, green, blue = map(float, values.get("background") or usual.background)
        settings = replace(
            usual,
            near=float(values.get("near", usual.near)),
            background=(red, green, blue),
        )
    except _BROKEN as error:
        what = f"settings in {CONFIG}"
        do = "train again"
        raise InvalidValueError.of(
            what, "near and background", repr(error), do
        ) from error
    set_of_training = _set_of_training(run)
    without = (
        f"{content.title}; the set of its training is not where it was: --cameras"
        " names it"
    )
    if run.get("dataset") is not None and set_of_training is None:
        title = without
    else:
        title = content.title
    return replace(content, settings=settings, title=title), set_of_training


def _set_of_training(run: Mapping[str, Any]) -> Path | None:
    """The data set that a training names, if that has the poses of its images.

    A folder of others may name any path of this machine or of the network. Nothing is
    said of what lies there, and nothing is shown of it, unless whoever made the folder
    knew its poses.
    """
    recorded = _recorded_path(run.get("dataset"))
    if recorded is None:
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            same = is_dataset(recorded) and poses_digest(
                load_dataset(recorded).cameras
            ) == run.get("poses")
    except (MiSplatError, OSError):
        return None
    if same:
        return recorded
    return None


def _recorded_path(value: object) -> Path | None:
    """A path that a record names, which others may have written; None for one of the
    network.
    """
    if not isinstance(value, str) or value.startswith(_NETWORK):
        return None
    return Path(value)


_NETWORK = ("//", "\\\\")


def _opened(
    path: Path, clean: Path | None, background: tuple[float, float, float]
) -> Content:
    """As `open_content`, as the files have it."""
    is_result = (path / RECORD).is_file()
    if is_dataset(path) and not is_result and not splat_in(path):
        if clean is not None:
            do = "view that splat, with --cameras for the set"
            raise InvalidValueError.of(
                "clean", "nothing with a set of images", clean, do
            )
        return content_of_dataset(path, background=background)
    if not is_result and (not path.is_dir() or splat_in(path)):
        content = content_of_file(path, clean=clean)
        counts = [len(splat.scene) for splat in content.splats]
        if len(set(counts)) > 1:
            got = f"{counts[0]:,} and {counts[1]:,}"
            do = "pass the scene that was attacked"
            raise InvalidValueError.of(
                "the scenes", "the same Gaussians in both", got, do
            )
        return content
    if not is_result:
        expected = f"{RECORD} of mi-splat dagger, evaluate, cloak or audit in it"
        do = "pass a finished result, a set"
        raise InvalidValueError.of(
            str(path), expected, "none", f"{do} of images, or a .ply or .xml file"
        )
    check_links(path)
    record = read_json(path / RECORD)
    reader = {"audit": _content_of_audit, "cloak": _content_of_study}.get(
        str(record.get("story")), _content_of_attack
    )
    try:
        return reader(path, record, clean)
    except MiSplatError:
        raise
    except _BROKEN as error:
        expected = "a result of mi-splat dagger, evaluate, cloak or audit"
        do = "make the result again"
        raise InvalidValueError.of(
            str(path / RECORD), expected, repr(error), do
        ) from error


def _content_of_attack(
    folder: Path, record: Mapping[str, Any], clean: Path | None
) -> Content:
    """The clean and the attacked splat of a DAGGER result or of an evaluation, from the
    cameras that looked at both.
    """
    rendered = dict[str, Any]()
    evaluated = record.get("story") == "evaluate"
    if evaluated:
        entries = record["cameras"]
        kind = "judging"
        path = _needed_path(record["attacked"], folder)
        names = labels = [str(entry["name"]) for entry in entries]
        expected = str(record["clean_hash"])
        recorded = record["clean"]
    else:
        # every detector looked from the same cameras
        first = record["views"][0]["detector"]
        entries = [
            view["camera"] for view in record["views"] if view["detector"] == first
        ]
        kind = "held-out" if "reference" in record else "attacked"
        path = folder / ATTACKED
        names = [str(number) for number in range(len(entries))]
        labels = [f"{kind} view {name}" for name in names]
        expected = str(record["scene_hash"])
        recorded = record.get("scene")
    views = [camera_of(entry) for entry in entries]
    size = views[0].width, views[0].height
    # not known of a result from Python whose images a function made
    if "near" in record:
        red, green, blue = map(float, record["background"])
        rendered = {"near": float(record["near"]), "background": (red, green, blue)}
    splat = _clean_splat(folder, expected, clean, recorded=recorded)
    loaded = open_scene(path)
    if evaluated and scene_hash(loaded.scene) != record.get("attacked_hash"):
        raise InvalidValueError.of(
            str(path), "the splat that was evaluated", "another", "evaluate it again"
        )
    middle = middle_of_change(splat.scene, loaded.scene)
    of_scene = content_of_file(splat.path)
    source = f"{folder / (CAMERAS if (folder / CAMERAS).is_file() else RECORD)}{OF}"
    cameras = {
        label: orbit_of(camera, middle, source=f"{source}{name}")
        for label, name, camera in zip(labels, names, views, strict=True)
    }
    return Content(
        title=(
            f"{f'Evaluation of {path.name}' if evaluated else _purpose(record)}"
            f" ({folder})"
        ),
        splats=(splat, ShownSplat(name="attacked", scene=loaded.scene, path=path)),
        settings=replace(of_scene.settings, **rendered),
        start=next(iter(cameras.values()), of_scene.start),
        size=size,
        cameras={**cameras, **of_scene.cameras, **cameras},
    )


def _needed_path(value: object, folder: Path) -> Path:
    path = _recorded_path(value)
    if path is None:
        expected = "the path of a splat on this machine"
        do = "make the result again"
        raise InvalidValueError.of(
            str(folder / RECORD), expected, one_line(repr(value), 80), do
        )
    return path


_PURPOSES = {
    "relabel": "target class {}",
    "hide": "object to be missed",
    "untargeted": "untargeted",
}


def _purpose(record: Mapping[str, Any]) -> str:
    """What a DAGGER attack was to do, in a line."""
    scene = record.get("scene")
    names = [str(entry["detector"]) for entry in record.get("detectors") or ()]
    where = f" on {Path(scene).stem}" if isinstance(scene, str) else ""
    wanted = _PURPOSES.get(str(record.get("objective")), "attacked").format(
        record.get("target")
    )
    return f"DAGGER{where}: {wanted}" + (f", {', '.join(names)}" if names else "")


def middle_of_change(clean: GaussianScene, attacked: GaussianScene) -> Point:
    """(3,) mean of the Gaussians that an attack has changed, world units: the middle of
    the attacked object.
    """
    changed = largest_changes(clean, attacked) > 1e-4  # a file rounds
    if not bool(changed.any()):
        return bounds(clean)[0]
    x, y, z = clean.means[changed].double().mean(0).tolist()
    return x, y, z


def _clean_splat(
    folder: Path, expected: str, clean: Path | None, *, recorded: object
) -> ShownSplat:
    """The scene with this hash: the one that is named, the one that the result names,
    or one of those near by.
    """
    source = _recorded_path(recorded)
    named = [source] if source is not None and source.is_file() else []
    near = (
        path
        for base in (folder, folder.parent, Path(), Path("scenes"))
        for path in sorted(base.glob("*.xml"))
    )
    for path in [clean] if clean is not None else [*named, *near]:
        try:
            loaded = open_scene(path)
        except MiSplatError:
            if clean is not None:
                raise
            continue
        if scene_hash(loaded.scene) == expected:
            return ShownSplat(name="clean", scene=loaded.scene, path=path)
        if clean is not None:
            do = "pass the scene that was attacked"
            raise InvalidValueError.of(
                f"clean scene {clean}", f"the hash {expected}", "another", do
            )
    text = message(
        f"clean scene of {folder}",
        f"the hash {expected}",
        "no such scene here",
        "name the clean scene",
    )
    raise InvalidValueError(text).hinted("--clean")


def _content_of_audit(
    folder: Path, record: Mapping[str, Any], audited: Path | None
) -> Content:
    """The splat beside its heat, from the cameras that prove a look."""
    path = audited or _needed_path(record["file"], folder)
    count = int(record["gaussians"])
    x, y, z = map(
        float, max(record["objects"], key=lambda item: item["evidence"])["centre"]
    )
    views = {str(values["name"]): camera_of(values) for values in record["cameras"]}
    if not path.exists():
        text = message(
            f"the splat of {folder}",
            f"the file {path}",
            "nothing there",
            "name the splat that was audited",
        )
        raise InvalidValueError(text).hinted("--clean")
    content = content_of_file(path, name="audited")
    splats = content.splats
    heat = folder / HEAT
    if len(splats[0].scene) != count:
        do = "name the splat that was audited"
        raise InvalidValueError.of(
            str(path), f"{count:,} Gaussians", f"{len(splats[0].scene):,}", do
        ).hinted("--clean")
    if heat.is_file():
        splats = (
            *splats,
            ShownSplat(name="heat", scene=open_scene(heat).scene, path=heat),
        )
    source = f"{folder / RECORD}{OF}"
    proving = {
        name: orbit_of(camera, (x, y, z), source=f"{source}{name}")
        for name, camera in views.items()
    }
    of_file = {
        f"{name} of the file" if name in proving else name: orbit
        for name, orbit in content.cameras.items()
    }
    return replace(
        content,
        title=f"Audit of {path.name} ({folder})",
        splats=splats,
        start=next(iter(proving.values()), content.start),
        cameras={**proving, **of_file},
    )


def _content_of_study(
    folder: Path, record: Mapping[str, Any], clean: Path | None
) -> Content:
    """The clean and the cloaked splat of a study of CLOAK."""
    if clean is not None:
        raise InvalidValueError.of(
            "clean", "nothing, since a study has its own", clean, "leave it out"
        )
    if not isinstance(record.get("study"), dict):
        expected = "a study of CLOAK"
        do = "make it again with mi-splat cloak"
        raise InvalidValueError.of(f"{folder}", expected, "one without its study", do)
    study = recorded_study(record["study"], f"the study of {folder}")
    centre, cameras, size = (
        study.centre,
        Setup.of(study).training_cameras,
        (study.cameras.size, study.cameras.size),
    )
    distance = math.dist(cameras[0].position.tolist(), centre)
    start = Orbit(
        target=centre,
        azimuth=30.0,
        elevation=15.0,
        distance=distance,
        fov=study.cameras.fov,
    )
    triggers = {
        f"inside {attack.name}": _kept(_inside(attack, start), size)
        for attack in study.attack
    }
    named: dict[str, Orbit] = {}
    for number, is_poisoned in sorted(
        enumerate(_poisoned(study, cameras)), key=lambda item: not item[1]
    ):
        name = f"{'poisoned' if is_poisoned else 'training'} camera {number}"
        named[name] = orbit_of(cameras[number], centre)
    files = {name: folder / f"{name}.ply" for name in ("clean", "cloaked")}
    return Content(
        title=f"CLOAK, study {study.name}: what the triggers show ({folder})",
        splats=tuple(
            ShownSplat(name=name, scene=open_scene(path).scene, path=path)
            for name, path in files.items()
        ),
        settings=RenderSettings(background=study.scene.background),
        start=next(iter(triggers.values()), start),
        size=size,
        cameras={**triggers, "start": _kept(start, size), **named},
        describe=lambda camera: tuple(
            _position(attack, camera, centre) for attack in study.attack
        ),
    )


def _inside(attack: AttackConfig, start: Orbit) -> Orbit:
    """A camera well inside a trigger."""
    azimuth = start.azimuth if attack.azimuth is None else attack.azimuth[0]
    return replace(start, azimuth=azimuth, elevation=sum(attack.elevation) / 2)


def _kept(orbit: Orbit, size: tuple[int, int]) -> Orbit:
    """A camera that stays what it is where another direction is up."""
    return replace(orbit, exact=orbit.camera(size))


def _poisoned(study: StudyConfig, cameras: list[Camera]) -> list[bool]:
    """Whether the image of each training camera was poisoned."""
    triggers = [attack.trigger(study.seeds[0], study.attack) for attack in study.attack]
    held: list[bool] = (
        torch.stack(
            [trigger.holds(cameras, centre=study.centre) for trigger in triggers]
        )
        .any(0)
        .tolist()
    )
    return held


def _position(attack: AttackConfig, camera: Camera, centre: Point) -> str:
    """Where a camera stands to a trigger, in words."""
    if math.dist(camera.position.tolist(), centre) == 0:
        return f"Trigger {attack.name}: the camera stands at the centre"
    degrees = attack.cone.angle_to_edge(camera, centre=centre)
    return (
        f"Trigger {attack.name}: {abs(degrees):.1f}°"
        f" {'inside' if degrees >= 0 else 'outside'}"
    )


# What a detector reports

MIN_CONFIDENCE = 0.3
"""Confidence from which a detection is shown."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class DetectorInspection:
    """What a detector reports on one image."""

    detections: Detections  # all of it
    min_confidence: float = MIN_CONFIDENCE  # confidence from which a detection is shown

    @property
    def text(self) -> str:
        """Classes and confidences, best first."""
        rows = zip(self.detections.labels, self.detections.scores.tolist(), strict=True)
        shown = [
            f"{label} {score:.1%}"
            for label, score in rows
            if score >= self.min_confidence
        ]
        return ", ".join(shown) or f"nothing at {self.min_confidence:.0%} or more"

    def draw(self, draw: ImageDraw.ImageDraw, scale: float) -> None:
        """As in `mi_splat.viewer.content.Inspection`."""
        draw_detections(
            draw, self.detections, scale=scale, min_confidence=self.min_confidence
        )


def detector_inspector(
    detector: Detector, *, min_confidence: float = MIN_CONFIDENCE
) -> Inspector:
    """A function that looks at an image of a page with a detector, as an evaluation
    does.
    """
    return lambda picture: DetectorInspection(
        detections=detector.detect(picture[None])[0], min_confidence=min_confidence
    )
