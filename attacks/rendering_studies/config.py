"""What a rendering study asks, as a TOML file holds it: which attacks, and under which conditions they count."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from attacks.cloak.study_file import read_table
from attacks.limits import NormName, SearchName
from attacks.observe.conditions import FORMATS, SunTable
from mi_splat.attributes import Attribute
from mi_splat.errors import InvalidValueError, message
from mi_splat.fields import Checked, Count, Degree, PositiveFraction, Steps, at_least, check, check_choice

OWN = "own"
"""Stands for the gradient of the renderer that makes the attacker's pictures."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair(Checked):
    """What is attacked, and what a detector shall take it for.

    Attributes:
        scene: Name of the scene file without its suffix.
        object: Id of the object; with spaces for its underscores it is the object's class.
        target: Class wanted.
        camera: Position of the camera in the order of the scene file.
    """

    scene: str
    object: str
    target: str
    camera: Count = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class AttackTable:
    """A group of attacks; one for each radius, renderer and gradient.

    Attributes:
        attribute: What of the object's Gaussians may change.
        norm: How the change is measured.
        eps: Radii of the ball.
        steps: Number of steps; no attack stops early.
        search: How the attacker searches, a key of `attacks.dagger.pairs.SEARCHES`.
        sh_degree: SH degree of the attacked file, if SH may change; never below that of the clean one.
        renderers: Names of the renderers (as in `mi-splat compare`) whose pictures the attacker looks at.
        gradients: Names of the renderers whose gradients the attacker follows; "own" is that of the pictures.

    Raises:
        InvalidValueError: A list is empty.
    """

    attribute: Attribute = "sh"
    norm: NormName = "l2"
    eps: Annotated[tuple[float, ...], at_least(0)] = (5.0,)
    steps: Steps = 11
    search: SearchName = "paper"
    sh_degree: Degree = 3
    renderers: tuple[str, ...] = ("tile",)
    gradients: tuple[str, ...] = (OWN,)

    def __post_init__(self) -> None:
        check(self)
        _check_some(self, "eps", "renderers", "gradients")


@dataclass(frozen=True, slots=True, kw_only=True)
class JudgeTable:
    """Under which conditions an attacked splat is judged.

    Attributes:
        own_renderer: Whether the renderer of the attack judges, and nothing else: conditions below stay empty.
        renderers: Names of renderers, as in `mi-splat compare`.
        files: Formats that the whole splat goes through, by their suffix.
        sh_degrees: Degrees that its SH is cut to.
        float16: Whether its SH is rounded to half precision.
        sun: A street of meshes that the object is put into.

    Raises:
        InvalidValueError: A format is unknown, or a degree is not 0, 1, 2 or 3.
    """

    own_renderer: bool = False
    renderers: tuple[str, ...] = ()
    files: tuple[str, ...] = ()
    sh_degrees: tuple[Degree, ...] = ()
    float16: bool = False
    sun: SunTable | None = None

    def __post_init__(self) -> None:
        check(self)
        for suffix in self.files:
            check_choice("files", suffix, FORMATS)


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderingStudy:
    """One study.

    Attributes:
        name: Name of it.
        question: What it asks, one sentence.
        pairs: What is attacked.
        attacks: How.
        judge: Under which conditions the attacks count.
        detectors: Names of the detectors; each judges the attacks on itself.
        confidence: From which a class counts as reported, in (0, 1].
        seeds: Number of seeds; each but 0 moves the camera and starts at a random point of the ball.

    Raises:
        InvalidValueError: A list is empty, or a number is out of its range.
    """

    name: str
    question: str
    pairs: tuple[Pair, ...]
    attacks: tuple[AttackTable, ...]
    judge: JudgeTable = field(default_factory=JudgeTable)
    detectors: tuple[str, ...] = ("fasterrcnn_small",)
    confidence: PositiveFraction = 0.5
    seeds: Annotated[int, at_least(1)] = 3

    def __post_init__(self) -> None:
        check(self)
        _check_some(self, "pairs", "attacks", "detectors")
        judge = self.judge
        others = bool(judge.renderers or judge.files or judge.sh_degrees or judge.float16 or judge.sun)
        if judge.own_renderer == others:
            do = "write own_renderer = true alone, or renderers, files, sh_degrees, float16 or [judge.sun]"
            raise InvalidValueError(message("judge", "conditions", "both kinds" if others else "none", do))


def _check_some(table: object, *names: str) -> None:
    """Raise unless each of these lists holds something."""
    for name in names:
        if not getattr(table, name):
            raise InvalidValueError(message(name, "at least one", "none", "add one to the study"))


def read_rendering_study(path: Path) -> RenderingStudy:
    """The study in a TOML file.

    Raises:
        InvalidValueError: There is no such file, it is no TOML, or a key or a value in it means nothing.
    """
    return read_table(RenderingStudy, path)
