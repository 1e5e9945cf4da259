"""Arrays of NumPy, lists, and single values where tensors and sequences are usual; all
else is refused in words.
"""

from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np
import pytest
import torch

from attacks import relabel
from attacks.cloak.config import LayerConfig, LayersConfig
from attacks.dagger.attack import attack
from attacks.dagger.config import DaggerConfig
from attacks.detectors import load_detector, register_detector
from attacks.detectors.base import check_images
from attacks.detectors.registry import DETECTORS, DetectorSpec
from attacks.gaussian_subset import GaussianSubset
from attacks.observe.views import detect_views
from mi_splat.cameras.camera import Camera, look_at
from mi_splat.cameras.lens import Lens
from mi_splat.errors import MiSplatError
from mi_splat.io import load_splat, save_splat
from mi_splat.render import variant
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.render.scene_files import read_scene
from mi_splat.training.config import FitConfig
from tests.fakes import ColourDetector, blobs, camera, toy_scene

ROWS = [10, 12, 11]


POSE = look_at((3.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def lens(**values: Any) -> Camera:
    pose = values.pop("to_world", POSE)
    width = values.pop("width", 64)
    height = values.pop("height", 48)
    usual: dict[str, Any] = {"focal": 30.0, "size": (width, height)}
    return Camera(to_world=pose, lens=Lens(**usual | values))


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
def test_cameras_take_numbers_of_any_kind(
    values: dict[str, Any], expected: tuple[float, ...]
) -> None:
    made = lens(**values)
    assert (made.fx, made.fy, made.width, made.height) == expected
    assert type(made.width) is int
    assert torch.equal(made.to_world, POSE)


def test_a_detector_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(DETECTORS, "own", dict(DETECTORS.own))
    spec = DetectorSpec(
        name="fake_colour",
        load=lambda _: ColourDetector(),
        classes=(),
        origin="",
        licence="",
    )
    register_detector(spec)
    assert isinstance(load_detector("fake_colour"), ColourDetector)
    scene, mask = toy_scene()
    config = DaggerConfig(steps=1, noise_draws=0)
    by_name = attack(
        scene,
        mask,
        [camera()],
        "fake_colour",
        relabel("person"),
        render=blobs,
        config=config,
    )
    by_value = attack(
        scene,
        mask,
        [camera()],
        ColourDetector(),
        relabel("person"),
        render=blobs,
        config=config,
    )
    assert torch.equal(by_name.scene.sh, by_value.scene.sh)
    assert len(list(detect_views(scene, camera(), ["fake_colour"], render=blobs))) == 1


@pytest.mark.skipif(dr.has_backend(dr.JitBackend.CUDA), reason="this machine has a GPU")
def test_cuda_without_a_gpu_is_refused_in_words() -> None:
    with pytest.raises(
        variant.VariantError, match=r"expected an NVIDIA GPU .*; use llvm_ad_rgb"
    ):
        Renderer(RenderSettings(variant="cuda_ad_rgb"))
    assert Renderer().variant == "llvm_ad_rgb"


# Numbers and tuples in configurations: what is meant is taken, the wrong kind is
# refused before anything runs


REFUSED: dict[str, tuple[Callable[[], object], str]] = {
    "a path that is none": (
        lambda: load_splat(None),  # type: ignore[arg-type]
        "path: expected the name of a file, got NoneType",
    ),
    "path before scene": (
        lambda: save_splat("a.ply", toy_scene()[0]),  # type: ignore[arg-type]
        "scene: expected a GaussianScene, got str",
    ),
    "an XML that is none": (
        lambda: read_scene(None),  # type: ignore[arg-type]
        "path: expected the name of a file, got NoneType",
    ),
    "a detector that is none": (
        lambda: load_detector(None),  # type: ignore[arg-type]
        "detector: expected .*, got None",
    ),
    "a class for an objective": (
        lambda: attacked(objective="person"),
        r"expected an Objective, got str; .*relabel\('",
    ),
    "no renderer": (
        lambda: attacked(render=None),
        r"render: expected a function.*Renderer\(\)",
    ),
    "a path to attack": (
        lambda: attacked(scene="a.ply"),
        "scene: expected a GaussianScene, got str",
    ),
    "an origin of two numbers": (
        lambda: look_at((0, 0), (0, 0, 1)),
        "origin: expected 3 values",
    ),
    "an origin that is none": (
        lambda: look_at((float("nan"), 0, 0), (0, 0, 0)),
        "origin: expected a finite number",
    ),
    "three focal lengths": (
        lambda: lens(focal=[1.0, 2.0, 3.0]),
        "focal: expected 2 values",
    ),
    "a pose in words": (lambda: lens(to_world="front"), "to_world: expected"),
    "cameras for one image": (
        lambda: Renderer()(toy_scene()[0], [camera()]),  # type: ignore[arg-type]
        r"call batch\(scene, cameras\)",
    ),
    "a path for a scene": (
        lambda: Renderer()("a.ply", camera()),  # type: ignore[arg-type]
        "expected a GaussianScene",
    ),
    "words for cameras": (
        lambda: Renderer().batch(toy_scene()[0], "ab"),  # type: ignore[arg-type]
        "expected values of Camera",
    ),
    "images of NumPy": (
        lambda: check_images(np.zeros((1, 8, 8, 3))),  # type: ignore[arg-type]
        "expected a torch tensor",
    ),
    "images of 0 to 255": (
        lambda: check_images(torch.full((1, 8, 8, 3), 200.0)),
        "divide 8-bit values by 255",
    ),
    "a mask of fractions": (
        lambda: GaussianSubset.of(toy_scene()[0], [0.5, 0.5]),  # type: ignore[list-item]
        "mask: expected bool",
    ),
    "an empty mask": (
        lambda: GaussianSubset.of(toy_scene()[0], []),
        "at least one Gaussian",
    ),
    "half a step": (
        lambda: FitConfig(iterations=2.5),  # type: ignore[arg-type]
        r"a whole number >= 1 \(steps\), got 2.5",
    ),
    "a rate below zero": (
        lambda: FitConfig(lr_sh=-1.0),
        "lr_sh: expected a number >= 0",
    ),
    "an unknown attribute": (
        lambda: FitConfig(trainable="texture"),  # type: ignore[arg-type]
        "trainable: expected one of means",
    ),
    "two gaps for one trigger": (
        lambda: LayersConfig(attacks=("rear",), making=LayerConfig(gap=(3.0, 4.0))),
        "gap: expected one number for all, or 1, one for each trigger, got 2 numbers",
    ),
}


def attacked(**given: Any) -> object:
    usual: dict[str, Any] = {
        "objective": relabel("person"),
        "render": blobs,
        "scene": toy_scene()[0],
    } | given
    return attack(
        usual["scene"],
        ROWS,
        camera(),
        ColourDetector(),
        usual["objective"],
        render=usual["render"],
    )


@pytest.mark.parametrize("name", REFUSED)
def test_an_argument_of_another_kind_is_refused_in_one_line(name: str) -> None:
    call, words = REFUSED[name]
    with pytest.raises(MiSplatError, match=words) as caught:
        call()
    assert len(str(caught.value).splitlines()) == 1
