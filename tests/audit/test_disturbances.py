"""Sets of images that something harmless disturbs, as they are drawn."""

import random
from pathlib import Path

import pytest
import torch

from scenes.recipes.audit_disturbances import (
    ARC,
    DISTURBANCES,
    MOMENTS,
    PASSING,
    Crowded,
    disturbed,
    exposed,
    setups,
)
from scenes.recipes.audit_images import HONEST, read, table
from tests.project.documented_commands import ROOT

COUNT = 60


@pytest.mark.parametrize("number", range(2 * len(DISTURBANCES)))
def test_four_honest_sets_are_followed_by_four_attackers(
    number: int, tmp_path: Path
) -> None:
    one, how = disturbed(number, tmp_path)
    assert how == DISTURBANCES[number % len(DISTURBANCES)]
    assert (one.kind == HONEST) == (number < len(DISTURBANCES))
    assert (one.setup.attacks == ()) == (one.kind == HONEST)


def test_the_sun_moves_by_an_arc(tmp_path: Path) -> None:
    one, _ = disturbed(2, tmp_path)
    scenes = setups(one, "moving sun", COUNT, random.Random(0))
    azimuths = [setup.scene.sun_azimuth for setup in scenes]
    assert len(set(azimuths)) == MOMENTS
    arc = (azimuths[-1] - one.setup.scene.sun_azimuth) % 360
    assert azimuths[0] == pytest.approx(one.setup.scene.sun_azimuth % 360)
    assert ARC[0] <= arc <= ARC[1]


def test_passers_by_stand_beside_the_object(tmp_path: Path) -> None:
    one, _ = disturbed(3, tmp_path)
    scenes = setups(one, "passers-by", COUNT, random.Random(0))
    crowded = [setup for setup in scenes if isinstance(setup, Crowded)]
    assert 0.5 * PASSING < len(crowded) / COUNT < 1.5 * PASSING
    plain = len(one.setup.mesh_scene.surroundings.meshes)
    places = set()
    for setup in crowded:
        added = len(setup.passer.meshes)
        assert len(setup.mesh_scene.surroundings.meshes) == plain + added
        low, high = setup.passer.bounds.astype(float)
        assert low[2] == pytest.approx(0.0, abs=0.02 * (high[2] - low[2]))
        places.add(tuple(((low + high) / 2).tolist()))
    assert len(places) == len(crowded)


def test_exposure_changes_within_an_image() -> None:
    image = torch.full((9, 9, 3), 0.5)
    rolled = exposed(image, "rolling", 0.2)
    assert rolled[0, 0, 0] == pytest.approx(0.4)
    assert rolled[-1, 0, 0] == pytest.approx(0.6)
    assert torch.equal(rolled[:, 0], rolled[:, -1])
    darkened = exposed(image, "vignette", 0.4)
    assert darkened[4, 4, 0] == pytest.approx(0.5)
    assert darkened[0, -1, 0] == pytest.approx(0.3)


def test_the_page_has_the_table_of_disturbed_sets() -> None:
    rows = read(ROOT / "docs" / "tables" / "audit_images_disturbed.csv")
    assert "\n".join(table(rows)) in (ROOT / "docs" / "audit.md").read_text()
