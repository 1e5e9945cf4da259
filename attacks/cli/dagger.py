"""`mi-splat dagger`: attack one object of a scene and write what came of it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from attacks.cli.options import AttackOptions
from attacks.dagger.config import DaggerConfig
from mi_splat.cli.console import Advance, limit_threads, progress, warn
from mi_splat.cli.flags import Unprefixed
from mi_splat.cli.options import CameraOptions, check_no_input_in
from mi_splat.errors import InvalidValueError
from mi_splat.fields import Folder
from mi_splat.processes import deferred_interrupt

if TYPE_CHECKING:
    from collections.abc import Sequence

    from torch import Tensor

    from attacks.detectors.base import Detector
    from attacks.search import Step
    from mi_splat.cli.cameras import Chosen
    from mi_splat.scene import GaussianScene

EXAMPLES = (
    "dagger scenes/car_street.xml --object car --target person --out out/dagger",
    "dagger scenes/car_street.xml --objective hide --eps 2 --out out/hidden",
    "dagger desk.ply --mask mask.npy --cameras orbit:4@25 --target person --out out/desk",
)
_LOOKS = 3
"""How many looks from a camera a step takes as long as: what is seen, and the gradient."""


@dataclass(frozen=True, kw_only=True)
class DaggerOptions(AttackOptions):
    """Change the Gaussians of one object within a budget, until a detector takes it for something else (DAGGER).

    Writes before.png, after.png, difference.png, detections.png, attacked.ply, mask.npy (the object), cameras.json,
    the rows and result.json into --out; of a scene XML also attacked.xml with its parts, which can be rendered and
    attacked again. The exit status is 0 also when the attack fails: that is a result.
    """

    view: Unprefixed[CameraOptions] = field(default_factory=CameraOptions)
    """The cameras attacked at once; without any flag it is one. Of the folder of a set it is those of the pictures for
    training that show the object, so that the others can judge."""
    config: Unprefixed[DaggerConfig] = field(default_factory=DaggerConfig)
    """How to attack."""
    out: Folder = Path("out/dagger")


def run(options: DaggerOptions) -> None:
    """Attack, write what came of it, and say it; Ctrl-C ends the search with the best so far."""
    from attacks.cli.aims import aim, chosen_object, write_result
    from attacks.cli.options import load_detectors
    from attacks.cli.summary import show_summary
    from attacks.dagger.attack import attack
    from mi_splat.cli.cameras import choose
    from mi_splat.io.folders import check_new_folder
    from mi_splat.scene_files import open_scene
    from mi_splat.selection.select import doubts, require_visible

    check_no_input_in(options.out, options.scene)
    check_new_folder(options.out, force=options.force)
    limit_threads()
    config = options.config
    with progress("loading the scene and the detector", total=config.restarts * (config.steps + 1)) as advance:
        loaded = open_scene(options.scene, options.device)
        selection = chosen_object(loaded, options.selection)
        chosen = choose(loaded, selection, options.view, split="train")
        weights = chosen.weights(loaded)
        if any(Path(text).is_dir() for text in options.view.cameras):
            chosen, weights = _showing(chosen, weights)
        require_visible(weights)
        detectors = load_detectors(options.detectors, options.weights, options.device)
        if len(chosen.cameras) > 1:
            _forecast(loaded.scene, chosen, detectors, config)
        objective = aim(options.objective, options.target, options.confidence)
        advance("attacking", 0)
        with deferred_interrupt() as interrupted:
            result = attack(
                loaded.scene,
                chosen.mask,
                list(chosen.cameras.values()),
                detectors,
                objective,
                render=chosen.render,
                config=config,
                up=options.view.up,
                on_step=_follow(advance, objective.label, config, interrupted),
            )
        origin = {"scene": str(options.scene), "selection": selection.as_dict(), "cameras": list(chosen.cameras)}
        doubtful = tuple(doubts(chosen.mask, weights))
        result = replace(result, origin={**result.origin, **origin}, doubts=doubtful)
        write_result(result, loaded, chosen.mask, options.out, force=options.force)
    show_summary(options.out, as_json=options.json)
    if interrupted():
        raise KeyboardInterrupt


def _showing(chosen: Chosen, weights: dict[str, Tensor]) -> tuple[Chosen, dict[str, Tensor]]:
    """The cameras from which the object shows; all if there is none."""
    from mi_splat.selection.select import SEEN

    kept = {name: weight for name, weight in weights.items() if bool((weight >= SEEN).any())} or weights
    if idle := len(weights) - len(kept):
        warn(f"{idle} of {len(weights)} pictures for training do not show the object, and are left out")
    return replace(chosen, cameras={name: chosen.cameras[name] for name in kept}), kept


def _forecast(scene: GaussianScene, chosen: Chosen, detectors: Sequence[Detector], config: DaggerConfig) -> None:
    """Say how many views are attacked and about how long that takes, by one look from one of them."""
    import torch

    from attacks.report.section import duration

    camera, begun = next(iter(chosen.cameras.values())), 0.0
    with torch.no_grad():
        for _ in range(2):  # the first one compiles
            begun = time.perf_counter()
            picture = chosen.render(scene, camera).clamp(0, 1)[None]
            for detector in detectors:
                detector.detect(picture)
    seconds = _LOOKS * (time.perf_counter() - begun) * len(chosen.cameras) * config.restarts * (config.steps + 1)
    warn(f"{len(chosen.cameras)} views at once, {config.steps} steps: at most about {duration(seconds)}")


def _follow(
    advance: Advance, label: str | None, config: DaggerConfig, interrupted: Callable[[], bool]
) -> Callable[[Step], bool]:
    """A callback that shows each step of the attack, and ends it if the clean object is taken for the class wanted."""

    def note(step: Step) -> bool:
        if label is not None and step.index == step.restart == 0 and step.unambiguous and not config.random_start:
            do = "name another class with --target"
            raise InvalidValueError.of("--target", "another class than is seen before the attack", label, do)
        advance(f"attacking: loss {step.loss:.3f}, score {step.score:.0%}")
        return step.index + step.restart > 0 and interrupted()

    return note
