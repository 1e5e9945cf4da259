"""`mi-splat dagger --sanity`: is the attack sane on this object and this detector; red lines end with exit status 1."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from attacks.cli.options import ClassName, Confidence, OneDetector, Seeds
from attacks.dagger.config import DaggerConfig
from attacks.detectors import load_detector
from attacks.detectors.registry import DETECTORS
from mi_splat.cli.console import limit_threads, progress, show, show_json, warn
from mi_splat.cli.flags import Positional
from mi_splat.cli.options import CameraOptions, ResultOptions
from mi_splat.fields import Folder, Metavar
from mi_splat.io.parsing import read_json
from mi_splat.selection.config import Selection

if TYPE_CHECKING:
    from attacks.dagger.sanity import Case, Finding
    from attacks.detectors.base import Detector


EXAMPLES = (
    "dagger --sanity scenes/car_street.xml --object car --target person --out out/sanity",
    "dagger --sanity desk.ply --mask mask.npy --azimuth 40 --detectors yolov8n_small --seeds 5 --out out/sanity",
)


@dataclass(frozen=True, kw_only=True)
class DaggerSanityOptions(ResultOptions):
    """Check whether DAGGER is a sane attack on an object and a detector, so that its failures can be believed.

    Success has to rise with the radius, many steps, white boxes and gradients have to do no worse than one step,
    another detector and random search, gradients have to equal finite differences, and so on. Each check is a line,
    green or red. Writes sanity.md and result.json into --out. The exit status is 1 if a line is red.
    """

    scene: Positional[Path]
    """Scene XML made of splats, a splat file, or example:car_street or example:stop_sign."""
    selection: Selection = field(default_factory=Selection)
    """The object whose Gaussians are attacked. If nothing is said, the part called car."""
    view: CameraOptions = field(default_factory=CameraOptions)
    """The camera; of several, the first. Each seed but 0 moves it about the object."""
    target: ClassName = "person"
    """Class that the detector shall see there."""
    confidence: Confidence = 0.7
    """Confidence in it that counts as success."""
    detector: OneDetector = "fasterrcnn_small"
    """Name of the detector (see `mi-splat detectors`)."""
    weights: Path | None = None
    """File with the detector's weights; None takes the shipped ones."""
    surrogate: Annotated[str, Metavar("DETECTOR")] = "auto"
    """Name of another detector, from which attacks are transferred; auto takes one that can be loaded, none leaves it
    out."""
    seeds: Seeds = 3
    """Number of seeds; each but 0 moves the camera and starts at a random point of the ball."""
    config: DaggerConfig = field(default_factory=lambda: DaggerConfig(steps=20))
    """How to attack; the checks also take fractions and multiples of the radius, and seeds of their own."""
    out: Folder = Path("out/sanity")


ATTACKS = 15
"""Kinds of attacks in the suite, each once a seed; for the progress bar."""


def run(options: DaggerSanityOptions) -> int:
    """Make the checks."""
    from attacks.dagger.sanity import CHECKS, Runs, write_findings
    from mi_splat.io.folders import RECORD, check_new_folder, new_folder

    check_new_folder(options.out, force=options.force)
    limit_threads()
    findings: list[Finding] = []
    with progress("loading the scene and the detectors", total=ATTACKS * options.seeds) as advance:
        case, conditions = _case(options)
        runs = Runs(case, on_run=lambda: advance(f"check {len(findings) + 1} of {len(CHECKS)}"))
        advance("attacking", 0)
        for check in CHECKS.values():
            findings.append(check(runs))
        with new_folder(options.out, force=options.force) as folder:
            write_findings(findings, runs, folder, **conditions)
    red = sum(finding.passed is False for finding in findings)
    if options.json:
        show_json(read_json(options.out / RECORD))
    else:
        for finding in findings:
            show(f"{finding.colour:5}  {finding.claim}: {finding.figures}")
            if finding.passed is False:
                show(f"{'':5}  -> {finding.meaning}")
        show(f"{red} of {len(findings)} lines are red. The report is {options.out / 'sanity.md'}.")
    return 1 if red else 0


def _case(options: DaggerSanityOptions) -> tuple[Case, dict[str, Any]]:
    from attacks.cli.dagger import chosen_object
    from attacks.dagger.sanity import Case
    from attacks.objectives import relabel
    from attacks.studies.attack import jittered
    from mi_splat.cli.cameras import choose
    from mi_splat.io.camera_records import describe
    from mi_splat.scene_files import open_scene
    from mi_splat.selection.select import require_visible

    loaded = open_scene(options.scene)
    selection = chosen_object(loaded, options.selection)
    chosen = choose(loaded, selection, options.view)
    require_visible(chosen.weights(loaded))
    name, camera = next(iter(chosen.cameras.items()))
    centre = loaded.scene.means[chosen.mask].mean(0)
    case = Case(
        scene=loaded.scene,
        mask=chosen.mask,
        cameras=tuple(jittered(camera, centre, seed=seed) for seed in range(options.seeds)),
        detector=load_detector(options.detector, weights=options.weights),
        objective=relabel(options.target, confidence=options.confidence),
        render=chosen.render,
        config=options.config,
        surrogate=_surrogate(options),
    )
    return case, {
        "scene": str(options.scene),
        "selection": selection.as_dict(),
        "cameras": [describe(name, camera)],
    }


def _surrogate(options: DaggerSanityOptions) -> Detector | None:
    if options.surrogate != "auto":
        return None if options.surrogate == "none" else load_detector(options.surrogate)
    for name, spec in DETECTORS.items():
        if name.endswith(("_small", "_coco")) and name != options.detector:
            missing = spec.missing()
            if not missing:
                return load_detector(name)
            warn(f"{name} is left out: {missing}")
    return None
