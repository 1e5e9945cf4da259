"""Lenses with distortion: the pinhole camera that comes of one, and its picture."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from mi_splat.cameras import View
from mi_splat.datasets import DatasetError, load_dataset
from mi_splat.training.evaluation import MOST_PSNR, score
from tests import oracle
from tests.datasets.sets import LENSES, lens_set, ramps


def where(model: str, parameters: list[float], x: float, y: float) -> tuple[float, float]:
    """Where OpenCV's documentation says that a lens shows the point (x, y, 1)."""
    fx, fy, cx, cy, *k = parameters if "OPENCV" in model else [parameters[0], *parameters]
    r = math.hypot(x, y)
    if model == "OPENCV_FISHEYE":
        theta = math.atan(r)
        ratio = (theta + k[0] * theta**3 + k[1] * theta**5 + k[2] * theta**7 + k[3] * theta**9) / r
        return fx * x * ratio + cx, fy * y * ratio + cy
    k1, k2, p1, p2, k3, k4, k5, k6 = [*k, *[0.0] * 7][:8]
    ratio = (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
    right = x * ratio + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2)
    down = y * ratio + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y
    return fx * right + cx, fy * down + cy


def assert_undone(view: View, model: str, parameters: list[float]) -> None:
    """Of a picture of `ramps`, some pixels come from where the closed form says."""
    camera = view.camera
    for row, column in ((5, 7), (60, 80), (camera.height - 9, camera.width - 4), (3, camera.width // 2)):
        x, y = (column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy
        u, v = where(model, parameters, x, y)
        assert (255 * view.image[row, column, :2]).tolist() == pytest.approx([u - 0.5, v - 0.5], abs=1e-3)


@pytest.mark.parametrize("model", LENSES)
def test_a_lens_is_undone_as_by_colmap(model: str, tmp_path: Path) -> None:
    parameters, size, wanted = LENSES[model]
    lens_set(tmp_path / "text", model, parameters, ramps())
    keys = {"SIMPLE_RADIAL": ["k1"], "RADIAL": ["k1", "k2"], "OPENCV": ["k1", "k2", "p1", "p2"]}
    keys["FULL_OPENCV"] = [*keys["OPENCV"], "k3", "k4", "k5", "k6"]
    fx, fy, cx, cy, *k = parameters if "OPENCV" in model else [parameters[0], *parameters]
    document = {"camera_model": model, "w": 160, "h": 120, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
    document |= dict(zip(keys.get(model, ["k1", "k2", "k3", "k4"]), k, strict=True))
    frames = [{"file_path": "../text/images/0.png", "transform_matrix": np.eye(4).tolist()}]
    (tmp_path / "nerf").mkdir()
    (tmp_path / "nerf" / "transforms.json").write_text(json.dumps({**document, "frames": frames}))
    for folder in ("text", "nerf"):
        (view,) = found = load_dataset(tmp_path / folder, split=None)
        camera = view.camera
        assert (camera.width, camera.height) == size
        assert [camera.fx, camera.fy, camera.cx, camera.cy] == pytest.approx(wanted)
        assert found.mask(0) is None  # all of it is in the photograph
        assert_undone(view, model, parameters)


def test_binary_models_have_lenses_too(tmp_path: Path) -> None:
    parameters, size, _ = LENSES["OPENCV"]
    lens_set(tmp_path, "OPENCV", parameters, ramps())
    sparse = tmp_path / "sparse" / "0"
    lens = struct.pack("<QiiQQ8d", 1, 1, 4, 160, 120, *parameters)
    (sparse / "cameras.bin").write_bytes(lens)
    (sparse / "images.bin").write_bytes(
        struct.pack("<Qi7di", 1, 1, 1, *[0.0] * 6, 1) + b"0.png\0" + struct.pack("<Q", 0)
    )
    (view,) = load_dataset(tmp_path, split=None)
    assert (view.camera.width, view.camera.height) == size
    assert_undone(view, "OPENCV", parameters)
    (sparse / "cameras.bin").write_bytes(lens[:16] + struct.pack("<Q", 1 << 40) + lens[24:])
    with pytest.raises(DatasetError, match=r"png: expected 1099511627776 x 120 pixels"):
        load_dataset(tmp_path, split=None)


def test_smaller_pictures_and_masks_are_undone_alike(tmp_path: Path) -> None:
    parameters = LENSES["OPENCV"][0]
    lens_set(tmp_path, "OPENCV", parameters, np.dstack([ramps(), ramps()[..., 2:]]))
    (tmp_path / "masks").mkdir()
    Image.fromarray(ramps()[..., 0]).save(tmp_path / "masks" / "0.png")  # as grey as the picture is red
    found = load_dataset(tmp_path, split=None, downscale=2)
    camera, mask, alpha = found.cameras[0], found.loss_mask(0), found.alpha(0)
    assert (camera.width, camera.height) == (84, 62)
    assert mask is not None
    assert alpha is not None
    torch.testing.assert_close(mask, found[0].image[..., 0], atol=1e-6, rtol=0)
    torch.testing.assert_close(alpha, torch.ones(62, 84))
    u, v = where("OPENCV", parameters, (20.5 - camera.cx) / camera.fx, (30.5 - camera.cy) / camera.fy)
    assert (255 * found[0].image[30, 20, :2]).tolist() == pytest.approx([u - 0.5, v - 0.5], abs=1e-3)
    assert found.fingerprint != load_dataset(tmp_path, split=None).fingerprint


def test_what_the_photograph_does_not_show_does_not_count(tmp_path: Path) -> None:
    # The lens folds before its corners.
    lens_set(tmp_path, "SIMPLE_RADIAL", [100.0, 80.0, 60.0, -0.23], np.full_like(ramps(), 255))
    views = load_dataset(tmp_path, split=None)
    shown = views.loss_mask(0, files=False)
    assert shown is not None
    assert shown[0, 0] == 0
    assert 0.9 < float(shown.mean()) < 1
    torch.testing.assert_close(views[0].image, shown[..., None].expand(*shown.shape, 3))
    scores = score(oracle.random_scene(1, degree=0, seed=0), views, lambda _, camera: torch.ones_like(views[0].image))
    assert scores is not None
    assert scores.psnr == MOST_PSNR  # white everywhere, and black at the border of the picture
