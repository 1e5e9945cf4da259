"""Evidence that a human can check: two cameras that show a look and its absence, and the Gaussians that carry it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from mi_splat.audit.explanations import Split, angles_between
from mi_splat.audit.frames import Target
from mi_splat.audit.results import Look
from mi_splat.audit.surfaces import AROUND, Elements, Sight, near_of, rays
from mi_splat.cameras import Camera, project_points
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene import GaussianScene
from mi_splat.sh import colour_to_dc, sh_to_colour

BLOCKED, FREE = 0.3, 0.1
"""Share of the rays to the object that end before it, from which a camera is blocked, and up to which it is free."""
_CORE, AIR, FLOOR, _TOLERANCE = 0.5, 1.15, 0.15, 0.15
"""Radii: rays that pass so near the centre count; air begins so far from it, and so far above the ground; depths that
differ by less are the same."""
_POINTS, _LEAST_POINTS = 60, 200
"""Points that are kept of each blocked picture, and looks at them from free cameras without which nothing is said."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cover:
    """What covers an object, in the frame of the splat."""

    blocked: Tensor  # (K,) share of the rays to the object that end at something in the air, by camera
    transparent: float  # share of that something that free cameras look through; 0 if they hardly look at it
    points: Tensor  # (P, 3) points of it
    air: dict[int, Tensor]  # of each blocked camera its number, and the (H, W) bool pixels that show it

    @property
    def score(self) -> float:
        """Share of blocked cameras times what others look through."""
        return float((self.blocked > BLOCKED).double().mean()) * self.transparent


def cover_of(scene: GaussianScene, view: Sight, target: Target) -> Cover:
    """What covers an object."""
    centre = target.centre.float()
    heights = scene.means[target.rows] @ (centre if target.up is None else target.up.float())
    floor = float(heights.kthvalue(max(1, len(heights) // 50)).values)
    blocked, points = torch.zeros(len(view.cameras)), [torch.zeros(0, 3)]
    shown: dict[int, Tensor] = {}
    for number, (camera, depth) in enumerate(zip(view.cameras, view.depths, strict=True)):
        eye, directions = camera.position.float(), rays(camera)
        unit = functional.normalize(directions, dim=-1)
        along = unit @ (centre - eye)
        miss = ((centre - eye).square().sum() - along.square()).clamp(min=0).sqrt()
        core = miss < _CORE * target.radius
        ends = depth.isfinite()
        surface = eye + directions * depth.masked_fill(~ends, 0)[..., None]
        air = core & ends & ((surface - centre).norm(dim=-1) > AIR * target.radius)
        air &= (surface - eye).norm(dim=-1) < along
        if target.up is not None:
            air &= surface @ target.up.float() > floor + FLOOR * target.radius
        blocked[number] = air.sum() / max(int(core.sum()), 1)
        if blocked[number] > BLOCKED:
            shown[number] = air
            points.append(surface[air][:: max(1, int(air.sum()) // _POINTS)])
    cover = torch.cat(points)
    through = _through(view, cover, (blocked < FREE).nonzero()[:, 0], target.radius) if len(cover) else 0.0
    return Cover(blocked=blocked, transparent=through, points=cover, air=shown)


def _through(view: Sight, points: Tensor, free: Tensor, radius: float) -> float:
    """Share of points that free cameras look through, of those that they look through or see."""
    beyond = seen = 0
    for number in free.tolist():
        camera, depths = view.cameras[number], view.depths[number]
        pixels, depth = project_points(points, camera)
        column, row = pixels.nan_to_num(-1.0, -1.0, -1.0).clamp(-1, 1 << 15).floor().long().unbind(-1)
        inside = (depth > 0.05 * radius) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        shown, depth = depths[row[inside], column[inside]], depth[inside]
        beyond += int((shown > depth + _TOLERANCE * radius).sum())
        seen += int(((shown - depth).abs() <= _TOLERANCE * radius).sum())
    return beyond / (beyond + seen) if beyond + seen >= _LEAST_POINTS else 0.0


def middle_of(directions: Tensor, blocked: Tensor) -> Tensor:
    """(3,) float64 unit vector: the middle of the directions that are covered."""
    middle = directions[blocked > BLOCKED].sum(0)
    return functional.normalize(middle, dim=0) if math.isfinite(float(middle.norm())) else middle


_PIECES = 800
_BINS = 128
_CARRIES = 1e-3
"""Pixels that a Gaussian makes up at least to have heat of the surface."""
_COLOURS = 16
"""Cameras on each side of a look from which the colours of Gaussians are compared, and that see what covers."""
_COVERS, _PIXELS = 0.2, 1.0
"""Heat of what covers an object, and pixels of it that a Gaussian makes up to have half of that."""


def pair_of(pieces: Elements, view: Sight, score: Tensor, shown: Tensor) -> tuple[int, int, float] | None:
    """The two cameras between which the surface that both see changes most, near each other if possible."""
    rows = score.argsort(descending=True)[:_PIECES]
    rows = rows[score[rows] > 0]
    seen, colours = pieces.moments[rows, :, 0] * score[rows, None], pieces.moments[rows, :, 1:4]
    inside, outside = shown.nonzero()[:, 0], (~shown).nonzero()[:, 0]
    if not len(rows) or not len(inside) or not len(outside):
        return None
    weight, change = torch.zeros(len(inside), len(outside)), torch.zeros(len(inside), len(outside))
    for number, camera in enumerate(inside.tolist()):
        both = (seen[:, camera, None] > 0) * seen[:, outside]
        gap = (colours[:, outside] - colours[:, camera, None]).abs().mean(-1)
        weight[number], change[number] = both.sum(0), (both * gap).sum(0)
    near = (angles_between(view.directions[inside], view.directions[outside]) / 2).deg2rad().cos()
    value = change * near
    best = int(value.argmax())
    first, second = divmod(best, len(outside))
    if not weight[first, second] > 0:
        return None
    return int(inside[first]), int(outside[second]), float(change[first, second] / weight[first, second])


def heat_of(
    scene: GaussianScene, pieces: Elements, view: Sight, score: Tensor, target: Target, looks: Sequence[Look]
) -> Tensor:
    """(N,) how much of the looks of an object each Gaussian carries.

    It is the larger of two scores: that of the surface that it makes up in some pictures, and that of its own colour,
    between the cameras that see a look and those that do not; so the back of an object has heat as well.
    """
    value = torch.cat([torch.stack([score, torch.ones(len(score))], 1), torch.zeros(1, 2)])[pieces.of_seen]
    sums = torch.zeros(len(scene), 2)
    for number, (pixels, seen) in view.pixels.items():
        camera = view.cameras[number]
        wanted = torch.zeros(camera.height * camera.width, 2)
        wanted[pixels] = value[seen]
        sums += _made_up(scene, camera, wanted.reshape(camera.height, camera.width, 2), near_of(target, view.cameras))
    heat = torch.where(sums[:, 1] > _CARRIES, sums[:, 0] / sums[:, 1].clamp(min=_CARRIES), 0.0)
    near = ((scene.means - target.centre.float()).norm(dim=1) < AROUND * target.radius).nonzero()[:, 0]
    for look in looks:
        heat[near] = torch.maximum(heat[near], own_scores(scene.select(near), view, look.shown))
    return heat


def own_scores(scene: GaussianScene, view: Sight, shown: Tensor) -> Tensor:
    """(N,) score of each Gaussian by itself: how far its colour switches with a look."""
    sums = []
    for side in (shown, ~shown):
        total = torch.zeros(len(scene), 5)
        for number in _evenly(side.nonzero()[:, 0], _COLOURS):
            towards = functional.normalize(scene.means - view.cameras[number].position.float(), dim=1)
            colours = sh_to_colour(scene.sh, towards).clamp(0, 1)
            total += torch.cat([torch.ones(len(scene), 1), colours, colours.square().sum(1, keepdim=True)], 1)
        sums.append(total)
    return Split.of(*sums).scores()


def cover_heat(scene: GaussianScene, view: Sight, cover: Cover, target: Target) -> Tensor:
    """(N,) which Gaussians in the air cover an object: `_COVERS` of those that make up many pixels of what does."""
    sums, near = torch.zeros(len(scene)), near_of(target, view.cameras)
    for number in _evenly(torch.tensor(list(cover.air)), _COLOURS):
        air = cover.air[number].float()
        sums += _made_up(scene, view.cameras[number], torch.stack([air, air], -1), near)[:, 0]
    in_air = (scene.means - target.centre.float()).norm(dim=1) > AIR * target.radius
    heat: Tensor = _COVERS * in_air * sums / (sums + _PIXELS)
    return heat


def _evenly(values: Tensor, most: int) -> list[int]:
    """At most so many of (M,) values, evenly taken."""
    chosen: list[int] = values[torch.linspace(0, len(values) - 1, min(len(values), most)).round().long()].tolist()
    return chosen


def _made_up(scene: GaussianScene, camera: Camera, wanted: Tensor, near: float) -> Tensor:
    """(N, 2) sums over the pixels of a picture of each Gaussian's weight there times (H, W, 2) values.

    A picture is linear in the colours, so the derivative by a Gaussian's colour is the sum of its weights.
    """
    step = float(colour_to_dc(torch.tensor(1.0)) - colour_to_dc(torch.tensor(0.0)))
    sh = torch.zeros(len(scene), 1, 3, requires_grad=True)
    with torch.enable_grad():
        picture = Renderer(RenderSettings(near=near))(GaussianScene.unchecked(*scene.tensors()[:4], sh), camera)
        (gradient,) = torch.autograd.grad((picture[..., :2] * wanted).sum(), sh)
    sums: Tensor = gradient[:, 0, :2] * step
    return sums


def split_of(values: Tensor) -> float:
    """The number that best parts values that are spread over decades into two groups (Otsu 1979, of fourth roots)."""
    values = values**0.25
    top = float(values.max()) if len(values) else 0.0
    if not top > 0:
        return 0.0
    counts = torch.histc(values, _BINS, 0.0, top).double()
    middles = (torch.arange(_BINS, dtype=torch.float64) + 0.5) * top / _BINS
    low, sums = counts.cumsum(0), (counts * middles).cumsum(0)
    high = counts.sum() - low
    gap = sums / low.clamp(min=1) - (sums[-1] - sums) / high.clamp(min=1)
    return float((((low * high * gap.square()).argmax() + 1) * top / _BINS) ** 4)
