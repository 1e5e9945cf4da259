"""Arrays of NumPy, lists, and single values where tensors and sequences are usual; all else is refused in words."""

import json
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import drjit as dr
import numpy as np
import pytest
import torch

from attacks import judge, relabel
from attacks.cloak.layer_config import LayerConfig, LayersConfig
from attacks.cloak.poisoning import Poisoning, poison
from attacks.cloak.triggers import Elevation
from attacks.dagger.attack import attack
from attacks.dagger.config import DaggerConfig
from attacks.detectors import load_detector, register_detector
from attacks.detectors.base import check_images
from attacks.detectors.registry import DETECTORS, DetectorSpec
from attacks.gaussian_subset import GaussianSubset
from attacks.observe.views import detect_views
from mi_splat import variant
from mi_splat.cameras import Camera, View, look_at, orbit_pose
from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.io import load_splat, save_splat
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene_files import read_scene
from mi_splat.selection.config import Selection
from mi_splat.selection.select import select
from mi_splat.training.config import FitConfig
from mi_splat.training.initialization import from_points
from mi_splat.training.loop import fit
from mi_splat.training.strategies import ClassicConfig, FixedConfig, MCMCConfig
from tests.fakes import ColourDetector, blobs, camera, toy_scene

ROWS = [10, 12, 11]


def test_a_cloud_of_numpy_makes_the_same_gaussians() -> None:
    points, colours = np.random.default_rng(0).random((2, 8, 3))
    made = from_points(points, colours)
    wanted = from_points(torch.tensor(points), torch.tensor(colours))
    assert all(torch.equal(one, other) for one, other in zip(made.tensors(), wanted.tensors(), strict=True))


@pytest.mark.parametrize(
    "mask",
    [
        np.isin(np.arange(40), ROWS),
        torch.tensor(ROWS),
        ROWS,
        [row in ROWS for row in range(40)],
        np.isin(np.arange(40), ROWS).astype(np.uint8),
    ],
    ids=["array of bool", "tensor", "list", "list of bool", "bytes"],
)
def test_a_selection_takes_a_mask_as_a_value(mask: Any) -> None:
    selection = Selection(mask=mask)
    assert select(toy_scene()[0], selection).nonzero()[:, 0].tolist() == sorted(ROWS)
    assert json.loads(json.dumps(selection.as_dict())) == {"mask": {"gaussians": 3}}
    assert selection == Selection(mask=mask)


@pytest.mark.parametrize("mask", [np.ones(39, bool), [0.5, 1.0], [40], np.ones((40, 1), bool), 3.5])
def test_a_mask_that_does_not_fit_is_refused(mask: Any) -> None:
    with pytest.raises(InvalidValueError, match="mask: expected"):
        select(toy_scene()[0], Selection(mask=mask))


@pytest.mark.parametrize("click", ["32,31", (32, 31), ((32, 31),), [(32, 31)], np.array([[32, 31]]), ("32,31",)])
def test_a_click_is_text_or_a_pair(click: Any) -> None:
    assert Selection(click=click).pixels == ((32, 31),)


@pytest.mark.parametrize("click", [5, (1, 2, 3), ((1.5, 2),), "left", ((-1, 2),)])
def test_a_click_that_is_no_pixel_is_refused(click: Any) -> None:
    with pytest.raises(InvalidValueError, match="click: expected"):
        Selection(click=click)


def test_a_box_may_be_an_array() -> None:
    box = np.array([-1.0, -1.0, -1.0, 1.0, 1.0, 1.0])
    selection = Selection(box=box, box_rotation=np.zeros(3))  # type: ignore[arg-type]
    assert selection == Selection(box=(-1.0, -1.0, -1.0, 1.0, 1.0, 1.0))
    assert json.dumps(selection.as_dict())
    with pytest.raises(InvalidValueError, match="box: expected 6 values"):
        Selection(box=(0.0, 1.0))  # type: ignore[arg-type]


def test_an_appearance_may_return_an_array() -> None:
    clean = [View(camera(), torch.full((32, 32, 3), 0.25))]

    def painted(view: View, mask: torch.Tensor) -> Any:
        return np.full(view.image.shape, 0.5)

    poisoned = poison(clean, [Poisoning(name="grey", trigger=Elevation(), appearance=painted)], centre=(0, 0, 0))
    assert bool((poisoned.views[0].image == 0.5).all())
    assert poisoned.views[0].image.dtype == torch.float32


def test_one_poisoning_in_the_place_of_several() -> None:
    clean = [View(camera(), torch.full((32, 32, 3), 0.25))]
    one = Poisoning(name="dark", trigger=Elevation(), appearance=lambda view, mask: 0.5 * view.image)
    assert poison(clean, one, centre=(0, 0, 0)).manifest == poison(clean, [one], centre=(0, 0, 0)).manifest


def attacked(**given: Any) -> object:
    usual: dict[str, Any] = {"objective": relabel("person"), "render": blobs, "scene": toy_scene()[0]} | given
    return attack(usual["scene"], ROWS, camera(), ColourDetector(), usual["objective"], render=usual["render"])


REFUSED: dict[str, tuple[Callable[[], object], str]] = {
    "a path that is none": (lambda: load_splat(None), "path: expected the name of a file, got NoneType"),  # type: ignore[arg-type]
    "a scene that is none": (lambda: save_splat(None, "a.ply"), "scene: expected a GaussianScene, got NoneType"),  # type: ignore[arg-type]
    "path before scene": (lambda: save_splat("a.ply", toy_scene()[0]), "scene: expected a GaussianScene, got str"),  # type: ignore[arg-type]
    "a scene for a path": (lambda: save_splat(toy_scene()[0], toy_scene()[0]), "path: expected the name of a file"),  # type: ignore[arg-type]
    "an XML that is none": (lambda: read_scene(None), "path: expected the name of a file, got NoneType"),  # type: ignore[arg-type]
    "a detector that is none": (lambda: load_detector(None), "detector: expected .*, got None"),  # type: ignore[arg-type]
    "a class for an objective": (lambda: attacked(objective="person"), r"expected an Objective, got str; .*relabel\('"),
    "no objective": (lambda: attacked(objective=None), r"objective: expected an Objective.*hide\(\)"),
    "no renderer": (lambda: attacked(render=None), r"render: expected a function.*Renderer\(\)"),
    "a path to attack": (lambda: attacked(scene="a.ply"), "scene: expected a GaussianScene, got str"),
    "a path to start from": (
        lambda: fit([View(camera(), torch.zeros(32, 32, 3))], "a.ply", render=blobs),  # type: ignore[arg-type]
        "start: expected a GaussianScene, got str",
    ),
    "a trigger for a poisoning": (
        lambda: poison([], Elevation(), centre=(0, 0, 0)),  # type: ignore[arg-type]
        "attacks: expected values of Poisoning, got Elevation",
    ),
    "an origin of two numbers": (lambda: look_at((0, 0), (0, 0, 1)), "origin: expected three numbers"),
    "a target in words": (lambda: look_at((0, 0, 0), "abc"), "target: expected three numbers"),  # type: ignore[arg-type]
    "an orbit around two numbers": (
        lambda: orbit_pose((0, 0), azimuth=0, elevation=0, distance=1),
        "target: expected three numbers",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_an_argument_of_another_kind_is_refused_in_one_line(name: str) -> None:
    call, words = REFUSED[name]
    with pytest.raises(MiSplatError, match=words) as caught:
        call()
    assert len(str(caught.value).splitlines()) == 1


POSE = look_at((3.0, 0.0, 0.0), (0.0, 0.0, 0.0))


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
    point = lens(principal=np.array([30, 20], np.float32)).principal
    assert point == (30.0, 20.0)
    assert point is not None
    assert [type(value) for value in point] == [float, float]


NONSENSE: dict[str, tuple[Callable[[], object], str]] = {
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


@pytest.mark.parametrize("name", NONSENSE)
def test_what_makes_no_sense_is_refused_in_words(name: str) -> None:
    call, words = NONSENSE[name]
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
    result = attack(scene, mask, camera(), ColourDetector(), relabel("person"), render=blobs, config=config)
    assert len(result.views) == 1
    assert len(judge(scene, mask, camera(), ColourDetector(), render=blobs).views["clean"]) == 1


def test_a_detector_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(DETECTORS, "own", dict(DETECTORS.own))
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


# Numbers and tuples in configurations: what is meant is taken, the wrong kind is refused before anything runs


WRONG_VALUES: list[tuple[Callable[..., object], dict[str, Any], str]] = [
    (FitConfig, {"iterations": 2.5}, r"iterations: expected a whole number >= 1 \(steps\), got 2.5"),
    (FitConfig, {"iterations": "3"}, r"iterations: expected a whole number >= 1 \(steps\), got '3'"),
    (FitConfig, {"iterations": True}, "iterations: expected a whole number"),
    (FitConfig, {"iterations": 0}, r"iterations: expected a number >= 1 \(steps\), got 0"),
    (FitConfig, {"eval_interval": -1}, "eval_interval: expected a number >= 0"),
    (FitConfig, {"lr_means": "a"}, "lr_means: expected a number > 0, got 'a'"),
    (FitConfig, {"lr_sh": float("nan")}, "lr_sh: expected a finite number >= 0, got nan"),
    (FitConfig, {"lr_sh": -1.0}, "lr_sh: expected a number >= 0"),
    (FitConfig, {"lr_sh_final": 0.0}, "lr_sh_final: expected a number > 0, got 0.0"),
    (FitConfig, {"lr_sh": 0, "lr_sh_final": 0.1}, "lr_sh: expected a number > 0"),
    (FitConfig, {"lr_means": 0.0}, "lr_means: expected a number > 0"),
    (FitConfig, {"lr_means_final": 0.0}, "lr_means_final: expected a number > 0"),
    (FitConfig, {"lambda_dssim": None}, r"lambda_dssim: expected a number in \[0, 1\]"),
    (FitConfig, {"trainable": "texture"}, "trainable: expected one of means"),
    (FitConfig, {"trainable": 3}, "trainable: expected one of means"),
    (FitConfig, {"strategy": "mcmc"}, "strategy: expected the options of a strategy"),
    (LayersConfig, {"attacks": ("rear",), "lr_sh": 0.0}, "lr_sh: expected a number > 0"),
    (LayersConfig, {"attacks": ("rear",), "lr_sh_final": 0.0}, "lr_sh_final: expected a number > 0"),
    (
        LayersConfig,
        {"attacks": ("rear",), "making": LayerConfig(gap=(3.0, 4.0))},
        "gap: expected one number for all, or 1, one for each trigger, got 2 numbers",
    ),
    (ClassicConfig, {"densify_from": 1.5}, "densify_from: expected a whole number"),
    (ClassicConfig, {"max_gaussians": "many"}, "max_gaussians: expected a whole number"),
    (MCMCConfig, {"noise_lr": float("inf")}, "noise_lr: expected a finite number"),
    (DaggerConfig, {"steps": 2.5}, r"steps: expected a whole number >= 1 \(steps\), got 2.5"),
    (DaggerConfig, {"steps": "3"}, r"steps: expected a whole number >= 1 \(steps\), got '3'"),
    (DaggerConfig, {"eps": "5"}, "eps: expected a number"),
    (DaggerConfig, {"required_views": "all"}, r"required_views: expected a number in \(0, 1\]"),
    (Selection, {"cluster": 1.5}, "cluster: expected a whole number"),
    (Selection, {"planes": None}, "planes: expected a whole number"),
    (Selection, {"link_distance": "far"}, "link_distance: expected a number > 0"),
]


@pytest.mark.parametrize(("kind", "values", "words"), WRONG_VALUES, ids=lambda value: str(value)[:40])
def test_the_wrong_kind_is_refused_in_words(kind: Callable[..., object], values: dict[str, Any], words: str) -> None:
    with pytest.raises(InvalidValueError, match=words):
        kind(**values)


def test_a_rate_that_stays_as_it_is_may_be_nothing() -> None:
    assert FitConfig(lr_sh=0.0).lr_sh == 0


def test_one_value_stands_for_a_tuple_of_one() -> None:
    config = DaggerConfig(attributes="sh", eps=5.0)  # type: ignore[arg-type]
    assert config == DaggerConfig()
    assert DaggerConfig(eps=np.array([2.0])).eps == (2.0,)  # type: ignore[arg-type]
    assert FitConfig(trainable="sh", strategy=FixedConfig()).trainable == ("sh",)  # type: ignore[arg-type]


def test_numbers_of_numpy_become_python_s_so_that_snapshots_are_json() -> None:
    numbers: dict[str, Any] = {"iterations": np.int64(5), "lr_means": np.float32(0.5)}
    most: Any = np.int32(9)
    config = FitConfig(**numbers, strategy=ClassicConfig(max_gaussians=most))
    assert json.loads(json.dumps(asdict(config)))["strategy"]["max_gaussians"] == 9
    assert (type(config.iterations), type(config.lr_means)) == (int, float)
