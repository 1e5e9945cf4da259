"""Lenses with distortion: the pinhole camera that comes of one, its image, and poses
alone.
"""

import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from mi_splat.cameras.camera import Camera, View, project_points
from mi_splat.cameras.lens import Lens
from mi_splat.cameras.sets import camera_set
from mi_splat.datasets import DatasetWarning, load_dataset
from mi_splat.datasets.colmap import MODELS, find_model, read_model_cameras
from mi_splat.datasets.lenses import ImageLens, undistorted
from mi_splat.errors import MiSplatError
from mi_splat.io.picture_files import pixel_limit
from mi_splat.training.evaluation import MOST_PSNR, score
from tests.datasets.sets import (
    CLOUD,
    LENSES,
    PROBES,
    VIEWS,
    lens_set,
    ramps,
    write_colmap,
)
from tests.gaussians import varied_scene


def pinhole_of(model: str, parameters: list[float]) -> tuple[float, ...]:
    """Focal lengths, principal point and coefficients of COLMAP's parameters."""
    return tuple(
        parameters if MODELS[model].focals == 2 else [parameters[0], *parameters]
    )


def where(
    model: str, parameters: list[float], x: float, y: float
) -> tuple[float, float]:
    """Where OpenCV's documentation says that a lens shows the point (x, y, 1)."""
    fx, fy, cx, cy, *k = pinhole_of(model, parameters)
    r = math.hypot(x, y)
    if model.endswith("FISHEYE"):
        theta = math.atan(r)
        k = [*k, *[0.0] * 4]
        ratio = (
            theta
            + k[0] * theta**3
            + k[1] * theta**5
            + k[2] * theta**7
            + k[3] * theta**9
        ) / r
        return fx * x * ratio + cx, fy * y * ratio + cy
    k1, k2, p1, p2, k3, k4, k5, k6 = [*k, *[0.0] * 7][:8]
    ratio = (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (
        1 + k4 * r**2 + k5 * r**4 + k6 * r**6
    )
    right = x * ratio + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2)
    down = y * ratio + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y
    return fx * right + cx, fy * down + cy


def assert_undone(view: View, model: str, parameters: list[float]) -> None:
    """Of an image of `ramps`, some pixels come from where the closed form says."""
    camera = view.camera
    for row, column in (
        (5, 7),
        (60, 80),
        (camera.height - 9, camera.width - 4),
        (3, camera.width // 2),
    ):
        x = (column + 0.5 - camera.cx) / camera.fx
        y = (row + 0.5 - camera.cy) / camera.fy
        u, v = where(model, parameters, x, y)
        assert (255 * view.image[row, column, :2]).tolist() == pytest.approx(
            [u - 0.5, v - 0.5], abs=0.02
        )


def nerf_set(folder: Path, model: str, parameters: list[float], image: str) -> Path:
    """Write a transforms file of one image of 160 x 120 with a lens."""
    keys = {
        "SIMPLE_RADIAL": ["k1"],
        "RADIAL": ["k1", "k2"],
        "OPENCV": ["k1", "k2", "p1", "p2"],
    }
    keys["FULL_OPENCV"] = [*keys["OPENCV"], "k3", "k4", "k5", "k6"]
    keys["FISHEYE"] = []
    fx, fy, cx, cy, *k = pinhole_of(model, parameters)
    document = {
        "camera_model": model,
        "w": 160,
        "h": 120,
        "fl_x": fx,
        "fl_y": fy,
        "cx": cx,
        "cy": cy,
    }
    document |= dict(zip(keys.get(model, ["k1", "k2", "k3", "k4"]), k, strict=True))
    frames = [{"file_path": image, "transform_matrix": np.eye(4).tolist()}]
    folder.mkdir(exist_ok=True)
    file = folder / "transforms.json"
    file.write_text(json.dumps({**document, "frames": frames}))
    return file


@pytest.mark.parametrize("model", LENSES)
def test_a_lens_is_undone_as_by_colmap(model: str, tmp_path: Path) -> None:
    parameters, size, wanted = LENSES[model]
    lens_set(tmp_path / "text", model, parameters, ramps())
    nerf_set(tmp_path / "nerf", model, parameters, "../text/images/0.png")
    for folder in ("text", "nerf"):
        (view,) = dataset = load_dataset(tmp_path / folder, split=None)
        camera = view.camera
        assert (camera.width, camera.height) == size
        assert [camera.fx, camera.fy, camera.cx, camera.cy] == pytest.approx(wanted)
        assert dataset.loss_mask(0) is None  # all of it is in the photograph
        assert_undone(view, model, parameters)


def test_masks_and_alpha_are_undone_as_their_image(tmp_path: Path) -> None:
    parameters = LENSES["OPENCV"][0]
    lens_set(tmp_path, "OPENCV", parameters, np.dstack([ramps(), ramps()[..., 2:]]))
    (tmp_path / "masks").mkdir()
    # as grey as the image is red
    Image.fromarray(ramps()[..., 0]).save(tmp_path / "masks" / "0.png")
    dataset = load_dataset(tmp_path, split=None, downscale=2)
    camera = dataset.cameras[0]
    mask = dataset.loss_mask(0)
    alpha = dataset.alpha(0)
    assert (camera.width, camera.height) == (84, 62)
    assert mask is not None
    assert alpha is not None
    torch.testing.assert_close(mask, dataset[0].image[..., 0], atol=1e-6, rtol=0)
    torch.testing.assert_close(alpha, torch.ones(62, 84))
    u, v = where(
        "OPENCV",
        parameters,
        (20.5 - camera.cx) / camera.fx,
        (30.5 - camera.cy) / camera.fy,
    )
    assert (255 * dataset[0].image[30, 20, :2]).tolist() == pytest.approx(
        [u - 0.5, v - 0.5], abs=0.02
    )
    assert dataset.fingerprint != load_dataset(tmp_path, split=None).fingerprint


def test_what_the_photograph_does_not_show_does_not_count(tmp_path: Path) -> None:
    # The lens folds before its corners.
    lens_set(
        tmp_path,
        "SIMPLE_RADIAL",
        [100.0, 80.0, 60.0, -0.23],
        np.full_like(ramps(), 255),
    )
    views = load_dataset(tmp_path, split=None)
    shown = views.loss_mask(0)
    assert shown is not None
    assert shown[0, 0] == 0
    assert 0.9 < float(shown.mean()) < 1
    torch.testing.assert_close(views[0].image, shown[..., None].expand(*shown.shape, 3))
    scores = score(
        varied_scene(1, degree=0, seed=0),
        views,
        lambda _, camera: torch.ones_like(views[0].image),
    )
    assert scores is not None
    # white everywhere, and black at the border of the image
    assert scores.psnr == MOST_PSNR


def test_an_image_may_not_grow_beyond_what_images_may_have(tmp_path: Path) -> None:
    lens_set(tmp_path, "OPENCV_FISHEYE", LENSES["OPENCV_FISHEYE"][0], ramps())
    with (
        pixel_limit(20_000),
        pytest.raises(
            MiSplatError, match=r"0\.png without its distortion: .* 20,000 pixels"
        ),
    ):
        load_dataset(tmp_path, split=None)


@pytest.mark.parametrize("found", ["4.13.0", None])
def test_an_unusable_opencv_is_said_in_one_line(
    found: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lens_set(
        tmp_path,
        "OPENCV_FISHEYE",
        [91.0, 95.0, 80.3, 60.1, 0.02, -0.01, 0.003, -0.001],
        ramps(),
    )
    monkeypatch.setitem(
        sys.modules,
        "cv2",
        None if found is None else SimpleNamespace(__version__=found),
    )
    with pytest.raises(
        MiSplatError,
        match=r"OpenCV 5 or later, got .*; pip install --force-reinstall --no-deps",
    ):
        load_dataset(tmp_path, split=None)


@pytest.mark.parametrize("model", ["OPENCV", "EQUIRECTANGULAR", "A_LENS_OF_TOMORROW"])
def test_poses_alone_are_never_refused_for_distortion(
    model: str, tmp_path: Path
) -> None:
    file = nerf_set(
        tmp_path,
        "OPENCV",
        [150.0, 140.0, 80.3, 60.1, -0.2, 0.05, 0.003, -0.002],
        "images/0.png",
    )
    document = json.loads(file.read_text())
    file.write_text(json.dumps({**document, "camera_model": model}))
    with pytest.warns(
        DatasetWarning, match=rf"without the distortion of their lenses \({model}\)"
    ):
        (camera,) = camera_set(
            str(file), (0, 0, 0), distance=1, lens=Lens(focal=1, size=(8, 8))
        )
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (150.0, 140.0, 80.3, 60.1)
    assert (camera.width, camera.height) == (160, 120)


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "FOV", "THIN_PRISM_FISHEYE"])
def test_poses_of_a_model_are_never_refused_for_distortion(
    model: str, tmp_path: Path
) -> None:
    kind = MODELS[model]
    focals = [100.0] * kind.focals
    parameters = [*focals, 80.3, 60.1, *[0.1] * (kind.parameters - kind.focals - 2)]
    lens_set(tmp_path, model, parameters, ramps())
    cameras = find_model(tmp_path)
    assert cameras is not None
    if kind.is_read:
        (camera,) = read_model_cameras(cameras).values()
        assert torch.equal(
            camera.to_world, load_dataset(tmp_path, split=None).cameras[0].to_world
        )
        assert (
            camera.width == load_dataset(tmp_path, split=None).cameras[0].width != 160
        )
        (tmp_path / "images" / "0.png").unlink()
    with pytest.warns(DatasetWarning, match=model):
        (camera,) = read_model_cameras(cameras).values()
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (100.0, 100.0, 80.3, 60.1)


# COLMAP's own library reads the sets that we write, and we read those that it writes


@pytest.fixture(scope="module")
def pycolmap() -> Any:
    return pytest.importorskip(
        "pycolmap", reason="pycolmap is not installed; pip install pycolmap"
    )


def assert_same_pixels(camera: Camera, image: Any) -> None:
    """Points are seen at the same pixels, which no wrong axis, sign or half pixel would
    leave.
    """
    ours, _ = project_points(PROBES, camera)
    theirs = np.stack([image.project_point(probe) for probe in PROBES.numpy()])
    np.testing.assert_allclose(ours.numpy(), theirs, atol=1e-4)


@pytest.mark.parametrize("write", ["write_binary", "write_text"])
@pytest.mark.parametrize("model", ["PINHOLE", "SIMPLE_PINHOLE"])
def test_we_read_colmap_s_set(
    write: str, model: str, pycolmap: Any, tmp_path: Path
) -> None:
    write_colmap(tmp_path, VIEWS, points=CLOUD)  # for the images
    written = pycolmap.Reconstruction()
    size = {"width": VIEWS[0].camera.width, "height": VIEWS[0].camera.height}
    params = [21.3, 19.7, 8.25, 7.75] if model == "PINHOLE" else [20.5, 8.25, 7.75]
    written.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model=model, params=params, **size)
    )
    for number, view in enumerate(VIEWS, 1):
        pose = pycolmap.Rigid3d(view.camera.to_camera[:3].numpy())
        image = pycolmap.Image(
            name=f"train_{number - 1:05d}.png", camera_id=1, image_id=number
        )
        written.add_image_with_trivial_frame(image, pose)
    for point, colour in zip(
        CLOUD.points.double().numpy(),
        (CLOUD.colours * 255).round().numpy(),
        strict=True,
    ):
        written.add_point3D(point, pycolmap.Track(), colour.astype(np.uint8))
    folder = tmp_path / "sparse" / "0"
    for file in folder.iterdir():
        file.unlink()
    save: Callable[[str], None] = getattr(written, write)
    save(str(folder))

    dataset = load_dataset(tmp_path, split=None)
    images = sorted(written.images.values(), key=lambda image: image.name)
    for camera, image in zip(dataset.cameras, images, strict=True):
        assert_same_pixels(camera, image)
    assert dataset.points is not None
    order, theirs = (
        points[:, 0].argsort() for points in (dataset.points.points, CLOUD.points)
    )
    torch.testing.assert_close(
        dataset.points.points[order], CLOUD.points[theirs], atol=1e-6, rtol=0
    )
    torch.testing.assert_close(
        dataset.points.colours[order], CLOUD.colours[theirs], atol=1e-6, rtol=0
    )


def test_we_know_colmap_s_camera_models(pycolmap: Any) -> None:
    for number, (name, model) in enumerate(MODELS.items()):
        kind = pycolmap.CameraModelId(number)
        assert kind.name == name
        camera = pycolmap.Camera.create_from_model_id(0, kind, 100.0, 160, 120)
        assert len(camera.params) == model.parameters
        assert len(camera.focal_length_idxs()) == model.focals


@pytest.mark.parametrize("model", LENSES)
def test_we_undistort_as_colmap_does(model: str, pycolmap: Any, tmp_path: Path) -> None:
    parameters, size, wanted = LENSES[model]
    noise = np.random.default_rng(0).integers(0, 256, (120, 160, 1))
    pixels = np.concatenate([ramps()[..., :2], noise], -1).astype(np.uint8)
    lens_set(tmp_path, model, parameters, pixels)
    camera = pycolmap.Camera(model=model, width=160, height=120, params=parameters)
    target = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
    assert (target.width, target.height) == size
    assert target.params.tolist() == pytest.approx(wanted)

    # Where the size stays COLMAP interpolates once, as we always do; else it shrinks
    # the image in a second step.
    options = pycolmap.UndistortCameraOptions()
    options.min_scale = options.max_scale = 1.0
    theirs, same = pycolmap.undistort_image(
        options, pycolmap.Bitmap.from_array(pixels), camera
    )
    lens = load_dataset(tmp_path, split=None).frames[0].lens
    assert lens is not None
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (40, 2))
    mapped = np.stack([camera.img_from_cam(np.array([x, y, 1.0])) for x, y in points])
    np.testing.assert_allclose(lens.project(points), mapped, atol=1e-9)
    fx, fy, cx, cy = same.params
    pinhole = ImageLens(focal=(fx, fy), principal=(cx, cy), size=(160, 120))
    ours, shown = undistorted((pixels / 255).astype(np.float32), lens, pinhole)
    values = theirs.to_array()
    # COLMAP leaves half a pixel black at the photograph's border
    both = shown & values.any(-1)
    assert both.mean() > 0.9
    assert np.abs(255 * ours - values)[both].max() < 0.51
