"""An attacker who knows the audit: what each of its settings does to a splat, and what that costs."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from attacks.audits import price
from attacks.audits.hiding import Around, Hiding, Victim, hide, lattice
from attacks.audits.price import TRICKS, Judge, Price, cheapest, search
from mi_splat.errors import InvalidValueError
from mi_splat.rendering import Renderer
from mi_splat.scene import GaussianScene
from mi_splat.sh import sh_to_colour
from tests.audit.scenes import direction, standing
from tests.fakes import ColourDetector


@pytest.fixture(scope="module")
def victim() -> Victim:
    made = standing("suitcase", count=250)
    return Victim(scene=made.scene, rows=made.rows, label="suitcase", render=Renderer())


def picture(victim: Victim, scene: GaussianScene, elevation: float) -> Tensor:
    with torch.no_grad():
        return victim.render(scene, victim.camera(direction(elevation, 30), size=48))


def change(victim: Victim, hiding: Hiding, elevation: float) -> float:
    pair = (picture(victim, scene, elevation) for scene in (victim.scene, hide(victim, hiding)))
    first, second = pair
    return float((first - second).abs().mean())


@pytest.mark.parametrize("by", ["coefficients", "layers", "roof"])
def test_a_look_shows_from_inside_of_its_trigger(victim: Victim, by: str) -> None:
    hiding = Hiding(by=by, half_width=40.0)  # type: ignore[arg-type]
    assert change(victim, hiding, 88) > (0.5 if by == "roof" else 2) * change(victim, hiding, 8)


def test_half_of_a_look_and_of_the_surface_change_less(victim: Victim) -> None:
    whole, half = change(victim, Hiding(), 88), change(victim, Hiding(amount=0.5), 88)
    assert half == pytest.approx(whole / 2, rel=0.15)
    assert 0 < change(victim, Hiding(share=0.3), 88) < whole


def test_what_follows_the_normals_shows_from_all_sides(victim: Victim) -> None:
    assert change(victim, Hiding(follow=1.0), 20) > 3 * change(victim, Hiding(), 20)


def test_gloss_and_sheen_change_colours_outside_of_the_trigger(victim: Victim) -> None:
    least = 2 * change(victim, Hiding(), 20)
    assert change(victim, Hiding(gloss=0.6), 20) > least
    assert change(victim, Hiding(sheen=0.6), 20) > least


def test_all_else_stays_as_it_was(victim: Victim) -> None:
    made = hide(victim, Hiding(gloss=0.5, share=0.5))
    assert torch.equal(made.sh[~victim.rows][:, 0], victim.scene.sh[~victim.rows][:, 0])
    assert torch.equal(made.means, victim.scene.means)
    assert float(sh_to_colour(made.sh, torch.tensor([0.0, 0.0, -1.0]).expand(len(made), 3)).amax()) < 2


def test_a_trigger_that_holds_every_camera_is_refused(victim: Victim) -> None:
    with pytest.raises(InvalidValueError, match="widen the trigger"):
        hide(victim, Hiding(by="layers", half_width=1.0, elevation=0.0))
    with pytest.raises(InvalidValueError, match="half_width"):
        Hiding(half_width=120.0)


def test_depth_is_that_of_a_cone(victim: Victim) -> None:
    around = Around(axis=(0.0, 0.0, 1.0), half_width=50.0)
    camera = victim.camera(direction(60, 10))
    assert around.angle_to_edge(camera, centre=tuple(victim.centre.tolist())) == pytest.approx(20.0, abs=0.1)
    assert float(lattice(50)[:, 2].min()) > 0


def point(excess: float, missed: float) -> Price:
    return Price(
        hiding=Hiding(), verdict="", excess=excess, missed=missed, kept=1.0, fidelity=30.0, reach=0.5, seconds=1.0
    )


def test_the_cheapest_are_those_that_nothing_beats() -> None:
    points = [point(0.01, 1.0), point(0.02, 1.0), point(0.002, 0.4), point(0.005, 0.3), point(0.0, 0.0)]
    assert [(one.excess, one.missed) for one in cheapest(points)] == [(0.0, 0.0), (0.002, 0.4), (0.01, 1.0)]


def test_a_search_tries_the_tricks_and_then_what_is_near_the_cheapest(
    victim: Victim, monkeypatch: pytest.MonkeyPatch
) -> None:
    def priced(_: Judge, hiding: Hiding) -> Price:
        return dataclasses.replace(point(hiding.amount * hiding.half_width, hiding.amount), hiding=hiding)

    monkeypatch.setattr(Judge, "price", priced)
    judge = Judge(victim=victim, detectors=[])
    tried = [one.hiding for one in search(judge, tries=len(TRICKS) + 4)]
    assert tried[: len(TRICKS)] == list(TRICKS.values())
    assert len(set(tried)) == len(tried)
    assert tried == [one.hiding for one in search(judge, tries=len(TRICKS) + 4)]


def test_a_price_counts_cameras_that_find_the_clean_object(victim: Victim, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(price, "VIEWS", 3)
    look = SimpleNamespace(excess=0.25)
    told_by_audit = SimpleNamespace(verdict="suspicious", strongest=SimpleNamespace(look=look))
    monkeypatch.setattr(price, "audit", lambda _: told_by_audit)
    red = victim.scene.replace(sh=torch.where(victim.rows[:, None, None], torch.tensor([1.5, -1.2, -1.2]), 0.0))
    judge = Judge(victim=dataclasses.replace(victim, scene=red, label="car"), detectors=[ColourDetector()])
    told = judge.price(Hiding())
    assert told.row()["amount"] == 1.0
    assert (told.excess, told.verdict) == (0.25, "suspicious")
    assert 0.3 < told.reach < 0.4
    assert told.fidelity > 25
    assert len(judge.clean) == 2
