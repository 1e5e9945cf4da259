"""`gaussians` and `splat_tile` through Mitsuba's own front door: XML, dicts, traverse,
render, gradients, errors.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mi_splat import oracle
from mi_splat.errors import InvalidValueError
from mi_splat.io import save_splat
from mi_splat.io.errors import SplatFileWarning
from mi_splat.render import variant
from mi_splat.render.renderer import Renderer
from mi_splat.scene import GaussianScene, Similarity, merge
from tests.gaussians import varied_scene

variant.use()

import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402

from mi_splat.render.plugins import sensor as sensors  # noqa: E402
from mi_splat.render.plugins.shape import shape_dict  # noqa: E402

FILM = '<integer name="width" value="61"/><integer name="height" value="43"/>'
CROP = (
    '<integer name="crop_width" value="20"/><integer name="crop_height" value="30"/>'
    '<integer name="crop_offset_x" value="7"/><integer name="crop_offset_y" value="5"/>'
)


def sensor_xml(name: str, film: str) -> str:
    return f"""<sensor type="perspective" id="{name}">
      <float name="fov" value="40"/><string name="fov_axis" value="y"/>
      <float name="principal_point_offset_x" value="0.1"/>
        <float name="principal_point_offset_y" value="-0.05"/>
      <transform name="to_world">
        <lookat origin="3, 1, 1" target="0, 0, 0" up="0, 0, 1"/></transform>
      <film type="hdrfilm">{film}</film></sensor>"""


def scene_xml(shapes: str, properties: str = "") -> str:
    sensor = sensor_xml("whole", FILM) + sensor_xml("crop", FILM + CROP)
    return (
        '<scene version="3.0.0"><integrator'
        f' type="splat_tile">{properties}</integrator>{shapes}{sensor}</scene>'
    )


def two_splats(folder: Path) -> tuple[GaussianScene, str]:
    """Two splats of different SH degree as files, and the shapes that name them."""
    first = varied_scene(80, degree=2, seed=1)
    second = varied_scene(50, degree=1, seed=2)
    save_splat(first, folder / "a.ply")
    save_splat(second, folder / "b.ply")
    shapes = "".join(
        f'<shape type="gaussians" id="{name}"><string name="filename"'
        f' value="{folder / file}"/></shape>'
        for name, file in (("car", "a.ply"), ("street", "b.ply"))
    )
    return merge(first, second), shapes


def test_crop_window_shows_the_same_pixels(tmp_path: Path) -> None:
    _, shapes = two_splats(tmp_path)
    loaded = mi.load_string(scene_xml(shapes))
    whole = np.array(mi.render(loaded))
    crop = np.array(mi.render(loaded, sensor=1))
    assert crop.shape == (30, 20, 3)
    np.testing.assert_allclose(crop, whole[5:35, 7:27], atol=1e-4)


def dict_scene(scene: GaussianScene, **integrator: Any) -> Any:
    sensor = mi.load_string(scene_xml("")).sensors()[0]
    parts = {
        "integrator": {"type": "splat_tile", **integrator},
        "splat": shape_dict(scene),
        "sensor": sensor,
    }
    return mi.load_dict({"type": "scene", **parts})


def test_gradients_are_the_renderers() -> None:
    scene = varied_scene(60, degree=2, seed=1)
    loaded = dict_scene(scene)
    params = mi.traverse(loaded)
    keys = [f"splat.{key}" for key in ("data", "opacities", "sh_coeffs")]
    for key in keys:
        dr.enable_grad(params[key])
    picture = mi.render(loaded, params)
    weights = np.random.default_rng(0).normal(size=picture.shape).astype(np.float32)
    dr.backward(dr.sum(picture * mi.TensorXf(weights)))
    data, opacities, sh = (np.array(dr.grad(params[key])) for key in keys)

    leaves = [tensor.clone().requires_grad_(True) for tensor in scene.tensors()]
    image = Renderer()(GaussianScene(*leaves), sensors.camera(loaded.sensors()[0]))
    (image * torch.from_numpy(weights)).sum().backward()  # type: ignore[no-untyped-call]
    expected = [leaf.grad.numpy() for leaf in leaves if leaf.grad is not None]
    rows = data.reshape(60, 10)
    for got, want in (
        (rows[:, :3], expected[0]),
        (rows[:, 3:6], expected[1]),
        (rows[:, [9, 6, 7, 8]], expected[2]),
        (opacities, expected[3]),
        (sh.reshape(60, 9, 3), expected[4]),
    ):
        np.testing.assert_allclose(
            got, want, rtol=1e-3, atol=1e-4 * float(np.abs(want).max())
        )


@pytest.mark.parametrize("name", ["x_fov", "principal_point_offset_x", "to_world"])
def test_a_sensor_that_moves_is_read_again(name: str) -> None:
    scene = varied_scene(60, degree=1, seed=4)
    loaded = dict_scene(scene)
    before = np.array(mi.render(loaded))
    params = mi.traverse(loaded.sensors()[0])
    if name == "to_world":
        params[name] = mi.Transform4f().translate([0.2, 0.1, 0.0]) @ params[name]
    else:
        params[name] = params[name] * 0.9 + 0.05
    params.update()
    after = np.array(mi.render(loaded))
    assert np.abs(after - before).max() > 0.01
    camera = sensors.camera(loaded.sensors()[0])
    reference = oracle.render(scene, camera).image
    np.testing.assert_allclose(after, reference, atol=1e-4)


def test_to_world_moves_and_turns_the_splat(tmp_path: Path) -> None:
    scene = varied_scene(60, degree=3, seed=1)
    save_splat(scene, tmp_path / "a.ply")
    shape = (
        '<shape type="gaussians" id="car"><string name="filename"'
        f' value="{tmp_path / "a.ply"}"/><transform name="to_world"><rotate z="1"'
        ' angle="50"/><scale value="0.5"/><translate x="0.3"/></transform></shape>'
    )
    loaded = mi.load_string(scene_xml(shape))
    angle = np.radians(50.0)
    turn = torch.tensor(
        [
            [np.cos(angle), -np.sin(angle), 0.0],
            [np.sin(angle), np.cos(angle), 0.0],
            [0.0, 0.0, 1.0],
        ]
    )
    moved = scene.transform(
        Similarity(rotation=turn, translation=torch.tensor([0.3, 0.0, 0.0]), scale=0.5)
    )
    expected = Renderer()(moved, sensors.camera(loaded.sensors()[0]))
    np.testing.assert_allclose(np.array(mi.render(loaded)), expected.numpy(), atol=2e-4)


def test_forward_mode_is_refused_in_words() -> None:
    loaded = dict_scene(varied_scene(10, degree=0, seed=1))
    params = mi.traverse(loaded)
    shift = mi.Float(0.0)
    dr.enable_grad(shift)
    params["splat.opacities"] = params["splat.opacities"] + shift
    params.update()
    picture = mi.render(loaded, params)
    with pytest.raises((InvalidValueError, RuntimeError)) as caught:
        dr.forward_to(picture)
    causes = [caught.value, caught.value.__cause__]
    assert any("reverse-mode" in str(cause) for cause in causes)


def test_what_cannot_be_rendered_is_said() -> None:
    sensor = {
        "type": "perspective",
        "film": {"type": "hdrfilm", "width": 4, "height": 4},
    }
    parts = {
        "type": "scene",
        "splat": shape_dict(varied_scene(5, degree=0, seed=0)),
        "sensor": sensor,
    }
    beside = mi.load_dict(
        {
            "integrator": {"type": "splat_tile"},
            "ball": {"type": "sphere", "id": "ball"},
            **parts,
        }
    )
    with pytest.raises(
        InvalidValueError,
        match='gaussians shapes only, got also ball; use the integrator "splat_ray"',
    ):
        mi.render(beside)
    shells = mi.load_dict({"integrator": {"type": "path"}, **parts})
    with pytest.warns(
        SplatFileWarning,
        match="PathIntegrator, which shows them as grey shells; use splat_tile",
    ):
        mi.render(shells, spp=1)
