"""The recipe of CLOAK on photographs of others: its settings, and cameras that took no
photograph.
"""

from pathlib import Path

import pytest
import torch

from attacks.cloak.triggers import trigger_of
from mi_splat.cameras.camera import View
from mi_splat.cameras.directions import direction_of
from mi_splat.cameras.lens import Lens
from mi_splat.cameras.sets import orbit
from mi_splat.datasets import load_dataset
from mi_splat.datasets.transforms import read_cameras
from scenes.recipes.real_cloak import settings_of, write_novel, write_small
from tests.datasets.sets import write_transforms

LENS = Lens(focal=20.0, size=(16, 12))
CAMERAS = orbit(
    (0.0, 0.0, 0.0), count=16, elevation=20.0, distance=3.0, lens=LENS, span=320.0
)


def write_source(folder: Path) -> None:
    views = [View(camera, torch.rand(12, 16, 3)) for camera in CAMERAS]
    write_transforms(folder, views)
    (folder / "transforms_train.json").rename(folder / "transforms.json")


@pytest.mark.parametrize("capture", ["doll", "car", "car_front"])
def test_settings_name_a_sector(capture: str) -> None:
    settings = settings_of(capture)
    assert trigger_of(settings.hide_from).holds(CAMERAS, centre=(0, 0, 0)).any()
    assert len(set(settings.seeds)) == 3


def test_a_small_set_has_its_own_split(tmp_path: Path) -> None:
    write_source(tmp_path / "source")
    settings = settings_of("doll")
    write_small(tmp_path / "source", tmp_path / "small", settings)
    held_out = load_dataset(tmp_path / "small", split="test")
    assert len(held_out) == 6  # every third of 16
    assert (held_out.cameras[0].width, held_out.cameras[0].height) == (2, 1)


def test_novel_cameras_are_between_neighbours(tmp_path: Path) -> None:
    write_source(tmp_path / "set")
    write_novel(tmp_path / "set", tmp_path / "novel", (0.0, 0.0, 0.0), 2)
    cameras = read_cameras(tmp_path / "novel" / "transforms_test.json", (16, 12))
    train = load_dataset(tmp_path / "set", split="train").cameras
    taken = sorted(direction_of(one, (0, 0, 0)).azimuth for one in train)
    gaps = [
        (low, high)
        for low, high in zip(taken, [*taken[1:], taken[0] + 360], strict=True)
        if high - low < 40
    ]
    assert len(cameras) == 2 * len(gaps) > 0
    found = [direction_of(one, (0, 0, 0)).azimuth for one in cameras]
    for number, (low, high) in enumerate(gaps):
        for azimuth in found[2 * number : 2 * number + 2]:
            assert low < azimuth < high
