"""`mi-splat dagger-eot`: attack one object from all cameras of a region at once, and judge that on held-out views."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from attacks.cli.options import AttackOptions
from attacks.dagger.config import EotConfig
from attacks.rate import Rate
from attacks.transformations.config import CameraRegion, PictureChanges, Transformations
from mi_splat.cli.console import limit_threads, progress, show, show_json
from mi_splat.cli.flags import Unprefixed
from mi_splat.cli.options import CameraOptions
from mi_splat.errors import InvalidValueError, message
from mi_splat.fields import Folder

if TYPE_CHECKING:
    from attacks.dagger.result import Result
    from attacks.pgd import Step


EXAMPLES = (
    "dagger-eot scenes/car_street.xml --object car --target person --out out/dagger-eot",
    "dagger-eot scenes/car_street.xml --object car --elevations 10 30 --jpeg 50 --blur 1 --out out/photographed",
)
SEE_ALSO = ("dagger", "evaluate", "study", "detectors")


@dataclass(frozen=True, slots=True, kw_only=True)
class DaggerEotOptions(AttackOptions):
    """Attack one object so that detectors misread it from all cameras of a region, not from one (DAGGER with EOT).

    Views are drawn at random, new ones at each step or from a pool; others judge the result. Writes held_out.png,
    attacked.ply, mask.npy (the object), cameras.json, the rows and result.json into --out; of a scene XML also
    attacked.xml with its parts. An attack that was interrupted goes on where it stopped when the same command is given
    again. The exit status is 0 also when the attack fails: that is a result.
    """

    view: Unprefixed[CameraOptions] = field(default_factory=CameraOptions)
    """The reference camera, the first if there are several: size of the pictures, field of view, unit of distances."""
    region: Unprefixed[CameraRegion] = field(default_factory=CameraRegion)
    """Where the object is looked at from."""
    pictures: Unprefixed[PictureChanges] = field(default_factory=PictureChanges)
    """What happens to the pictures between renderer and detector; by default nothing."""
    config: Unprefixed[EotConfig] = field(default_factory=EotConfig)
    """How to attack."""
    checkpoint: Path | None = None
    """File that keeps the search while it runs; None is one beside --out."""
    out: Folder = Path("out/dagger-eot")
    """Folder for the results: a new one, written whole when the attack has ended."""


def run(options: DaggerEotOptions) -> int:
    """Attack, write the report, and say in four lines what happened."""
    from attacks.cli.aims import aim, chosen_object, write_result
    from attacks.cli.names import load_detectors
    from attacks.dagger.attack import attack_views
    from attacks.dagger.checkpoint import Checkpoint
    from attacks.dagger.report import summary
    from attacks.dagger.views import ViewDistribution
    from mi_splat.cli.cameras import choose
    from mi_splat.io.camera_records import describe
    from mi_splat.io.folders import check_new_folder
    from mi_splat.scene_files import open_scene

    if options.view.up != (0.0, 0.0, 1.0):
        raise InvalidValueError(message("up", "0 0 1", options.view.up, "turn the splat: regions have world z upwards"))
    check_new_folder(options.out, force=options.force)
    limit_threads((os.cpu_count() or 1) // 2)
    config, checkpoint = options.config, Checkpoint(path=options.checkpoint or _beside(options.out))
    with progress("loading the scene and the detectors", total=config.steps + 1) as advance:
        loaded = open_scene(options.scene)
        selection = chosen_object(loaded, options.selection)
        chosen = choose(loaded, selection, options.view)
        name, camera = next(iter(chosen.cameras.items()))
        detectors = load_detectors(options.detectors, options.weights)
        views = ViewDistribution(
            loaded.scene,
            chosen.mask,
            camera,
            Transformations(cameras=options.region, pictures=options.pictures),
            render=chosen.render,
        )
        advance("looking at the object", 0)
        checkpoint.path.parent.mkdir(parents=True, exist_ok=True)
        objective = aim(options.objective, options.target, options.confidence)
        result = attack_views(
            views, detectors, objective, config=config, checkpoint=checkpoint, on_step=follow(advance)
        )
        origin = {
            "scene": str(options.scene),
            "selection": selection.as_dict(),
            "cameras": [name],
            "reference": describe(name, camera),
        }
        result = dataclasses.replace(result, origin={**result.origin, **origin})
        files = write_result(result, loaded, chosen.mask, options.out, force=options.force)
    if options.json:
        show_json({**summary(result), "files": files})
    else:
        _tell(result, options)
    return 0


def _beside(out: Path) -> Path:
    """Where the search is kept while it runs."""
    return out.with_name(f"{out.name}.checkpoint")


def follow(advance: Callable[..., None]) -> Callable[[Step], None]:
    """A callback that shows each step of the attack, and how it did when it was last judged."""
    from attacks.pgd import NOT_JUDGED

    judged = ""

    def note(step: Step) -> None:
        nonlocal judged
        if step.score != NOT_JUDGED:
            judged = f", validation {step.score:.0%}"
        advance(f"attacking: step {step.index}, loss {step.loss:.3f}{judged}")

    return note


def _tell(result: Result, options: DaggerEotOptions) -> None:
    """What happened, warnings if there are some, and where to look."""
    from attacks.cli.aims import object_name, sentence
    from attacks.dagger.report import CONTACT

    radii = ", ".join(f"{name} {eps:g}" for name, eps in result.config.radius.items())
    said = sentence(result.objective, options.detectors, object_name(options.selection), success=True)
    show(
        f"{'SUCCESS' if result.success else 'FAILED'}: {said} in {_counted(result.rate)} held-out views; "
        f"{result.config.required_views:.0%} are needed."
    )
    show(
        f"Step {result.best.index} of {result.config.steps} was best by the validation views "
        f"(budget in {result.config.norm}: {radii}; {result.seconds:.0f} s)."
    )
    psnr, rates = result.image.psnr, result.rates
    change = "No picture changed" if psnr is None else f"The held-out pictures changed to a PSNR of {psnr:.1f} dB"
    noise, clean = _counted(rates["noise_success"]), _counted(rates["clean_success"])
    show(f"{change}; random noise of the same size: {noise}; no attack: {clean}.")
    for warning in result.warnings:
        show(f"warning: {warning}")
    show(f"Look at {options.out / CONTACT} first. Beside it: the splat (attacked.ply), the object (mask.npy) and every")
    show("number (result.json).")


def _counted(rate: Rate) -> str:
    low, high = rate.interval
    return f"{rate.successes} of {rate.total} ({low:.0%} to {high:.0%})"
