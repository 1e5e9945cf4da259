"""The test kit accepts what keeps its contract, and says of broken plug-ins what is
broken and what to do.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from attacks.detectors import Candidates, Detections, wrap_detector
from attacks.objectives.base import Target, confidence
from attacks.objectives.function import objective
from attacks.observe.conditions import Viewing, rendered, renderer_of
from attacks.optimisers import OptimiserSpec
from attacks.optimisers.methods import SearchSettings
from attacks.poisons.base import Poisoned, PoisonedViews, poisoned
from attacks.poisons.specs import PoisonSpec
from attacks.search.loop import Evaluation, Memory, Verdict
from attacks.search.parameters import Parameters
from attacks.testing import (
    ContractError,
    check_attack,
    check_condition,
    check_detector,
    check_objective,
    check_poison,
    check_renderer,
    check_rule,
)
from attacks.testing.promises import cloud
from mi_splat.audit.rules import Rule, Stored
from mi_splat.cameras.camera import Camera, View
from mi_splat.comparison.methods import RENDERERS, RendererSpec
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.scene import GaussianScene
from tests.fakes import CoarseDetector, ColourDetector


def broken_by(check: Callable[[], None], *words: str) -> ContractError:
    """The error of a check, which says all these words, each in a line of its own."""
    with pytest.raises(ContractError) as caught:
        check()
    for word in words:
        assert any(word in line for line in caught.value.broken), (
            f"{word!r} not in {caught.value}"
        )
    assert str(caught.value).count("\n") == len(caught.value.broken)
    return caught.value


# Detectors


class Changed(ColourDetector):
    """Candidates of the wrapped one, changed."""

    def __init__(self, change: Callable[[Candidates], Candidates]) -> None:
        self._change = change

    def candidates(self, images: Tensor) -> list[Candidates]:
        return [self._change(seen) for seen in super().candidates(images)]


def scores(change: Callable[[Tensor], Tensor]) -> Changed:
    return Changed(lambda seen: Candidates(seen.boxes, change(seen.scores)))


def boxes(change: Callable[[Tensor], Tensor]) -> Changed:
    return Changed(lambda seen: Candidates(change(seen.boxes), seen.scores))


class Stacked(ColourDetector):
    """Normalises over all images."""

    def candidates(self, images: Tensor) -> list[Candidates]:
        return super().candidates((images - images.mean() + 0.5).clamp(0, 1))


class Unmarked(ColourDetector):
    fingerprint = "new"


class Lenient(ColourDetector):
    threshold = 0.01


class Careless(ColourDetector):
    """Takes everything, and clips it in place."""

    name = "careless"

    def candidates(self, images: Tensor) -> list[Candidates]:
        return ColourDetector.candidates(
            self, torch.nan_to_num(images).detach().clamp_(0, 1)[..., :3]
        )

    def detect(self, images: Tensor) -> list[Detections]:
        images.mul_(0.5)
        return [
            Detections(torch.zeros(2, 4), torch.tensor([0.01, 0.5]), ("cat", "car"))
            for _ in images
        ]


@pytest.mark.parametrize(
    ("detector", "words"),
    [
        (
            scores(Tensor.detach),
            (
                (
                    "gradients: expected a gradient, got none; keep the way from the"
                    " images"
                ),
            ),
        ),
        (
            scores(lambda s: 2 * s.detach() - s),
            ("gradients: expected a gradient that is true: a slope of",),
        ),
        (scores(Tensor.logit), ("candidates: expected scores in [0, 1], got -",)),
        (
            boxes(lambda b: b / 128),
            ("candidates: expected boxes in pixels, got numbers up to 1",),
        ),
        (
            boxes(lambda b: b[..., [1, 0, 3, 2]] * 2),
            ("candidates: expected boxes with their middle in the image",),
        ),
        (
            boxes(lambda b: torch.cat([b[..., 2:], b[..., 2:] - b[..., :2]], -1)),
            ("candidates: expected boxes whose first corner is the upper left one",),
        ),
        (
            scores(lambda s: torch.nn.functional.dropout(s, 0.5).clamp(max=1)),
            ("determinism: expected the same in a second look",),
        ),
        (
            Changed(lambda seen: Candidates(seen.boxes[:0], seen.scores[:0])),
            ("candidates: expected candidates before any threshold, got none",),
        ),
        (
            Stacked(),
            (
                "stacks: expected the same scores",
                "each image for itself: expected no gradient in the other",
            ),
        ),
        (
            Careless(),
            (
                "detections: expected labels that are among the classes, got cat",
                "images: expected images that stay as they are",
                (
                    "refusals: expected InvalidValueError for values up to 255, got an"
                    " answer"
                ),
                "refusals: expected InvalidValueError for NaN, got an answer",
            ),
        ),
        (
            object(),
            (
                (
                    "names: expected all members of Detector, got no candidates,"
                    " detect, name"
                ),
            ),
        ),
        (Unmarked(), ("names: expected 16 hex digits as fingerprint, got new",)),
        (
            Lenient(),
            (
                "names: expected an operating threshold from min_confidence (0.05) to"
                " 1, got 0.01",
            ),
        ),
    ],
    ids=lambda value: value[0].split(":")[0] if isinstance(value, tuple) else "",
)
def test_detectors_that_are_broken(detector: Any, words: tuple[str, ...]) -> None:
    broken_by(lambda: check_detector(detector), *words)


# Objectives


def _score(candidates: Candidates, target: Target) -> Tensor:
    return candidates.scores[:, 0].sum()


def _gone(detections: Detections, target: Target) -> float:
    return 1 - confidence(detections, target.box, iou=0.3)


def _nothing(detections: Detections, target: Target) -> bool:
    return False


def _says(answer: Any, detections: Detections, target: Target) -> Any:
    return answer


@pytest.mark.parametrize(
    ("aim", "words"),
    [
        (
            objective(lambda c, t: -c.scores[:, 0].sum(), _gone),
            ("loss and success: expected success that comes nearer",),
        ),
        (
            objective(_score, _nothing),
            ("loss and success: expected success that comes nearer",),
        ),
        (
            objective(lambda c, t: c.scores.mean().detach(), _gone),
            ("gradients: expected a loss with a gradient, got none",),
        ),
        (
            objective(lambda c, t: c.scores[:, 0], _gone),
            ("loss: raised InvalidValueError: loss of _gone: expected a tensor",),
        ),
        (
            objective(lambda c, t: c.scores[:, 0].max(), _gone),
            ("no candidates: raised",),
        ),
        (
            objective(lambda c, t: _score(c, t) + torch.rand(()), _gone),
            ("determinism: expected the same loss",),
        ),
        (
            objective(_score, lambda d, t: 7.0),
            ("verdict: raised InvalidValueError: success of lambda",),
        ),
        (object(), ("names: expected a text as name, got None",)),
    ],
)
def test_objectives_that_are_broken(aim: Any, words: tuple[str, ...]) -> None:
    broken_by(lambda: check_objective(aim), *words)


def test_what_success_says_becomes_a_verdict() -> None:
    target = Target(
        box=torch.tensor([0.0, 0.0, 9.0, 9.0]),
        label=None,
        classes=("car",),
        original="car",
    )
    seen = Detections(torch.zeros(0, 4), torch.zeros(0), ())
    whole = Verdict(success=True, score=0.5, unambiguous=False)
    answers = {
        True: Verdict(success=True, score=1, unambiguous=True),
        False: Verdict(success=False, score=0, unambiguous=False),
        0.25: Verdict(success=False, score=0.25, unambiguous=False),
        whole: whole,
    }
    for answer, verdict in answers.items():
        assert (
            objective(_score, partial(_says, answer)).verdict(seen, target) == verdict
        )
    assert objective(_score, _gone).name == "_gone"
    assert "tests.plug_ins.test_testing._gone" in repr(objective(_score, _gone))


# Attacks


def _descent(settings: SearchSettings, sign: float = -1.0) -> Any:
    def update(point: Parameters, here: Evaluation, memory: Memory) -> Any:
        directions = settings.ball.steepest(here.gradients)
        return {
            name: point[name] + sign * settings.step[name] * directions[name]
            for name in point
        }

    return update


def _forgetful(settings: SearchSettings) -> Any:
    """Its steps become shorter by what it remembers beside the memory."""
    taken: list[int] = []

    def update(point: Parameters, here: Evaluation, memory: Memory) -> Any:
        taken.append(0)
        steepest = settings.ball.steepest(here.gradients)
        return {
            name: point[name] - settings.step[name] / len(taken) * steepest[name]
            for name in point
        }

    return update


def _moving(settings: SearchSettings) -> Any:
    def update(point: Parameters, here: Evaluation, memory: Memory) -> Any:
        for name, value in point.items():
            value.sub_(settings.step[name] * here.gradients[name].sign())
        return point

    return update


OWN = OptimiserSpec(name="own", make=_descent, about="steps of fixed length")


def test_attacks_that_are_broken() -> None:
    for make, words in (
        (
            partial(_descent, sign=1.0),
            "gain in l2: expected a lower loss within the budget",
        ),
        (_forgetful, "memory: expected the same from a new memory"),
        (_moving, "steps: expected points and gradients that stay as they are"),
    ):
        broken_by(partial(check_attack, dataclasses.replace(OWN, make=make)), words)
    broken_by(
        partial(check_attack, dataclasses.replace(OWN, about="")),
        "names: expected a text as line about it",
    )


# Renderers and conditions

_TILE = RENDERERS["tile"]


def changed_tile(
    change: Callable[[Tensor], Tensor],
) -> Callable[[GaussianScene, Camera], Tensor]:
    return lambda scene, camera: change(Renderer()(scene, camera))


def _cut(scene: GaussianScene, camera: Camera) -> Tensor:
    return Renderer()(
        scene.replace(means=scene.means.detach(), opacities=scene.opacities.detach()),
        camera,
    )


def _overwriting(scene: GaussianScene, camera: Camera) -> Tensor:
    picture = Renderer()(scene, camera)
    with torch.no_grad():
        scene.sh.mul_(0.9)
    return picture


@pytest.mark.parametrize(
    ("renderer", "words"),
    [
        (
            changed_tile(lambda picture: picture.flip(1)),
            ("places: expected a Gaussian at",),
        ),
        (
            changed_tile(lambda picture: picture.permute(2, 0, 1)),
            ("images: expected an image of shape (28, 40, 3)",),
        ),
        (
            changed_tile(lambda picture: picture * 255),
            ("images: expected sRGB about in [0, 1]", "colours: expected"),
        ),
        (
            changed_tile(lambda picture: picture**2.2),
            ("colours: expected sRGB (0.8, 0.4, 0.2)",),
        ),
        (
            changed_tile(lambda picture: picture + 0.1 * torch.rand(())),
            ("determinism: expected the same image",),
        ),
        (
            changed_tile(lambda picture: picture.detach()),
            ("gradient of sh: expected a gradient, got none",),
        ),
        (_cut, ("gradient of means: expected", "gradient of opacities: expected")),
        (_overwriting, ("scene: expected a scene that stays as it is",)),
        (
            RendererSpec(make=lambda settings: Renderer()),
            (
                (
                    "background: expected the background (1.0, 0.5, 0.0), got (0.0,"
                    " 0.0, 0.0)"
                ),
            ),
        ),
    ],
)
def test_renderers_that_are_broken(renderer: Any, words: tuple[str, ...]) -> None:
    broken_by(lambda: check_renderer(renderer), *words)


def fog(viewing: Viewing) -> Any:
    render = renderer_of("", viewing.settings)
    return rendered("fog", lambda scene, camera: 0.8 * render(scene, camera) + 0.2)


def test_conditions_that_are_broken() -> None:
    def noisy(viewing: Viewing) -> Any:
        render = renderer_of("", viewing.settings)
        return rendered(
            "noisy",
            lambda scene, camera: render(scene, camera) + 0.1 * torch.rand(28, 40, 3),
        )

    broken_by(
        lambda: check_condition(noisy),
        "determinism: expected the same image in a second call",
    )
    broken_by(
        lambda: check_condition(lambda viewing: 3),
        "making it: expected a Condition, got int",
    )
    viewing = Viewing(
        settings=RenderSettings(), centre=(0.0, 0.0, 0.0), alone=lambda splat: splat
    )
    nowhere = dataclasses.replace(fog(viewing), move=lambda camera: 3)
    broken_by(
        lambda: check_condition(nowhere),
        "cameras: expected a Camera that it moves to, got int",
    )


# Poisons


@dataclass(frozen=True, kw_only=True)
class Dark:
    by: float = 0.5


def darker(config: Dark, decoy: object) -> Any:
    def poison(
        views: Sequence[View], *, seed: int = 0, on_step: Any = None
    ) -> Poisoned:
        pictures = {}
        for number, view in enumerate(views):
            pictures[number] = view.image * config.by
            if on_step is not None:
                on_step(number + 1, len(views))
        return poisoned(
            views, pictures, {"kind": "dark", "by": config.by, "seed": seed}
        )

    return poison


def _three(config: Dark, decoy: object) -> Any:
    return 3


DARK = PoisonSpec(name="dark", config=Dark, make=darker)


def test_poisons_that_are_broken() -> None:
    def unseeded(
        views: Sequence[View], *, seed: int = 0, on_step: Any = None
    ) -> Poisoned:
        return poisoned(views, {0: torch.rand(views[0].image.shape)}, {})

    words = (
        "determinism: expected the same images",
        "progress: expected calls of on_step",
        "manifest: expected a text",
    )
    broken_by(lambda: check_poison(unseeded), *words)

    def secret(
        views: Sequence[View], *, seed: int = 0, on_step: Any = None
    ) -> Poisoned:
        shown = PoisonedViews(views, {1: View(views[1].camera, views[1].image * 0.5)})
        return Poisoned(views=shown, changes=(), poison={"kind": "secret"})

    broken_by(
        lambda: check_poison(secret),
        "changes: expected changes of the views [1], got []",
    )

    def overwriting(
        views: Sequence[View], *, seed: int = 0, on_step: Any = None
    ) -> Poisoned:
        views[0].image.mul_(0.5)
        return poisoned(views, {0: views[0].image}, {"kind": "rude"})

    broken_by(
        lambda: check_poison(overwriting),
        "the untouched set: expected an untouched set",
    )

    @dataclass
    class Loose:
        by: float

    broken_by(
        lambda: check_poison(dataclasses.replace(DARK, config=Loose)),
        "settings: raised TypeError",
    )
    broken_by(
        lambda: check_poison(dataclasses.replace(DARK, needs=("splat",))),
        "settings: expected a poison that needs nothing, got one that needs splat",
    )
    broken_by(
        lambda: check_poison(dataclasses.replace(DARK, make=_three)),
        "making it: expected a function",
    )


# Rules


def _grey(stored: Stored, threshold: float) -> Any:
    return stored.valid & (np.abs(stored.arrays["sh"][:, 0]).max(1) < threshold)


GREY = Rule(
    name="grey",
    severity="note",
    threshold=1e-3,
    reason="It has no colour at all.",
    find=_grey,
)


def test_rules_that_are_broken() -> None:
    def rude(stored: Stored, threshold: float) -> Any:
        stored.arrays["sh"] *= 0.5
        return np.zeros(len(stored.valid), np.bool_)

    def short(stored: Stored, threshold: float) -> Any:
        return np.zeros(3, np.bool_)

    cases: tuple[tuple[dict[str, Any], str], ...] = (
        ({"find": rude}, "determinism: expected arrays that stay as they are"),
        (
            {"find": short},
            (
                "healthy splats: raised InvalidValueError: rule grey: expected bool"
                " (60,), got bool (3,)"
            ),
        ),
        (
            {"threshold": 1e9},
            "healthy splats: expected nothing, got a finding in 60 of 60",
        ),
        ({"name": "giant"}, "names: expected a name that is free, got giant"),
        ({"reason": "no"}, "names: expected a sentence as reason"),
        ({"severity": "bad"}, "names: expected error or warning or note, got bad"),
    )
    for changes, words in cases:
        broken_by(partial(check_rule, dataclasses.replace(GREY, **changes)), words)
    broken_by(lambda: check_rule(3), "names: expected a Rule, got int")


def test_a_rule_that_finds_nothing_where_it_has_to() -> None:
    coloured = cloud(20, 0)
    check_rule(GREY, finds=coloured.replace(sh=torch.zeros_like(coloured.sh)))
    broken_by(
        lambda: check_rule(GREY, finds=coloured),
        "what it finds: expected a finding, got none",
    )


# All that is right


class Bright(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.tensor(3.0))

    def forward(self, images: Tensor) -> Tensor:
        return self.scale * (images.mean((1, 2, 3)) - 0.5)


def whole_picture(logits: Tensor, size: tuple[int, int]) -> Any:
    box = torch.tensor([[0.0, 0.0, size[1], size[0]]])
    return [(box, logit.sigmoid().reshape(1, 1)) for logit in logits]


def still(scene: GaussianScene, camera: Camera) -> Tensor:
    return Renderer()(scene, camera).detach()


RIGHT: list[tuple[Callable[..., None], Any]] = [
    *((check_detector, detector) for detector in (ColourDetector(), CoarseDetector())),
    (check_detector, wrap_detector(Bright(), ("stop sign",), whole_picture)),
    *((check_objective, aim) for aim in (objective(_score, _gone),)),
    (check_attack, OWN),
    (check_renderer, RendererSpec(make=_TILE.make, differentiable=False)),
    (partial(check_renderer, differentiable=False), still),
    (check_condition, fog),
    (check_poison, DARK),
    (check_rule, GREY),
]


@pytest.mark.parametrize(("check", "plug_in"), RIGHT)
def test_what_is_right_is_accepted(check: Callable[..., None], plug_in: Any) -> None:
    check(plug_in)
