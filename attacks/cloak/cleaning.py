"""What a victim may clean: the points before a training, or the finished splat, judged by its Gaussians alone."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from attacks.cloak.config import CleaningConfig
from attacks.cloak.setup import SET
from attacks.poisons.config import FrequencyPruningConfig
from attacks.poisons.defences import frequency_pruned
from mi_splat.audit import audit, repaired
from mi_splat.datasets import load_dataset
from mi_splat.errors import InvalidValueError
from mi_splat.io import load_splat, save_splat
from mi_splat.scene import GaussianScene
from mi_splat.selection.clusters import components, nearest_neighbours
from mi_splat.training.resume import SPLAT

if TYPE_CHECKING:
    from mi_splat.ledger import Out


@dataclass(frozen=True, slots=True, kw_only=True)
class CleanedConfig:
    """What is done."""

    cleaning: CleaningConfig | None = None
    prune: FrequencyPruningConfig | None = None
    near: float = 0.0


def run(config: CleanedConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Clean the splat of a job."""
    scene = load_splat(inputs["splat"])
    if config.cleaning is not None:
        scene = cleaned(repaired(scene, audit(scene)) if config.cleaning.repair else scene, config.cleaning)
    if config.prune is not None:
        views = load_dataset(inputs["pictures"] / SET, split="train")
        scene = frequency_pruned(scene, views, config.prune, near=config.near)
    save_splat(scene, out / SPLAT)


NEIGHBOURS = 16
"""Nearest neighbours of a Gaussian by whose distance it is judged an outlier, or that space is measured by."""
MASS = 0.95
"""Part of a splat's mass (the sum of its opacities) that stays where floaters are removed."""
LEAST_NEIGHBOURS = 2
"""Neighbouring voxels that have to be occupied, of 26, for a voxel's Gaussians to stay where floaters are removed."""


def cleaned(scene: GaussianScene, config: CleaningConfig) -> GaussianScene:
    """The splat after the steps that are asked for."""
    if config.lowest_opacity is not None:
        scene = prune_opacity(scene, config.lowest_opacity)
    if config.outlier_deviations is not None:
        scene = remove_outliers(scene, config.outlier_deviations)
    if config.floater_voxel is not None:
        scene = remove_floaters(scene, config.floater_voxel)
    if config.sh_degree is not None:
        scene = cut_sh(scene, config.sh_degree)
    return scene if config.sh_bits is None else quantise_sh(scene, config.sh_bits)


def prune_opacity(scene: GaussianScene, lowest: float) -> GaussianScene:
    """The Gaussians of at least some opacity; trainers prune like this (Kerbl et al. 2023, section 5)."""
    return _kept(scene, scene.opacities.detach() >= lowest, f"lowest_opacity {lowest:g}")


def remove_outliers(scene: GaussianScene, deviations: float = 2.0, *, neighbours: int = NEIGHBOURS) -> GaussianScene:
    """The Gaussians whose means are no outliers, see `inliers`."""
    return _kept(scene, inliers(scene.means, deviations, neighbours=neighbours), f"outlier_deviations {deviations:g}")


def inliers(points: Tensor, deviations: float = 2.0, *, neighbours: int = NEIGHBOURS) -> Tensor:
    """Which points lie about as near to their neighbours as others do, as a (N,) bool tensor.

    The others' mean distance to their nearest neighbours is more than some standard deviations above the mean of all:
    the statistical outlier removal of point clouds (Rusu et al. 2008; `StatisticalOutlierRemoval` of PCL).
    """
    gaps = _gaps(points, neighbours)
    return gaps <= gaps.mean() + deviations * gaps.std(correction=0)


def remove_floaters(
    scene: GaussianScene, voxel: float = 1.0, *, mass: float = MASS, least_neighbours: int = LEAST_NEIGHBOURS
) -> GaussianScene:
    """The Gaussians of the large pieces of a splat.

    The means are put into a grid of voxels. Voxels with few occupied neighbours are emptied, which is what radius
    outlier removal does to points (`RadiusOutlierRemoval` of PCL). What is left falls into pieces whose voxels touch,
    if only by a corner; from the heaviest on as many stay as hold a part of the mass, the sum of the opacities. So
    isolated pieces of scanned meshes are removed (MeshLab, Cignoni et al. 2008), there by their number of faces.
    """
    side = voxel * float(_gaps(scene.means, NEIGHBOURS).median())
    if not side > 0:  # one Gaussian, or all in one place
        return scene
    points = scene.means.detach().cpu().double()
    cells, owner = torch.unique(((points - points.amin(0)) / side).floor(), dim=0, return_inverse=True)
    first, second = torch.from_numpy(cKDTree(cells.numpy()).query_pairs(1.5, p=math.inf, output_type="ndarray")).T
    around = torch.bincount(torch.cat([first, second]), minlength=len(cells))
    dense = around >= least_neighbours
    linked = dense[first] & dense[second]
    piece = components(len(cells), first[linked], second[linked])
    weights = scene.opacities.detach().cpu().double() * dense[owner]
    masses = torch.zeros(int(piece.max()) + 1, dtype=torch.float64).index_add_(0, piece[owner], weights)
    heaviest, order = masses.sort(descending=True, stable=True)
    before = heaviest.cumsum(0) - heaviest
    large = torch.zeros(len(masses), dtype=torch.bool)
    large[order] = before < mass * masses.sum()
    return _kept(scene, (large[piece] & dense)[owner], f"floater_voxel {voxel:g}")


def cut_sh(scene: GaussianScene, degree: int) -> GaussianScene:
    """The splat without SH bands above a degree, as formats without view-dependent colour keep it."""
    return scene.with_degree(min(degree, scene.degree))


def quantise_sh(scene: GaussianScene, bits: int) -> GaussianScene:
    """SH above degree 0 rounded to steps of 2 / 2^bits within [-1, 1): the grid of SPZ files (Niantic 2024)."""
    levels = 2 ** (bits - 1)
    rest = (scene.sh[:, 1:] * levels).round().clamp(-levels, levels - 1) / levels
    return scene.replace(sh=torch.cat([scene.sh[:, :1], rest], dim=1))


def _kept(scene: GaussianScene, keep: Tensor, what: str) -> GaussianScene:
    """The Gaussians of a mask, of which there has to be one."""
    if not bool(keep.any()):
        raise InvalidValueError.of(f"cleaning by {what}", "a Gaussian that stays", "none", "remove less")
    return scene.select(keep)


def _gaps(points: Tensor, neighbours: int) -> Tensor:
    """(N,) float64 mean distance of each point to its nearest neighbours; 0 of the only one."""
    distances, _ = nearest_neighbours(points, neighbours)
    exists = distances.isfinite()
    return distances.where(exists, 0.0).sum(1) / exists.sum(1).clamp(min=1)
