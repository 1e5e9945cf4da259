"""The settings of `splat_tile`: given by XML, dict, attribute or `mi.traverse`,
checked, seen by the next image.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mi_splat.cameras.framing import near_plane
from mi_splat.errors import InvalidValueError
from mi_splat.io import save_splat
from mi_splat.render import variant
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.render.scene_files import read_scene
from mi_splat.scene import GaussianScene
from tests.gaussians import varied_scene
from tests.rendering.test_plugins import dict_scene, scene_xml, two_splats

variant.use()

import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402

from mi_splat.render.plugins import sensor as sensors  # noqa: E402

SCENE = varied_scene(60, degree=1, seed=4)
DEFAULTS: dict[str, Any] = {
    "background": (0.0, 0.0, 0.0),
    "near": 0.2,
    "alpha": False,
    "linear": False,
}
CHANGED: dict[str, Any] = {
    "background": (0.1, 0.5, 0.9),
    "near": 3.0,
    "alpha": True,
    "linear": True,
}
Set = Callable[[Any, str, Any], None]


def by_attribute(loaded: Any, name: str, value: Any) -> None:
    setattr(loaded.integrator(), name, value)


def by_traverse(loaded: Any, name: str, value: Any) -> None:
    params = mi.traverse(loaded)
    params[f"integrator.{name}"] = value
    params.update()


def by_traverse_of_the_integrator(loaded: Any, name: str, value: Any) -> None:
    mi.traverse(loaded.integrator()).update({name: value})


def expected(loaded: Any, scene: GaussianScene, name: str, value: Any) -> Any:
    settings = RenderSettings(**{**DEFAULTS, name: value})
    return Renderer(settings)(scene, sensors.camera(loaded.sensors()[0]))


@pytest.mark.parametrize(
    "change", [by_attribute, by_traverse, by_traverse_of_the_integrator]
)
@pytest.mark.parametrize("name", list(CHANGED))
def test_a_change_is_seen_by_the_next_picture_and_its_gradient(
    name: str, change: Set
) -> None:
    loaded = dict_scene(SCENE)
    before = mi.render(loaded).numpy()
    change(loaded, name, CHANGED[name])
    params = mi.traverse(loaded)
    dr.enable_grad(params["splat.sh_coeffs"])
    picture = mi.render(loaded, params)
    assert (
        picture.shape != before.shape or np.abs(picture.numpy() - before).max() > 0.01
    )

    sh = SCENE.sh.clone().requires_grad_(True)
    image = expected(loaded, SCENE.replace(sh=sh), name, CHANGED[name])
    np.testing.assert_allclose(picture.numpy(), image.detach().numpy(), atol=2e-6)
    weights = np.random.default_rng(0).normal(size=picture.shape).astype(np.float32)
    dr.backward(dr.sum(picture * mi.TensorXf(weights)))
    (image * torch.from_numpy(weights)).sum().backward()
    assert sh.grad is not None
    largest = float(sh.grad.abs().max())
    gradient = dr.grad(params["splat.sh_coeffs"]).numpy().reshape(sh.shape)
    np.testing.assert_allclose(gradient, sh.grad.numpy(), atol=1e-5 * largest)

    change(loaded, name, DEFAULTS[name])
    assert np.array_equal(mi.render(loaded).numpy(), before)


def test_names_and_values_in_traverse(tmp_path: Path) -> None:
    _, shapes = two_splats(tmp_path)
    properties = (
        '<rgb name="background" value="0.25, 0.5, 0.75"/><float name="near"'
        ' value="0.5"/><boolean name="alpha" value="true"/><boolean name="linear"'
        ' value="true"/>'
    )
    with_id = scene_xml(shapes, properties).replace(
        '"splat_tile"', '"splat_tile" id="tile"'
    )
    values = {
        "background": (0.25, 0.5, 0.75),
        "near": 0.5,
        "alpha": True,
        "linear": True,
    }
    for loaded, prefix in (
        (mi.load_string(scene_xml(shapes, properties)), "integrator"),
        (mi.load_string(with_id), "tile"),
        (
            dict_scene(
                SCENE,
                **{**values, "background": {"type": "rgb", "value": [0.25, 0.5, 0.75]}},
            ),
            "integrator",
        ),
        (
            dict_scene(SCENE, **{**values, "background": [0.25, 0.5, 0.75]}),
            "integrator",
        ),
    ):
        params = mi.traverse(loaded)
        integrator = loaded.integrator()
        for name, value in values.items():
            assert getattr(integrator, name) == value
            shown = np.ravel(np.array(params[f"{prefix}.{name}"]))
            assert shown.tolist() == np.array(value).ravel().tolist()
            assert params.flags(f"{prefix}.{name}") & mi.ParamFlags.NonDifferentiable


WRONG = [
    ("near", 0.0, "a positive distance"),
    ("near", float("nan"), "a positive distance"),
    ("near", [1.0, 2.0], "a positive distance"),
    ("background", [0.0, float("inf"), 0.0], "three finite numbers"),
]


@pytest.mark.parametrize(("name", "value", "reason"), WRONG)
def test_wrong_values_are_refused_and_the_old_ones_stay(
    name: str, value: Any, reason: str
) -> None:
    loaded = dict_scene(SCENE)
    before = mi.render(loaded).numpy()
    old = getattr(loaded.integrator(), name)
    params = mi.traverse(loaded)
    with pytest.raises(InvalidValueError, match=reason):
        setattr(loaded.integrator(), name, value)
    with pytest.raises(InvalidValueError, match=reason):
        params.update({f"integrator.{name}": value})
    assert getattr(loaded.integrator(), name) == old
    assert np.ravel(np.array(params[f"integrator.{name}"])).tolist() == pytest.approx(
        np.array(old).ravel().tolist()
    )
    assert np.array_equal(mi.render(loaded).numpy(), before)


def test_of_several_values_all_are_taken_or_none() -> None:
    loaded = dict_scene(SCENE)
    params = mi.traverse(loaded)
    with pytest.raises(InvalidValueError, match="a positive distance"):
        params.update(
            {"integrator.background": [1.0, 1.0, 1.0], "integrator.near": -1.0}
        )
    assert loaded.integrator().background == DEFAULTS["background"]
    params.update({"integrator.background": [1.0, 1.0, 1.0], "integrator.near": 1.0})
    assert (loaded.integrator().background, loaded.integrator().near) == (
        (1.0, 1.0, 1.0),
        1.0,
    )


def test_near_without_a_value_follows_the_scene_as_read_scene_does(
    tmp_path: Path,
) -> None:
    small = SCENE.replace(means=0.02 * SCENE.means, scales=0.02 * SCENE.scales)
    save_splat(small, tmp_path / "a.ply")
    shape = (
        '<shape type="gaussians" id="car"><string name="filename"'
        ' value="a.ply"/></shape>'
    )
    for properties, near in (("", None), ('<float name="near" value="0.2"/>', 0.2)):
        (tmp_path / "scene.xml").write_text(scene_xml(shape, properties))
        values = read_scene(tmp_path / "scene.xml")
        loaded = mi.load_file(str(tmp_path / "scene.xml"))
        mi.render(loaded)
        if near is None:
            expected = near_plane(values.scene, list(values.cameras.values()))
        else:
            expected = near
        assert values.settings.near == expected
        assert loaded.integrator().near == pytest.approx(expected)
        assert (expected < 0.02) == (near is None)
