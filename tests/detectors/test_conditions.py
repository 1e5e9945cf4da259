"""How objects are seen: exact in cases done by hand, recorded with the pictures, and found again without rendering."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from attacks.detectors.evaluation import held_out
from attacks.detectors.training.conditions import ViewingConditions, viewing_conditions
from attacks.detectors.training.config import BackgroundConfig, PictureSetConfig, SplatConfig
from attacks.detectors.training.dataset import fill_conditions, load, make
from attacks.detectors.training.pictures import LabelledPicture, SceneRenderer
from mi_splat.assets.daylight import Light
from mi_splat.cameras import Camera, orbit_pose
from mi_splat.errors import InvalidValueError

pytestmark = pytest.mark.usefixtures("scalar")

TINY = PictureSetConfig(split="held-out", size=48, samples=1, shots=2, count=2, empty=0.0, pair=0.0, street=0.0)
FEW = SplatConfig(views=2, samples=1, objects=300, surroundings=300, sky=50, steps=0, pictures=2)
CORNERS = np.array([[-1.0, -2.0, 0.0], [1.0, 2.0, 4.0], [0.0, 0.0, 1.0]], np.float32)


def from_elevation(degrees: float) -> Camera:
    pose = orbit_pose((0.0, 0.0, 2.0), azimuth=70.0, elevation=degrees, distance=9.0)
    return Camera(to_world=pose, focal=50.0, width=64, height=64)


@pytest.mark.parametrize("elevation", [0.0, 33.0, 90.0])
def test_a_case_done_by_hand(elevation: float) -> None:
    light = Light(sun_elevation=31.0, sun_strength=1.5)
    seen = viewing_conditions(CORNERS, from_elevation(elevation), light)
    assert seen.elevation == pytest.approx(elevation, abs=1e-4)
    assert seen.distance == pytest.approx(9.0, abs=1e-5)
    assert seen.extent == pytest.approx(math.sqrt(4 + 16 + 16), abs=1e-5)
    assert (seen.sun_elevation, seen.sun_strength) == (31.0, 1.5)
    assert viewing_conditions(CORNERS, from_elevation(0.0)).sun_elevation is None


def recorded(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "labels.json").read_text())
    return found


def forget(folder: Path) -> None:
    """What labels.json was before it held how objects are seen."""
    content = recorded(folder)
    for record in content["pictures"].values():
        del record["conditions"]
    (folder / "labels.json").write_text(json.dumps(content))


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("set")
    make(TINY, folder, processes=0)
    return folder


def copy_of(pictures: Path, folder: Path) -> Path:
    for path in pictures.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    return folder


def test_they_are_recorded_with_the_pictures(pictures: Path) -> None:
    samples = load(pictures)
    assert all(len(one.conditions) == len(one.labels) > 0 for one in samples)
    for number in range(1):
        renderer = SceneRenderer(TINY, number)
        light, cameras = renderer.contents.light, [renderer.choose_camera() for _ in range(TINY.shots)]
        for one, camera in zip(samples[2 * number : 2 * number + 2], cameras, strict=True):
            assert {seen.sun_elevation for seen in one.conditions} == {round(light.sun_elevation, 6)}
            down = math.degrees(math.asin(-float(camera.to_world[2, 2])))  # it looks at the one object there is
            assert [seen.elevation for seen in one.conditions] == pytest.approx([down], abs=1e-4)


def test_they_are_found_again_without_rendering(pictures: Path, tmp_path: Path) -> None:
    folder = copy_of(pictures, tmp_path)
    before = recorded(folder)
    forget(folder)
    assert load(folder)[0].conditions == ()
    steps: list[tuple[int, int]] = []
    fill_conditions(folder, TINY, {0: 0}, on_step=lambda done, total: steps.append((done, total)))
    assert recorded(folder) == before
    assert steps == [(1, 1)]
    written = (folder / "labels.json").stat().st_mtime_ns
    fill_conditions(folder, TINY, {0: 0})
    assert (folder / "labels.json").stat().st_mtime_ns == written, "nothing was missing"


def test_pictures_of_something_else_are_left_alone(pictures: Path, tmp_path: Path) -> None:
    folder = copy_of(pictures, tmp_path)
    forget(folder)
    before = recorded(folder)
    with pytest.raises(InvalidValueError, match=r"scene 0: expected labels .*as recorded, got labels"):
        fill_conditions(folder, replace(TINY, seed=1), {0: 0})
    assert recorded(folder) == before


def test_values_of_other_kinds_are_not_lost() -> None:
    seen = ViewingConditions(elevation=1.0, distance=2.0, extent=3.0)
    assert ViewingConditions(**json.loads(json.dumps(asdict(seen)))) == seen


def sets_of(folder: Path) -> dict[str, list[LabelledPicture]]:
    return held_out.held_out_sets(
        folder,
        replace(TINY, count=2),
        splats=1,
        splat=FEW,
        backgrounds=BackgroundConfig(scenes=0),
        processes=0,
        on_work=lambda text, done, total: None,
    )


@pytest.mark.slow
def test_held_out_sets_gain_what_older_ones_lack(tmp_path: Path) -> None:
    folders = [tmp_path / "held-out", tmp_path / "splats" / "10000"]
    made = sets_of(tmp_path)
    before = [recorded(folder) for folder in folders]
    for folder in folders:
        forget(folder)
    again = sets_of(tmp_path)
    assert [recorded(folder) for folder in folders] == before
    for name in ("path traced", "splat renders"):
        seen = [one.conditions for one in made[name]]
        assert [one.conditions for one in again[name]] == seen
        assert any(seen)
