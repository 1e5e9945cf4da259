"""What a victim does to a finished splat: what goes, what stays, what is refused; and as a stage of a study."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from attacks.cloak.cleaning import (
    cleaned,
    cut_sh,
    inliers,
    prune_opacity,
    quantise_sh,
    remove_floaters,
    remove_outliers,
)
from attacks.cloak.config import CleaningConfig
from attacks.cloak.kinds.trained import starting_cloud
from attacks.cloak.steps import StudySteps
from mi_splat.errors import InvalidValueError
from mi_splat.io import load_splat
from mi_splat.io.points import PointCloud
from mi_splat.scene import GaussianScene, scene_hash
from tests.cloak.tiny_study import STUDY
from tests.ledger.drive import Ledger
from tests.training.sets import views_of

VICTIM = replace(STUDY.training, outliers=5)


def splat(means: Tensor, opacities: Tensor | float = 0.5, *, degree: int = 1) -> GaussianScene:
    count = len(means)
    generator = torch.Generator().manual_seed(1)
    return GaussianScene(
        means=means.float(),
        scales=torch.full((count, 3), 0.1),
        rotations=torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4).contiguous(),
        opacities=torch.as_tensor(opacities).expand(count).contiguous(),
        sh=torch.rand(count, (degree + 1) ** 2, 3, generator=generator) - 0.5,
    )


def block(*corner: float, side: int = 6) -> Tensor:
    """Points one apart that fill a cube."""
    axis = torch.arange(side, dtype=torch.float64)
    return torch.cartesian_prod(axis, axis, axis) + torch.tensor(corner, dtype=torch.float64)


def same(one: GaussianScene, other: GaussianScene) -> bool:
    return scene_hash(one) == scene_hash(other)


def test_gaussians_of_low_opacity_go() -> None:
    scene = splat(block(0, 0, 0, side=2), torch.tensor([0.0, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0]))
    assert same(prune_opacity(scene, 0.1), scene.select(slice(2, None)))
    assert same(prune_opacity(scene, 1.0), scene.select(slice(7, None)))


def test_what_lies_far_from_everything_is_an_outlier() -> None:
    far = torch.tensor([[30.0, 0.0, 0.0], [0.0, -40.0, 0.0]])
    scene = splat(torch.cat([block(0, 0, 0), far]))
    assert same(remove_outliers(scene, 2.0), scene.select(slice(0, 216)))
    assert same(remove_outliers(scene, 1000.0), scene)
    one = scene.select(slice(0, 1))
    assert same(remove_outliers(one), one)


def test_the_limit_of_outliers_is_mean_and_deviations() -> None:
    """Against all pairs of distances."""
    means = torch.randn(60, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    nearest = torch.cdist(means, means).sort(dim=1).values[:, 1:6].mean(1)
    scene = splat(means)
    wanted = nearest <= nearest.mean() + nearest.std(correction=0)
    assert 0 < int((~wanted).sum()) < 20
    assert same(remove_outliers(scene, 1.0, neighbours=5), scene.select(wanted))


def test_outliers_are_removed_from_the_points_before_a_training() -> None:
    _, views = views_of()
    surface = block(0, 0, 0, side=8) * 0.02
    cloud = PointCloud(surface.float(), torch.rand(512, 3, generator=torch.Generator().manual_seed(3)))
    every = starting_cloud(VICTIM, cloud, views, seed=1)
    assert len(every.points) == 517
    kept = starting_cloud(replace(VICTIM, point_deviations=2.0), cloud, views, seed=1)
    stays = inliers(every.points, 2.0)
    assert bool(stays[:512].all())
    assert not bool(stays[512:].any())
    assert torch.equal(kept.points, cloud.points)
    assert torch.equal(kept.colours, cloud.colours)


def test_pieces_apart_from_the_rest_are_floaters() -> None:
    large, small, lonely = block(0, 0, 0, side=9), block(40, 0, 0, side=3), torch.tensor([[0.0, 50.0, 0.0]])
    scene = splat(torch.cat([small, lonely, large]))
    assert same(remove_floaters(scene, 1.0), scene.select(slice(28, None)))
    everything = remove_floaters(scene, 1.0, mass=1.0, least_neighbours=0)
    assert same(everything, scene)
    assert same(remove_floaters(scene, 1.0, mass=1.0), scene.select(torch.arange(len(scene)) != 27))
    assert same(remove_floaters(scene, 1000.0, least_neighbours=0), scene)  # one voxel


def test_voxels_that_touch_by_a_corner_are_one_piece() -> None:
    steps = torch.arange(20, dtype=torch.float64)[:, None].expand(20, 3)
    scene = splat(steps.contiguous())
    assert same(remove_floaters(scene, 0.15, mass=0.1, least_neighbours=1), scene)


def test_higher_bands_are_cut_off() -> None:
    scene = splat(block(0, 0, 0, side=2), degree=3)
    for degree in range(4):
        assert same(cut_sh(scene, degree), scene.with_degree(degree))
    low = scene.with_degree(1)
    assert cut_sh(low, 2) is low


def test_coefficients_are_rounded_to_a_grid() -> None:
    values = torch.tensor([0.0, 0.3, -0.3, 0.9, -2.0, 2.0, 0.02, -0.02])
    scene = splat(block(0, 0, 0, side=2))
    scene = scene.replace(sh=values[:, None, None].expand(8, 4, 3).contiguous())
    coarse, fine = quantise_sh(scene, 5), quantise_sh(scene, 8)
    assert torch.equal(coarse.sh[:, 0], scene.sh[:, 0])
    expected = torch.tensor([0, 5, -5, 14, -16, 15, 0, 0]) / 16
    assert torch.equal(coarse.sh[:, 1:], expected[:, None, None].expand(8, 3, 3))
    inside = values.abs() < 1
    assert float((fine.sh - scene.sh)[inside].abs().max()) <= 1 / 256
    assert same(quantise_sh(coarse, 5), coarse)
    base = scene.with_degree(0)
    assert same(quantise_sh(base, 1), base)


SCENE = splat(block(0, 0, 0, side=2))


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: CleaningConfig(), "cleaning: expected one of repair, lowest_opacity, "),
        (lambda: prune_opacity(SCENE, 0.9), "cleaning by lowest_opacity 0.9: expected a Gaussian that stays, got none"),
        (lambda: remove_floaters(SCENE, 0.1, least_neighbours=8), "cleaning by floater_voxel 0.1"),
    ],
)
def test_values_out_of_range_are_refused(make: Callable[[], object], says: str) -> None:
    with pytest.raises(InvalidValueError) as raised:
        make()
    assert says in str(raised.value)


@pytest.mark.slow
def test_both_splats_of_a_study_are_cleaned(finished: Path) -> None:
    config = CleaningConfig(lowest_opacity=0.1, sh_degree=0)
    ledger = Ledger(finished / "stages")
    for splat in ("clean", "cloaked"):
        before, after = (
            load_splat(ledger.do(StudySteps(study=study).splat(splat, 0)).folder / "splat.ply")
            for study in (STUDY, replace(STUDY, cleaning=config))
        )
        assert same(after, cleaned(before, config))
