"""Capture: exact cameras, tight boxes, determinism, the caller's variant, XML scenes,
bad input.
"""

import math
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch

from mi_splat.cameras.camera import Camera, look_at, orbit_pose, project_points
from mi_splat.cameras.lens import Lens
from mi_splat.capture import mitsuba_scene, path_tracer
from mi_splat.capture.daylight import Light
from mi_splat.capture.mesh import Asset, Mesh, skin
from mi_splat.capture.mitsuba_scene import corner_normals, scene_dict
from mi_splat.capture.path_tracer import (
    FEW_PICTURES,
    MANY_PICTURES,
    PathTracer,
    tracing_variant,
)
from mi_splat.errors import InvalidValueError
from mi_splat.maths.metrics import psnr
from scenes.recipes.mesh_views import capture, depth_maps
from scenes.recipes.objects.primitives import box, ellipsoid, quad, sheet

EVEN = Light(
    sun_strength=0.0, sky_strength=1.0, zenith=(1, 1, 1), horizon=(1, 1, 1), clouds=0.0
)
CUBE = Asset("car", (box((1, 1, 1), (0.8, 0.1, 0.1), centre=(0, 0, 0.5)),))
FLOOR = Asset(
    "ground", (quad([[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]], (0.5, 0.5, 0.5)),)
)


def camera(
    *,
    size: tuple[int, int] = (64, 48),
    principal: tuple[float, float] | None = None,
    elevation: float = 25.0,
) -> Camera:
    pose = orbit_pose((0, 0, 0.5), azimuth=30, elevation=elevation, distance=4)
    return Camera(to_world=pose, lens=Lens(focal=60.0, size=size, principal=principal))


@pytest.mark.parametrize(
    ("size", "principal"), [((64, 48), (40.5, 15.0)), ((33, 70), None)]
)
def test_points_land_on_projected_pixels(
    size: tuple[int, int], principal: tuple[float, float] | None
) -> None:
    spots = torch.tensor(
        [[0.8, 0.0, 0.2], [-0.5, 0.7, 0.9], [0.0, -0.6, 1.1], [0.1, 0.1, 0.0]]
    )
    view = camera(size=size, principal=principal)
    pixels, depth = project_points(spots, view)
    for spot, pixel, far in zip(spots, pixels, depth, strict=True):
        ball = Asset(
            "ball", (ellipsoid((0.3, 0.3, 0.3), (1, 1, 1), centre=spot.tolist()),)
        )
        hits = depth_maps(scene_dict([ball]), [view])[0]
        rows, columns = torch.nonzero(hits > 0, as_tuple=True)
        middle = torch.tensor([columns.float().mean() + 0.5, rows.float().mean() + 0.5])
        assert (middle - pixel).abs().max() < 0.5, (spot, middle, pixel)
        near = hits[hits > 0].min()
        assert near == pytest.approx(
            float((spot - view.position.float()).norm()) - 0.15, abs=0.02
        ), far


def test_picture_is_neither_mirrored_nor_upside_down() -> None:
    texture = np.zeros((2, 2, 3), np.float32)
    texture[0, 0], texture[0, 1], texture[1, 0] = (1, 0, 0), (0, 1, 0), (0, 0, 1)
    board = Asset(
        "board", (quad([[1, -1, 0], [1, 1, 0], [1, 1, 2], [1, -1, 2]], texture),)
    )
    view = Camera(
        to_world=look_at((5, 0, 1), (0, 0, 1)), lens=Lens(focal=64.0, size=(32, 32))
    )
    picture = capture(scene_dict([board], light=EVEN), [view], samples=16)[0].image
    # the texture's first row is at the top, its first column on the left
    assert picture[4, 4].argmax() == 0
    assert picture[4, 27].argmax() == 1
    assert picture[27, 4].argmax() == 2
    assert picture[24, 24].max() < 0.2


def test_variant_is_put_back() -> None:
    before = mi.variant()
    mi.set_variant("llvm_ad_rgb")
    try:
        capture(scene_dict([CUBE]), [camera()], samples=1)
        assert mi.variant() == "llvm_ad_rgb"
        with pytest.raises(RuntimeError), tracing_variant():
            raise RuntimeError
        assert mi.variant() == "llvm_ad_rgb"
    finally:
        if before is not None:
            mi.set_variant(before)


def test_scene_file(tmp_path: Path) -> None:
    file = tmp_path / "ball.xml"
    file.write_text(
        '<scene version="3.0.0"><integrator type="direct"/><emitter'
        ' type="constant"/><shape type="sphere"><point name="center" x="0" y="0"'
        ' z="0.5"/><float name="radius" value="0.5"/><bsdf type="diffuse"><rgb'
        ' name="reflectance" value="0, 0, 0"/></bsdf></shape></scene>'
    )
    picture = capture(file, [camera(size=(33, 33))], samples=4)[0].image
    assert picture[16, 16].max() == 0
    assert picture[0, 0].min() == 1


def test_normals_are_smooth_on_a_ball_and_sharp_on_a_box() -> None:
    ball = ellipsoid((2, 2, 2), (1, 1, 1), segments=40)
    normals = corner_normals(ball)
    assert np.abs(normals - ball.vertices[ball.faces]).max() < 0.08
    flat = corner_normals(CUBE.meshes[0])
    assert np.allclose(np.abs(flat).max(-1), 1)
    ramp = sheet(
        np.array(
            [[[0, 0, 0], [1, 0, 0]], [[0, 1, 0], [1, 1, 0]], [[0, 2, 1.2], [1, 2, 1.2]]]
        ),
        (1.0, 1.0, 1.0),
    )
    bend = math.degrees(math.atan(1.2))
    # sharper than the crease angle, so the two halves keep their own normals
    assert bend > 38
    assert np.allclose(
        sorted(set(np.round(corner_normals(ramp)[..., 2].ravel(), 4))),
        [np.cos(np.radians(bend)), 1],
        atol=1e-3,
    )


def test_a_picture_is_the_same_on_any_threads_and_close_in_the_other_variant() -> None:
    pictures = {}
    before = dr.thread_count()
    for variant in (FEW_PICTURES, MANY_PICTURES):
        with tracing_variant(variant):
            tracer = PathTracer(scene_dict([CUBE], backdrop=FLOOR), samples=16)
        # in its own variant, whatever is set now
        pictures[variant] = tracer.picture(camera(), seed=3)
    try:
        dr.set_thread_count(1)
        assert torch.equal(tracer.picture(camera(), seed=3), pictures[MANY_PICTURES])
    finally:
        dr.set_thread_count(before)
    means = [picture.mean((0, 1)) for picture in pictures.values()]
    torch.testing.assert_close(*means, rtol=0, atol=2e-3)
    assert not torch.equal(*pictures.values())


def test_a_large_picture_is_traced_in_bands(monkeypatch: pytest.MonkeyPatch) -> None:
    tracer = PathTracer(scene_dict([CUBE], backdrop=FLOOR), samples=64)
    whole = tracer.picture(camera(), seed=0)
    monkeypatch.setattr(path_tracer, "AT_ONCE", 32 * 24 * camera().width)
    banded = tracer.picture(camera(), seed=0)
    assert not torch.equal(whole, banded)
    assert psnr(whole, banded) > 30


def fan(count: int, *, smooth: bool = True) -> Mesh:
    """Triangles that all meet at the origin."""
    angles = np.linspace(0, np.pi, count + 1)
    rim = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    order = np.arange(1, count + 1)
    faces = np.stack([0 * order, order, order + 1], axis=1)
    vertices = np.concatenate([np.zeros((1, 3)), rim])
    return Mesh(
        vertices.astype(np.float32),
        faces.astype(np.uint32),
        np.zeros((len(vertices), 2), np.float32),
        skin(0.5),
        smooth=smooth,
    )


def test_normals_are_the_same_in_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    ball = ellipsoid((1, 2, 3), (0.5, 0.5, 0.5), segments=20)
    whole = corner_normals(ball)
    for at_once in (1, 7, 1000):
        monkeypatch.setattr(mitsuba_scene, "_PAIRS_AT_ONCE", at_once)
        assert np.array_equal(corner_normals(ball), whole)


def test_faces_at_one_point_take_no_unbounded_time_or_memory() -> None:
    up = corner_normals(fan(3000))
    assert np.allclose(up, (0, 0, 1))
    with pytest.raises(InvalidValueError, match=r"few faces meet, got one of 60,000"):
        corner_normals(fan(60_000))
    assert corner_normals(fan(60_000, smooth=False)).shape == (60_000, 3, 3)
