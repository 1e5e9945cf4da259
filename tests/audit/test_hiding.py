"""The recipe of an attacker who knows the audit."""

from typing import Literal

import pytest
import torch

from mi_splat.rendering import Renderer
from scenes.recipes.audit_hiding import Hiding, Victim, hide
from tests.audit.scenes import direction, standing


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
