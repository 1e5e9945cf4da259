"""Methods by name, folders of images, and the comparison of a few of them on
fakes.
"""

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from mi_splat.cameras.camera import Camera, RenderFn
from mi_splat.comparison import methods
from mi_splat.comparison.compare import (
    FORWARD,
    GAP,
    GRADIENT,
    CompareConfig,
    as_dict,
    compare,
    save_sheets,
    sheet,
)
from mi_splat.comparison.methods import Method, load_methods, register_method
from mi_splat.datasets import DatasetError
from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.scene import GaussianScene
from tests.fakes import blobs, camera, toy_scene

SCENE = toy_scene()[0]
CAMERAS = {"left": camera(24, offset=-0.4), "right": camera(24, offset=0.4)}
QUICK = CompareConfig(rounds=0)


def darker(scene: GaussianScene, camera: Camera) -> Tensor:
    return 0.9 * blobs(scene, camera)


def beside_blobs(render: RenderFn) -> None:
    """Compare a renderer that makes no image."""
    compare(
        SCENE,
        CAMERAS,
        {"good": Method(render=blobs), "bad": Method(render=render)},
        config=QUICK,
    )


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    """`blobs` and `darker` beside the project's own methods."""
    monkeypatch.setattr(methods.RENDERERS, "own", dict(methods.RENDERERS.own))
    register_method("blobs", lambda settings: blobs)
    register_method("darker", lambda settings: darker, differentiable=False)


def test_one_function_lets_a_renderer_join(registered: None) -> None:
    methods = load_methods(("blobs, darker",), RenderSettings(), CAMERAS)
    assert list(methods) == ["blobs", "darker"]
    assert (methods["blobs"].differentiable, methods["darker"].differentiable) == (
        True,
        False,
    )


def test_a_scene_s_own_filter_does_not_change_what_a_name_means() -> None:
    settings = RenderSettings(antialiased=True, background=(0.5, 0.0, 0.0), near=0.4)
    methods = load_methods(
        ("tile", "tile-antialiased", "ray", "ray-to-mean"), settings, CAMERAS
    )
    made = [
        method.render.settings
        for method in methods.values()
        if isinstance(method.render, Renderer)
    ]
    assert [(one.method, one.antialiased, one.colour_to_mean) for one in made] == [
        ("tile", False, False),
        ("tile", True, False),
        ("ray", False, False),
        ("ray", False, True),
    ]
    assert {(one.background, one.near) for one in made} == {((0.5, 0.0, 0.0), 0.4)}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ("blobs", "unheard"),
            (
                r"expected one of tile, .* ray, ray-to-mean, volprim, blobs, darker, or"
                r" folder:PATH"
            ),
        ),
        (("blobs",), "expected two or more, got blobs"),
        (("blobs", "folder:nowhere"), "a folder of images, got none"),
    ],
)
def test_methods_that_are_refused(
    words: tuple[str, ...], message: str, registered: None
) -> None:
    with pytest.raises(InvalidValueError, match=message):
        load_methods(words, RenderSettings(), CAMERAS)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: register_method("tile", lambda settings: blobs),
            "a name that is free",
        ),
        (lambda: register_method("a,b", lambda settings: blobs), "a letter first"),
        (
            lambda: load_methods(
                ("volprim", "tile"), RenderSettings(background=(1.0, 1.0, 1.0)), CAMERAS
            ),
            "a black",
        ),
        (
            lambda: compare(SCENE, CAMERAS, {"one": Method(render=blobs)}),
            "methods: expected 2 or more",
        ),
        (
            lambda: compare(
                SCENE, {}, {"a": Method(render=blobs), "b": Method(render=blobs)}
            ),
            "cameras: expected 1",
        ),
        (
            lambda: beside_blobs(lambda *shot: blobs(*shot)[:-1]),
            r"\(23, 24, 3\), 0 values not finite",
        ),
        (
            lambda: beside_blobs(lambda *shot: blobs(*shot) * float("nan")),
            "1728 values not finite",
        ),
    ],
)
def test_what_is_refused(call: Any, message: str) -> None:
    with pytest.raises(MiSplatError, match=message):
        call()


def test_what_differs_is_measured_and_what_cannot_be_is_null() -> None:
    several = {
        "files": Method(render=darker, differentiable=False, renders=False, bits=8),
        "blobs": Method(render=blobs),
        "dark": Method(render=darker),
    }
    document = as_dict(
        compare(SCENE, CAMERAS, several, config=CompareConfig(rounds=2)), several
    )
    pairs = {tuple(pair["methods"]): pair for pair in document["pairs"]}
    assert pairs["files", "dark"]["psnr"] is None
    assert (pairs["files", "dark"]["bits"], pairs["files", "dark"]["gradients"]) == (
        8,
        None,
    )
    assert 15 < pairs["blobs", "dark"]["psnr"] < 45
    for one in pairs["blobs", "dark"]["gradients"].values():
        assert one["cosine"] == pytest.approx(1.0, abs=1e-6)
        assert one["relative_error"] == pytest.approx(0.1, rel=1e-3)
    costs = document["methods"]
    assert (costs["files"][FORWARD], costs["files"][GRADIENT]) == (None, None)
    assert costs["blobs"][FORWARD]["ratio"] == 1.0  # the first that renders
    assert len(costs["dark"][GRADIENT]["rounds"]) == 2


def test_a_folder_with_the_same_pictures_is_equal(
    tmp_path: Path, registered: None
) -> None:
    seen = {name: {"blobs": blobs(SCENE, view)} for name, view in CAMERAS.items()}
    save_sheets(seen, tmp_path)
    given = ("blobs", f"folder:{tmp_path / 'pictures' / 'blobs'}")
    with pytest.raises(InvalidValueError, match="blobs twice"):
        load_methods(given, RenderSettings(), CAMERAS)
    folder = (tmp_path / "pictures" / "blobs").rename(tmp_path / "theirs")
    methods = load_methods(("blobs", f"folder:{folder}"), RenderSettings(), CAMERAS)
    pair = compare(SCENE, CAMERAS, methods, config=QUICK).pairs["blobs", "theirs"]
    assert (pair.bits, pair.whole.mse, pair.agreement) == (8, 0.0, None)
    with pytest.raises(
        InvalidValueError, match="camera: expected one of left, right, got another"
    ):
        methods["theirs"].render(SCENE, camera(24))


def test_a_folder_that_lacks_a_picture_or_has_another_size(tmp_path: Path) -> None:
    with pytest.raises(
        DatasetError, match=r"left\.png for the camera left, got an empty folder"
    ):
        load_methods(("tile", f"folder:{tmp_path}"), RenderSettings(), CAMERAS)
    save_sheets({"left": {"x": blobs(SCENE, camera(24))}}, tmp_path)
    folder = tmp_path / "pictures" / "x"
    with pytest.raises(
        DatasetError, match=r"right\.png for the camera right, got none among left\.png"
    ):
        load_methods(("tile", f"folder:{folder}"), RenderSettings(), CAMERAS)
    save_sheets({"right": {"x": blobs(SCENE, camera(12))}}, tmp_path)
    with pytest.raises(DatasetError, match="expected 24 x 24 pixels, got 12 x 12"):
        load_methods(("tile", f"folder:{folder}"), RenderSettings(), CAMERAS)


def test_a_sheet_shows_methods_and_differences() -> None:
    flat = {
        name: torch.full((4, 8, 3), value)
        for name, value in (("a", 0.5), ("b", 0.45), ("c", 0.5))
    }
    drawn = sheet(flat, factor=4)
    assert drawn.shape == (2 * 128 + GAP, 3 * 256 + 2 * GAP, 3)
    corners = drawn[[127, -1]][:, [255, 515, -1], 0]
    assert corners.tolist() == [[128, 115, 128], [51, 0, 51]]  # 4 * 0.05 * 255
