"""Other ways to find a hidden look: each ranks what it is made for above what it is not."""

from typing import Literal

import pytest
import torch
from torch import Tensor

from attacks.audits.audited import BASELINES, attributes, fit_attributes, measured
from attacks.audits.disagreement import AROUND, OVER, Seen, seen_along_paths
from attacks.detectors.base import Detections
from mi_splat.audit.thresholds import LIMITS
from mi_splat.rendering import Renderer
from mi_splat.scene import GaussianScene, merge
from scenes.recipes.audit_hiding import Hiding, Victim, hide
from tests.audit.scenes import Made, cone, direction, glossy, hidden, standing
from tests.fakes import ColourDetector


@pytest.fixture(scope="module")
def plain() -> Made:
    return standing("suitcase", count=500)


def looks(made: Made) -> Made:
    return hidden(made, cone(direction(90, 0), 50))


def test_a_look_ranges_over_more_colours_and_needs_higher_bands(plain: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(vars(LIMITS), "image_size", 72)
    monkeypatch.setitem(vars(LIMITS), "cameras", 40)
    timed = measured(looks(plain).scene)
    clean, hiding = ({name: score for name, (score, _) in part.items()} for part in (measured(plain.scene), timed))
    assert set(clean) == set(hiding) == set(BASELINES)
    assert timed["colour range"][1] > timed["band 1"][1] >= 0
    assert hiding["colour range"] > 1.5 * clean["colour range"]
    assert all(hiding[name] > clean[name] == 0 for name in ("band 1", "band 2", "band 3"))
    assert hiding["contributions"] == pytest.approx(clean["contributions"], abs=0.01)


def test_what_few_cameras_see_beside_what_many_do_is_a_cluster(plain: Made) -> None:
    score = BASELINES["contributions"]
    part = plain.scene.select(plain.rows)
    inner = part.replace(means=part.means * 0.97, opacities=0.3 * part.opacities)
    assert score(merge(plain.scene, inner)) > score(plain.scene)


def test_a_classifier_finds_the_kind_of_attack_that_it_was_trained_on() -> None:
    def kinds(name: str) -> list[GaussianScene]:
        made = standing(name, count=300)
        return [made.scene, glossy(made).scene, looks(made).scene]

    known = torch.stack([attributes(scene) for scene in (*kinds("suitcase"), *kinds("bird"))])
    trained = fit_attributes(known, [False, False, True] * 2)
    plain, shiny, look = trained(torch.stack([attributes(scene) for scene in kinds("tv")])).tolist()
    assert look > max(plain, shiny)
    assert look > 0


# What detectors report along paths of cameras: where a class goes away and comes back


class Reddest(ColourDetector):
    """Reports a car around all that is clearly red."""

    def detect(self, images: Tensor) -> list[Detections]:
        return [self._reddest(image) for image in images]

    def _reddest(self, image: Tensor) -> Detections:
        positions = (image[..., 0] > image[..., 1] + 0.3).nonzero().float()
        if len(positions) < 50:
            return Detections(torch.zeros(0, 4), torch.zeros(0), ())
        (y0, x0), (y1, x1) = positions.amin(0).tolist(), positions.amax(0).tolist()
        return Detections(torch.tensor([[x0, y0, x1, y1]]), torch.tensor([0.9]), ("car",))


@pytest.fixture(scope="module")
def red() -> Made:
    return standing("suitcase", count=500).with_colours(
        lambda own, normals, views: torch.tensor([0.8, 0.1, 0.1]).expand(len(views), len(own), 3), degree=3
    )


def seen(made: Made) -> dict[str, Seen]:
    return {one.path: one for one in seen_along_paths(made.scene, [Reddest()]) if one.number == 1}


def test_a_class_that_goes_away_and_comes_back_is_seen(red: Made) -> None:
    looks = seen(hidden(red, cone(direction(90, 0), 50)))
    assert looks[OVER].runs == ["car", "nothing", "car"]
    assert looks[OVER].comes_back
    assert looks[AROUND].runs == ["car"]
    honest = seen(red)
    assert {path: one.runs for path, one in honest.items()} == {AROUND: ["car"], OVER: ["car"]}
    assert not any(one.comes_back for one in honest.values())


# The recipe of an attacker who knows the audit


@pytest.mark.parametrize("by", ["coefficients", "layers", "roof"])
def test_the_recipe_hides_from_inside_of_its_trigger(by: Literal["coefficients", "layers", "roof"]) -> None:
    made = standing("suitcase", count=250)
    victim = Victim(scene=made.scene, rows=made.rows, label="suitcase", render=Renderer())
    attacked = hide(victim, Hiding(by=by, half_width=40.0))
    changes = []
    for elevation in (88, 8):
        camera = victim.camera(direction(elevation, 30), size=48)
        with torch.no_grad():
            clean, changed = (victim.render(scene, camera) for scene in (victim.scene, attacked))
        changes.append(float((clean - changed).abs().mean()))
    assert changes[0] > (0.5 if by == "roof" else 2) * changes[1]
