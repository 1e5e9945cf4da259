"""What an attack did, and the warnings about it."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from attacks.dagger.config import DaggerConfig
from attacks.dagger.controls import Draw
from attacks.dagger.problem import Problem
from attacks.dagger.search import Level
from attacks.dagger.views import Reports, View, detected
from attacks.detectors.base import Detections
from attacks.figures.frame import Figures
from attacks.figures.rate import Rate
from attacks.objectives.base import Objective, Target, confidence, least_confidence
from attacks.observe.observations import (
    Observations,
    camera_cells,
    detection_rows,
    report_cells,
    verdict_cells,
)
from attacks.observe.rows import (
    ATTACKED,
    CLEAN,
    CONTROLS,
    NOISE,
    NORM_NOISE,
    OPERATING,
    Cell,
    Row,
    frame_of,
)
from attacks.observe.views import ImageChange, ViewDetections, image_change
from attacks.search.loop import Step, Verdict
from attacks.threats import THREATS
from attacks.transformations.config import Transformations
from attacks.transformations.draws import ImageTransformation
from mi_splat.errors import counted as number_of
from mi_splat.errors import one_line
from mi_splat.io.images import from_bytes, to_bytes
from mi_splat.maths.metrics import psnr
from mi_splat.scene import GaussianScene


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Seen:
    """What a detector reports on one splat in one view."""

    pixels: Tensor  # (H, W, 3) uint8 sRGB, the image as the detector got it
    detections: Detections  # what it reports
    verdict: Verdict  # whether the attacker has the aim there
    box: Tensor  # (4,) x0, y0, x1, y1 in pixels: where the object is looked for

    @property
    def image(self) -> Tensor:
        """The image as (H, W, 3) float32 in [0, 1]."""
        return from_bytes(self.pixels)


@dataclass(frozen=True, slots=True, eq=False)
class JudgedView:
    """One view as one detector sees it."""

    view: View  # the view
    detector: str  # name of the detector
    target: Target  # the object's box and classes in this view
    clean: Seen  # of the clean splat: its verdict is the aim reached without any attack
    attacked: Seen  # of the attacked splat
    controls: Mapping[Draw, Seen]  # of each draw of each control

    def confidence(self, label: str | None, *, attacked: bool) -> float:
        """Highest score with which `label` (any class if None) is reported on the
        object, clean or attacked.
        """
        seen = self.attacked if attacked else self.clean
        labels = None if label is None else [label]
        return confidence(seen.detections, seen.box, labels=labels)


def observed(
    views: Sequence[JudgedView], objective: Objective, **ids: Cell
) -> Observations:
    """What was reported as rows: clean, attacked and with noise."""
    rows = list[Row]()
    detections = list[Row]()
    for judged in views:
        view = judged.view
        target = judged.target
        clean = judged.clean.image
        where = camera_cells(view.camera, target.box, view.direction)
        splats = [
            ((CLEAN, None), judged.clean),
            ((ATTACKED, None), judged.attacked),
            *judged.controls.items(),
        ]
        for (splat, draw), seen in splats:
            of: dict[str, Cell] = {**ids, "splat": splat, "draw": draw}
            of |= {
                "threshold": least_confidence(objective, target),
                OPERATING: target.threshold,
            }
            of |= {"detector": judged.detector, "view": view.index}
            if torch.equal(clean, seen.image):
                change = None
            else:
                change = float(psnr(clean, seen.image))
            if change is None:
                on_object = None
            else:
                on_object = image_change(
                    [clean], [seen.image], [view.weight]
                ).psnr_object
            cells = report_cells(
                seen.detections,
                seen.box,
                original=target.original,
                target=target.label,
            )
            cells |= {
                **verdict_cells(seen.verdict),
                "psnr": change,
                "object_psnr": on_object,
            }
            rows.append({**of, **where, **cells})
            detections += detection_rows(of, seen.detections, seen.box)
    return Observations(rows=frame_of(rows), detections=frame_of(detections))


def judge(
    problem: Problem,
    views: Sequence[View],
    clean: tuple[GaussianScene, Reports],
    attacked: GaussianScene,
    controls: Mapping[Draw, GaussianScene],
    attributes: Sequence[str] = (),
) -> tuple[tuple[JudgedView, ...], ImageChange, dict[Draw, ImageChange]]:
    """The attacked splat and its controls as each detector sees them in each view, and
    the change of the images.

    What a threat among the `attributes` has moved is looked for where it shows now.
    """
    scenes = [clean[0], attacked, *controls.values()]
    reports = [
        clean[1],
        *(
            detected(problem.detectors, scene, views, problem.render)
            for scene in scenes[1:]
        ),
    ]
    judged = []
    moves = any(name in THREATS for name in attributes)
    boxes = {
        (view.index, number): problem.shown_box(view, scene)
        for view in views
        for number, scene in enumerate(scenes)
        if moves and number
    }
    for detector in problem.detectors:
        for view in views:
            target = problem.target(view, detector)
            before, after, *others = (
                _seen(
                    problem,
                    one[view.index, detector.name],
                    problem.target(view, detector, boxes.get((view.index, number))),
                )
                for number, one in enumerate(reports)
            )
            names = (view, detector.name, target)
            seen = dict(zip(controls, others, strict=True))
            judged.append(
                JudgedView(*names, clean=before, attacked=after, controls=seen)
            )
    plain = [
        _plain_pictures(problem, scene, views, of_splat)
        for scene, of_splat in zip(scenes, reports, strict=True)
    ]
    weights = [view.weight for view in views]
    image, *changes = [
        image_change(map(from_bytes, plain[0]), map(from_bytes, one), weights)
        for one in plain[1:]
    ]
    return tuple(judged), image, dict(zip(controls, changes, strict=True))


def _seen(problem: Problem, report: ViewDetections, target: Target) -> Seen:
    verdict = problem.objective.verdict(report.detections, target)
    return Seen(
        pixels=report.pixels,
        detections=report.detections,
        verdict=verdict,
        box=target.box,
    )


def _plain_pictures(
    problem: Problem,
    scene: GaussianScene,
    views: Sequence[View],
    reports: Mapping[tuple[int, str], ViewDetections],
) -> list[Tensor]:
    """uint8 images before anything random happens to them; those of the detections
    where nothing does.
    """
    if all(
        view.change == ImageTransformation(noise_seed=view.change.noise_seed)
        for view in views
    ):
        return [reports[view.index, problem.detectors[0].name].pixels for view in views]
    with torch.no_grad():
        return [
            torch.from_numpy(to_bytes(problem.render(scene, view.camera)))
            for view in views
        ]


_ZERO_GRADIENT_LIMIT = 0.9
"""Fraction of zero gradients that raises a warning; hidden Gaussians have none in any
case, so it is high.
"""

_CLAMPED_LIMIT = 0.25
"""Fraction of clamped colour channels that raises a warning."""

MATCHED = 1.0
"""How far the object's PSNR under a control may be from that under the attack before a
result warns of it, dB.
"""

PSNR_SLACK = 0.5
"""How far the held-out images may be below the image budget before a result warns of
it, dB.
"""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class Result:
    """What an attack did, evaluated on the saved file and 8-bit images, from its own
    views or from held-out ones.

    Attributes:
        scene: The attacked scene; Gaussians outside the object are bit for bit what
            they were.
        views: Every view before and after, detector by detector.
        image: Change of the images before anything random happens to them; its PSNR is
            of the mean squared error over all pixels of all views.
        control_images: The same for each draw of each control.
        looked: The same as rows, and every detection.
        figures: All that is counted from these rows
            (`attacks.dagger.figures.attack_figures`).
        fingerprints: What stands for the weights of each attacked detector, by its
            name.
        trace: Every evaluated point, all runs, in order; of drawn views only
            some were evaluated.
        best: The line of the trace whose point was kept.
        used: Size of the perturbation by attribute; never above its radius.
        used_in_file: The same, measured on the saved file, where quaternions have been
            normalised and logits rounded.
        object_gaussians: Number of Gaussians of the object.
        changed_gaussians: Number of Gaussians that differ.
        clamped_fraction: Fraction of the object's colour channels at the clamp (clean,
            mean over views).
        objective: The aim and its settings.
        config: The full configuration.
        origin: Detectors, versions, variant, commit, scene hash.
        seconds: Wall time of the attack.
        cpu_seconds: CPU time of only the search, of all threads.
        transformations: The distribution that it was made for; None for fixed views.
        evaluation: The distribution of its held-out views.
        redraws: Cameras drawn in vain, as they did not show the object: held-out,
            validation and attacked views.
        levels: What each level of a ladder has led to, the quietest first; the last is
            the answer.
        doubts: Of the choice of the object; the first of the warnings.
        stopped: Whether the search was ended before its time.
    """

    scene: GaussianScene
    views: tuple[JudgedView, ...]
    image: ImageChange
    control_images: dict[Draw, ImageChange]
    looked: Observations
    figures: Figures
    fingerprints: dict[str, str]
    trace: tuple[Step, ...]
    best: Step
    used: dict[str, float]
    used_in_file: dict[str, float]
    object_gaussians: int
    changed_gaussians: int
    clamped_fraction: float
    objective: Objective
    config: DaggerConfig
    origin: dict[str, Any]
    seconds: float
    cpu_seconds: float = 0.0
    transformations: Transformations | None = None
    evaluation: Transformations | None = None
    redraws: dict[str, int] = field(default_factory=dict)
    levels: tuple[Level, ...] = ()
    doubts: tuple[str, ...] = ()
    stopped: bool = False

    def __repr__(self) -> str:
        aim = " ".join(filter(None, (self.objective.name, self.objective.label)))
        rate = self.rate
        steps = number_of(self.best.index, "step")
        warnings = number_of(len(self.warnings), "warning")
        return (
            f"Result({'success' if self.success else 'no success'}:"
            f" {one_line(aim, 40)}, score {self.score:.2f}, {rate.successes} of"
            f" {rate.total} views, {steps}, {warnings})"
        )

    @property
    def drawn(self) -> bool:
        """Whether views were drawn from a region."""
        return self.evaluation is not None

    @property
    def detectors(self) -> tuple[str, ...]:
        """Names of the attacked detectors."""
        return tuple(self.fingerprints)

    @property
    def pictures(self) -> list[JudgedView]:
        """Every view once, as the first detector sees it: all look at the same
        images.
        """
        return [view for view in self.views if view.detector == self.detectors[0]]

    @property
    def success(self) -> bool:
        """Whether the aim was reached, and the clean object is detected in at least one
        view.
        """
        return bool(self.figures.rate("succeeded").successes)

    @property
    def aim_reached(self) -> bool:
        """Whether the aim was reached in enough views, with every detector, whatever is
        seen of the clean object.

        See `attacks.objectives.verdicts.overall_verdict`, also for the score.
        """
        return self._reached("reached")

    @property
    def unambiguous(self) -> bool:
        """Whether the aim is reached, and no other class is reported on the object with
        more confidence.
        """
        return self._reached("reached_unambiguously")

    @property
    def strict(self) -> bool:
        """Whether the aim is reached, and the object's own class is reported with less
        than counts.
        """
        return self._reached("reached_strictly")

    @property
    def score(self) -> float:
        """How near the aim is, in [0, 1].

        Of fixed views it is what enough views reach: the confidence in the wanted
        class, or 1 minus the confidence in what is still detected.
        """
        return self.figures.value("score", splat=ATTACKED) or 0.0

    @property
    def target_confidence(self) -> float | None:
        """Confidence in the wanted class on the object that enough views reach; None
        when no class was wanted.
        """
        return self.figures.value("target_confidence")

    @property
    def rate(self) -> Rate:
        """Views in which every detector is deceived."""
        return self.figures.rate("success", splat=ATTACKED)

    def _reached(self, measure: str) -> bool:
        return bool(self.figures.rate(measure, splat=ATTACKED).successes)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Flags in the spirit of AutoAttack: signs that success or failure is not what
        it looks like.
        """
        steps = f"step {self.trace[-1].index} of {self.config.steps}"
        ended: tuple[str, ...] = ()
        if self.stopped:
            ended = (f"the search was stopped after {steps}, before its end",)
        return (
            *self.doubts,
            *ended,
            *(_warnings_of_drawn(self) if self.drawn else _warnings_of_fixed(self)),
        )


def _warnings_of_fixed(result: Result) -> list[str]:
    warnings = []
    for view in result.views:
        least = view.target.threshold
        if view.confidence(view.target.original, attacked=False) < least:
            by = "" if len(result.detectors) == 1 else f" by {view.detector}"
            number = view.view.index
            warnings.append(
                f"the clean image of view {number} has no detection{by} of {least:g}"
                " or more on the object"
            )
    first = result.trace[0]
    zeros = max(line.zero_gradient_fraction for line in result.trace)
    if first.success:
        warnings.append("the aim is reached without any attack")
    if zeros > _ZERO_GRADIENT_LIMIT:
        warnings.append(
            f"up to {zeros:.0%} of the gradient's elements are exactly zero"
        )
    if (
        len(result.trace) > 1
        and min(line.loss for line in result.trace[1:]) >= first.loss
    ):
        warnings.append("the loss did not fall")
    if "sh" in result.config.attributes and result.clamped_fraction > _CLAMPED_LIMIT:
        clamped = f"{result.clamped_fraction:.0%} of the object's colour channels"
        warnings.append(f"{clamped} are clamped at 0, where SH has no gradient")
    if result.best.success and not result.aim_reached:
        warnings.append(
            "success in the search did not survive the saved file and 8-bit images"
        )
    if result.aim_reached and not result.unambiguous:
        warnings.append(
            "another class is still detected on the object with more confidence"
        )
    if result.aim_reached and not result.strict:
        known = [view for view in result.views if view.target.original is not None]
        left = max(
            view.confidence(view.target.original, attacked=True) for view in known
        )
        warnings.append(
            f"the object's own class is still reported on it, at up to {left:.0%}"
        )
    figures = result.figures
    for name in CONTROLS:
        reached = figures.rate("reached", splat=name)
        best = figures.value("best_score", splat=name) or 0.0
        as_often = result.aim_reached and reached.successes
        if as_often or (reached.total and best >= result.score > 0):
            warnings.append(f"a random change ({name}) does as well")
    warnings += _unmatched(result)
    return warnings


def _warnings_of_drawn(result: Result) -> list[str]:
    warnings = list[str]()
    config = result.config
    figures = result.figures
    for name in result.detectors:
        found = figures.rate("found_clean", detector=name)
        if found.fraction < 0.5:
            warnings.append(
                f"{name} finds the clean object in {found.counts} held-out views only"
            )
    clean = figures.rate("success", splat=CLEAN)
    noise = figures.rate("success", splat=NOISE)
    rate = figures.rate("unambiguous", splat=ATTACKED)
    if clean.successes:
        warnings.append(
            f"the aim is reached without any attack in {clean.counts} views"
        )
    if result.best.success and not result.aim_reached:
        warnings.append(
            "success on the validation views did not carry over to the held-out views"
        )
    reached = result.rate
    if noise.total and reached.successes and noise.fraction >= reached.fraction:
        warnings.append(f"a random change ({NOISE}) does as well")
    warnings += _unmatched(result)
    if result.aim_reached and rate.fraction < config.required_views:
        few = f"{rate.successes} of {rate.total} views only"
        warnings.append(
            f"without another class of more confidence on the object: {few}"
        )
    wanted = config.image_psnr
    psnr = result.image.psnr
    if wanted is not None and psnr is not None and psnr < wanted - PSNR_SLACK:
        warnings.append(
            f"the held-out images have {psnr:.1f} dB: less than the {wanted:g} dB of"
            " the validation views"
        )
    return warnings


def _unmatched(result: Result) -> Iterator[str]:
    """Controls whose images do not change the object as much as those of the attack."""
    wanted = result.image.psnr_object
    for (name, draw), change in result.control_images.items():
        psnr = change.psnr_object
        if name != NORM_NOISE and wanted and psnr and abs(psnr - wanted) > MATCHED:
            yield (
                f"draw {draw} of {name} leaves the object at {psnr:.1f} dB, the attack"
                f" at {wanted:.1f} dB"
            )
