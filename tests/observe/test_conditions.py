"""The conditions under which splats are judged."""

from __future__ import annotations

import pytest
import torch

from attacks.observe.conditions import (
    SunTable,
    changed,
    distances,
    fewer_bands,
    file_forms,
    half_precision,
    picture_change,
    rendered,
    street_hours,
    through_file,
)
from attacks.observe.look import look, report_cells
from attacks.observe.views import object_boxes
from mi_splat.cameras import Camera, look_at
from mi_splat.comparison.methods import load_method
from mi_splat.errors import InvalidValueError
from mi_splat.mixed_scenes import MixedScene
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene import GaussianScene
from mi_splat.scene_files import read_scene
from tests.fakes import ColourDetector, blobs, camera, toy_scene
from tests.gaussians import random_scene
from tests.project.layers import ROOT

STREET = "scenes/mixed/car_among_meshes.xml"
SETTINGS = RenderSettings()


def view_of(scene: GaussianScene, name: str) -> torch.Tensor:
    pose = look_at((0.0, -4.0, 0.5), (0.0, 0.0, 0.0))
    seen = Camera(to_world=pose, focal=26.0, width=24, height=24, principal=(12.0, 12.0))
    return load_method(name, SETTINGS).render(scene, seen)


def test_each_variant_changes_what_it_is_called_by() -> None:
    scene = random_scene(60, seed=1)
    plain = view_of(scene, "tile")
    assert not torch.allclose(view_of(scene, "tile-near-3"), plain, atol=1e-3)
    far = scene.replace(means=scene.means + torch.tensor([0.0, 40.0, 0.0]))
    torch.testing.assert_close(view_of(far, "tile-near-3"), view_of(far, "tile"))
    tame = scene.replace(sh=0.05 * torch.tanh(scene.sh))  # all colours within (0, 1): nothing is cut anywhere
    loud = scene.replace(sh=20 * scene.sh)
    for name in ("tile-colours-in-0-1", "tile-colours-not-cut"):
        assert not torch.allclose(view_of(loud, name), view_of(loud, "tile"), atol=1e-2)
        torch.testing.assert_close(view_of(tame, name), view_of(tame, "tile"), rtol=0, atol=1e-5)
    with pytest.raises(InvalidValueError, match="tile-near-3"):
        load_method("unreal", SETTINGS)


def test_files_and_bands() -> None:
    scene = random_scene(40, seed=2)
    assert torch.equal(through_file(scene, ".ply").sh, scene.sh)
    assert not torch.equal(through_file(scene, ".splat").sh[:, :1], scene.sh[:, :1])
    half = half_precision(scene).sh
    assert not torch.equal(half, scene.sh)
    torch.testing.assert_close(half, scene.sh, rtol=1e-3, atol=1e-6)
    assert fewer_bands(scene, 0).degree == 0
    assert fewer_bands(scene, 3).degree == scene.degree
    with pytest.raises(InvalidValueError, match=r"\.splat"):
        through_file(scene, ".obj")


def test_the_car_stands_in_the_street_by_the_hour() -> None:
    loaded = read_scene(ROOT / "scenes" / "car_street.xml")
    rows = loaded.objects["car"]
    hours = street_hours(
        SunTable(scene=STREET, hours=(8.0, 16.0), samples=1), lambda scene: scene.select(rows), parameter="car"
    )
    assert [condition.name for condition in hours] == ["08:00", "16:00"]
    for condition in hours:
        inside, render = condition.show(loaded.scene.with_degree(3))  # the scene's file has degree 1
        assert isinstance(render, MixedScene)
        assert inside.sh.shape == (len(render.splats.scene), 16, 3)
        assert torch.equal(inside.means, render.splats.scene.means)


def test_stored_splats_are_rendered_as_the_scene_is() -> None:
    scene, _ = toy_scene()
    (condition,) = file_forms(Renderer(SETTINGS), files=(".ply",))
    saved, render = condition.show(scene)
    torch.testing.assert_close(render(saved, camera()), Renderer(SETTINGS)(scene, camera()))


def test_a_picture_can_have_noise_blur_and_jpeg_in_it() -> None:
    scene, _ = toy_scene()
    plain, pictures = blobs(scene, camera()), {}
    for name in ("noise 0.05", "blur 1.5", "JPEG 20"):
        change = picture_change(name)
        assert change is not None
        pictures[name] = changed(name, blobs, change)
        assert not torch.equal(pictures[name](scene, camera()), plain)
    noisy = pictures["noise 0.05"]
    assert torch.equal(noisy(scene, camera()), noisy(scene, camera()))
    other = camera(offset=0.1)
    grain = noisy(scene, camera()) - plain
    assert not torch.allclose(noisy(scene, other) - blobs(scene, other), grain, atol=1e-3)
    assert [picture_change(name) for name in ("tile", "noise", "JPEG 0", "JPEG 101", "blur -1")] == [None] * 5


def test_cameras_move_along_the_line_to_the_centre() -> None:
    near, far = distances(blobs, (0.5, 2.0), (0.0, 0.0, 0.0))
    assert (near.name, far.name) == ("0.5 x distance", "2 x distance")
    assert torch.allclose(near.move(camera()).position, 0.5 * camera().position)
    scene, _ = toy_scene()
    assert torch.equal(far(scene, camera()), blobs(scene, far.move(camera())))


def test_every_detector_looks_at_every_splat_under_every_condition() -> None:
    scene, mask = toy_scene()
    cameras = [camera(), camera(offset=0.2)]
    boxes = dict(zip(cameras, object_boxes(scene, mask, cameras, render=blobs), strict=True))
    dark = rendered("dark", lambda scene, camera: 0.05 * blobs(scene, camera))
    seen = look(
        [rendered("plain", blobs), dark],
        {"clean": scene, "attacked": scene.replace(sh=-scene.sh)},
        cameras,
        [ColourDetector()],
        boxes=boxes.__getitem__,
        cells=lambda view: report_cells(view.detections, view.box, original="car"),
    )
    assert seen.rows.select("condition", "splat", "view").rows() == [
        (condition, splat, view)
        for condition in ("plain", "dark")
        for splat in ("clean", "attacked")
        for view in (0, 1)
    ]
    assert (seen.rows.filter(condition="plain", splat="clean")["original_score"] > 0.5).all()
    assert (seen.rows.filter(condition="dark")["score"] == 0).all()
    best = seen.detections.filter(condition="plain", splat="clean", view=0).sort("score", descending=True)
    assert best["score"][0] == seen.rows["score"][0]
