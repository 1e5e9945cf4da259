"""What is meant is taken, from NumPy or from torch, one or several; all else is refused in the project's own words."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np
import pytest
import torch

from attacks import evaluate, relabel
from attacks.dagger.attack import attack
from attacks.dagger.config import DaggerConfig
from attacks.detectors import load_detector, register_detector
from attacks.detectors.base import check_images
from attacks.detectors.registry import _REGISTRY, DetectorSpec
from attacks.gaussian_subset import GaussianSubset
from attacks.observe.views import detect_views
from mi_splat import variant
from mi_splat.cameras import Camera, look_at, orbit_pose
from mi_splat.errors import MiSplatError
from mi_splat.rendering import Renderer, RenderSettings
from tests.fakes import ColourDetector, blobs, camera, toy_scene

POSE = look_at((3.0, 0.0, 0.0), (0.0, 0.0, 0.0))
ROWS = [10, 12, 11]


def lens(**values: Any) -> Camera:
    usual: dict[str, Any] = {"to_world": POSE, "focal": 30.0, "width": 64, "height": 48}
    return Camera(**usual | values)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"width": np.int64(64), "height": np.uint16(48)}, (30.0, 30.0, 64, 48)),
        ({"width": torch.tensor(64)}, (30.0, 30.0, 64, 48)),
        ({"focal": np.float32(31.5)}, (31.5, 31.5, 64, 48)),
        ({"focal": np.array([31.0, 32.0])}, (31.0, 32.0, 64, 48)),
        ({"focal": [31, 32]}, (31.0, 32.0, 64, 48)),
        ({"to_world": POSE.numpy()}, (30.0, 30.0, 64, 48)),
        ({"to_world": POSE.tolist()}, (30.0, 30.0, 64, 48)),
    ],
)
def test_cameras_take_numbers_of_any_kind(values: dict[str, Any], expected: tuple[float, ...]) -> None:
    made = lens(**values)
    assert (made.fx, made.fy, made.width, made.height) == expected
    assert type(made.width) is int
    assert torch.equal(made.to_world, POSE)


def test_a_principal_point_may_be_an_array() -> None:
    found = lens(principal=np.array([30, 20], np.float32)).principal
    assert found == (30.0, 20.0)
    assert found is not None
    assert [type(value) for value in found] == [float, float]


REFUSED: dict[str, tuple[Callable[[], object], str]] = {
    "a width of 64.5": (lambda: lens(width=64.5), "width: expected an integer"),
    "three focal lengths": (lambda: lens(focal=[1.0, 2.0, 3.0]), "focal: expected two numbers"),
    "a focal length in words": (lambda: lens(focal="wide"), "focal: expected"),
    "a pose in words": (lambda: lens(to_world="front"), "to_world: expected"),
    "an azimuth that is none": (
        lambda: orbit_pose((0, 0, 0), azimuth=float("nan"), elevation=0, distance=1),
        "azimuth: expected finite",
    ),
    "a distance below zero": (
        lambda: orbit_pose((0, 0, 0), azimuth=0, elevation=0, distance=-1),
        "distance: expected a positive",
    ),
    "an origin that is none": (lambda: look_at((float("nan"), 0, 0), (0, 0, 0)), "origin: expected finite"),
    "cameras for one picture": (lambda: Renderer()(toy_scene()[0], [camera()]), r"call batch\(scene, cameras\)"),  # type: ignore[arg-type]
    "a path for a scene": (lambda: Renderer()("a.ply", camera()), "expected a GaussianScene"),  # type: ignore[arg-type]
    "words for cameras": (lambda: Renderer().batch(toy_scene()[0], "ab"), "expected values of Camera"),  # type: ignore[arg-type]
    "no near plane": (lambda: RenderSettings(near=None), "near: expected"),  # type: ignore[arg-type]
    "pictures of NumPy": (lambda: check_images(np.zeros((1, 8, 8, 3))), "expected a torch tensor"),  # type: ignore[arg-type]
    "pictures of 0 to 255": (lambda: check_images(torch.full((1, 8, 8, 3), 200.0)), "divide 8-bit values by 255"),
    "a mask of fractions": (lambda: GaussianSubset.of(toy_scene()[0], [0.5, 0.5]), "mask: expected bool"),  # type: ignore[list-item]
    "a mask in words": (lambda: GaussianSubset.of(toy_scene()[0], "car"), "mask: expected bool"),  # type: ignore[arg-type]
    "an empty mask": (lambda: GaussianSubset.of(toy_scene()[0], []), "at least one Gaussian"),
    "a detector that is none": (
        lambda: list(detect_views(toy_scene()[0], camera(), 3, render=blobs)),  # type: ignore[arg-type]
        "expected a Detector or its name",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_makes_no_sense_is_refused_in_words(name: str) -> None:
    call, words = REFUSED[name]
    with pytest.raises(MiSplatError, match=words):
        call()


@pytest.mark.parametrize(
    "mask",
    [
        torch.tensor(ROWS),
        np.array(ROWS),
        np.array(ROWS, dtype=np.uint8),
        ROWS,
        [row in ROWS for row in range(40)],
        np.isin(np.arange(40), ROWS),
    ],
    ids=["tensor", "array", "bytes", "list", "list of bool", "array of bool"],
)
def test_masks_of_any_kind(mask: Any) -> None:
    assert GaussianSubset.of(toy_scene()[0], mask).rows.tolist() == sorted(ROWS)


def test_one_camera_in_the_place_of_several() -> None:
    scene, mask = toy_scene()
    (picture,) = Renderer().batch(scene, camera())
    assert torch.equal(picture, Renderer()(scene, camera()))
    config = DaggerConfig(steps=1, noise_draws=0)
    found = attack(scene, mask, camera(), ColourDetector(), relabel("person"), render=blobs, config=config)
    assert len(found.views) == 1
    assert len(evaluate({"clean": scene}, mask, camera(), ColourDetector(), render=blobs)["clean"]) == 1


def test_a_detector_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_REGISTRY, "_specs", dict(_REGISTRY._specs))
    spec = DetectorSpec(name="fake_colour", load=lambda _: ColourDetector(), classes=(), origin="", licence="")
    register_detector(spec)
    assert isinstance(load_detector("fake_colour"), ColourDetector)
    scene, mask = toy_scene()
    config = DaggerConfig(steps=1, noise_draws=0)
    by_name = attack(scene, mask, [camera()], "fake_colour", relabel("person"), render=blobs, config=config)
    by_value = attack(scene, mask, [camera()], ColourDetector(), relabel("person"), render=blobs, config=config)
    assert torch.equal(by_name.scene.sh, by_value.scene.sh)
    assert len(list(detect_views(scene, camera(), ["fake_colour"], render=blobs))) == 1


@pytest.mark.skipif(dr.has_backend(dr.JitBackend.CUDA), reason="this machine has a GPU")
def test_cuda_without_a_gpu_is_refused_in_words() -> None:
    with pytest.raises(variant.VariantError, match=r"expected an NVIDIA GPU .*; use llvm_ad_rgb"):
        Renderer(RenderSettings(variant="cuda_ad_rgb"))
    assert Renderer().variant == "llvm_ad_rgb"
