"""Cameras without a centre of projection: honoured where rays are traced, and refused
by everything that computes with a pinhole.
"""

import json
from pathlib import Path

import pytest
import torch

from attacks import cli
from mi_splat.audit.auditing import audit
from mi_splat.cameras.camera import Camera, View, look_at, project_points
from mi_splat.cameras.lens import ORTHOGRAPHIC, PROJECTIONS, Lens, Projection
from mi_splat.datasets import load_dataset
from mi_splat.errors import InvalidValueError
from mi_splat.io import save_splat
from mi_splat.io.camera_records import camera_of, describe
from mi_splat.render.overdraw import most_layers
from mi_splat.render.plugins.sensor import sensor_dict
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.scene import GaussianScene
from mi_splat.training.config import FitConfig
from mi_splat.training.loop import fit
from mi_splat.training.strategies import FixedConfig
from tests.audit.recogniser import Painted
from tests.datasets.sets import write_transforms

PARALLEL = Lens(focal=(12.0, 10.0), size=(40, 36), projection=ORTHOGRAPHIC.name)
CAMERA = Camera(to_world=look_at((4.0, 0.0, 1.0), (0.0, 0.0, 0.0)), lens=PARALLEL)
RAY = Renderer(RenderSettings(method="ray"))


def balls(*centres: tuple[float, float, float]) -> GaussianScene:
    """Round white Gaussians, nearly opaque."""
    count = len(centres)
    turns = torch.zeros(count, 4)
    turns[:, 0] = 1
    return GaussianScene(
        means=torch.tensor(centres),
        scales=torch.full((count, 3), 0.1),
        rotations=turns,
        opacities=torch.full((count,), 0.99),
        sh=torch.full((count, 1, 3), 1.7),
    )


def centre_of(image: torch.Tensor) -> torch.Tensor:
    """(2,) middle of what is bright, pixels."""
    light = image.sum(2)
    rows = torch.arange(light.shape[0]) + 0.5
    columns = torch.arange(light.shape[1]) + 0.5
    x = (light.sum(0) * columns).sum() / light.sum()
    y = (light.sum(1) * rows).sum() / light.sum()
    return torch.stack([x, y])


@pytest.mark.parametrize("centre", [(0.0, 0.5, 0.3), (-2.0, 0.5, 0.3), (2.0, -1.0, 0)])
def test_a_ball_appears_where_it_projects_to_and_as_large_from_any_distance(
    centre: tuple[float, float, float],
) -> None:
    scene = balls(centre)
    image = RAY(scene, CAMERA)
    pixels, depth = project_points(scene.means.double(), CAMERA)
    assert float(depth[0]) > 0
    torch.testing.assert_close(centre_of(image), pixels[0].float(), atol=0.05, rtol=0)
    near = RAY(balls((0.0, 0.0, 0.0)), CAMERA)
    assert float(image.sum()) == pytest.approx(float(near.sum()), rel=0.05)


def test_the_ray_tracer_is_differentiable_with_it() -> None:
    scene = balls((0.0, 0.2, 0.1), (-1.0, -0.4, 0.0))
    weights = torch.rand(36, 40, 3, generator=torch.Generator().manual_seed(2))

    def value(opacities: torch.Tensor) -> torch.Tensor:
        return (RAY(scene.replace(opacities=opacities), CAMERA) * weights).sum()

    opacities = torch.tensor([0.6, 0.4], requires_grad=True)
    value(opacities).backward()  # type: ignore[no-untyped-call]
    assert opacities.grad is not None
    for index in range(2):
        step = torch.zeros(2)
        step[index] = 0.01
        up = float(value(opacities.detach() + step))
        down = float(value(opacities.detach() - step))
        slope = (up - down) / 0.02
        assert float(opacities.grad[index]) == pytest.approx(slope, rel=0.02)


def test_whatever_computes_with_a_pinhole_refuses_it(tmp_path: Path) -> None:
    scene = balls((0.0, 0.0, 0.0))
    refused = "a perspective projection, got orthographic"
    with pytest.raises(InvalidValueError, match=refused):
        Renderer()(scene, CAMERA)
    with pytest.raises(InvalidValueError, match=refused):
        most_layers(scene, [CAMERA], near=0.1)
    with pytest.raises(InvalidValueError, match=refused):
        sensor_dict(CAMERA)
    with pytest.raises(InvalidValueError, match=refused):
        audit(scene, Painted(), cameras=[CAMERA])
    with pytest.raises(InvalidValueError, match="did you mean orthographic"):
        Lens(focal=1.0, size=(4, 4), projection="orthografic")


def test_it_is_kept_by_files_and_honoured_by_training(tmp_path: Path) -> None:
    truth = balls((0.0, 0.2, 0.1), (-1.0, -0.4, 0.0))
    assert camera_of(describe("a", CAMERA)).lens.projection == "orthographic"
    cameras = [
        Camera(to_world=look_at(eye, (0.0, 0.0, 0.0)), lens=PARALLEL)
        for eye in ((4.0, 0.0, 1.0), (0.0, 4.0, 1.0), (-4.0, 1.0, 1.0))
    ]
    with torch.no_grad():
        views = [View(camera, RAY(truth, camera).clamp(0, 1)) for camera in cameras]
    write_transforms(tmp_path / "set", views)
    read = load_dataset(tmp_path / "set")
    assert {camera.lens.projection for camera in read.cameras} == {"orthographic"}
    dim = truth.replace(opacities=torch.tensor([0.3, 0.3]))
    config = FitConfig(iterations=40, strategy=FixedConfig(), lr_opacities=0.2)
    trained = fit(read, dim, render=RAY, config=config).scene
    assert float(trained.opacities.min()) > 0.6


def test_the_command_renders_with_such_cameras(tmp_path: Path) -> None:
    save_splat(balls((0.0, 0.2, 0.1)), tmp_path / "a.ply")
    (tmp_path / "cameras.json").write_text(json.dumps([describe("side", CAMERA)]))
    words = ["render", str(tmp_path / "a.ply"), "--cameras"]
    words += [str(tmp_path / "cameras.json"), "--out", str(tmp_path / "out")]
    assert cli.main([*words, "--method", "ray"]) == 0
    assert cli.main([*words, "--force"]) == 1


def test_a_projection_from_outside_is_one_value(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    oblique = Projection(
        name="oblique",
        ray=lambda u, v: ((u, v, 0.0), (0.25, 0.0, 1.0)),
        place=lambda x, y, z: (x - 0.25 * z, y),
    )
    monkeypatch.setitem(PROJECTIONS.own, "oblique", oblique)
    lens = Lens(focal=12.0, size=(40, 36), principal=(32.0, 18.0), projection="oblique")
    camera = Camera(to_world=CAMERA.to_world, lens=lens)
    scene = balls((0.0, 0.4, 0.3))
    pixels, _ = project_points(scene.means.double(), camera)
    torch.testing.assert_close(
        centre_of(RAY(scene, camera)), pixels[0].float(), atol=0.05, rtol=0
    )
