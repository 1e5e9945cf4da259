"""What the other directions predict: a splat that hides its object from a cone of
directions contradicts itself there, and an honest one does not.
"""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from attacks import cli
from attacks.audits import recognition
from mi_splat.audit import Audit, HeldOutConfig, audit
from mi_splat.audit.files import document
from mi_splat.audit.held_out import cones_around
from mi_splat.audit.objects import frame_of, targets
from mi_splat.cameras.camera import Camera, look_at, project_points
from mi_splat.cameras.lens import Lens
from mi_splat.errors import InvalidValueError
from mi_splat.io import load_splat, save_splat
from mi_splat.maths.rotation import to_matrix
from mi_splat.scene import Similarity, merge
from tests.audit import scenes
from tests.audit.recogniser import Painted, judged, painted
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


@pytest.fixture(scope="module")
def clean() -> Made:
    return painted("suitcase", count=1200)


@pytest.fixture(scope="module")
def above(clean: Made) -> Made:
    """Without its object from above."""
    return hidden(clean, cone(direction(90, 0), 50), colour=ROAD)


def off(found: Audit, wanted: Tensor) -> float:
    """Degrees between the clearest contradiction and a direction."""
    axis = torch.tensor(found.contradicted[0].region.axis)
    return math.degrees(math.acos(float((axis @ wanted.float()).clamp(-1, 1))))


def test_a_hidden_object_contradicts_the_other_directions(above: Made) -> None:
    found = judged(above.scene)
    assert found.answer == "contradicted"
    assert [item.known_as for item in found.objects] == ["orange"]
    assert off(found, direction(90, 0)) < 40
    worst = found.contradicted[0]
    assert worst.evidence == found.evidence >= 1
    # the prediction shows what the file hides
    difference = worst.prediction - worst.file
    assert float(difference[..., 0].amax()) > 0.2


def test_layers_rank_high_though_half_of_the_views_show_them(clean: Made) -> None:
    found = judged(layered(clean).scene)
    assert found.evidence > 0.9
    assert judged(clean.scene).evidence < 0.1


@pytest.mark.parametrize("kind", ["plain", "glossy"])
def test_an_honest_splat_does_not(kind: str, clean: Made) -> None:
    made = glossy(clean) if kind == "glossy" else clean
    found = judged(made.scene)
    assert found.answer != "contradicted"
    assert not found.contradicted
    assert len(found.views) == 11


def test_nothing_is_contradicted_where_the_detector_knows_nothing(above: Made) -> None:
    config = HeldOutConfig(cameras=30, size=64, weighed=48, known=1.1)
    found = audit(above.scene, Painted(), config=config)
    assert found.answer != "contradicted"
    assert [item.known_as for item in found.objects] == [None]
    assert "no object" in found.summary()[0]


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
    found = audit(clean.scene, Painted(), config=config)
    assert not found.views
    assert found.summary()[0].startswith("not compared")


@pytest.mark.parametrize("on_ground", [True, False])
def test_cones_leave_no_direction_above_the_ground_out(on_ground: bool) -> None:
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    cones = cones_around(up if on_ground else None)
    heights = torch.linspace(5 if on_ground else -90, 90, 18)
    ways = [
        direction(float(height), float(turn))
        for height in heights
        for turn in range(0, 360, 15)
    ]
    inside = torch.stack([one.holds(torch.stack(ways).double()) for one in cones])
    assert bool(inside.any(0).all())


def test_the_account_has_numbers_and_sentences(above: Made) -> None:
    found = judged(above.scene)
    account = document(found)
    json.dumps(account)
    assert account["verdict"] == "contradicted"
    contradictions = [line for line in account["summary"] if "contradicted" in line]
    assert len(contradictions) == len(found.contradicted)
    assert "from above" in account["summary"][0]
    (item,) = account["objects"]
    assert {cone["answer"] for cone in item["cones"]} >= {"contradicted"}
    assert {camera["contradicted"] for camera in item["seen_from"]} == {True, False}


def test_the_gaussians_that_carry_a_contradiction_are_those_of_the_object(
    above: Made, clean: Made
) -> None:
    found = judged(above.scene)
    ours = found.heat[above.rows]
    others = found.heat[~above.rows]
    assert float(ours.median()) > 4 * float(others.median())
    both = int((found.mask & above.rows).sum())
    assert float(found.heat[found.mask].sum()) > 0.8 * float(found.heat.sum())
    assert both > 0.9 * int(found.mask.sum())
    assert not bool(judged(clean.scene).mask.any())


def test_the_command_writes_what_it_found(
    above: Made,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(recognition, "Recognition", Painted)
    path = tmp_path / "s.ply"
    save_splat(above.scene, path)
    out = tmp_path / "audit"
    words = ["audit", str(path), "--up", "z", "--out", str(out)]
    assert cli.main(words) == 3
    text = capsys.readouterr().out
    assert "s.ply: contradicted: within" in text
    assert "from above" in text
    assert "up is z" in text
    record = json.loads((out / "result.json").read_text())
    assert record["story"] == "audit"
    assert record["verdict"] == "contradicted"
    assert record["up"] == [0, 0, 1]
    assert record["objects"][0]["up"] == pytest.approx([0, 0, 1], abs=1e-6)
    with Image.open(out / "contradicted.png") as image:
        assert image.size == (3 * 384 + 2 * 8, 384)
    mask = np.load(out / "mask.npy")
    assert len(load_splat(out / "heat.ply")) == len(mask) == len(above.scene)
    words = ["select", str(path), "--mask", str(out / "mask.npy"), "--size", "32"]
    assert cli.main([*words, "--json"]) == 0
    selected = json.loads(capsys.readouterr().out)
    assert selected["gaussians"] == int(mask.sum()) == record["carrying"] > 0
    save_splat(above.scene.replace(opacities=0.02 * above.scene.opacities), path)
    assert cli.main(["audit", str(path)]) == 1
    assert "expected Gaussians with an opacity above 0.1" in capsys.readouterr().err


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
    found = judged(above.scene, cameras=cameras)
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
    more = judged(above.scene, cameras=cameras + high)
    assert more.answer == "contradicted"
    with pytest.raises(InvalidValueError, match="cameras: expected at least 12, got 3"):
        judged(above.scene, cameras=cameras[:3])
    away = [
        replace(camera, to_world=look_at(eye, tuple(2 * value for value in eye)))
        for camera in cameras
        for eye in [camera.position.tolist()]
    ]
    nothing = judged(above.scene, cameras=away)
    assert not nothing.views
    assert nothing.near == 0
    assert document(nothing)["verdict"] is None


@pytest.mark.parametrize("make", [scenes.noisy, scenes.metal, scenes.velvet])
def test_honest_materials_do_not_contradict(make: Callable[[Made], Made]) -> None:
    made = make(standing("suitcase", count=1200))
    assert judged(made.scene).answer != "contradicted"


def test_a_thin_sign_is_an_object_and_not_the_ground_of_its_pole() -> None:
    frame = frame_of(standing("stop sign", count=1500).scene)
    objects = targets(frame.scene)
    assert len(objects[0].rows) > 1000
    for item in objects:
        assert item.up is not None
        assert frame.direction(item.up).tolist() == pytest.approx([0, 0, 1], abs=0.02)
    for item in targets(frame.scene, frame.own((0.0, -3.0, 0.0))):
        assert item.up is not None
        assert frame.direction(item.up).tolist() == pytest.approx([0, -1, 0], abs=1e-6)


def rough(made: Made) -> Made:
    """With a ground that trembles, as a training leaves it."""
    generator = torch.Generator().manual_seed(1)
    scene = made.scene
    means = scene.means.clone()
    count = int((~made.rows).sum())
    means[~made.rows, 2] += 0.06 * torch.randn(count, generator=generator)
    return replace(made, scene=scene.replace(means=means))


@pytest.mark.parametrize("name", ["suitcase", "person", "fire hydrant"])
def test_a_rough_ground_is_no_object(name: str) -> None:
    made = rough(standing(name, count=1200))
    frame = frame_of(made.scene)
    (found,) = targets(frame.scene)
    assert found.up is not None
    assert frame.direction(found.up).tolist() == pytest.approx([0, 0, 1], abs=0.02)
    own = made.rows[frame.order[found.rows]]
    assert float(own.double().mean()) > 0.9
    # the feet are within what the ground is known to
    assert int(own.sum()) > 0.7 * int(made.rows.sum())


def test_a_roof_far_above_is_no_floor() -> None:
    made = standing("car", count=1200)
    roof = scenes.ground(3.0, 4000)
    lifted = roof.replace(means=roof.means + torch.tensor([0.0, 0.0, 8.0]))
    frame = frame_of(merge(made.scene, lifted))
    ups = [found.up for found in targets(frame.scene)]
    assert ups
    for up in ups:
        assert up is not None
        assert frame.direction(up).tolist() == pytest.approx([0, 0, 1], abs=0.02)


def test_the_compared_images_show_the_object_large() -> None:
    made = standing("person", count=1200)
    above = max(judged(made.scene).views, key=lambda view: view.region.axis[2])
    for camera in above.cameras:
        pixels, _ = project_points(made.scene.means[made.rows], camera)
        low, high = pixels.quantile(torch.tensor([0.1, 0.9]), 0)
        side = camera.width
        middle = ((low + high) / 2).tolist()
        assert middle == pytest.approx([side / 2] * 2, abs=0.1 * side)
        assert float((high - low).max()) > 0.35 * side


def test_what_cannot_be_judged_gets_no_answer(clean: Made) -> None:
    scene = clean.scene
    clear = scene.replace(opacities=torch.full((len(scene),), 0.01))
    for empty in (clear, scene.select(slice(0, 0))):
        with pytest.raises(
            InvalidValueError, match=r"Gaussians with an opacity above 0\.1, got none"
        ):
            judged(empty)
    with pytest.raises(
        InvalidValueError, match="Gaussians at several places, got all at one"
    ):
        judged(scene.select(slice(0, 1)))


def test_the_answer_does_not_depend_on_axes_units_and_rows(above: Made) -> None:
    scene = above.scene
    values = torch.tensor([0.3, -0.5, 0.7, 0.2], dtype=torch.float64)
    turn = to_matrix(torch.nn.functional.normalize(values, dim=0))
    shift = torch.tensor([30.0, -5.0, 12.0], dtype=torch.float64)
    order = torch.randperm(len(scene), generator=torch.Generator().manual_seed(3))
    similarity = Similarity(rotation=turn, translation=shift, scale=0.05)
    found = judged(scene)
    again = judged(scene.transform(similarity).select(order))
    assert again.answer == found.answer
    assert again.evidence == pytest.approx(found.evidence, rel=0.1)
    same = (again.mask == found.mask[order]).double().mean()
    assert float(same) > 0.95
