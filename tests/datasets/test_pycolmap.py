"""COLMAP's own library reads the sets that we write, and we read those that it writes.

It is not installed by `make setup`, being 135 MB; `.venv/bin/pip install pycolmap` lets these tests run.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mi_splat.cameras import Camera, project_points
from mi_splat.datasets import load_dataset, write_colmap
from mi_splat.datasets.distortion import Intrinsics, undistorted
from tests.datasets.sets import CLOUD, LENSES, PROBES, VIEWS, lens_set, ramps


@pytest.fixture(scope="module")
def pycolmap() -> Any:
    """The library; imported where it is needed alone, since it takes over what a process does on signals."""
    return pytest.importorskip("pycolmap", reason="pycolmap is not installed; pip install pycolmap")


def assert_same_pixels(camera: Camera, image: Any) -> None:
    """Points are seen at the same pixels, which no wrong axis, sign or half pixel would leave."""
    ours, _ = project_points(PROBES, camera)
    theirs = np.stack([image.project_point(probe) for probe in PROBES.numpy()])
    np.testing.assert_allclose(ours.numpy(), theirs, atol=1e-4)


def test_colmap_reads_our_set(pycolmap: Any, tmp_path: Path) -> None:
    write_colmap(tmp_path, VIEWS, points=CLOUD)
    model = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    assert model.num_images() == len(VIEWS)
    by_name = {image.name: image for image in model.images.values()}
    for view, name in zip(VIEWS, sorted(by_name), strict=True):
        assert_same_pixels(view.camera, by_name[name])
        lens = by_name[name].camera
        assert (lens.width, lens.height) == (view.camera.width, view.camera.height)
    points = np.stack([model.points3D[i].xyz for i in sorted(model.points3D)])
    np.testing.assert_allclose(points, CLOUD.points.numpy(), atol=1e-6)
    colours = np.stack([model.points3D[i].color for i in sorted(model.points3D)])
    np.testing.assert_array_equal(colours, (CLOUD.colours * 255).round().numpy())


@pytest.mark.parametrize("write", ["write_binary", "write_text"])
@pytest.mark.parametrize("model", ["PINHOLE", "SIMPLE_PINHOLE"])
def test_we_read_colmap_s_set(write: str, model: str, pycolmap: Any, tmp_path: Path) -> None:
    write_colmap(tmp_path, VIEWS, points=CLOUD)  # for the pictures
    written = pycolmap.Reconstruction()
    size = {"width": VIEWS[0].camera.width, "height": VIEWS[0].camera.height}
    params = [21.3, 19.7, 8.25, 7.75] if model == "PINHOLE" else [20.5, 8.25, 7.75]
    written.add_camera_with_trivial_rig(pycolmap.Camera(camera_id=1, model=model, params=params, **size))
    for number, view in enumerate(VIEWS, 1):
        pose = pycolmap.Rigid3d(view.camera.to_camera[:3].numpy())
        image = pycolmap.Image(name=f"train_{number - 1:05d}.png", camera_id=1, image_id=number)
        written.add_image_with_trivial_frame(image, pose)
    for point, colour in zip(CLOUD.points.double().numpy(), (CLOUD.colours * 255).round().numpy(), strict=True):
        written.add_point3D(point, pycolmap.Track(), colour.astype(np.uint8))
    folder = tmp_path / "sparse" / "0"
    for file in folder.iterdir():
        file.unlink()
    save: Callable[[str], None] = getattr(written, write)
    save(str(folder))

    found = load_dataset(tmp_path, split=None)
    images = sorted(written.images.values(), key=lambda image: image.name)
    for camera, image in zip(found.cameras, images, strict=True):
        assert_same_pixels(camera, image)
    assert found.points is not None
    order, theirs = (points[:, 0].argsort() for points in (found.points.points, CLOUD.points))
    torch.testing.assert_close(found.points.points[order], CLOUD.points[theirs], atol=1e-6, rtol=0)
    torch.testing.assert_close(found.points.colours[order], CLOUD.colours[theirs], atol=1e-6, rtol=0)


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

    # Where the size stays COLMAP interpolates once, as we always do; else it shrinks the picture in a second step.
    options = pycolmap.UndistortCameraOptions()
    options.min_scale = options.max_scale = 1.0
    theirs, same = pycolmap.undistort_image(options, pycolmap.Bitmap.from_array(pixels), camera)
    lens = load_dataset(tmp_path, split=None).frames[0].lens
    assert lens is not None
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (40, 2))
    mapped = np.stack([camera.img_from_cam(np.array([x, y, 1.0])) for x, y in points])
    np.testing.assert_allclose(np.stack(lens.project(*points.T), -1), mapped, atol=1e-11)
    fx, fy, cx, cy = same.params
    pinhole = Intrinsics(focal=(fx, fy), principal=(cx, cy), size=(160, 120))
    ours, shown = undistorted(torch.from_numpy(pixels).float(), lens, pinhole)
    values = theirs.to_array()
    both = shown.numpy() & values.any(-1)  # COLMAP leaves half a pixel black at the photograph's border
    assert both.mean() > 0.9
    assert np.abs(ours.numpy() - values)[both].max() < 0.501
