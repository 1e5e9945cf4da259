"""`mi-splat dagger --region`: attack one object from all cameras of a region, evaluated on held-out views."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from attacks.cli.options import AttackOptions
from attacks.dagger.config import DaggerConfig
from attacks.transformations.config import CameraRegion, PictureChanges, Transformations
from mi_splat.cli.console import Advance, limit_threads, progress
from mi_splat.cli.flags import Unprefixed
from mi_splat.cli.options import CameraOptions, check_no_input_in
from mi_splat.fields import Folder

if TYPE_CHECKING:
    from attacks.search import Step


EXAMPLES = (
    "dagger --region scenes/car_street.xml --object car --target person --out out/dagger-eot",
    "dagger --region scenes/car_street.xml --object car --elevations 10 30 --jpeg 50 --blur 1 --out out/photographed",
)


@dataclass(frozen=True, kw_only=True)
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
    config: Unprefixed[DaggerConfig] = field(default_factory=DaggerConfig.for_region)
    """How to attack."""
    checkpoint: Path | None = None
    """File that keeps the search while it runs; None is one beside --out."""
    out: Folder = Path("out/dagger-eot")


def run(options: DaggerEotOptions) -> None:
    """Attack, write what came of it, and say it."""
    from attacks.cli.aims import aim, chosen_object, write_result
    from attacks.cli.options import load_detectors
    from attacks.cli.summary import show_summary
    from attacks.dagger.attack import attack_views
    from attacks.dagger.search import Checkpoint
    from attacks.dagger.views import DrawnViews
    from mi_splat.cli.cameras import choose
    from mi_splat.io.camera_records import describe
    from mi_splat.io.folders import check_new_folder
    from mi_splat.scene_files import open_scene

    check_no_input_in(options.out, options.scene)
    check_new_folder(options.out, force=options.force)
    limit_threads()
    config = options.config
    checkpoint = Checkpoint(path=options.checkpoint or options.out.with_name(f"{options.out.name}.checkpoint"))
    with progress("loading the scene and the detectors", total=config.steps + 1) as advance:
        loaded = open_scene(options.scene, options.device)
        selection = chosen_object(loaded, options.selection)
        chosen = choose(loaded, selection, options.view)
        name, camera = next(iter(chosen.cameras.items()))
        detectors = load_detectors(options.detectors, options.weights, options.device)
        drawn = Transformations(cameras=options.region, pictures=options.pictures)
        views = DrawnViews(loaded.scene, chosen.mask, camera, drawn, render=chosen.render, up=options.view.up)
        advance("looking at the object", 0)
        checkpoint.path.parent.mkdir(parents=True, exist_ok=True)
        objective = aim(options.objective, options.target, options.confidence)
        result = attack_views(
            views, detectors, objective, config=config, checkpoint=checkpoint, on_step=_follow(advance)
        )
        origin = {"scene": str(options.scene), "selection": selection.as_dict(), "cameras": [name]}
        result = replace(result, origin={**result.origin, **origin, "reference": describe(name, camera)})
        write_result(result, loaded, chosen.mask, options.out, force=options.force)
    show_summary(options.out, as_json=options.json)


def _follow(advance: Advance) -> Callable[[Step], None]:
    """A callback that shows each step of the attack, and how it did when it was last judged."""
    from attacks.search import NOT_JUDGED

    judged = ""

    def note(step: Step) -> None:
        nonlocal judged
        if step.score != NOT_JUDGED:
            judged = f", validation {step.score:.0%}"
        advance(f"attacking: step {step.index}, loss {step.loss:.3f}{judged}")

    return note
