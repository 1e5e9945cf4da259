"""Other ways to find a hidden look: each ranks what it is made for above what it is not."""

from typing import Literal

import pytest
import torch

from attacks.audits.audited import BASELINES, measured
from mi_splat.audit.thresholds import LIMITS
from mi_splat.rendering import Renderer
from scenes.recipes.audit_hiding import Hiding, Victim, hide
from tests.audit.scenes import Made, cone, direction, hidden, standing


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
