"""`mi-splat dagger-eot`: attack one object from all cameras of a region at once, and judge that on held-out views."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path

from attacks.cli.aims import aim, chosen_object, object_name, sentence, write_parts
from attacks.cli.eot_options import DaggerEotOptions
from attacks.cli.loading import load_detectors
from attacks.dagger.attack import attack_views
from attacks.dagger.checkpoint import Checkpoint
from attacks.dagger.report import CONTACT, summary, write_files
from attacks.dagger.result import Result
from attacks.dagger.views import ViewDistribution
from attacks.pgd import NOT_JUDGED, Step
from attacks.rate import Rate
from attacks.transformations.config import Transformations
from mi_splat.cli.console import limit_threads, progress, show, show_json
from mi_splat.cli.selecting import choose
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.camera_records import describe
from mi_splat.io.folders import check_new_folder, new_folder
from mi_splat.scene_files import open_scene


def run(options: DaggerEotOptions) -> int:
    """Attack, write the report, and say in four lines what happened."""
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
        with new_folder(options.out, force=options.force) as folder:
            written = [*write_files(result, folder), *write_parts(loaded, chosen.mask, result.scene, folder)]
        files = {path.name: options.out / path.name for path in written}
    if options.json:
        show_json({**summary(result), "files": {name: str(path) for name, path in files.items()}})
    else:
        _tell(result, options)
    return 0


def _beside(out: Path) -> Path:
    """Where the search is kept while it runs."""
    return out.with_name(f"{out.name}.checkpoint")


def follow(advance: Callable[..., None]) -> Callable[[Step], None]:
    """A callback that shows each step of the attack, and how it did when it was last judged."""
    judged = ""

    def note(step: Step) -> None:
        nonlocal judged
        if step.score != NOT_JUDGED:
            judged = f", validation {step.score:.0%}"
        advance(f"attacking: step {step.index}, loss {step.loss:.3f}{judged}")

    return note


def _tell(result: Result, options: DaggerEotOptions) -> None:
    """What happened, warnings if there are some, and where to look."""
    radii = ", ".join(f"{name} {eps:g}" for name, eps in result.config.radius.items())
    objective = aim(options.objective, options.target, options.confidence)
    said = sentence(objective, options.detectors, object_name(options.selection), success=True)
    show(
        f"{'SUCCESS' if result.success else 'FAILED'}: {said} in {_words(result.rate)} held-out views; "
        f"{result.config.required_views:.0%} are needed."
    )
    show(
        f"Step {result.best.index} of {result.config.steps} was best by the validation views "
        f"(budget in {result.config.norm}: {radii}; {result.seconds:.0f} s)."
    )
    psnr, rates = result.image.psnr, result.rates
    change = "No picture changed" if psnr is None else f"The held-out pictures changed to a PSNR of {psnr:.1f} dB"
    noise, clean = _words(rates["noise_success"]), _words(rates["clean_success"])
    show(f"{change}; random noise of the same size: {noise}; no attack: {clean}.")
    for warning in result.warnings:
        show(f"warning: {warning}")
    show(f"Look at {options.out / CONTACT} first. Beside it: the splat (attacked.ply), the object (mask.npy) and every")
    show("number (result.json).")


def _words(rate: Rate) -> str:
    low, high = rate.interval
    return f"{rate.successes} of {rate.total} ({low:.0%} to {high:.0%})"
