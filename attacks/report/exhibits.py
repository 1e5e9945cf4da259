"""What there is to see of a file, a set or a folder with results, as an exhibit: splats, cameras, detections."""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from PIL import ImageDraw
from torch import Tensor

from attacks.cloak.own_pictures import RECORD as POISONED
from attacks.detectors.base import Detections, Detector
from attacks.observe.drawing import draw_detections
from attacks.observe.result_cameras import CAMERAS
from attacks.report.study_exhibit import exhibit_of_study
from mi_splat.audit.files import HEAT
from mi_splat.bounds import bounds
from mi_splat.datasets import is_dataset, load_dataset
from mi_splat.directions import UP, Point
from mi_splat.errors import InvalidValueError, MiSplatError, message
from mi_splat.io.camera_records import OF, camera_of
from mi_splat.io.folders import RECORD, splat_in
from mi_splat.io.parsing import read_json
from mi_splat.scene import GaussianScene, scene_hash
from mi_splat.scene_files import open_scene
from mi_splat.training.resume import CONFIG, poses_digest
from mi_splat.viewer.exhibit import Exhibit, Inspector, ShownSplat, exhibit_of_file
from mi_splat.viewer.lines import Lines, frustums
from mi_splat.viewer.orbit import orbit_of
from mi_splat.viewer.photographs import exhibit_of_dataset, with_cameras

ATTACKED = "attacked.ply"


def open_exhibit(
    path: Path,
    *,
    clean: Path | None = None,
    up: Point | None = None,
    cameras: Path | None = None,
    background: tuple[float, float, float] | None = None,
) -> Exhibit:
    """A splat, scene XML, data set, or folder of `train`, `dagger`, `evaluate`, `cloak` or `audit`."""
    exhibit = _opened(path, clean, background or (0.0, 0.0, 0.0))
    run = path / CONFIG
    if run.is_file() and exhibit.photographs is None:
        exhibit, set_of_training = _rendered_as_trained(exhibit, read_json(run))
        cameras = cameras or set_of_training
    if background is not None:
        exhibit = replace(exhibit, settings=replace(exhibit.settings, background=background))
    if cameras is not None:
        exhibit = with_cameras(exhibit, cameras)
    return exhibit.turned(recorded_up(path) if up is None else up)


def recorded_up(path: Path) -> Point:
    """(3,) direction that was up when a folder was made: a result, or a poisoned set; z if it does not say."""
    for file in (path / RECORD, path / POISONED):
        try:
            x, y, z = map(float, read_json(file).get("up") or UP) if file.is_file() else UP
        except (TypeError, ValueError, AttributeError) as error:
            raise InvalidValueError.of(f"{file}: up", "three numbers", repr(error), "pass --up") from error
        if (x, y, z) != UP:
            return x, y, z
    return UP


def _rendered_as_trained(exhibit: Exhibit, run: Mapping[str, Any]) -> tuple[Exhibit, Path | None]:
    """The splat of a training with its near plane and background, and its data set, if that is where it was."""
    values = run.get("settings") or {}
    try:
        red, green, blue = map(float, values.get("background") or exhibit.settings.background)
        settings = replace(
            exhibit.settings, near=float(values.get("near", exhibit.settings.near)), background=(red, green, blue)
        )
    except (TypeError, ValueError, AttributeError) as error:
        raise InvalidValueError.of(
            f"settings in {CONFIG}", "near and background", repr(error), "train again"
        ) from error
    set_of_training = _set_of_training(run)
    without = f"{exhibit.title}; the set of its training is not where it was: --cameras names it"
    title = without if run.get("dataset") is not None and set_of_training is None else exhibit.title
    return replace(exhibit, settings=settings, title=title), set_of_training


def _set_of_training(run: Mapping[str, Any]) -> Path | None:
    """The data set that a training names, if that has the poses of its pictures.

    A folder of others may name any path of this machine or of the network. Nothing is said of what lies there, and
    nothing is shown of it, unless whoever made the folder knew its poses.
    """
    recorded = run.get("dataset")
    if not isinstance(recorded, str) or recorded.startswith(("//", "\\\\")):
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            same = is_dataset(recorded) and poses_digest(load_dataset(recorded).cameras) == run.get("poses")
    except (MiSplatError, OSError):
        return None
    return Path(recorded) if same else None


def _opened(path: Path, clean: Path | None, background: tuple[float, float, float]) -> Exhibit:
    """As `open_exhibit`, as the files have it."""
    if is_dataset(path) and not (path / RECORD).is_file() and not splat_in(path):
        if clean is not None:
            do = "view that splat, with --cameras for the set"
            raise InvalidValueError.of("clean", "nothing beside a set of pictures", clean, do)
        return exhibit_of_dataset(path, background=background)
    if not path.is_dir() or (splat_in(path) and not (path / RECORD).is_file()):
        exhibit = exhibit_of_file(path, clean=clean)
        counts = [len(splat.scene) for splat in exhibit.splats]
        if len(set(counts)) > 1:
            got, do = f"{counts[0]:,} and {counts[1]:,}", "pass the scene that was attacked"
            raise InvalidValueError.of("the scenes", "the same Gaussians in both", got, do)
        return exhibit
    if not (path / RECORD).is_file():
        do = "pass a finished result, a set of pictures, or a .ply or .xml file"
        raise InvalidValueError.of(
            str(path), f"{RECORD} of mi-splat dagger, evaluate, cloak or audit in it", "none", do
        )
    record = read_json(path / RECORD)
    if record.get("story") == "audit":
        return _exhibit_of_audit(path, record, clean)
    if record.get("story") != "cloak":
        return _exhibit_of_attack(path, record, clean)
    if clean is not None:
        raise InvalidValueError.of("clean", "nothing, since a study has its own", clean, "leave it out")
    return exhibit_of_study(path, record)


def _exhibit_of_attack(folder: Path, record: Mapping[str, Any], clean: Path | None) -> Exhibit:
    """The clean and the attacked splat of a DAGGER result or of an evaluation, from the cameras that looked at both."""
    rendered, evaluated = dict[str, Any](), record.get("story") == "evaluate"
    try:
        if evaluated:
            entries, kind, path = record["cameras"], "judging", Path(record["attacked"])
            names = labels = [str(entry["name"]) for entry in entries]
            expected, recorded = str(record["clean_hash"]), record["clean"]
        else:
            first = record["views"][0]["detector"]  # every detector looked from the same cameras
            entries = [view["camera"] for view in record["views"] if view["detector"] == first]
            kind, path = "held-out" if "reference" in record else "attacked", folder / ATTACKED
            names = [str(number) for number in range(len(entries))]
            labels = [f"{kind} view {name}" for name in names]
            expected, recorded = str(record["scene_hash"]), record.get("scene")
        views = [camera_of(entry) for entry in entries]
        size = views[0].width, views[0].height
        if "near" in record:  # not known of a result from Python whose pictures a function made
            red, green, blue = map(float, record["background"])
            rendered = {"near": float(record["near"]), "background": (red, green, blue)}
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        made, do = ("an evaluation", "evaluate") if evaluated else ("a result of DAGGER", "dagger")
        text = message(str(folder / RECORD), made, repr(error), f"make the result again with mi-splat {do}")
        raise InvalidValueError(text) from error
    splat, loaded = _clean_splat(folder, expected, clean, recorded=recorded), open_scene(path)
    if evaluated and scene_hash(loaded.scene) != record.get("attacked_hash"):
        raise InvalidValueError.of(str(path), "the splat that was evaluated", "another", "evaluate it again")
    middle, of_scene = middle_of_change(splat.scene, loaded.scene), exhibit_of_file(splat.path)
    source = f"{folder / (CAMERAS if (folder / CAMERAS).is_file() else RECORD)}{OF}"
    cameras = {
        label: orbit_of(camera, middle, source=f"{source}{name}")
        for label, name, camera in zip(labels, names, views, strict=True)
    }
    cones = Lines(segments=frustums(views, 0.1 * bounds(splat.scene)[1]), colour="#ffa500")
    return Exhibit(
        title=f"{f'Evaluation of {path.name}' if evaluated else _purpose(record)} ({folder})",
        splats=(
            splat,
            ShownSplat(name="attacked", scene=loaded.scene, path=path, file_settings=loaded.settings),
        ),
        settings=replace(splat.file_settings, **rendered),
        start=next(iter(cameras.values()), of_scene.start),
        size=size,
        cameras={**cameras, **of_scene.cameras, **cameras},
        lines={f"{kind.capitalize()} cameras": cones},
    )


_PURPOSES = {"relabel": "to be taken for {}", "hide": "to be missed", "untargeted": "to be taken for something else"}


def _purpose(record: Mapping[str, Any]) -> str:
    """What a DAGGER attack was to do, in a line."""
    scene, target = record.get("scene"), record.get("target")
    where = f" on {Path(scene).stem}" if isinstance(scene, str) else ""
    wanted = _PURPOSES.get(str(record.get("objective")), "attacked").format(target)
    names = [str(entry.get("detector")) for entry in record.get("detectors") or () if isinstance(entry, Mapping)]
    return f"DAGGER{where}: {wanted}" + (f" by {', '.join(names)}" if names else "")


def middle_of_change(clean: GaussianScene, attacked: GaussianScene) -> Point:
    """(3,) mean of the Gaussians that an attack has changed, world units: the middle of the attacked object."""
    if len(clean) != len(attacked):
        do = "pass the scene that was attacked"
        raise InvalidValueError.of("attacked.ply", f"{len(clean)} Gaussians", len(attacked), do)
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
            raise InvalidValueError.of(f"clean scene {clean}", f"the hash {expected}", "another", do)
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
        raise InvalidValueError.of(str(folder / RECORD), "an audit", repr(error), do) from error
    if not path.exists():
        text = message(f"the splat of {folder}", f"the file {path}", "nothing there", "name the splat that was audited")
        raise InvalidValueError(text).hinted("--clean")
    exhibit = exhibit_of_file(path, name="audited")
    splats, heat = exhibit.splats, folder / HEAT
    if len(splats[0].scene) != count:
        do = "name the splat that was audited"
        raise InvalidValueError.of(str(path), f"{count:,} Gaussians", f"{len(splats[0].scene):,}", do).hinted("--clean")
    if heat.is_file():
        hot = ShownSplat(name="heat", scene=open_scene(heat).scene, path=heat, file_settings=splats[0].file_settings)
        splats = (*splats, hot)
    cameras = {
        name: orbit_of(camera, (x, y, z), source=f"{folder / RECORD}{OF}{name}") for name, camera in views.items()
    }
    distance = min((orbit.distance for orbit in cameras.values()), default=1.0)
    lines = Lines(segments=frustums(list(views.values()), 0.1 * distance), colour="#ffa500")
    return replace(
        exhibit,
        title=f"Audit of {path.name} ({folder})",
        splats=splats,
        start=next(iter(cameras.values()), exhibit.start),
        cameras={
            **cameras,
            **{f"{name} of the file" if name in cameras else name: orbit for name, orbit in exhibit.cameras.items()},
        },
        lines={"Cameras that prove it": lines} if views else {},
    )


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
    """A function that looks at a picture of a page with a detector, as an evaluation does."""

    def inspect(picture: Tensor) -> DetectorInspection:
        (detections,) = detector.detect(picture[None])
        return DetectorInspection(detections=detections, min_confidence=min_confidence)

    return inspect
