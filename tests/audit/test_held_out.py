"""What the other directions predict: a splat that hides its object from a cone of
directions contradicts itself there, and an honest one does not.
"""

import json
import math
from pathlib import Path

import pytest
import torch
from PIL import Image
from torch import Tensor

from attacks import cli
from attacks.audits import recognition
from mi_splat.audit.held_out import HeldOut, HeldOutConfig, cones_around, held_out
from mi_splat.audit.held_out_files import held_out_document, held_out_lines
from mi_splat.cameras.camera import Camera, look_at
from mi_splat.cameras.lens import Lens
from mi_splat.io import save_splat
from mi_splat.scene import GaussianScene, Similarity
from tests.audit.scenes import (
    ROAD,
    Made,
    cone,
    direction,
    glossy,
    hidden,
    layered,
    standing,
)

CONFIG = HeldOutConfig(cameras=30, size=64, weighed=48)
PAINT = (0.85, 0.45, 0.1)


class Painted:
    """Recognises what is orange, as a detector recognises a shape that it learnt."""

    classes = ("nothing", "orange")
    missing = ""

    def features(self, images: Tensor) -> Tensor:
        """A coarse image, and a constant, so that black has a direction too."""
        coarse = images[:, ::8, ::8].flatten(1)
        return torch.cat([coarse, torch.ones(len(coarse), 1)], 1)

    def scores(self, images: Tensor) -> Tensor:
        """How much of the middle is more red than blue, at most 1."""
        side = images.shape[1]
        edge = side // 4
        middle = images[:, edge : side - edge, edge : side - edge]
        is_orange = middle[..., 0] > middle[..., 2] + 0.3
        share = is_orange.float().mean((1, 2))
        orange = (8 * share).clamp(max=1.0)
        return torch.stack([torch.zeros_like(orange), orange], 1)


@pytest.fixture(scope="module")
def clean() -> Made:
    made = standing("suitcase", count=1200)
    sh = made.scene.sh.clone()
    paint = (torch.tensor(PAINT) - 0.5) / 0.28209479
    sh[made.rows, 0] = paint + 0.1 * sh[made.rows, 0]
    return Made(scene=made.scene.replace(sh=sh), rows=made.rows, normals=made.normals)


@pytest.fixture(scope="module")
def above(clean: Made) -> Made:
    """Without its object from above."""
    return hidden(clean, cone(direction(90, 0), 50), colour=ROAD)


def judged(scene: GaussianScene) -> HeldOut:
    return held_out(scene, Painted(), config=CONFIG)


def off(found: HeldOut, wanted: Tensor) -> float:
    """Degrees between the clearest contradiction and a direction."""
    axis = torch.tensor(found.contradicted[0].region.axis)
    return math.degrees(math.acos(float((axis @ wanted.float()).clamp(-1, 1))))


def test_a_hidden_object_contradicts_the_other_directions(above: Made) -> None:
    found = judged(above.scene)
    assert found.answer == "contradicted"
    assert found.known_as == ("orange",)
    assert off(found, direction(90, 0)) < 40
    worst = found.contradicted[0]
    assert worst.evidence == found.evidence >= 1
    # the prediction shows what the file hides
    difference = worst.prediction - worst.file
    assert float(difference[..., 0].amax()) > 0.2


def test_layers_rank_high_though_half_of_the_views_show_them(clean: Made) -> None:
    found = judged(layered(clean).scene)
    assert found.evidence > 0.9
    # which half is true, held-out directions cannot tell
    assert found.answer != "contradicted"
    assert judged(clean.scene).evidence < 0.1


@pytest.mark.parametrize("kind", ["plain", "glossy"])
def test_an_honest_splat_does_not(kind: str, clean: Made) -> None:
    made = glossy(clean) if kind == "glossy" else clean
    found = judged(made.scene)
    assert found.answer != "contradicted"
    assert not found.contradicted
    assert len(found.views) == 11


def test_the_answer_is_that_of_the_splat_in_any_frame(above: Made) -> None:
    half = math.sqrt(0.5)
    moved = above.scene.transform(
        Similarity(
            scale=3.0,
            rotation=torch.tensor(
                [[1.0, 0.0, 0.0], [0.0, half, -half], [0.0, half, half]]
            ),
            translation=torch.tensor([4.0, -2.0, 7.0]),
        )
    )
    found = judged(moved)
    assert found.answer == "contradicted"
    assert off(found, torch.tensor([0.0, -half, half])) < 40


def test_nothing_is_contradicted_where_the_detector_knows_nothing(above: Made) -> None:
    config = HeldOutConfig(cameras=30, size=64, weighed=48, known=1.1)
    found = held_out(above.scene, Painted(), config=config)
    assert found.answer != "contradicted"
    assert found.known_as == (None,)
    assert "no object" in held_out_lines(found)[0]


def test_a_class_that_few_views_show_contradicts_nothing() -> None:
    values = {"gain": 0.9, "distance": 0.0, "rise": 0.0}
    assert HeldOutConfig().evidence(**values, is_agreed=True) >= 1
    assert HeldOutConfig().evidence(**values, is_agreed=False) < 1
    departs = {"gain": 0.0, "distance": 0.3}
    assert HeldOutConfig().evidence(**departs, rise=0.05, is_agreed=False) >= 1
    # gloss looks unlike the prediction, and no less like the other views
    assert HeldOutConfig().evidence(**departs, rise=-0.05, is_agreed=True) < 1


def test_without_cameras_on_several_sides_nothing_is_compared(clean: Made) -> None:
    config = HeldOutConfig(cameras=30, size=64, weighed=48, least_inside=1000)
    found = held_out(clean.scene, Painted(), config=config)
    assert not found.views
    assert held_out_lines(found)[0].startswith("not compared")


def test_cones_leave_no_direction_above_the_ground_out() -> None:
    cones = cones_around(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    heights = torch.linspace(5, 90, 18)
    ways = [
        direction(float(height), float(turn))
        for height in heights
        for turn in range(0, 360, 15)
    ]
    inside = torch.stack([one.holds(torch.stack(ways).double()) for one in cones])
    assert bool(inside.any(0).all())


def test_the_account_has_numbers_and_sentences(above: Made) -> None:
    found = judged(above.scene)
    account = held_out_document(found)
    json.dumps(account)
    assert account["answer"] == "contradicted"
    assert len(account["summary"]) == len(found.contradicted)
    assert "from above" in account["summary"][0]
    assert {cone["answer"] for cone in account["cones"]} >= {"contradicted"}


def test_the_command_shows_the_contradiction(
    above: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recognition, "Recognition", Painted)
    path = tmp_path / "s.ply"
    save_splat(above.scene, path)
    out = tmp_path / "audit"
    assert cli.main(["audit", str(path), "--out", str(out)]) == 3
    record = json.loads((out / "result.json").read_text())
    assert record["held_out"]["answer"] == "contradicted"
    with Image.open(out / "contradicted.png") as image:
        assert image.size == (3 * 384 + 2 * 8, 384)


def test_only_directions_near_training_cameras_are_compared(above: Made) -> None:
    """Cameras at the side say nothing of the view from above."""
    reach = 3.5 * float(above.scene.means[above.rows].norm(dim=1).max())
    cameras = [
        Camera(
            to_world=look_at((reach * direction(height, turn)).tolist(), (0, 0, 0.1)),
            lens=Lens(focal=100.0, size=(128, 128)),
        )
        for height in (15.0, 30.0)
        for turn in range(0, 360, 12)
    ]
    found = held_out(above.scene, Painted(), cameras=cameras, config=CONFIG)
    assert found.answer != "contradicted"
    assert found.views
    assert all(
        direction(90, 0).float() @ torch.tensor(view.region.axis) < 0.9
        for view in found.views
    )
    # with cameras above as well, the view from there contradicts the others
    high = [
        Camera(
            to_world=look_at((reach * direction(height, turn)).tolist(), (0, 0, 0.1)),
            lens=Lens(focal=100.0, size=(128, 128)),
        )
        for height in (55.0, 70.0, 85.0)
        for turn in range(0, 360, 24)
    ]
    more = held_out(above.scene, Painted(), cameras=cameras + high, config=CONFIG)
    assert more.answer == "contradicted"
