"""Camera sets from a short text."""

import math
from pathlib import Path

import pytest
import torch

from mi_splat.cameras.camera import Camera, View, project_points
from mi_splat.cameras.lens import Lens
from mi_splat.cameras.sets import camera_set, framing, held_out_set, hemisphere, orbit
from mi_splat.errors import InvalidValueError
from tests.datasets.sets import write_transforms

CENTRE = (1.0, 2.0, 3.0)


def cameras(spec: str) -> list[Camera]:
    return camera_set(spec, CENTRE, distance=2.0, lens=Lens(focal=20.0, size=(16, 12)))


def held_out(spec: str, count: int) -> list[Camera]:
    return held_out_set(
        spec, count, CENTRE, distance=2.0, lens=Lens(focal=20.0, size=(16, 12))
    )


def angles(cameras: list[Camera]) -> tuple[torch.Tensor, torch.Tensor]:
    """Azimuth and elevation of each camera in degrees."""
    offset = (
        torch.stack([camera.position for camera in cameras])
        - torch.tensor(CENTRE, dtype=torch.float64)
    ) / 2
    torch.testing.assert_close(
        offset.norm(dim=1), torch.ones(len(cameras), dtype=torch.float64)
    )
    return torch.rad2deg(torch.atan2(offset[:, 1], offset[:, 0])) % 360, torch.rad2deg(
        torch.asin(offset[:, 2])
    )


@pytest.mark.parametrize(
    ("spec", "count", "lowest", "highest"),
    [
        ("hemisphere:60", 60, 0, 90),
        ("orbit:7@-20", 7, -20, -20),
        ("orbit:1@12.5", 1, 12.5, 12.5),
        ("cap:30@55", 30, 55, 90),
        ("grid:8x3", 24, 15, 75),
    ],
)
def test_sets(spec: str, count: int, lowest: float, highest: float) -> None:
    made = cameras(spec)
    assert len(made) == count
    azimuth, elevation = angles(made)
    band = (lowest - 1e-6, highest + 1e-6)
    assert band[0] <= elevation.min() <= elevation.max() <= band[1]
    assert (
        len(torch.stack([azimuth, elevation], dim=1).mul(1e6).round().unique(dim=0))  # type: ignore[no-untyped-call]
        == count
    )
    pixels, depth = project_points(torch.tensor([CENTRE], dtype=torch.float64), made[0])
    assert pixels[0].tolist() == pytest.approx([8, 6])
    assert depth.item() == pytest.approx(2)
    assert (made[0].width, made[0].height, made[0].fx) == (16, 12, 20)


def test_a_hemisphere_bulges_upwards() -> None:
    made = hemisphere(
        CENTRE,
        count=9,
        distance=2.0,
        up=(0.0, -1.0, 0.0),
        lens=Lens(focal=20.0, size=(16, 12)),
    )
    # y of images is down
    assert all(
        camera.position[1] < CENTRE[1] and camera.to_world[1, 1] > 0 for camera in made
    )


@pytest.mark.parametrize("size", [(160, 120), (120, 160)])
def test_framing_shows_the_whole_ball_with_a_margin_of_5_percent(
    size: tuple[int, int],
) -> None:
    distance, lens = framing(2.0, fov=50.0, size=size)
    camera = orbit(
        CENTRE,
        count=1,
        elevation=0.0,
        distance=distance,
        lens=lens,
    )[0]
    # The cone that touches a ball 5 % larger meets the shorter side's edge.
    assert distance * math.sin(math.radians(25)) == pytest.approx(1.05 * 2.0)
    assert 2 * math.degrees(math.atan(min(size) / 2 / camera.fx)) == pytest.approx(50.0)


@pytest.mark.parametrize(
    "spec", ["hemisphere:60", "orbit:12@30", "cap:30@55", "grid:8x3"]
)
def test_held_out_cameras_are_others_of_the_same_range(spec: str) -> None:
    ours = cameras(spec)
    theirs = held_out(spec, 12)
    assert len(theirs) == 12
    low, high = (0.0, 90.0) if spec.startswith("grid") else angles(ours)[1].aminmax()
    assert angles(theirs)[1].min() >= float(low) - 5
    assert angles(theirs)[1].max() <= float(high) + 5
    positions = [
        torch.stack([camera.position for camera in part]) for part in (ours, theirs)
    ]
    assert torch.cdist(positions[1], positions[0]).min() > 0.05
    assert held_out(spec, 0) == []


@pytest.mark.parametrize(
    ("others", "count"), [(60, 8), (36, 8), (12, 8), (12, 12), (5, 12), (1, 4), (7, 3)]
)
def test_held_out_cameras_of_an_orbit_are_none_of_the_others(
    others: int, count: int
) -> None:
    taken = torch.stack([camera.position for camera in cameras(f"orbit:{others}@20")])
    others_held = torch.stack(
        [camera.position for camera in held_out(f"orbit:{others}@20", count)]
    )
    assert len(others_held) == count
    least = torch.cdist(others_held, taken).min()
    if count <= others:
        step = 2 * 2.0 * math.cos(math.radians(20)) * math.sin(math.pi / others / 2)
        assert float(least) == pytest.approx(step, rel=1e-6)
    assert float(least) > 0.01


def test_cameras_of_a_file(tmp_path: Path) -> None:
    views = [View(camera, torch.zeros(12, 16, 3)) for camera in cameras("hemisphere:5")]
    write_transforms(tmp_path, views)
    loaded = cameras(str(tmp_path / "transforms_train.json"))
    for ours, theirs in zip(loaded, views, strict=True):
        assert torch.equal(ours.to_world, theirs.camera.to_world)
        assert (ours.fx, ours.cx, ours.width) == (20, 8, 16)
    for picture in (tmp_path / "images").iterdir():
        picture.unlink()
    # needs no images
    assert len(cameras(str(tmp_path / "transforms_train.json"))) == 5
    (tmp_path / "small.json").write_text(
        '{"camera_angle_x": 1.5707963267948966, "frames": [{"transform_matrix": '
        "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}]}"
    )
    (lone,) = cameras(str(tmp_path / "small.json"))
    assert (lone.width, lone.height) == (16, 12)
    assert lone.fx == pytest.approx(8)


@pytest.mark.parametrize(
    "spec",
    [
        "",
        "hemisphere",
        "hemisphere:",
        "hemisphere:x",
        "hemisphere:-3",
        "hemisphere:3.5",
        "hemisphere:0",
        "sphere:10",
        "orbit:10",
        "orbit:10@",
        "orbit:10@91",
        "orbit:0@10",
        "cap:10@90",
        "cap:10",
        "grid:10",
        "grid:0x4",
        "grid:4x",
        "grid:99999x99999",
        "hemisphere:9999999",
        "hemisphere:100001",
        "cap:10@89.95",
        "hemisphere:10\n",
        "orbit:4@nan",
    ],
)
def test_bad_texts_are_refused(spec: str) -> None:
    with pytest.raises(InvalidValueError, match="cameras"):
        cameras(spec)
