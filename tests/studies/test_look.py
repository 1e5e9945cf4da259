"""Scenes, renderers and conditions of studies: what the attacker sees, and what those
who judge see.
"""

import dataclasses
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from attacks.observe.conditions import SunTable, Viewing, condition_of
from attacks.studies.attack import AttackScene, attack_scene, jittered, with_gradient_of
from attacks.studies.look import clean_and_attacked
from mi_splat.cameras.camera import Camera, project_points
from mi_splat.errors import InvalidValueError
from mi_splat.render.scene_files import MixedScene
from mi_splat.scene import GaussianScene
from tests.fakes import blobs, camera, toy_scene
from tests.project.layers import ROOT
from tests.studies.toy import SCENE, write_toy

pytestmark = pytest.mark.shipped

STREET = "scenes/mixed/car_among_meshes.xml"


def night(scene: GaussianScene, camera: Camera) -> Tensor:
    """A renderer in which all is nearly black."""
    return 0.05 * blobs(scene, camera)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> AttackScene:
    """The toy scene."""
    return attack_scene(write_toy(tmp_path_factory.mktemp("toy")))


def test_pictures_are_of_one_renderer_and_gradients_of_another() -> None:
    scene, _ = toy_scene()
    both = with_gradient_of(night, blobs)
    weights = torch.rand(camera().height, camera().width, 3)

    def gradient(render: Any) -> Tensor:
        sh = scene.sh.clone().requires_grad_(True)
        (render(scene.replace(sh=sh), camera()) * weights).sum().backward()
        assert sh.grad is not None
        return sh.grad

    assert torch.equal(both(scene, camera()), blobs(scene, camera()))
    learned = both(scene.replace(sh=scene.sh.clone().requires_grad_(True)), camera())
    torch.testing.assert_close(learned.detach(), blobs(scene, camera()))
    torch.testing.assert_close(gradient(both), gradient(night))
    assert not torch.allclose(gradient(both), gradient(blobs))


def test_a_scene_is_read_anew_when_its_files_change(tmp_path: Path) -> None:
    path = write_toy(tmp_path)
    first = attack_scene(path)
    assert attack_scene(path) is first
    write_toy(
        tmp_path, scene=SCENE.scene.replace(opacities=SCENE.scene.opacities * 0.5)
    )
    assert not torch.equal(attack_scene(path).scene.opacities, first.scene.opacities)


def viewing(
    scene: AttackScene, name: str = "car", sun: SunTable | None = None
) -> Viewing:
    rows = scene.objects[name]
    return Viewing(
        settings=scene.settings,
        centre=scene.centre(name),
        alone=lambda splat: splat.select(rows),
        sun=sun,
        clean=scene.scene.select(rows),
    )


def test_the_car_stands_in_the_street_by_the_hour() -> None:
    scene = attack_scene(ROOT / "scenes" / "car_street.xml")
    sun = SunTable(scene=str(ROOT / STREET), samples=1)
    # the file has 1
    shown, street = condition_of("08:00", viewing(scene, sun=sun)).show(
        scene.scene.with_degree(3)
    )
    assert isinstance(street, MixedScene)
    assert shown.sh.shape == (len(street.splats.scene), 16, 3)
    assert torch.equal(shown.means, street.splats.scene.means)
    with pytest.raises(
        InvalidValueError, match="the Gaussians of the object and no others"
    ):
        condition_of("08:00", viewing(scene, "street", sun))
    moved = viewing(scene, sun=sun)
    assert moved.clean is not None
    moved = dataclasses.replace(
        moved, clean=moved.clean.replace(means=moved.clean.means + 1e-3)
    )
    with pytest.raises(
        InvalidValueError, match="the Gaussians of the object and no others"
    ):
        condition_of("08:00", moved)


def test_what_was_not_attacked_is_the_clean_scene_s(scene: AttackScene) -> None:
    rows = scene.objects["car"]
    saved = scene.scene.select(rows)
    saved = saved.replace(sh=saved.sh + 1, means=saved.means + 1)
    clean, attacked = clean_and_attacked(scene.scene, rows, saved, ("sh",))
    assert torch.equal(attacked.scene.means, scene.scene.means)
    assert torch.equal(attacked.scene.sh[rows], saved.sh)
    assert torch.equal(attacked.scene.sh[:10], clean.scene.sh[:10])
    wider = clean_and_attacked(scene.scene, rows, saved.with_degree(2), ("sh",))
    assert {subset.scene.degree for subset in wider} == {2}


def test_jitter_keeps_the_object_in_the_middle() -> None:
    centre = torch.tensor([0.0, 0.0, 0.0])
    assert torch.equal(jittered(camera(), centre, seed=0).to_world, camera().to_world)
    moved = [jittered(camera(), centre, seed=seed) for seed in (1, 1, 2)]
    assert torch.equal(moved[0].to_world, moved[1].to_world)
    assert not torch.equal(moved[0].to_world, moved[2].to_world)
    for view in moved:
        pixel, depth = project_points(centre[None].double(), view)
        assert pixel[0].tolist() == pytest.approx([16.0, 16.0], abs=1e-6)
        assert 3 * 0.95 - 1e-6 <= float(depth[0]) <= 3 * 1.05 + 1e-6
        turn = math.degrees(
            math.acos(min(1.0, float(view.to_world[:3, 2] @ camera().to_world[:3, 2])))
        )
        assert turn <= 6.0 + 1e-6
