"""What an optimiser leaves in the colours of a finished file: shades that neither paint nor light explains.

Light changes how bright a colour is, and gloss adds white to it. So the colours of an honest Gaussian and of its
neighbours, and how they change with the direction of view, lie near the plane of grey and its own colour. A step of an
attack on a detector (`mi-splat dagger`) moves the three channels nearly independently, a third of it across that plane.
An attack on few views does so along the harmonics that peak towards its cameras, one on many views from everywhere.
"""

import math

import torch
from torch import Tensor
from torch.nn import functional

from mi_splat.audit.evidence import split_of
from mi_splat.audit.frames import SOLID, Frame, Target
from mi_splat.audit.results import Edit, vector
from mi_splat.audit.surfaces import basis, lattice
from mi_splat.rotation import to_matrix
from mi_splat.scene import GaussianScene
from mi_splat.selection.clusters import nearest_neighbours
from mi_splat.sh import dc_to_colour, sh_basis

_LEAST_COUNT = 50
"""Gaussians from which shares are worth anything, of the object and of each shell around it."""
_SHELLS, _REST = 8, 16_000
"""Shells around an object, of equal numbers, and Gaussians in them together: those of the rest that are nearest."""
_MOST, _SLAB = 32_000, 4_000
"""Gaussians of an object that are looked at, of a larger one in slabs of so many that lie together."""
_FLOOR, _SMALL = 0.003, 0.001
"""Root mean square of coefficients, and difference of colours (sRGB), that nobody sees; with less, shares are those of
rounding."""
_NEIGHBOURS, _ALIKE, _FEW = 8, 0.8, 3
"""Neighbours that a colour is compared with, least cosine between normals of those that count, and least number."""
_STRONGEST = 1500
"""Gaussians that say where the camera stood."""
_DISTANCES, _DIRECTIONS, _FINER, _WITHIN = (2.0, 3.5), 500, 150, 10.0
"""Radii from the middle to the places that are tried, directions tried at first, and within degrees of the best."""


def edit_of(frame: Frame, target: Target) -> Edit | None:
    """How much the colours of an object look like an attack on a detector, and from where.

    The median shell of the surroundings says what of it this file has without an attack, by undertraining or rounding.
    """
    if len(target.rows) < _LEAST_COUNT:
        return None
    rows = _slabs(frame.scene.means, target.rows)
    part = frame.scene.select(rows)
    shells = [frame.scene.select(shell) for shell in _shells(frame.scene, target)]
    strange = _across(part.sh[:, 1:], dc_to_colour(part.sh[:, 0]))
    direction, peak = _camera(part, strange, target)
    size = strange.square().sum(1) + _across(part.sh[:, :1], dc_to_colour(part.sh[:, 0])).square().sum(1)
    return Edit(
        share=_share(part),
        usual_share=_median([_share(shell) for shell in shells]),
        grain=_grain(part),
        usual_grain=_median([_grain(shell) for shell in shells]),
        peak=peak,
        direction=vector(frame.direction(direction)),
        rows=frame.order[rows[size > split_of(size)]],
    )


def _slabs(points: Tensor, rows: Tensor) -> Tensor:
    """All of the rows, or of many some that lie together, evenly over the first axis."""
    if len(rows) <= _MOST:
        return rows
    slabs = torch.split(rows[points[rows, 0].argsort()], _SLAB)
    numbers = torch.linspace(0, len(slabs) - 1, _MOST // _SLAB).round().long().tolist()
    return torch.cat([slabs[number] for number in numbers])


def _shells(scene: GaussianScene, target: Target) -> list[Tensor]:
    """Rows of what is around an object, from the nearest; none where there is too little."""
    around = scene.opacities > SOLID
    around[target.rows] = False
    rest = around.nonzero()[:, 0]
    gaps = (scene.means[rest] - target.centre.float()).norm(dim=1)
    rest = rest[gaps.argsort()[:_REST]]
    count = min(_SHELLS, len(rest) // _LEAST_COUNT)
    return list(rest.tensor_split(count)) if count else []


def _median(values: list[float]) -> float:
    return float(torch.tensor(values).median()) if values else 0.0


def _across(values: Tensor, colours: Tensor) -> Tensor:
    """(N, K) of (N, K, 3) values what lies along the axis that is at right angles to grey and to (N, 3) colours."""
    grey = torch.full((3,), 1 / math.sqrt(3))
    hue = colours - (colours @ grey)[:, None] * grey
    any_hue = torch.tensor([1.0, -1.0, 0.0]) / math.sqrt(2)
    hue = torch.where(hue.norm(dim=1, keepdim=True) > 1e-4, functional.normalize(hue, dim=1), any_hue)
    axis = torch.linalg.cross(grey.expand_as(hue), hue)
    strange: Tensor = (values * axis[:, None]).sum(-1)
    return strange


def _share(scene: GaussianScene) -> float:
    """Share of the energy of all degrees above 0 that is strange; a third where channels are independent."""
    bands = scene.sh[:, 1:]
    strange = _across(bands, dc_to_colour(scene.sh[:, 0]))
    return float(strange.square().sum() / (bands.square().sum() + _FLOOR**2 * max(bands.numel(), 1)))


def _grain(scene: GaussianScene) -> float:
    """Median share of the difference to the colour around a Gaussian that is strange; a half for independent ones."""
    distances, near = nearest_neighbours(scene.means, _NEIGHBOURS)
    if not distances.shape[1]:
        return 0.0
    thin = scene.scales.argmin(1)
    normals = to_matrix(scene.rotations)[torch.arange(len(scene)), :, thin]
    weights = (scene.opacities * scene.scales.prod(1) / scene.scales.amin(1).clamp(min=1e-12)).sqrt()[near]
    weights = weights * ((normals[:, None] * normals[near]).sum(-1).abs() > _ALIKE)
    colours = dc_to_colour(scene.sh[:, 0])
    around = (weights[..., None] * colours[near]).sum(1) / weights.sum(1, keepdim=True).clamp(min=1e-20)
    known = (weights > 0).sum(1) >= min(_FEW, near.shape[1])
    gap = (colours - around)[known]
    if not len(gap):
        return 0.0
    strange = _across(gap[:, None], around[known])[:, 0].abs()
    return float((strange / (gap.norm(dim=1) + _SMALL)).median())


def _camera(scene: GaussianScene, strange: Tensor, target: Target) -> tuple[Tensor, float]:
    """(3,) direction to the place towards which strange colours peak most, and how often more there than in the mean.

    The change that one camera asks for is a multiple of the harmonics along its ray, so all of its energy lies along
    them, K - 1 times the mean over all directions; of several cameras each has a part.
    """
    directions = lattice(_DIRECTIONS, -90.0, 90.0)
    if scene.degree == 0:
        return directions[0], 1.0
    energy = strange.square().sum(1)
    rows = energy.argsort(descending=True)[:_STRONGEST]
    points, strange, total = scene.means[rows], strange[rows], energy[rows].sum().clamp(min=1e-20)

    def peaks(directions: Tensor) -> Tensor:
        peaks_at = []
        for distance in _DISTANCES:
            positions = (target.centre + distance * target.radius * directions).float()
            towards = sh_basis(functional.normalize(points - positions[:, None], dim=2), scene.degree)[..., 1:]
            along = (functional.normalize(towards, dim=2) * strange).sum(2)
            peaks_at.append(along.square().sum(1) / total * strange.shape[1])
        return torch.stack(peaks_at).amax(0)

    best = directions[int(peaks(directions).argmax())]
    finer = lattice(_FINER, 90.0 - _WITHIN, 90.0) @ basis(best).T
    values = peaks(finer)
    return finer[int(values.argmax())], float(values.max())
