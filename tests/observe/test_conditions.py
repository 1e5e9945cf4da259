"""The conditions under which splats are judged."""

import math
from typing import Any

import pytest
import torch

from attacks.observe.conditions import (
    Condition,
    SunTable,
    Viewing,
    condition_of,
    fewer_bands,
    half_precision,
    image_transformation,
    rendered,
    through_file,
)
from attacks.observe.observations import observe, report_cells
from attacks.observe.views import object_boxes
from mi_splat.cameras.camera import Camera, look_at
from mi_splat.cameras.lens import Lens
from mi_splat.cameras.sets import orbit
from mi_splat.comparison.methods import load_method
from mi_splat.errors import InvalidValueError
from mi_splat.maths.sh import colour_to_dc
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.render.scene_files import MixedScene, read_scene
from mi_splat.scene import GaussianScene
from tests.fakes import ColourDetector, blobs, camera, toy_scene
from tests.gaussians import random_scene
from tests.project.layers import ROOT

pytestmark = pytest.mark.shipped

STREET = "scenes/mixed/car_among_meshes.xml"
SETTINGS = RenderSettings()


def view_of(scene: GaussianScene, name: str) -> torch.Tensor:
    pose = look_at((0.0, -4.0, 0.5), (0.0, 0.0, 0.0))
    seen = Camera(
        to_world=pose, lens=Lens(focal=26.0, size=(24, 24), principal=(12.0, 12.0))
    )
    return load_method(name, SETTINGS).render(scene, seen)


def test_each_variant_changes_what_it_is_called_by() -> None:
    scene = random_scene(60, seed=1)
    plain = view_of(scene, "tile")
    assert not torch.allclose(view_of(scene, "tile-near-3"), plain, atol=1e-3)
    far = scene.replace(means=scene.means + torch.tensor([0.0, 40.0, 0.0]))
    torch.testing.assert_close(view_of(far, "tile-near-3"), view_of(far, "tile"))
    # all colours within (0, 1): nothing is cut anywhere
    tame = scene.replace(sh=0.05 * torch.tanh(scene.sh))
    loud = scene.replace(sh=20 * scene.sh)
    for name in ("tile-colours-in-0-1", "tile-colours-not-cut"):
        assert not torch.allclose(view_of(loud, name), view_of(loud, "tile"), atol=1e-2)
        torch.testing.assert_close(
            view_of(tame, name), view_of(tame, "tile"), rtol=0, atol=1e-5
        )
    with pytest.raises(InvalidValueError, match="tile-near-3"):
        load_method("unreal", SETTINGS)


def test_files_and_bands() -> None:
    scene = random_scene(40, seed=2)
    assert torch.equal(named(".ply").show(scene)[0].sh, scene.sh)
    assert not torch.equal(through_file(scene, ".splat").sh[:, :1], scene.sh[:, :1])
    half = half_precision(scene).sh
    assert not torch.equal(half, scene.sh)
    torch.testing.assert_close(half, scene.sh, rtol=1e-3, atol=1e-6)
    assert [fewer_bands(scene, degree).degree for degree in (0, 3)] == [0, scene.degree]


def named(name: str, settings: RenderSettings = SETTINGS) -> Condition:
    return condition_of(
        name,
        Viewing(settings=settings, centre=(0.0, 0.0, 0.0), alone=lambda scene: scene),
    )


def test_the_car_stands_in_the_street_by_the_hour() -> None:
    loaded = read_scene(ROOT / "scenes" / "car_street.xml")
    rows = loaded.objects["car"]
    sun = SunTable(scene=STREET, samples=1, parameter="car", north=4.0)
    viewing = Viewing(
        settings=SETTINGS,
        centre=(0.0, 0.0, 0.0),
        alone=lambda scene: scene.select(rows),
        sun=sun,
    )
    for name in ("08:00", "16:00"):
        condition = condition_of(name, viewing)
        assert condition.name == name
        # the scene's file has degree 1
        inside, render = condition.show(loaded.scene.with_degree(3))
        assert isinstance(render, MixedScene)
        assert inside.sh.shape == (len(render.splats.scene), 16, 3)
        assert torch.equal(inside.means, render.splats.scene.means)
        held = [
            condition.holds(
                Camera(
                    to_world=look_at((0.0, y, 1.0), (0.0, 0.0, 0.0)),
                    lens=Lens(focal=9.0, size=(8, 8)),
                )
            )
            for y in (-5.0, 5.0)
        ]
        assert held == [True, False]


def test_a_picture_can_have_noise_blur_and_jpeg_in_it() -> None:
    scene, _ = toy_scene()
    plain = Renderer(SETTINGS)
    pictures = {name: named(name) for name in ("noise 0.05", "blur 1.5", "JPEG 20")}
    for condition in pictures.values():
        assert not torch.equal(condition(scene, camera()), plain(scene, camera()))
    noisy = pictures["noise 0.05"]
    assert torch.equal(noisy(scene, camera()), noisy(scene, camera()))
    other = camera(offset=0.1)
    grain = noisy(scene, camera()) - plain(scene, camera())
    assert not torch.allclose(
        noisy(scene, other) - plain(scene, other), grain, atol=1e-3
    )
    assert [
        image_transformation(name)
        for name in ("tile", "noise", "JPEG 0", "JPEG 101", "blur -1")
    ] == [None] * 5


def test_cameras_move_along_the_line_to_the_centre() -> None:
    near = named("0.5 x distance")
    far = named("2 x distance")
    assert torch.allclose(near.move(camera()).position, 0.5 * camera().position)
    scene, _ = toy_scene()
    assert torch.equal(
        far(scene, camera()), Renderer(SETTINGS)(scene, far.move(camera()))
    )


def test_cameras_turn_about_the_centre_and_images_get_other_sizes() -> None:
    turned = named("10 degrees").move(camera())
    before = camera().position
    assert float(turned.position.norm()) == pytest.approx(float(before.norm()))
    cosine = float(turned.position @ before / before.norm() ** 2)
    assert math.degrees(math.acos(cosine)) == pytest.approx(10.0)
    # to the right, as the image shows it
    assert float((turned.position - before) @ camera().to_world[:3, 0].double()) > 0
    small = named("0.5 x size").move(camera())
    assert (small.width, small.height) == (camera().width // 2, camera().height // 2)
    assert small.fx == pytest.approx(camera().fx / 2)


def test_an_image_of_few_bits_has_few_values() -> None:
    scene, _ = toy_scene()
    image = named("2 bits")(scene, camera())
    assert {round(3 * value) for value in image.flatten().tolist()} <= {0, 1, 2, 3}
    assert torch.allclose(image * 3, (image * 3).round(), atol=1e-6)


def gaussian(**values: torch.Tensor) -> GaussianScene:
    turn = torch.tensor([[1.0, 0.0, 0.0, 0.0]])
    return GaussianScene(
        torch.zeros(1, 3),
        torch.ones(1, 3),
        turn,
        torch.tensor([0.5]),
        torch.zeros(1, 1, 3),
    ).replace(**values)


def test_renderers_stand_before_the_same_background() -> None:
    settings = RenderSettings(background=(0.2, 0.5, 0.9), near=0.05)
    pose = look_at((3.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    scene = gaussian(scales=torch.full((1, 3), 0.2))
    front = Camera(to_world=pose, lens=Lens(focal=24.0, size=(24, 24)))
    names = ("tile", "tile-antialiased", "ray", "ray-to-mean", "volprim")
    pictures = [named(name, settings)(scene, front) for name in names]
    assert all(
        float((picture - pictures[0]).square().mean()) < 1e-3 for picture in pictures
    )
    assert all(
        torch.allclose(picture[0, 0], torch.tensor([0.2, 0.5, 0.9]), atol=0.02)
        for picture in pictures
    )


def test_renderers_that_cut_colours_elsewhere() -> None:
    """Of a half opaque Gaussian whose colour is (2, 0.5, -1), in its middle and before
    a background of 0.4.
    """
    colour = torch.tensor([2.0, 0.5, -1.0])
    settings = RenderSettings(background=(0.4, 0.4, 0.4))
    scene = gaussian(sh=colour_to_dc(colour).reshape(1, 1, 3))
    (front,) = orbit(
        (0.0, 0.0, 0.0),
        count=1,
        elevation=10.0,
        distance=5.0,
        lens=Lens(focal=60.0, size=(33, 33)),
    )
    cuts = {
        "tile": colour.clamp(min=0),
        "tile-colours-in-0-1": colour.clamp(0, 1),
        "tile-colours-not-cut": colour,
    }
    for name, shown in cuts.items():
        assert torch.allclose(
            named(name, settings)(scene, front)[16, 16], 0.5 * shown + 0.2, atol=2e-3
        )


def test_every_detector_looks_at_every_splat_under_every_condition() -> None:
    scene, mask = toy_scene()
    cameras = [camera(), camera(offset=0.2)]
    boxes = dict(
        zip(cameras, object_boxes(scene, mask, cameras, render=blobs), strict=True)
    )
    dark = rendered("dark", lambda scene, camera: 0.05 * blobs(scene, camera))
    splats = {"clean": scene, "attacked": scene.replace(sh=-scene.sh)}
    where: dict[str, Any] = {
        "boxes": boxes.__getitem__,
        "cells": lambda view: report_cells(view.detections, view.box, original="car"),
    }
    plain, black = (
        observe(condition, splats, cameras, [ColourDetector()], **where)
        for condition in (rendered("plain", blobs), dark)
    )
    assert plain.rows.select("condition", "splat", "view").rows() == [
        ("plain", splat, view) for splat in ("clean", "attacked") for view in (0, 1)
    ]
    assert (plain.rows.filter(splat="clean")["original_score"] > 0.5).all()
    assert (black.rows.filter(splat="clean")["score"] == 0).all()
    best = plain.detections.filter(splat="clean", view=0).sort("score", descending=True)
    assert best["score"][0] == plain.rows["score"][0]
