"""Each format keeps what the table of formats says, for any scene, and a second round
trip loses nothing more.
"""

import warnings
from pathlib import Path

import hypothesis
import numpy as np
import pytest
import torch
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from torch import Tensor

from mi_splat.io import SplatFileError, SplatLossWarning, load_splat, save_splat
from mi_splat.io.formats import sog
from mi_splat.io.splat_files import write_splat_file
from mi_splat.maths.sh import dc_to_colour
from mi_splat.scene import GaussianScene
from tests.gaussians import random_scene
from tests.io.format_files import WRITTEN, assert_close, differences, tame_scene
from tests.io.test_round_trip import scenes as wild_scenes
from tests.project.layers import ROOT

pytestmark = pytest.mark.shipped

SLACK = 1.02
"""For float32, in which scenes are."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("formats")


@st.composite
def scenes(draw: st.DrawFn) -> GaussianScene:
    """Scenes in the ranges of every format, of up to three chunks and with few or many
    different values.
    """
    count = draw(st.sampled_from([1, 2, 5, 300, 600]))
    degree = draw(st.integers(0, 3))
    seed = draw(st.integers(0, 99))
    size = draw(st.sampled_from([1e-3, 1.0, 1e3]))
    few = draw(st.booleans())
    scene = tame_scene(count, degree, seed=seed)
    scene = scene.replace(
        means=scene.means * size, scales=scene.scales.clamp(5e-5, 300)
    )
    corner = draw(
        hnp.arrays(np.float32, (3,), elements=st.floats(-1000, 1000, width=32))
    )
    means = scene.means + torch.from_numpy(corner)
    return scene.replace(
        means=means.round() if few else means,
        opacities=scene.opacities.round(decimals=1 if few else 6),
    )


def read_table() -> dict[str, dict[str, str]]:
    """What docs/formats.md says of each format, by its ending."""
    _, rest = (ROOT / "docs" / "formats.md").read_text().split("| ends in |")
    lines = f"| ends in |{rest}".split("\n\n")[0].splitlines()
    titles, _, *rows = (
        [cell.strip(" `") for cell in line.strip("|").split("|")] for line in lines
    )
    return {row[0]: dict(zip(titles, row, strict=True)) for row in rows}


TABLE = read_table()


def limit(suffix: str, title: str, values: Tensor, float_step: float) -> float:
    """The largest error of `values` that the table allows, beside the steps of
    float32.
    """
    cell = TABLE[suffix][title].split(", clamped")[0]
    if cell in ("exact", "none"):
        return 0.0
    size, _, unit = cell.partition(" ")
    if len(values):
        extent = values.double().amax(0) - values.double().amin(0)
    else:
        extent = values.double()
    logs = values.double().sign() * values.double().abs().log1p()
    sizes = {
        "of the extent of its chunk": float(extent.max()),
        "of the range in its chunk": float(extent.max()),
        "of their range": float(values.max() - values.min()),
        "of the largest coordinate or of 1": max(1.0, float(values.abs().max())),
        # A step in the logarithm is the larger in space the farther out it is.
        "of the extent, in sign(x) ln(1 + abs(x))": float(
            (logs.amax(0) - logs.amin(0)).max() * (1 + values.abs().max())
        ),
    }
    return float(size) * sizes.get(unit, 1.0) * SLACK + float_step


def check(
    scene: GaussianScene, again: GaussianScene, suffix: str, factor: float = 1.0
) -> None:
    """Raise unless two scenes with the same rows are as close as the table says."""
    step = 4e-7 * float(scene.means.abs().max())
    colours = dc_to_colour(scene.sh[:, 0])
    allowed = {
        "means": limit(suffix, "means", scene.means, step),
        "scales": limit(suffix, "log-scales", scene.scales.log(), 1e-6) + 1e-6,
        "rotations": limit(suffix, "rotations", scene.rotations, 1e-3) + 1e-3,
        "opacities": limit(suffix, "opacity", scene.opacities, 1e-6) + 1e-6,
        "colours": limit(suffix, "colour", colours, 1e-6) + 1e-6,
        "sh": limit(suffix, "SH", scene.sh[:, 1:], 1e-6) if scene.degree else 0.0,
    }
    for name, value in differences(scene.with_degree(again.degree), again).items():
        assert not value.numel() or float(value.max()) <= factor * allowed[name], (
            name,
            float(value.max()),
            allowed[name],
        )


def sorted_as(scene: GaussianScene, order: np.ndarray | None) -> GaussianScene:
    if order is None:
        return scene
    return scene.select(torch.from_numpy(order))


@pytest.mark.parametrize("suffix", WRITTEN)
@hypothesis.settings(max_examples=12, deadline=None)
@hypothesis.given(scene=scenes())
def test_round_trips_stay_within_the_table(
    suffix: str, scene: GaussianScene, folder: Path
) -> None:
    path = folder / f"a{suffix}"
    scene = sorted_as(scene, write_splat_file(scene, path).order)
    once = load_splat(path)
    check(scene, once, suffix)
    twice = sorted_as(once, write_splat_file(once, path).order)
    check(twice, load_splat(path), suffix)


@pytest.mark.parametrize("suffix", [".glb", ".spz", ".splat", ".sog"])
@pytest.mark.parametrize("degree", [0, 3])
def test_a_second_round_trip_changes_nothing(
    suffix: str, degree: int, tmp_path: Path
) -> None:
    """Rounded values are rounded to themselves."""
    path = tmp_path / f"a{suffix}"
    write_splat_file(tame_scene(500, degree), path)
    once = load_splat(path)
    write_splat_file(once, path)
    assert_close(
        load_splat(path),
        once,
        means=1e-6,
        scales=1e-6,
        rotations=1e-3,
        opacities=0,
        colours=1e-6,
        sh=1e-6,
    )


@pytest.mark.parametrize("suffix", WRITTEN)
@hypothesis.settings(max_examples=15, deadline=None)
@hypothesis.given(scene=wild_scenes())
def test_any_scene_is_saved_or_refused(
    suffix: str, scene: GaussianScene, folder: Path
) -> None:
    """Values at the ends of float32 as well: what is loaded is a valid scene."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SplatLossWarning)
        try:
            save_splat(scene, folder / f"wild{suffix}")
            again = load_splat(folder / f"wild{suffix}")
        except SplatFileError as error:
            assert not len(scene) or "valid Gaussians" in str(error)  # noqa: PT017
            return
    assert len(GaussianScene(*again.tensors())) == len(scene)


@pytest.mark.parametrize("suffix", WRITTEN)
def test_saving_is_deterministic(suffix: str, tmp_path: Path) -> None:
    saved = []
    for _ in range(2):
        write_splat_file(random_scene(300, 2), tmp_path / f"a{suffix}")
        saved.append((tmp_path / f"a{suffix}").read_bytes())
    assert saved[0] == saved[1]


@pytest.mark.parametrize("version", [2, 3, 4])
def test_versions_of_spz(version: int, tmp_path: Path) -> None:
    scene = tame_scene(100, 3)
    write_splat_file(scene, tmp_path / "a.spz", version=version)
    assert_close(
        load_splat(tmp_path / "a.spz"),
        scene,
        scales=1 / 31,
        rotations=13 if version == 2 else 0.3,
        opacities=0.002,
        colours=0.0037,
        sh=1 / 255,
    )


def test_a_palette_for_more_gaussians_than_it_has_rows(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(sog, "PALETTE", 64)
    scene = tame_scene(400, 1)
    losses = write_splat_file(scene, tmp_path / "a.sog").losses
    once = load_splat(tmp_path / "a.sog")
    assert [loss.what for loss in losses] == ["SH shared with similar Gaussians"]
    worst = float((once.sh[:, 1:] - scene.sh[:, 1:]).abs().max())
    assert worst == pytest.approx(losses[0].largest, abs=0.01)
    assert len(torch.unique(once.sh[:, 1:], dim=0)) <= 64
    flat = scene.sh[:, 1:].std()
    assert float(
        (once.sh[:, 1:] - scene.sh[:, 1:]).pow(2).mean().sqrt()
    ) < 0.85 * float(flat)
    repeated = scene.select(torch.arange(400) % 60)
    assert write_splat_file(repeated, tmp_path / "b.sog").losses == ()
