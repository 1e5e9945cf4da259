"""`mi-splat dagger`: attack one object of a scene and write what came of it."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attacks.cli.options import AttackOptions
from attacks.dagger.config import DaggerConfig
from mi_splat.cli.console import limit_threads, progress, show, show_json
from mi_splat.cli.flags import Unprefixed
from mi_splat.cli.options import CameraOptions
from mi_splat.errors import InvalidValueError, message
from mi_splat.fields import Folder

if TYPE_CHECKING:
    from attacks.dagger.result import Result
    from attacks.pgd import Step
    from mi_splat.cli.cameras import Chosen
    from mi_splat.scene_files import SplatScene


EXAMPLES = (
    "dagger scenes/car_street.xml --object car --target person --out out/dagger",
    "dagger scenes/car_street.xml --objective hide --eps 2 --out out/hidden",
    "dagger desk.ply --mask mask.npy --cameras orbit:4@25 --target person --out out/desk",
)
SEE_ALSO = ("select", "evaluate", "dagger-eot", "study", "detectors")


@dataclass(frozen=True, slots=True, kw_only=True)
class DaggerOptions(AttackOptions):
    """Change the Gaussians of one object within a budget, until a detector takes it for something else (DAGGER).

    Writes before.png, after.png, difference.png, detections.png, attacked.ply, mask.npy (the object), cameras.json,
    the rows and result.json into --out; of a scene XML also attacked.xml with its parts, which can be rendered and
    attacked again. The exit status is 0 also when the attack fails: that is a result.
    """

    view: Unprefixed[CameraOptions] = field(default_factory=CameraOptions)
    """The cameras attacked at once."""
    config: Unprefixed[DaggerConfig] = field(default_factory=DaggerConfig)
    """How to attack."""
    out: Folder = Path("out/dagger")
    """Folder for the results: a new one, written whole when the attack has ended."""


def run(options: DaggerOptions) -> int:
    """Attack, write the report, and say in three lines what happened."""
    from attacks.cli.aims import aim, chosen_object, write_result
    from attacks.cli.names import load_detectors
    from attacks.dagger.attack import attack
    from attacks.dagger.report import summary
    from mi_splat.cli.cameras import choose
    from mi_splat.io.folders import check_new_folder
    from mi_splat.scene_files import open_scene
    from mi_splat.selection.select import doubts, require_visible

    check_new_folder(options.out, force=options.force)
    limit_threads((os.cpu_count() or 1) // 2)
    config = options.config
    with progress("loading the scene and the detector", total=config.restarts * (config.steps + 1)) as advance:
        loaded = open_scene(options.scene)
        chosen = choose(loaded, chosen_object(loaded, options.selection), options.view)
        weights = chosen.weights(loaded)
        require_visible(weights)
        detectors = load_detectors(options.detectors, options.weights)
        objective = aim(options.objective, options.target, options.confidence)
        advance("attacking", 0)
        result = attack(
            loaded.scene,
            chosen.mask,
            list(chosen.cameras.values()),
            detectors,
            objective,
            render=chosen.render,
            config=config,
            on_step=_follow(advance, objective.label, config),
        )
        result = dataclasses.replace(
            result,
            origin={**result.origin, **_origin(loaded, chosen, options)},
            doubts=tuple(doubts(chosen.mask, weights)),
        )
        files = write_result(result, loaded, chosen.mask, options.out, force=options.force)
    if options.json:
        show_json({**summary(result), "files": files})
    else:
        _tell(result, options)
    return 0


def _origin(loaded: SplatScene, chosen: Chosen, options: DaggerOptions) -> dict[str, Any]:
    """What was attacked, and from which cameras, for the record."""
    from attacks.cli.aims import chosen_object

    return {
        "scene": str(options.scene),
        "selection": chosen_object(loaded, options.selection).as_dict(),
        "cameras": list(chosen.cameras),
    }


def _follow(advance: Callable[..., None], label: str | None, config: DaggerConfig) -> Callable[[Step], None]:
    """A callback that shows each step of the attack, and ends it if the clean object is taken for the class wanted."""

    def note(step: Step) -> None:
        if label is not None and step.index == step.restart == 0 and step.unambiguous and not config.random_start:
            do = "name another class with --target"
            raise InvalidValueError(message("--target", "another class than is seen before the attack", label, do))
        advance(f"attacking: loss {step.loss:.3f}, score {step.score:.0%}")

    return note


def _tell(result: Result, options: DaggerOptions) -> None:
    """What happened in three lines, warnings if there are some, and where to look."""
    from attacks.cli.aims import object_name, sentence
    from attacks.dagger.report import summary

    record = summary(result)
    radii = ", ".join(f"{name} {eps:g}" for name, eps in record["radius"].items())
    what = "detectors" if len(result.detectors) > 1 else "views"
    reached = f"{sum(entry['success'] for entry in record[what])} of {len(record[what])} {what}"
    names = [entry["detector"] for entry in record["detectors"] if entry["success"] == result.success]
    name, clear = object_name(options.selection), result.unambiguous
    said = sentence(result.objective, names, name, success=result.success, clear=clear)
    show(f"{'SUCCESS' if result.success else 'FAILED'}: {said}; {reached}.")
    effort = (
        f"after {record['steps']} of {options.config.steps} steps "
        f"(budget in {record['norm']}: {radii}; {result.seconds:.0f} s)."
    )
    if what == "detectors":
        for detector in result.detectors:
            views = [view for view in record["views"] if view["detector"] == detector]
            successes = sum(view["success"] for view in views)
            show(f"{detector}, {successes} of {len(views)} views: {_seen(record, views)}")
        show(f"This is {effort}")
    else:
        show(f"{_seen(record, record['views'])} {effort}")
    psnr = record["image_psnr"]
    change = "No picture changed" if psnr is None else f"The picture changed to a PSNR of {psnr:.1f} dB"
    noise = f"{record['noise']['successes']} of {record['noise']['draws']} draws"
    show(f"{change}; random noise of the same size had the same success in {noise}.")
    for warning in result.warnings:
        show(f"warning: {warning}")
    show(f"Look at {options.out / 'detections.png'} first. Beside it: before.png, after.png, difference.png,")
    show("the splat (attacked.ply), the object (mask.npy) and every number (result.json).")


def _seen(record: Mapping[str, Any], views: Sequence[Mapping[str, Any]]) -> str:
    """What a detector makes of the object in the first of its views, before and after."""
    view, target = views[0], record["target"]
    before = f"{view['original']} at {view['clean_confidence']:.0%}" if view["original"] else "nothing"
    after = [f"{target} at {view['target_confidence']:.0%}"] if target else []
    if view["original"] not in (None, target):
        after.append(f"{view['original']} at {view['original_confidence']:.0%}")
    return f"On the object it saw {before} before, and {' and '.join(after) or 'nothing known'}"
