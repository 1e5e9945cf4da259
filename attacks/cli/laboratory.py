"""What `mi-splat view` can do with a splat beside showing it: audit it, attack an object, judge that from all around.

Each is a command of `mi-splat`, whose words a form makes; it runs in another process, and its folder is the result.
"""

import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor

from attacks.cli.names import DEFAULT_TARGET
from attacks.detectors.base import Candidates, Detections, Detector
from attacks.detectors.catalogue import DetectorError
from attacks.detectors.registry import DETECTORS, load_detector
from attacks.limits import NORM_NAMES
from attacks.observe.drawing import draw_detections
from attacks.observe.measures import REPORTED
from attacks.observe.rows import ATTACKED, CLEAN, rows
from attacks.rate import FIXED
from attacks.report.exhibits import detector_inspector, open_exhibit
from attacks.report.results import read_section
from mi_splat.audit.files import HEAT
from mi_splat.bounds import bounds
from mi_splat.camera_sets import framing
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.folders import RECORD
from mi_splat.io.images import quantise, to_bytes
from mi_splat.io.parsing import read_json
from mi_splat.rotation import from_z
from mi_splat.viewer.command import camera_words, up_words
from mi_splat.viewer.composition import Pixels
from mi_splat.viewer.dome import Seen, draw_domes
from mi_splat.viewer.exhibit import Exhibit, Inspector
from mi_splat.viewer.jobs import Choice, Field, News, Number, Outcome, Request, Tell, Values
from mi_splat.viewer.orbit import Orbit

AUDIT, ATTACK, JUDGE = "Audit", "Attack", "Judge"
_FOLDERS = {AUDIT: Path("out/audit"), ATTACK: Path("out/dagger"), JUDGE: Path("out/judged")}
MISSED = "(missed)"
"""What stands for no class in the form of a judgement."""
WISHES = ("relabel", "hide", "untargeted")
_FOV = 45.0
"""Field of view in degrees of a camera that looks at what an audit has found."""


class Laboratory:
    """The commands that a page offers; see `mi_splat.viewer.jobs.Laboratory`.

    Args:
        detector: Name of the detector that is usual; None is the first.
        weights: File with its weights; None takes the shipped ones.
    """

    kinds, lasting = (AUDIT, ATTACK, JUDGE), frozenset({ATTACK})

    def __init__(self, detector: str | None = None, *, weights: Path | None = None) -> None:
        self._weights = {detector: weights} if detector is not None and weights is not None else {}
        known = dict(available())
        self._classes = known if detector is None else {detector: DETECTORS[detector].classes, **known}
        self._inspector = functools.cache(self._made_inspector)

    @property
    def perform(self) -> Callable[[Sequence[str], Tell], None]:
        """Runs the words of a command."""
        return perform

    def form(self, kind: str, exhibit: Exhibit, values: Values) -> tuple[Field, ...]:
        """As in `mi_splat.viewer.jobs.Laboratory`."""
        if kind == AUDIT:
            names = splats_of(exhibit)
            return (Choice(name="splat", label="Splat", options=names, usual=names[-1]),)
        names = tuple(self._classes)
        detector = Choice(name="detector", label="Detector", options=names, usual=names[0])
        classes = self._classes[str(detector.taken(values.get("detector")))]
        if kind == JUDGE:
            wanted = values.get("target") if values.get("wish") == "relabel" else None
            usual = wanted if isinstance(wanted, str) and wanted in classes else MISSED
            return (
                detector,
                Choice(name="success", label="Success", options=(MISSED, *classes), usual=usual),
                Number(name="cameras", label="Cameras", low=6, high=120, step=1, usual=60),
            )
        person = DEFAULT_TARGET if DEFAULT_TARGET in classes else classes[0]
        return (
            detector,
            Choice(name="wish", label="Wish", options=WISHES, usual="relabel"),
            Choice(name="target", label="Class (relabel)", options=classes, usual=person),
            Choice(name="norm", label="Norm", options=tuple(NORM_NAMES), usual="l2"),
            Number(name="eps", label="eps", low=0.1, high=50.0, step=0.1, usual=5.0),
            Number(name="steps", label="Steps", low=1, high=500, step=1, usual=11),
        )

    def folder(self, kind: str) -> Path:
        """As in `mi_splat.viewer.jobs.Laboratory`."""
        return _FOLDERS[kind]

    def words(self, request: Request, *, mask: Path, out: Path) -> list[str]:
        """As in `mi_splat.viewer.jobs.Laboratory`."""
        exhibit, values = request.exhibit, request.values
        if request.kind == AUDIT:
            path = exhibit.splat(str(values["splat"])).path
            return ["audit", str(path), *up_words(exhibit.up), "--out", str(out)]
        if request.picked is None:
            raise InvalidValueError(message(request.kind, "an object", "none", "click on one in the picture"))
        orbit = request.orbit.changed() if request.kind == JUDGE else request.orbit  # its distance and lens
        splat, size = exhibit.splat(request.picked.splat), exhibit.size_at(request.orbit)
        camera = camera_words(orbit, size, settings=exhibit.settings, up=exhibit.up, path=splat.path)
        detector = str(values["detector"])
        weights = ["--weights", str(self._weights[detector])] if detector in self._weights else []
        shared = ["--mask", str(mask), "--detectors", detector, *weights]
        if request.kind == JUDGE:
            names = splats_of(exhibit)
            paths = [str(exhibit.splat(name).path) for name in (names[0], names[-1])]
            target = [] if values["success"] == MISSED else ["--target", str(values["success"])]
            around = ["--cameras", f"hemisphere:{values['cameras']:.0f}"]
            around += without(camera, "--azimuth", "--elevation", "--camera-roll", "--centre")
            return ["evaluate", *paths, *shared, *target, *around, "--pictures", "0", "--out", str(out)]
        wish = ["--objective", str(values["wish"])]
        wish += ["--target", str(values["target"])] if values["wish"] == "relabel" else []
        ball = ["--norm", str(values["norm"]), "--eps", f"{values['eps']:g}", "--steps", f"{values['steps']:.0f}"]
        return ["dagger", str(splat.path), *shared, *wish, *ball, *camera, "--out", str(out)]

    def opened(self, request: Request, out: Path) -> Outcome:
        """As in `mi_splat.viewer.jobs.Laboratory`."""
        if request.kind == AUDIT:
            return _audited(request, out)
        if request.kind == JUDGE:
            return _judged(request, out)
        assert request.picked is not None
        clean = request.exhibit.splat(request.picked.splat).path
        return Outcome(
            lines=tuple(_lines(out)),
            exhibit=open_exhibit(out, clean=clean, up=request.exhibit.up),
            inspector=self._inspector(str(request.values["detector"])),
        )

    def _made_inspector(self, name: str) -> Inspector:
        return detector_inspector(load_detector(name, weights=self._weights.get(name)))


def available() -> Iterator[tuple[str, tuple[str, ...]]]:
    """Names and classes of the detectors that can be loaded without any download."""
    for name in DETECTORS:
        try:
            spec = DETECTORS[name]
        except DetectorError:  # of an installed package that is broken
            continue
        if not spec.missing():
            yield name, spec.classes


def splats_of(exhibit: Exhibit) -> tuple[str, ...]:
    """Names of the splats that are shown, without the heat of an audit beside one, which is a picture."""
    names = tuple(splat.name for splat in exhibit.splats)
    return tuple(name for name in names if name != HEAT.partition(".")[0]) or names


def without(words: Sequence[str], *flags: str) -> list[str]:
    """Words of a command without some flags and their values."""
    kept, dropped = list[str](), False
    for word in words:
        dropped = word in flags if word.startswith("--") else dropped
        kept += [] if dropped else [word]
    return kept


def _lines(result: Path) -> Iterator[str]:
    """What the page of a result says first."""
    section = read_section(result)
    yield section.conclusion.replace(FIXED, " ")
    for figure in section.all_figures:
        yield f"{figure.label}: {'; '.join(filter(None, (figure.cell, figure.note)))}".replace(FIXED, " ")
    for text in section.warnings:
        yield f"Warning: {text}".replace(FIXED, " ")


# An audit


def _audited(request: Request, out: Path) -> Outcome:
    """What was found, and cameras that see it; the splat beside its heat where something was."""
    record = read_json(out / RECORD)
    lines, exhibit = tuple(map(str, record["summary"])), request.exhibit
    if record["verdict"] in (None, "nothing found"):
        return Outcome(lines=lines)
    path = exhibit.splat(str(request.values["splat"])).path
    opened = open_exhibit(out, clean=path, up=exhibit.up)
    cameras = dict[str, Orbit]()
    for number, picture in enumerate(record["pictures"], 1):
        name = "inside" if number == 1 else f"inside {number}"
        if name in opened.cameras:
            cameras[f"Object {picture['object'] + 1}, look {picture['look'] + 1}"] = opened.cameras[name].changed(
                roll=0.0
            )
    for number, item in enumerate(record["objects"], 1):
        sources = item["occluder"] and item["occluder"]["axis"], (item["edited"] or {}).get("camera")
        for what, direction in zip(("what covers it", "where its colours aim"), sources, strict=True):
            if direction and item["verdict"] != "nothing found":
                cameras[f"Object {number}, {what}"] = _towards(direction, item, opened)
    return Outcome(lines=lines, exhibit=opened if (out / HEAT).is_file() else None, cameras=cameras)


def _towards(direction: Sequence[float], item: Mapping[str, Any], exhibit: Exhibit) -> Orbit:
    """A camera in a direction from an object of an audit, which shows it whole."""
    turn = from_z(torch.tensor(list(exhibit.up), dtype=torch.float64)).T
    (x, y, z), target = ((turn @ torch.tensor(v, dtype=torch.float64)).tolist() for v in (direction, item["centre"]))
    elevation = math.degrees(math.atan2(z, math.hypot(x, y)))
    distance, _ = framing(float(item["radius"]), fov=_FOV, size=exhibit.size)
    azimuth = math.degrees(math.atan2(y, x))
    return Orbit(target=target, azimuth=azimuth, elevation=elevation, distance=distance, fov=_FOV)


# A judgement


def _judged(request: Request, out: Path) -> Outcome:
    """How often, and from where."""
    assert request.picked is not None
    exhibit, target = request.exhibit, request.values["success"]
    table = rows(out)
    scene = exhibit.splat(request.picked.splat).scene
    centre, _ = bounds(scene.select(request.picked.mask))
    turn = from_z(torch.tensor(list(exhibit.up), dtype=torch.float64)).T
    domes = dict[str, list[Seen]]()
    names = splats_of(exhibit)
    for name, splat in dict(zip((names[0], names[-1]), (CLEAN, ATTACKED), strict=True)).items():
        seen = domes[name] = list[Seen]()
        for row in table.filter(splat=splat).iter_rows(named=True):
            position = turn @ torch.tensor([row["x"], row["y"], row["z"]], dtype=torch.float64)
            x, y, z = (position - torch.tensor(list(centre), dtype=torch.float64)).tolist()
            missed = row["original_score"] < REPORTED
            success = missed if target == MISSED else row["target_score"] >= REPORTED
            azimuth, elevation = math.degrees(math.atan2(y, x)), math.degrees(math.atan2(z, math.hypot(x, y)))
            seen.append((azimuth, elevation, None if row["x0"] is None else success))
    wanted = "missed" if target == MISSED else f"taken for a {target}"
    counts = (f"{name}: {wanted} from {_counted(seen)}" for name, seen in domes.items())
    titled = {f"{name}: {wanted}": seen for name, seen in domes.items()}
    return Outcome(lines=(*counts, *_lines(out)), picture=draw_domes(titled))


def _counted(seen: Sequence[Seen]) -> str:
    """A rate in words."""
    shown = [success for *_, success in seen if success is not None]
    return f"{sum(shown)} of {len(shown)} cameras that see it"


# In the other process


def perform(words: Sequence[str], tell: Tell) -> None:
    """Run a command, and tell how it goes on; of an attack with the pictures that it looks at."""
    from attacks.cli import module_of, parse
    from attacks.cli.dagger import DaggerOptions
    from attacks.cli.dagger import run as run_dagger
    from attacks.cli.names import check_names
    from mi_splat.cli.console import PROGRAM, telling
    from mi_splat.provenance import running_command

    options = parse(words[0], words[1:])
    check_names(options)
    seen, ended = list[Pixels](), False

    def listen(text: str, share: float | None) -> None:
        nonlocal ended
        ended = bool(tell(News(text=text, share=share, picture=seen[-1] if seen else None)))

    with running_command([PROGRAM, *words]), telling(listen):
        if isinstance(options, DaggerOptions):
            run_dagger(options, watched=lambda detector: Watched(detector, seen), enough=lambda: ended)
        else:
            module_of(words[0]).run(options)


class Watched:
    """A detector that shows each picture of a search with what it reports there; it answers as the detector does.

    Args:
        detector: The detector.
        seen: Holds the last picture, (H, W, 3), from then on.
    """

    def __init__(self, detector: Detector, seen: list[Pixels]) -> None:
        self._detector, self._seen = detector, seen
        self.name, self.classes, self.fingerprint = detector.name, detector.classes, detector.fingerprint
        self.min_confidence = detector.min_confidence

    def candidates(self, images: Tensor) -> list[Candidates]:
        """As in `attacks.detectors.base.Detector`; draws the first picture."""
        picture = quantise(images[0].detach().clamp(0, 1))
        with torch.no_grad():
            (detections,) = self._detector.detect(picture[None])
        image = Image.fromarray(to_bytes(picture))
        draw_detections(ImageDraw.Draw(image), detections)
        self._seen[:] = [np.asarray(image)]
        return self._detector.candidates(images)

    def detect(self, images: Tensor) -> list[Detections]:
        """As in `attacks.detectors.base.Detector`."""
        return self._detector.detect(images)
