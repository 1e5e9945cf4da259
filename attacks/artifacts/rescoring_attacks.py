"""Scoring the splat of an attack of DAGGER again: from the recorded cameras, by the attack's detectors or by others."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from attacks.artifacts.checking import Checked
from attacks.artifacts.contents import CAMERAS, SPLATS, Contents, read_object
from attacks.artifacts.dagger_results import ATTACKED, objective_of
from attacks.artifacts.figures import Line, moved
from attacks.artifacts.packed import OnView, Outcome
from attacks.artifacts.places import Places, checked_splat, places_of
from attacks.detectors.base import Detector
from attacks.objectives import Target
from attacks.observe.views import ViewDetections
from attacks.rate import Rate
from mi_splat.errors import InvalidValueError, message
from mi_splat.scene import GaussianScene

_RATES: Mapping[str, Callable[[Outcome], bool]] = {
    "the aim is reached": lambda one: one.success,
    "so, and no other class has more confidence": lambda one: one.unambiguous,
}


def rescore_attack(
    checked: Checked,
    before: Sequence[Outcome],
    detectors: Sequence[Detector],
    *,
    splats: Path | None,
    every: int,
    rate_tolerance: float,
    on_view: OnView,
) -> list[Line]:
    """Render the attacked splat, let detectors look, and say how often the aim is reached now.

    Args:
        checked: The artifact.
        before: What its rows say.
        detectors: As in `attacks.artifacts.rescoring.rescore`.
        splats: As there.
        every: As there.
        rate_tolerance: As there.
        on_view: As there.

    Raises:
        InvalidValueError: The splat is not there or another one, or cameras.json is missing or broken.
    """
    scene, places = _scene(checked, splats), _places(checked)
    views = sorted({one.view for one in before})[::every]
    if not views or not 0 <= views[0] <= views[-1] < len(places.cameras):
        got, do = f"{len(places.cameras)} cameras", "get the artifact again"
        raise InvalidValueError(message(str(checked.found.folder / CAMERAS), "the cameras of the rows", got, do))
    after, total = list[Outcome](), len(views) * len(detectors)
    # One picture at a time, as the attack was judged: the same bits.
    for one in _judged(checked.contents, before, places.look(scene, detectors, views, batch=1), detectors):
        after.append(one)
        on_view(len(after), total)
    same = [one for one in before if one.view in set(views)]
    lines = [line for detector in detectors for line in _lines(checked, detector, same, after, rate_tolerance)]
    known = set(checked.contents.detectors)
    if len(known) > 1 and known == {detector.name for detector in detectors}:
        then, now = (_together(some) for some in (same, after))
        lines.append(moved("all detectors at once, the aim is reached", then, now, tolerance=rate_tolerance))
    return lines


def _together(outcomes: Sequence[Outcome]) -> Rate:
    """Views in which the aim is reached with every detector."""
    views: dict[int, bool] = {}
    for one in outcomes:
        views[one.view] = views.get(one.view, True) and one.success
    return Rate(successes=sum(views.values()), total=len(views))


def _judged(
    contents: Contents, before: Sequence[Outcome], seen: Iterator[ViewDetections], detectors: Sequence[Detector]
) -> Iterator[Outcome]:
    """Whether the aim is reached in each picture, by the attack's own objective."""
    objective, label = objective_of(contents.configuration), contents.configuration.get("target")
    classes = {detector.name: tuple(detector.classes) for detector in detectors}
    known = {(one.view, one.detector): one for one in before}
    any_detector = {one.view: one for one in before}
    for one in seen:
        if one.box is None:
            do = "get the artifact again"
            raise InvalidValueError(message(CAMERAS, "a box of the object in each view", "none", do))
        # What another detector calls the object is not known: it counts as what one of the attack's calls it.
        then = known.get((one.view, one.detector), any_detector[one.view])
        target = Target(box=one.box, label=label, classes=classes[one.detector], original=then.original)
        verdict = objective.verdict(one.detections, target)
        yield replace(then, detector=one.detector, success=verdict.success, unambiguous=verdict.unambiguous)


def _lines(
    checked: Checked, detector: Detector, before: Sequence[Outcome], after: Sequence[Outcome], tolerance: float
) -> Iterator[Line]:
    """How the rates of one detector have moved."""
    known = checked.contents.detectors.get(detector.name)
    for words, holds in _RATES.items():
        then, now = (Rate.of([one for one in some if one.detector == detector.name], holds) for some in (before, after))
        yield moved(
            f"{detector.name}, {words}",
            None if known is None else then,
            now,
            tolerance=tolerance,
            other_weights=known != detector.fingerprint,
        )


def _places(checked: Checked) -> Places:
    file = checked.found.folder / CAMERAS
    if CAMERAS not in checked.found.files:
        do = "attack again: the result was made by a version that did not store its cameras"
        raise InvalidValueError(message(str(file), "the cameras of the attack", "none", do))
    return places_of(read_object(file), str(file))


def _scene(checked: Checked, splats: Path | None) -> GaussianScene:
    """The attacked splat, known by its hash."""
    path = (checked.found.folder / SPLATS if splats is None else splats) / ATTACKED
    if not path.is_file() or not checked.contents.splats:
        do = "pass the folder with the splat"
        raise InvalidValueError(message(str(path), "the attacked splat", "none", do)).hinted("--splats")
    return checked_splat(path, checked.contents.splats[0])
