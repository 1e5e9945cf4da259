"""A cloaked object on a street of meshes: which Gaussians stand there, under which sun, and who looks from where."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from attacks.cloak.config import LayersConfig
from attacks.cloak.elsewhere import HOUSES, STREET, measure_street
from attacks.observe import conditions as street
from attacks.observe.conditions import SunTable
from mi_splat.cameras import Camera
from mi_splat.errors import InvalidValueError
from mi_splat.io import load_splat
from mi_splat.mixed_scenes import MixedScene
from mi_splat.scene import GaussianScene, merge
from mi_splat.scene_files import SplatScene
from tests import oracle
from tests.cloak.test_experiments import STUDY, one_gaussian
from tests.cloak.tiny_study import Redness
from tests.project.layers import ROOT

LAYERED = replace(STUDY, layers=LayersConfig(attacks=("overhead",)))
made: list[dict[str, Any]] = []
looked: list[Camera] = []


class Street:
    """A street that is red in the morning and grey later, and remembers what was put into it."""

    def __init__(self, path: Path, *, samples: int, car: str, **sun: float) -> None:
        self._red = sun["sun_x"] > 0.1
        scene = load_splat(Path(car))
        self.splats = SplatScene(scene=scene, objects={}, cameras={}, settings=None)  # type: ignore[arg-type]
        made.append({"scene": scene, "samples": samples, **sun})

    def __call__(self, scene: GaussianScene, camera: Camera) -> Tensor:
        looked.append(camera)
        return torch.tensor([1.0, 0.0, 0.0] if self._red else [0.5, 0.5, 0.5]).expand(48, 48, 3)


def at(*hours: float) -> SunTable:
    return replace(STREET, hours=hours)


@pytest.fixture(autouse=True)
def _street(monkeypatch: pytest.MonkeyPatch) -> None:
    made.clear()
    looked.clear()
    monkeypatch.setattr(street, "MixedScene", Street)


def test_the_object_alone_stands_there_hour_by_hour() -> None:
    car = one_gaussian(0.9).replace(means=torch.tensor([[0.0, 0.0, 0.7]]))
    far = one_gaussian(0.1).replace(means=torch.tensor([[30.0, 0.0, 0.0]]))
    rows = measure_street(LAYERED, {"clean": merge(car, far)}, [Redness()], every=20, sun=at(8.0, 12.0, 16.0))
    assert [len(one["scene"]) for one in made] == [1, 1, 1]
    assert torch.equal(made[0]["scene"].means, car.means)
    assert [one["sun_z"] for one in made] == pytest.approx([0.353553, 0.707107, 0.353553], abs=1e-5)
    assert made[0]["sun_x"] == pytest.approx(-made[2]["sun_x"])
    assert {(row["hour"], row["cameras"]) for row in rows} == {
        (hour, cameras) for hour in ("08:00", "12:00", "16:00") for cameras in ("overhead", "elsewhere")
    }
    assert all((row["found"] > 0) == (row["hour"] == "08:00") for row in rows if row["of"])


def test_nobody_looks_out_of_a_house() -> None:
    rows = measure_street(LAYERED, {"clean": one_gaussian(0.5)}, [Redness()], every=5, sun=at(12.0))
    assert len(looked) == sum(row["of"] for row in rows) > 4
    assert all(float(camera.position[1]) < HOUSES for camera in looked)


def test_without_layers_the_object_is_not_known() -> None:
    with pytest.raises(InvalidValueError, match="layers"):
        measure_street(STUDY, {"clean": one_gaussian(0.5)}, [Redness()])


def test_another_car_can_stand_in_the_shipped_street(tmp_path: Path) -> None:
    from mi_splat.io import save_splat

    scene = oracle.random_scene(20, degree=3, seed=1)
    save_splat(scene, tmp_path / "a.ply")
    put = MixedScene(ROOT / STREET.scene, samples=1, car=str(tmp_path / "a.ply"))
    assert len(put.splats.scene) == 20
    torch.testing.assert_close(put.splats.scene.means, scene.means)
