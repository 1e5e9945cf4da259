"""`mi-splat dagger`: attack one object of a scene and write what came of it."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from typing import Any

from attacks.cli.options import DaggerOptions
from attacks.dagger.attack import attack
from attacks.dagger.report import summary, write_report
from attacks.dagger.result import Result
from attacks.detectors import load_detector
from attacks.objectives import Objective, hide, relabel, untargeted
from attacks.pgd import Step
from mi_splat.cli.console import limit_threads, progress, show, show_json
from mi_splat.errors import InvalidValueError, message
from mi_splat.rendering import Renderer
from mi_splat.scene_files import SplatScene, choose_camera, open_scene


def run(options: DaggerOptions) -> int:
    """Attack, write the report, and say in three lines what happened."""
    limit_threads((os.cpu_count() or 1) // 2)
    config = options.config
    with progress("loading the scene and the detector", total=config.restarts * (config.steps + 1)) as advance:
        loaded = open_scene(options.scene)
        rows = _object_rows(loaded, options)
        cameras = [choose_camera(loaded, name, options.scene) for name in options.views or (None,)]
        detector = load_detector(options.detector, weights=options.weights)
        advance("attacking", 0)
        result = attack(
            loaded.scene,
            rows,
            cameras,
            detector,
            _objective(options),
            render=Renderer(loaded.settings),
            config=config,
            on_step=_follow(advance),
        )
        files = write_report(result, options.out)
    if options.json:
        show_json({**summary(result), "files": {name: str(path) for name, path in files.items()}})
    else:
        _tell(result, options)
    return 0


def _objective(options: DaggerOptions) -> Objective:
    """The attacker's aim."""
    aims: dict[str, Callable[..., Objective]] = {
        "relabel": lambda **limit: relabel(options.target, **limit),
        "hide": hide,
        "untargeted": untargeted,
    }
    limit = {} if options.confidence is None else {"confidence": options.confidence}
    return aims[options.objective](**limit)


def _object_rows(loaded: SplatScene, options: DaggerOptions) -> slice:
    """The Gaussians of the object that the options name."""
    if options.object not in loaded.objects:
        expected = f"one of {', '.join(loaded.objects)}"
        raise InvalidValueError(
            message(f"object of {options.scene}", expected, options.object, "name a shape with --object")
        )
    return loaded.objects[options.object]


def _follow(advance: Callable[..., None]) -> Callable[[Step], None]:
    """A callback that shows each step of the attack."""
    return lambda step: advance(f"attacking: loss {step.loss:.3f}, score {step.score:.0%}")


def _tell(result: Result, options: DaggerOptions) -> None:
    """What happened in three lines, warnings if there are some, and where to look."""
    found = summary(result)
    aim = {"relabel": f"see a {options.target}", "hide": "see nothing"}.get(options.objective, "see something else")
    radii = ", ".join(f"{name} {eps:g}" for name, eps in found["radius"].items())
    views = found["views"]
    reached = sum(view["success"] for view in views)
    outcome = "SUCCESS" if result.success else "FAILED"
    show(
        f"{outcome}: {options.detector} shall {aim} in place of the {options.object}; {reached} of {len(views)} views."
    )
    show(
        f"{_seen(views[0], found['target'])} after {found['steps']} of {options.config.steps} steps "
        f"(budget in {found['norm']}: {radii}; {result.seconds:.0f} s)."
    )
    psnr = found["image_psnr"]
    change = "No picture changed" if psnr is None else f"The picture changed to a PSNR of {psnr:.1f} dB"
    noise = f"{found['noise']['successes']} of {found['noise']['draws']} draws"
    show(f"{change}; random noise of the same size had the same success in {noise}.")
    for warning in result.warnings:
        show(f"warning: {warning}")
    show(f"Look at {options.out / 'detections.png'} first. Beside it: before.png, after.png, difference.png,")
    show("the splat (attacked.ply) and every number (result.json).")


def _seen(view: Mapping[str, Any], target: str | None) -> str:
    """What the detector makes of the object in one view, before and after."""
    before = f"{view['original']} at {view['clean_confidence']:.0%}" if view["original"] else "nothing"
    after = [f"{target} at {view['target_confidence']:.0%}"] if target else []
    if view["original"] not in (None, target):
        after.append(f"{view['original']} at {view['original_confidence']:.0%}")
    return f"On the object it saw {before} before, and {' and '.join(after) or 'nothing known'}"
