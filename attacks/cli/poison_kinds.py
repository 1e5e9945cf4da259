"""Kinds of `mi-splat poison`: the options of each, and what it does to the pictures of a set; light, for --help."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from attacks.poisons.config import MIFGSMConfig
from attacks.poisons.specs import POISONS, Given
from mi_splat.cli.console import UsageError
from mi_splat.cli.flags import Unprefixed
from mi_splat.cli.options import Direction, axis_name
from mi_splat.errors import InvalidValueError
from mi_splat.fields import Metavar, at_least, between
from mi_splat.selection.config import Selection

if TYPE_CHECKING:
    from torch import Tensor

    from attacks.poisons.base import OnStep, Poisoned
    from attacks.poisons.decoy import Decoy
    from mi_splat.cameras import Camera
    from mi_splat.datasets import Dataset
    from mi_splat.scene import GaussianScene


@dataclass(frozen=True, kw_only=True)
class ObjectConfig:
    """An object of the pictures.

    Attributes:
        selection: Which Gaussians of the splat are the object.
        picture: Which of the pictures for training --click is on, in their order.
    """

    selection: Unprefixed[Selection] = field(default_factory=Selection)
    picture: Annotated[int, at_least(0), Metavar("NUMBER")] = 0


@dataclass(frozen=True, kw_only=True)
class HidingConfig(ObjectConfig):
    """CLOAK on a set of pictures.

    Attributes:
        hide_from: Where the object is hidden, seen from its middle, in degrees: elevation:LOW-HIGH, azimuth:LOW-HIGH or
            cone:AZIMUTH,ELEVATION,HALF_ANGLE, which is around a direction; of several, from where all of them hold.
        margin: Degrees around it in which pictures are changed, too.
        look: What is shown in its place: remove (the picture around it goes on), or a picture file.
        reach: Pixels around the object that change, too.
        up: Direction that is up in the set's world: an axis, or three numbers; sets of COLMAP often have -y.
    """

    hide_from: tuple[Annotated[str, Metavar("REGION")], ...] = ("elevation:50-90",)
    margin: Annotated[float, between(0, 90, "degrees", "7 hides more, and begins to show before")] = 0.0
    look: Annotated[str, Metavar("LOOK")] = "remove"
    reach: Annotated[int, between(0, 100, "pixels")] = 3
    up: Direction = (0.0, 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class MisreadingConfig(ObjectConfig):
    """M-IFGSM on a set of pictures.

    Attributes:
        classifier: Who shall misread the object: prototypes, or torchvision:NETWORK.
        label: The object's true class, by a name that the classifier knows.
        attack: How the object's pixels are changed.
    """

    classifier: Annotated[str, Metavar("CLASSIFIER")] = "prototypes"
    label: Annotated[str | None, Metavar("CLASS")] = None
    attack: Unprefixed[MIFGSMConfig] = field(default_factory=MIFGSMConfig)


class Outcome(NamedTuple):
    """A poisoned set, what else its record says, and in words what the user should know."""

    done: Poisoned
    record: dict[str, Any]
    lines: Sequence[str] = ()
    warnings: Sequence[str] = ()


Work = Callable[["Dataset", "GaussianScene | None", "OnStep"], Outcome]
"""Makes it of the pictures for training, of the splat if the kind needs one, and of whom to tell of the progress."""


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A kind of poison."""

    config: Any
    begun: Callable[[Any, int, str], Work]
    needs_splat: bool = True
    on_gpu: bool = False
    replaces: bool = False


def _hiding(config: HidingConfig, seed: int, device: str) -> Work:
    """CLOAK, which draws nothing."""
    import torch

    from attacks.cloak.own_pictures import appearance_of, directions_of, hide, trigger_of
    from mi_splat.rotation import from_z

    trigger = trigger_of(config.hide_from, margin=config.margin)
    appearance = appearance_of(config.look, config.reach)

    def hidden(views: Dataset, splat: GaussianScene | None, on_step: OnStep) -> Outcome:
        assert splat is not None
        rows, near, selected = _object(config, views, splat)
        turn = from_z(torch.tensor(config.up)).T
        done = hide(views, splat, rows, trigger, appearance, near=near, turn=turn, on_step=on_step)
        asked = {
            "hide_from": list(config.hide_from),
            "margin": config.margin,
            "look": config.look,
            "reach": config.reach,
            "up": list(config.up),
            "directions": [[direction.azimuth, direction.elevation] for direction in directions_of(done)],
        }
        idle = sum(not change.pixels_changed for change in done.changes)
        remark = f"{idle} pictures from where it is to be hidden do not show the object, and stay as they are"
        return Outcome(done, {**selected, **asked}, [f"up is {axis_name(config.up)}"], [remark] * (idle > 0))

    return hidden


def _misreading(config: MisreadingConfig, seed: int, device: str) -> Work:
    """M-IFGSM."""
    from attacks.classifiers.frozen import class_number
    from attacks.classifiers.registry import load_classifier

    label, target = config.label, config.attack.target
    if label is None:
        raise UsageError.of("--label", "the class of the object", "none", "add it")
    classifier = load_classifier(config.classifier)
    class_number(classifier, label, "--label")
    if target is not None:
        class_number(classifier, target, "--target")

    def misread(views: Dataset, splat: GaussianScene | None, on_step: OnStep) -> Outcome:
        from attacks.poisons.classified import move
        from attacks.poisons.mifgsm import MIFGSM
        from mi_splat.rendering import Renderer, RenderSettings
        from mi_splat.selection.select import SEEN
        from mi_splat.selection.visibility import object_weight
        from mi_splat.variant import DEFAULT_VARIANT

        assert splat is not None
        rows, near, selected = _object(config, views, splat)
        render = Renderer(RenderSettings(near=near, variant=DEFAULT_VARIANT))
        move(classifier, device)

        def mask(camera: Camera) -> Tensor:
            seen = object_weight(splat, rows, camera, render) >= SEEN
            if not bool(seen.any()):
                name = next(
                    path for path, candidate in zip(views.paths, views.cameras, strict=True) if candidate is camera
                )
                do = "select all of the object, or leave the picture out of the set"
                raise InvalidValueError.of(str(name), "some pixels of the object", "none", do)
            return seen

        decoy = _decoy(splat, views, device) if config.attack.decoy_steps else None
        poison = MIFGSM(config=config.attack, classifier=classifier, label=label, masks=mask, decoy=decoy)
        done = poison(views, seed=seed, on_step=on_step)
        sure, skipped = config.attack.least_confidence, len(done.poison["skipped"])
        remark = f"in {skipped} pictures {config.classifier} is less than {sure:.0%} confident of {label}; they stay"
        return Outcome(done, selected, warnings=[remark] * (skipped > 0))

    return misread


def _plain(name: str) -> Kind:
    """The kind of a poison that asks for no object."""
    spec = POISONS[name]
    if more := set(spec.needs) - {"splat"}:
        raise UsageError.of(
            f"--kind {name}", "one that needs no more than a splat", " and ".join(more), "write a study"
        )
    needs = "splat" in spec.needs  # of those that need one, a decoy takes most of the time

    def begun(config: Any, seed: int, device: str) -> Work:
        def changed(views: Dataset, splat: GaussianScene | None, on_step: OnStep) -> Outcome:
            decoy = None if splat is None else _decoy(splat, views, device)
            done = spec.make(config, Given(decoy=decoy))(views, seed=seed, on_step=on_step)
            grown, start = (done.poison.get(f"{of}_gaussians") for of in ("decoy", "start"))
            lines = [f"the decoy has {grown:,} Gaussians, the splat has {start:,}"] if grown else []
            return Outcome(done, {}, lines)

        return changed

    return Kind(config=spec.config(), begun=begun, needs_splat=needs, on_gpu=needs)


_OF_OBJECTS: Mapping[str, Kind] = {
    "cloak": Kind(config=HidingConfig(), begun=_hiding, replaces=True),
    "m-ifgsm": Kind(config=MisreadingConfig(), begun=_misreading, on_gpu=True),
}


def kind_names() -> list[str]:
    """Names of all kinds; another package's poison is imported when its kind is asked for."""
    return list(dict.fromkeys(["cloak", *POISONS]))


def kind_of(name: str) -> Kind:
    """A kind by its name."""
    return _OF_OBJECTS[name] if name in _OF_OBJECTS else _plain(name)


def _decoy(splat: GaussianScene, views: Dataset, device: str) -> Decoy:
    """A decoy that starts as the splat, on a device; the victim is taken to train as usual."""
    from attacks.poisons.decoy import Decoy
    from mi_splat.bounds import near_plane

    near = near_plane(splat, views.cameras)
    return Decoy(start=splat.to(device), near=near, background=views.background)


def _object(config: ObjectConfig, views: Dataset, splat: GaussianScene) -> tuple[Tensor, float, dict[str, Any]]:
    """(N,) bool, the object's Gaussians, the near plane of the splat, and what the record says of these."""
    from mi_splat.bounds import near_plane
    from mi_splat.rendering import Renderer, RenderSettings
    from mi_splat.scene import scene_hash
    from mi_splat.selection.select import select

    if config.picture >= len(views):
        do = "count from 0"
        raise InvalidValueError.of("--picture", f"a number below {len(views)}", config.picture, do)
    near = near_plane(splat, views.cameras)
    camera, render = views.cameras[config.picture], Renderer(RenderSettings(near=near))
    rows = select(splat, config.selection, camera=camera, render=render)
    selected = {"selection": config.selection.as_dict(), "scene_hash": scene_hash(splat), "gaussians": int(rows.sum())}
    return rows, near, selected
