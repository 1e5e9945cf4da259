"""Every optimiser of the registry on one interface: inside its ball, the same again,
never worse than its start.
"""

import copy
import dataclasses
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch import Tensor

from attacks.dagger.attack import attack
from attacks.dagger.config import DaggerConfig
from attacks.dagger.result import Result
from attacks.detectors.base import Candidates
from attacks.objectives.relabel import relabel
from attacks.optimisers import NORM_NAMES, OPTIMISERS, NormName, optimiser_spec
from attacks.optimisers.methods import SearchSettings, apgd, checkpoints, square
from attacks.search.budget import Budget
from attacks.search.loop import Evaluation, Memory, Outcome, Verdict, pgd, rank
from attacks.search.parameters import Parameters
from tests.fakes import ColourDetector, blobs, camera, toy_scene

NAMES = tuple(OPTIMISERS)
REFERENCE = {"sh": torch.linspace(-1, 1, 24).reshape(8, 3), "means": torch.zeros(8, 3)}
GOALS = {
    "sh": REFERENCE["sh"] + 0.6,
    "means": torch.linspace(-0.4, 0.8, 24).reshape(8, 3),
}


def bowl(point: Parameters, *, enough: float = -1.0) -> Evaluation:
    """Squared distance to the goals; success from `enough` downwards."""
    loss = sum(float((point[name] - GOALS[name]).square().sum()) for name in point)
    gradients = {name: 2 * (point[name] - GOALS[name]) for name in point}
    return Evaluation(
        loss=loss,
        gradients=gradients,
        verdict=Verdict(loss <= enough, 1 / (1 + loss), loss <= enough),
    )


def settings(norm: NormName = "linf", **more: Any) -> SearchSettings:
    steps = more.pop("steps", 24)
    radius = more.pop("radius", {"sh": 0.5, "means": 0.3})
    usual = {
        "positions": torch.arange(24.0).reshape(8, 3),
        "step": {k: 2 * v / steps for k, v in radius.items()},
    }
    ball = Budget(radius=radius, norm=norm)
    return SearchSettings(
        **{"ball": ball, "reference": REFERENCE, "steps": steps, **usual, **more}
    )


def run(
    name: str, search: SearchSettings, *, enough: float = -1.0, **more: Any
) -> Outcome:
    spec = optimiser_spec(name)

    def evaluate(point: Parameters) -> Evaluation:
        here = bowl(point, enough=enough)
        if spec.gradient:
            return here
        return dataclasses.replace(here, gradients={})

    made = spec.make(dataclasses.replace(search, momentum=spec.momentum))
    more = {"early_stop": False, "smallest": spec.smallest, **more}
    return pgd(
        evaluate,
        search.reference,
        search.ball,
        steps=search.steps,
        optimiser=made,
        **more,
    )


@pytest.mark.parametrize("name", NAMES)
def test_a_restart_draws_anew_and_a_radius_of_zero_moves_nothing(name: str) -> None:
    twice = run(name, settings(), starts=[REFERENCE, REFERENCE])
    runs = [
        [line.loss for line in twice.trace if line.restart == number]
        for number in range(2)
    ]
    assert (runs[0] != runs[1]) == (not optimiser_spec(name).gradient)
    still = run(name, settings(radius={"sh": 0.0, "means": 0.0}))
    assert all(torch.equal(still.parameters[key], REFERENCE[key]) for key in REFERENCE)


@pytest.mark.parametrize("name", NAMES)
def test_every_attack_gains_in_each_norm(name: str) -> None:
    for norm in NORM_NAMES:
        outcome = run(name, settings(norm))
        assert outcome.best.loss < outcome.trace[0].loss


@pytest.mark.parametrize(
    "name", [name for name in NAMES if OPTIMISERS[name].gradient and name != "fgsm"]
)
def test_with_gradients_the_corner_of_the_ball_is_reached(name: str) -> None:
    search = settings(steps=60)
    nearest = bowl(search.project(GOALS)).loss
    outcome = run(name, search)
    assert outcome.best.loss == pytest.approx(
        nearest, abs=0.1 * (outcome.trace[0].loss - nearest)
    )


class Watching(ColourDetector):
    """Keeps whether the images of a search were differentiated."""

    def __init__(self) -> None:
        super().__init__()
        self.differentiated: list[bool] = []

    def candidates(self, images: Tensor) -> list[Candidates]:
        self.differentiated.append(images.requires_grad)
        return super().candidates(images)


def attacked(name: str, detector: ColourDetector | None = None, **more: Any) -> Result:
    scene, mask = toy_scene()
    config = DaggerConfig(
        **{
            "optimiser": name,
            "eps": (10.0,),
            "steps": 10,
            "noise_draws": 0,
            "seed": 1,
            **more,
        }
    )
    detector = detector or ColourDetector()
    return attack(
        scene,
        mask,
        [camera()],
        detector,
        relabel("person"),
        render=blobs,
        config=config,
    )


@pytest.mark.parametrize("name", NAMES)
def test_every_attack_on_a_splat_is_judged_alike(name: str) -> None:
    """By the saved file, from the same start, with the same trace; and without
    gradients where nobody wants them.
    """
    detector = Watching()
    result = attacked(name, detector)
    pgd_s = attacked("pgd")
    assert result.used["sh"] <= 10.0
    assert (result.trace[0].loss, result.trace[0].score) == (
        pgd_s.trace[0].loss,
        pgd_s.trace[0].score,
    )
    assert result.best == max(
        result.trace, key=lambda line: rank(line, smallest=name == "cw")
    )
    assert result.score == pytest.approx(result.best.score, abs=0.05)
    assert any(detector.differentiated) == optimiser_spec(name).gradient


def test_apgd_asks_at_the_shares_of_the_paper() -> None:
    assert checkpoints(100) == [22, 41, 57, 70, 80, 87, 93, 99]
    assert checkpoints(1) == []
    assert all(0 < number < 10 for number in checkpoints(10))


def points(
    search: SearchSettings, losses: Iterator[float]
) -> Iterator[tuple[Parameters, Memory]]:
    """Points and memories of APGD under losses that a test chooses; the gradient is
    that of the bowl.
    """
    update = apgd(search)
    memory = Memory()
    point = REFERENCE
    for memory.index, loss in enumerate(losses):
        yield point, copy.deepcopy(memory)
        moved = update(point, dataclasses.replace(bowl(point), loss=loss), memory)
        assert moved is not None
        point = search.project(moved)


def test_apgd_halves_its_step_and_resumes_from_the_best_point() -> None:
    search = settings(steps=20, momentum=0.25)
    first, *_ = checkpoints(20)
    # the best is the point after one step
    rising = [5.0, 1.0, *(2.0 + number for number in range(first))]
    walk = list(points(search, iter(rising)))
    (_, best), (_, before), (_, after) = walk[2], walk[first], walk[first + 1]
    assert (before.numbers["length"], after.numbers["length"]) == (2.0, 1.0)
    for name, value in after.tensors["best"].items():
        assert torch.equal(value, best.tensors["best"][name])
        assert torch.equal(value, walk[1][0][name])
        assert torch.equal(value, after.tensors["last"][name]), (
            "from which the next move is counted"
        )
    falling = list(points(search, iter([9.0 - number for number in range(first + 2)])))
    assert falling[-1][1].numbers["length"] == 2.0


def test_a_square_is_a_block_of_neighbours_that_move_alike() -> None:
    search = settings(steps=1000, seed=5)
    update = square(search)
    moved = update(REFERENCE, bowl(REFERENCE), Memory(index=500))
    assert moved is not None
    (row,) = (moved["sh"] != REFERENCE["sh"]).any(1).nonzero()[:, 0].tolist()
    change = moved["sh"][row] - REFERENCE["sh"][row]
    torch.testing.assert_close(change.abs(), torch.full((3,), 0.5))
    moved = update(REFERENCE, bowl(REFERENCE), Memory())
    assert moved is not None
    rows = (moved["sh"] != REFERENCE["sh"]).any(1).nonzero()[:, 0]
    assert len(rows) == round(0.8 * 8)
    assert int(rows.max() - rows.min()) == len(rows) - 1, "neighbours in a row"
    changes = (moved["sh"] - REFERENCE["sh"])[rows]
    torch.testing.assert_close(changes, changes[:1].expand_as(changes))


def test_the_price_of_the_change_finds_a_smaller_one_that_succeeds() -> None:
    search = settings("l2", radius={"sh": 4.0, "means": 4.0}, steps=80)
    enough = 0.5 * bowl(REFERENCE).loss
    cheap = run("cw", search, enough=enough)
    plain = run("adam", search, enough=enough)
    assert cheap.best.success
    assert plain.best.success
    assert cheap.best.share < 0.8 * plain.best.share
    assert cheap.best.share == min(line.share for line in cheap.trace if line.success)
