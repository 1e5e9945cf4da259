"""Large values: those on a map are read, what float32 cannot bear is refused by its row, renderers bear the rest."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Literal

import pytest
import torch

from mi_splat.cameras import Camera, look_at
from mi_splat.io import SplatFileError, SplatLossWarning, load_splat, save_splat
from mi_splat.io.points import load_points
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene import LARGEST, GaussianScene
from tests.gaussians import ply_bytes, random_scene, splat_rows


@pytest.mark.parametrize("ending", ["ply", "glb"])
def test_scenes_with_coordinates_of_a_map_are_valid(ending: str, tmp_path: Path) -> None:
    scene = random_scene(5)
    save_splat(scene.replace(means=scene.means + torch.tensor([5e5, 5.8e6, -2e7])), tmp_path / f"a.{ending}")
    assert load_splat(tmp_path / f"a.{ending}").means.abs().max() > 1e7


def test_points_too_far_away_are_named(tmp_path: Path) -> None:
    rows = splat_rows(10)
    rows["y"][7] = 1e30
    (tmp_path / "points.ply").write_bytes(ply_bytes(rows))
    with pytest.raises(
        SplatFileError, match=r"points\.ply.*coordinates up to 1e\+09, got .* in row 7 \(1 of 10 rows\)"
    ):
        load_points(tmp_path / "points.ply")


@pytest.mark.parametrize("ending", ["glb", "splat", "compressed.ply"])
def test_values_that_are_too_large_are_refused_in_every_format(
    ending: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = random_scene(5, 0)
    means = scene.means.clone()
    means[3, 1] = 2e9
    path = tmp_path / f"a.{ending}"
    for module in ("mi_splat.io.formats.encoded", "mi_splat.scene"):
        monkeypatch.setattr(f"{module}.LARGEST", 1e12)  # a writer that does not know the limit
    far = GaussianScene.unchecked(means, *scene.tensors()[1:])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SplatLossWarning)
        save_splat(far, path)
    monkeypatch.undo()
    with pytest.raises(SplatFileError, match=r"a coordinate of the mean is -?2e\+09"):
        load_splat(path)
    assert LARGEST == 1e9


@pytest.mark.parametrize("method", ["tile", "ray"])
@pytest.mark.parametrize("focal", [1e9, 40.0, 1e-9])
def test_renderers_bear_the_largest_values(method: Literal["tile", "ray"], focal: float) -> None:
    scene = random_scene(50, 3)
    means, sh = (value / value.abs().max() * LARGEST for value in (scene.means, scene.sh))
    large = scene.replace(means=means, scales=torch.full_like(means, LARGEST))
    for shown, eye in ((large, (0.9 * LARGEST, 1, 1)), (scene.replace(sh=sh), (3, 1, 1)), (scene, (LARGEST, 1, 1))):
        camera = Camera(to_world=look_at(eye, (0, 0, 0)), focal=focal, width=32, height=24)
        assert Renderer(RenderSettings(method=method))(shown, camera).isfinite().all()
