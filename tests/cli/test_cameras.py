"""The cameras that the shared options describe, and the near plane and background that
go with them.
"""

import json
import shutil
from pathlib import Path

import pytest
import torch

from mi_splat.cameras.camera import Camera, View, look_at, project_points
from mi_splat.cameras.lens import Lens
from mi_splat.cameras.sets import orbit
from mi_splat.cli.cameras import find_cameras, render_settings
from mi_splat.cli.options import CameraOptions
from mi_splat.datasets import DatasetError
from mi_splat.errors import InvalidValueError
from mi_splat.io.camera_records import describe, recorded_cameras, unique_names
from mi_splat.maths.rotation import to_matrix
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.render.scene_files import SplatScene
from mi_splat.scene import GaussianScene, Similarity
from tests.datasets.sets import CLOUD, VIEWS, colmap_binary, write_colmap
from tests.fakes import camera, toy_scene
from tests.gaussians import varied_scene
from tests.training.sets import write_set


def loaded(**cameras: Camera) -> SplatScene:
    scene, _ = toy_scene()
    return SplatScene(
        scene=scene,
        objects={},
        cameras=cameras,
        settings=RenderSettings(background=(0.1, 0.2, 0.3)),
    )


def test_without_flags_it_is_the_first_of_the_scene_or_an_orbit() -> None:
    first = camera()
    second = camera(offset=1.0)
    assert find_cameras(loaded(a=first, b=second), CameraOptions()) == {"a": first}
    (made,) = find_cameras(loaded(), CameraOptions(size=(60, 40))).values()
    projected, depth = project_points(toy_scene()[0].means.double(), made)
    assert (
        (projected > 0).all(1)
        & (projected < torch.tensor([60, 40])).all(1)
        & (depth > 0)
    ).all()


def test_names_of_the_scene_s_cameras_come_in_the_order_asked_for() -> None:
    scene = loaded(a=camera(), b=camera(offset=1.0))
    assert list(find_cameras(scene, CameraOptions(cameras=("b", "a")))) == ["b", "a"]
    assert list(find_cameras(scene, CameraOptions(cameras=("all",)))) == ["a", "b"]
    (small,) = find_cameras(
        scene, CameraOptions(cameras=("b",), size=(16, 16))
    ).values()
    assert (small.width, small.height) == (16, 16)
    assert torch.equal(small.to_world, scene.cameras["b"].to_world)


def test_sets_look_at_the_centre_from_the_distance() -> None:
    options = CameraOptions(
        cameras=("orbit:4@30", "grid:2x1"), centre=(1, 2, 3), distance=5, size=(20, 10)
    )
    cameras = find_cameras(loaded(), options)
    assert list(cameras) == [
        "orbit-0",
        "orbit-1",
        "orbit-2",
        "orbit-3",
        "grid-0",
        "grid-1",
    ]
    middle = torch.tensor([[1.0, 2.0, 3.0]], dtype=torch.float64)
    for one in cameras.values():
        pixel, depth = project_points(middle, one)
        assert pixel[0].tolist() == pytest.approx([10, 5])
        assert float(depth) == pytest.approx(5)
    plain = orbit(
        (1, 2, 3),
        count=4,
        elevation=30,
        distance=5,
        lens=Lens(focal=cameras["orbit-0"].fx, size=(20, 10)),
    )
    assert torch.equal(cameras["orbit-1"].to_world, plain[1].to_world)


@pytest.mark.parametrize("up", [(0.0, -1.0, 0.0), (0.0, 0.0, -1.0), (1.0, 2.0, -3.0)])
def test_up_is_up(up: tuple[float, float, float]) -> None:
    options = CameraOptions(
        centre=(1, 2, 3), distance=2, azimuth=10, elevation=40, up=up
    )
    (one,) = find_cameras(loaded(), options).values()
    direction = torch.nn.functional.normalize(
        torch.tensor(up, dtype=torch.float64), dim=0
    )
    away = (one.position - torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)) / 2
    assert float(away @ direction) == pytest.approx(
        torch.tensor(40.0).deg2rad().sin().item()
    )
    # the horizon is level
    assert float(one.to_world[:3, 0] @ direction) == pytest.approx(0, abs=1e-9)
    assert float(one.to_world[:3, 1] @ direction) < 0  # y of the camera points down


def test_two_of_one_name_are_kept_apart() -> None:
    assert (
        len(
            find_cameras(
                loaded(a=camera()),
                CameraOptions(cameras=("orbit:2@0", "orbit:2@10", "a", "a")),
            )
        )
        == 6
    )
    assert unique_names(["x", "x", "x-1", "x", "y"]) == [
        "x",
        "x-1",
        "x-1-2",
        "x-3",
        "y",
    ]


def test_an_object_is_looked_at_from_where_it_shows() -> None:
    scene, mask = toy_scene()
    asked: list[Camera] = []

    def shows(one: Camera) -> float:
        asked.append(one)
        if len(asked) == 3:
            return 0.9
        return 0.1

    (camera_made,) = find_cameras(
        loaded(), CameraOptions(), focus=scene.select(mask), shows=shows
    ).values()
    assert camera_made is asked[2]
    middle = scene.means[mask].double().quantile(0.5, dim=0)
    assert torch.allclose(
        project_points(middle[None], camera_made)[0],
        torch.tensor([320.0, 240.0]).double(),
        atol=40,
    )


def test_cameras_are_read_from_files(tmp_path: Path) -> None:
    pictures = write_set(tmp_path / "set")
    asked = CameraOptions(cameras=(str(pictures),))
    parts = [
        list(find_cameras(loaded(), asked, split=split)) for split in ("train", "test")
    ]
    assert all(parts)
    assert list(find_cameras(loaded(), asked)) == [*parts[0], *parts[1]]
    (file,) = pictures.glob("transforms_train.json")
    numbered = find_cameras(loaded(), CameraOptions(cameras=(str(file),)))
    assert next(iter(numbered)).startswith("transforms_train-")
    assert len(numbered) == len(json.loads(file.read_text())["frames"])


def test_a_colmap_model_needs_no_pictures(tmp_path: Path) -> None:
    colmap_binary(tmp_path, VIEWS, CLOUD)
    shutil.rmtree(tmp_path / "images")
    cameras = find_cameras(loaded(), CameraOptions(cameras=(str(tmp_path),)))
    assert len(cameras) == len(VIEWS)
    train = find_cameras(
        loaded(), CameraOptions(cameras=(str(tmp_path),)), split="train"
    )
    assert list(train) == list(cameras)[1:8] + list(cameras)[9:]
    for shot, one in zip(VIEWS, cameras.values(), strict=True):
        assert torch.allclose(one.to_world, shot.camera.to_world, atol=1e-6)


def test_cameras_of_an_earlier_command_come_back(tmp_path: Path) -> None:
    one = Camera(
        to_world=look_at((1, 2, 3), (0, 0, 0)),
        lens=Lens(focal=(30.0, 31.0), size=(40, 20), principal=(19.0, 11.0)),
    )
    entry = describe("left", one)
    (tmp_path / "cameras.json").write_text(json.dumps([entry]))
    (tmp_path / "result.json").write_text(
        json.dumps({"views": [{"camera": entry}], "cameras": ["left"]})
    )
    (tmp_path / "old.json").write_text(
        json.dumps({"views": [{"camera": {**entry, "name": "left"}}]})
    )
    for name in ("cameras.json", "result.json", "old.json"):
        ((key, back),) = find_cameras(
            loaded(), CameraOptions(cameras=(str(tmp_path / name),))
        ).items()
        assert key == "left"
        assert torch.equal(back.to_world, one.to_world)
        assert (back.fx, back.fy, back.cx, back.cy, back.width, back.height) == (
            30,
            31,
            19,
            11,
            40,
            20,
        )
    (tmp_path / "broken.json").write_text(json.dumps([{"name": "left"}]))
    with pytest.raises(InvalidValueError, match=r"broken\.json"):
        recorded_cameras(tmp_path / "broken.json")
    far = {**entry, "name": "far", "principal": [1e30, 0]}
    (tmp_path / "far.json").write_text(json.dumps([entry, far]))
    with pytest.raises(InvalidValueError, match=r"far\.json.*principal"):
        recorded_cameras(tmp_path / "far.json")
    (tmp_path / "other.json").write_text("{}")
    with pytest.raises(DatasetError, match=r"other\.json"):
        find_cameras(loaded(), CameraOptions(cameras=(str(tmp_path / "other.json"),)))


def test_cameras_of_the_trainer_of_3dgs(tmp_path: Path) -> None:
    pose = look_at((1, 2, 3), (0, 0, 0.5))
    entry = {
        "id": 0,
        "img_name": "desk_01",
        "width": 40,
        "height": 30,
        "fx": 50.0,
        "fy": 51.0,
    }
    entry |= {"position": pose[:3, 3].tolist(), "rotation": pose[:3, :3].tolist()}
    (tmp_path / "cameras.json").write_text(json.dumps([entry]))
    ((name, one),) = find_cameras(
        loaded(), CameraOptions(cameras=(str(tmp_path / "cameras.json"),))
    ).items()
    assert name == "desk_01"
    assert torch.equal(one.to_world, pose)
    assert (one.fx, one.fy, one.cx, one.cy, one.width, one.height) == (
        50,
        51,
        20,
        15,
        40,
        30,
    )


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (CameraOptions(cameras=("behind",)), "one of front; or hemisphere:N"),
        (CameraOptions(cameras=("orbit:0@20",)), "1 to 100000 cameras"),
        (CameraOptions(cameras=("orbit:3",)), "orbit:N@ELEVATION"),
        (
            CameraOptions(cameras=("front",), azimuth=3),
            "have their places, got --cameras front and --azimuth",
        ),
        (
            CameraOptions(cameras=("front",), distance=3, centre=(0, 0, 0)),
            "front and --distance, --centre",
        ),
        (
            CameraOptions(cameras=("orbit:2@0",), distance=3, elevation=9),
            "orbit:2@0 and --elevation; leave one out",
        ),
        (CameraOptions(azimuth=3, up=(0, 0, 0)), "up: expected a direction"),
    ],
)
def test_what_is_wrong_is_said(options: CameraOptions, says: str) -> None:
    with pytest.raises(InvalidValueError, match=says):
        find_cameras(loaded(front=camera()), options)


def test_near_plane_and_background() -> None:
    bare = loaded()
    own = loaded(front=camera())
    near_one = {
        "a": Camera(
            to_world=look_at((0.0, -0.3, 0.0), (0.0, 0.0, 0.0)),
            lens=Lens(focal=10, size=(8, 8)),
        )
    }
    assert render_settings(bare, CameraOptions(), near_one).near < 0.2
    # the scene's own
    assert render_settings(own, CameraOptions(), near_one).near == 0.2
    assert render_settings(own, CameraOptions(near=0.07), near_one).near == 0.07
    assert render_settings(own, CameraOptions(), near_one).background == (0.1, 0.2, 0.3)
    assert render_settings(
        own, CameraOptions(background=(1, 1, 1)), near_one
    ).background == (1, 1, 1)


# A set whose world is another one


@pytest.fixture(scope="module")
def photographed(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[GaussianScene, Path]:
    """A splat, and a set of its renderings."""
    scene = varied_scene(60, degree=0, seed=5).replace(opacities=torch.full((60,), 0.9))
    poses = orbit(
        (0, 0, 0),
        count=9,
        elevation=25,
        distance=4,
        lens=Lens(focal=50.0, size=(48, 36)),
    )
    render = Renderer()
    views = [View(pose, render(scene, pose).clamp(0, 1)) for pose in poses]
    folder = tmp_path_factory.mktemp("photographed") / "set"
    write_colmap(folder, views)
    return scene, folder


def opened(scene: GaussianScene) -> SplatScene:
    return SplatScene(scene=scene, objects={}, cameras={}, settings=RenderSettings())


def test_a_set_of_the_splat_s_world_is_not_warned_of(
    photographed: tuple[GaussianScene, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    scene, folder = photographed
    assert len(find_cameras(opened(scene), CameraOptions(cameras=(str(folder),)))) == 9
    noisy = scene.replace(
        sh=scene.sh
        + 0.2 * torch.randn(scene.sh.shape, generator=torch.Generator().manual_seed(1))
    )
    find_cameras(opened(noisy), CameraOptions(cameras=(str(folder),)))
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("how", ["turned", "another", "far away"])
def test_a_set_of_another_world_is_warned_of(
    how: str,
    photographed: tuple[GaussianScene, Path],
    capsys: pytest.CaptureFixture[str],
) -> None:
    scene, folder = photographed
    quarter = to_matrix(
        torch.tensor([0.5**0.5, 0.5**0.5, 0.0, 0.0], dtype=torch.float64)
    )
    shift = torch.tensor([500.0, 0, 0]) if how == "far away" else torch.zeros(3)
    moved = {
        "turned": scene.transform(
            Similarity(rotation=quarter, translation=torch.zeros(3))
        ),
        "another": varied_scene(60, degree=0, seed=6),
        "far away": scene.replace(means=scene.means + shift),
    }[how]
    find_cameras(opened(moved), CameraOptions(cameras=(str(folder),)))
    (line,) = capsys.readouterr().err.splitlines()
    assert "its images do not look like the splat from their own cameras" in line
