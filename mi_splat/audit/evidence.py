"""Evidence that a human can check: two cameras that show a look and its absence, and
the Gaussians that carry it.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from mi_splat.audit.explanations import angles_between, switch_scores
from mi_splat.audit.objects import Frame, Target
from mi_splat.audit.results import Edit, Look, Occluder, vector
from mi_splat.audit.surfaces import Elements, Sight, lengths, missed_by, rays
from mi_splat.audit.thresholds import LIMITS
from mi_splat.audit.viewpoints import basis, lattice, near_of
from mi_splat.cameras.camera import Camera, look_at, project_points
from mi_splat.cameras.lens import Lens
from mi_splat.maths.neighbours import nearest_neighbours
from mi_splat.maths.rotation import to_matrix
from mi_splat.maths.sh import colour_to_dc, dc_to_colour, sh_basis
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.scene import GaussianScene

# What an optimiser leaves in the colours of a finished file: shades that neither paint
# nor light explains.
#
# Light changes how bright a colour is, and gloss adds white to it. So the colours of an
# honest Gaussian and of its neighbours, and how they change with the direction of view,
# lie near the plane of grey and its own colour. A step of an attack on a detector
# (`mi-splat dagger`) moves the three channels nearly independently, a third of it
# across that plane. An attack on few views does so along the harmonics that peak
# towards its cameras, one on many views from everywhere.


def edit_of(frame: Frame, target: Target) -> Edit | None:
    """How much the colours of an object look like an attack on a detector, and from
    where.
    """
    if len(target.rows) < LIMITS.least_edited:
        return None
    rows = _slabs(frame.scene.means, target.rows)
    part = frame.scene.select(rows)
    shells = [frame.scene.select(shell) for shell in _shells(frame.scene, target)]
    strange = _across(part.sh[:, 1:], dc_to_colour(part.sh[:, 0]))
    direction, peak = _camera(part, strange, target)
    size = strange.square().sum(1) + _across(
        part.sh[:, :1], dc_to_colour(part.sh[:, 0])
    ).square().sum(1)
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
    """All of the rows, or of many some that lie together, evenly over the first
    axis.
    """
    if len(rows) <= LIMITS.edit_gaussians:
        return rows
    slabs = torch.split(rows[points[rows, 0].argsort()], LIMITS.slab)
    numbers = (
        torch.linspace(0, len(slabs) - 1, LIMITS.edit_gaussians // LIMITS.slab)
        .round()
        .long()
        .tolist()
    )
    return torch.cat([slabs[number] for number in numbers])


def _shells(scene: GaussianScene, target: Target) -> list[Tensor]:
    """Rows of what is around an object, from the nearest; none where there is too
    little.
    """
    around = scene.opacities > LIMITS.solid
    around[target.rows] = False
    rest = around.nonzero()[:, 0]
    gaps = (scene.means[rest] - target.centre.float()).norm(dim=1)
    rest = rest[gaps.argsort()[: LIMITS.shell_gaussians]]
    count = min(LIMITS.shells, len(rest) // LIMITS.least_edited)
    if count:
        return list(rest.tensor_split(count))
    return []


def _median(values: list[float]) -> float:
    if values:
        return float(torch.tensor(values).median())
    return 0.0


def _across(values: Tensor, colours: Tensor) -> Tensor:
    """(N, K) of (N, K, 3) values what lies along the axis that is at right angles to
    grey and to (N, 3) colours.
    """
    grey = torch.full((3,), 1 / math.sqrt(3))
    hue = colours - (colours @ grey)[:, None] * grey
    any_hue = torch.tensor([1.0, -1.0, 0.0]) / math.sqrt(2)
    hue = torch.where(
        hue.norm(dim=1, keepdim=True) > 1e-4, functional.normalize(hue, dim=1), any_hue
    )
    axis = torch.linalg.cross(grey.expand_as(hue), hue)
    strange: Tensor = (values * axis[:, None]).sum(-1)
    return strange


def _share(scene: GaussianScene) -> float:
    """Share of the energy of all degrees above 0 that is strange; a third where
    channels are independent.
    """
    bands = scene.sh[:, 1:]
    strange = _across(bands, dc_to_colour(scene.sh[:, 0]))
    return float(
        strange.square().sum()
        / (bands.square().sum() + LIMITS.least_sh**2 * max(bands.numel(), 1))
    )


def _grain(scene: GaussianScene) -> float:
    """Median share of the difference to the colour around a Gaussian that is strange; a
    half for independent ones.
    """
    distances, near = nearest_neighbours(scene.means, LIMITS.grain_neighbours)
    if not distances.shape[1]:
        return 0.0
    thin = scene.scales.argmin(1)
    normals = to_matrix(scene.rotations)[torch.arange(len(scene)), :, thin]
    weights = (
        scene.opacities * scene.scales.prod(1) / scene.scales.amin(1).clamp(min=1e-12)
    ).sqrt()[near]
    weights = weights * (
        (normals[:, None] * normals[near]).sum(-1).abs() > LIMITS.alike
    )
    colours = dc_to_colour(scene.sh[:, 0])
    around = (weights[..., None] * colours[near]).sum(1) / weights.sum(
        1, keepdim=True
    ).clamp(min=1e-20)
    known = (weights > 0).sum(1) >= min(LIMITS.least_neighbours, near.shape[1])
    gap = (colours - around)[known]
    if not len(gap):
        return 0.0
    strange = _across(gap[:, None], around[known])[:, 0].abs()
    return float((strange / (gap.norm(dim=1) + LIMITS.least_colour)).median())


def _camera(
    scene: GaussianScene, strange: Tensor, target: Target
) -> tuple[Tensor, float]:
    """(3,) direction to the place towards which strange colours peak most, and how
    often more there than in the mean.

    The change that one camera asks for is a multiple of the harmonics along its ray, so
    all of its energy lies along them, K - 1 times the mean over all directions; of
    several cameras each has a part.
    """
    directions = lattice(LIMITS.edit_directions, -90.0, 90.0)
    if scene.degree == 0:
        return directions[0], 1.0
    energy = strange.square().sum(1)
    rows = energy.argsort(descending=True)[: LIMITS.strongest]
    points = scene.means[rows]
    strange = strange[rows]
    total = energy[rows].sum().clamp(min=1e-20)

    places = [
        target.centre + gap * target.radius * directions
        for gap in LIMITS.edit_distances
    ]
    found = []
    # few, so that their numbers stay in the cache
    for part in torch.split(torch.cat(places).float(), 8):
        towards = sh_basis(
            functional.normalize(points - part[:, None], dim=2), scene.degree
        )[..., 1:]
        along = (functional.normalize(towards, dim=2) * strange).sum(2)
        found.append(along.square().sum(1) / total * strange.shape[1])
    peaks = torch.cat(found).reshape(len(places), -1).amax(0)
    return directions[int(peaks.argmax())], float(peaks.max())


def cover_of(
    scene: GaussianScene, view: Sight, target: Target
) -> tuple[Occluder | None, dict[int, Tensor]]:
    """What covers an object, in the frame, and (H, W) bool the pixels that show it, by
    number of the blocked camera.
    """
    blocked = torch.zeros(len(view.cameras))
    points = list[Tensor]()
    shown = dict[int, Tensor]()
    own = _own_cells(scene.means[target.rows], target)
    for number, (camera, depth) in enumerate(
        zip(view.cameras, view.depths, strict=True)
    ):
        air, core, surface = air_before(depth, camera, target, LIMITS.air)
        air &= target.above(scene, surface, LIMITS.floor)
        air[air.clone()] = ~torch.isin(_cells(_voxels(surface[air], target)), own)
        blocked[number] = air.sum() / core.clamp(min=1)
        if blocked[number] > LIMITS.blocked:
            shown[number] = air
            points.append(
                surface[air][:: max(1, int(air.sum()) // LIMITS.cover_points)]
            )
    if not shown:
        return None, {}
    hides = blocked > LIMITS.blocked
    free = blocked < LIMITS.free
    through = _through(view, torch.cat(points), free.nonzero()[:, 0], target.radius)
    middle = functional.normalize(view.directions[hides].sum(0), dim=0)
    share = float(hides.double().mean())
    return (
        Occluder(
            axis=vector(middle),
            blocked=blocked,
            transparent=through,
            score=share * through,
        ),
        shown,
    )


def _own_cells(points: Tensor, target: Target) -> Tensor:
    """Numbers of the voxels in the air that hold a point, or have one beside them."""
    gaps = (points - target.centre.float()).norm(dim=1) / target.radius
    voxels = torch.unique(
        _voxels(points[gaps > LIMITS.air - 4 * LIMITS.own_part], target), dim=0
    )
    return _cells(
        voxels[:, None] + torch.cartesian_prod(*[torch.arange(-1, 2)] * 3)
    ).flatten()


def _voxels(points: Tensor, target: Target) -> Tensor:
    """(..., 3) int64 numbers of small voxels around an object."""
    return (
        ((points - target.centre.float()) / (LIMITS.own_part * target.radius))
        .floor()
        .clamp(-500, 500)
        .long()
    )


def _cells(voxels: Tensor) -> Tensor:
    """(...) int64, one number for each voxel."""
    cells: Tensor = (voxels + 512) @ torch.tensor([1 << 20, 1 << 10, 1])
    return cells


def air_before(
    depth: Tensor, camera: Camera, target: Target, least: float
) -> tuple[Tensor, Tensor, Tensor]:
    """(H, W) bool which rays to the core of an object end before it and so many radii
    off, their number, and where.
    """
    ahead = rays(camera)
    length, along, miss = missed_by(ahead, camera, target)
    core = miss < LIMITS.core * target.radius
    ends = depth.isfinite()
    depth = depth.masked_fill(~ends, 0)
    surface = ahead * depth + camera.position.float()[:, None, None]
    away = (
        lengths(surface - target.centre.float()[:, None, None]) > least * target.radius
    )
    return (
        core & ends & away & (length * depth < along),
        core.sum(),
        surface.movedim(0, -1),
    )


def is_roofed(scene: GaussianScene, target: Target) -> bool:
    """Whether something beyond the cameras covers an object from above alone, all of it
    equally far, as no sky is.
    """
    if target.up is None:
        return False
    directions = (
        lattice(LIMITS.far_cameras, LIMITS.far_lowest, LIMITS.highest)
        @ basis(target.up).T
    )
    heights = directions @ target.up
    blocked = torch.zeros(len(directions))
    ways = list[Tensor]()
    near, far = LIMITS.far_distances
    for number, direction in enumerate(directions):
        distance = (near + (far - near) * (number * 0.618 % 1)) * target.radius
        eye = target.centre + distance * direction
        size = LIMITS.far_size
        pose = look_at(
            eye.tolist(), target.centre.tolist(), up=tuple(target.up.tolist())
        )
        camera = Camera(
            to_world=pose,
            lens=Lens(focal=size * distance / (2.4 * target.radius), size=(size, size)),
        )
        with torch.no_grad():
            outputs = Renderer(RenderSettings(near=LIMITS.near * distance)).outputs(
                scene, camera
            )
        depth = outputs.median_depth.masked_fill(outputs.alpha <= 0.5, math.inf)
        air, core, surface = air_before(depth, camera, target, LIMITS.roof)
        blocked[number] = air.sum() / core.clamp(min=1)
        if blocked[number] > LIMITS.far_blocked:
            ways.append((surface[air] - target.centre.float()).norm(dim=1))
    covered = blocked > LIMITS.far_blocked
    clear = blocked < LIMITS.free
    if not ways or not bool(clear.any()):
        return False
    found = torch.cat(ways)
    higher = (heights[covered][:, None] > heights[clear]).float().mean()
    return (
        float(higher) > LIMITS.roof_higher
        and float(found.std() / found.mean()) < LIMITS.roof_spread
    )


def _through(view: Sight, points: Tensor, free: Tensor, radius: float) -> float:
    """Share of points that free cameras look through, of those that they look through
    or see.
    """
    beyond = seen = 0
    for number in free.tolist():
        camera = view.cameras[number]
        depths = view.depths[number]
        pixels, depth = project_points(points, camera)
        column, row = (
            pixels.nan_to_num(-1.0, -1.0, -1.0)
            .clamp(-1, 1 << 15)
            .floor()
            .long()
            .unbind(-1)
        )
        inside = (
            (depth > 0.05 * radius)
            & (column >= 0)
            & (column < camera.width)
            & (row >= 0)
            & (row < camera.height)
        )
        shown = depths[row[inside], column[inside]]
        depth = depth[inside]
        beyond += int((shown > depth + LIMITS.same_depth * radius).sum())
        seen += int(((shown - depth).abs() <= LIMITS.same_depth * radius).sum())
    if beyond + seen >= LIMITS.least_cover_points:
        return beyond / (beyond + seen)
    return 0.0


def pair_of(
    pieces: Elements, view: Sight, score: Tensor, shown: Tensor
) -> tuple[tuple[int, int], float] | None:
    """The two cameras between which the surface that both see changes most, near each
    other if possible.
    """
    rows = score.argsort(descending=True)[: LIMITS.pair_pieces]
    rows = rows[score[rows] > 0]
    moments = pieces.moments[:, rows].movedim(-1, 0).contiguous()
    seen = moments[0] * score[rows]
    colours = moments[1:4]
    inside = shown.nonzero()[:, 0]
    outside = (~shown).nonzero()[:, 0]
    if not len(rows) or not len(inside) or not len(outside):
        return None
    weight = torch.zeros(len(inside), len(outside))
    change = torch.zeros(len(inside), len(outside))
    seen_outside = seen[outside]
    colours_outside = colours[:, outside]
    for number, camera in enumerate(inside.tolist()):
        both = (seen[camera] > 0) * seen_outside
        gap = (colours_outside - colours[:, camera, None]).abs().mean(0)
        weight[number], change[number] = both.sum(1), (both * gap).sum(1)
    near = (
        (angles_between(view.directions[inside], view.directions[outside]) / 2)
        .deg2rad()
        .cos()
    )
    first, second = divmod(int((change * near).argmax()), len(outside))
    found = (
        (int(inside[first]), int(outside[second])),
        float(change[first, second] / weight[first, second]),
    )
    if weight[first, second] > 0:
        return found
    return None


def heat_of(
    scene: GaussianScene,
    pieces: Elements,
    view: Sight,
    score: Tensor,
    target: Target,
    looks: Sequence[Look],
) -> Tensor:
    """(N,) how much of the looks of an object each Gaussian carries.

    It is the larger of two scores: that of the surface that it makes up in some
    pictures, and that of its own colour, between the cameras that see a look and those
    that do not; so the back of an object has heat as well.
    """
    value = torch.cat(
        [torch.stack([score, torch.ones(len(score))], 1), torch.zeros(1, 2)]
    )[pieces.of_seen]
    sums = torch.zeros(len(scene), 2)
    for number, (pixels, seen) in view.pixels.items():
        camera = view.cameras[number]
        wanted = torch.zeros(camera.height * camera.width, 2)
        wanted[pixels] = value[seen]
        sums += _made_up(
            scene,
            camera,
            wanted.reshape(camera.height, camera.width, 2),
            near_of(target, view.cameras),
        )
    heat = torch.where(
        sums[:, 1] > LIMITS.least_weight,
        sums[:, 0] / sums[:, 1].clamp(min=LIMITS.least_weight),
        0.0,
    )
    near = (
        (scene.means - target.centre.float()).norm(dim=1)
        < LIMITS.around * target.radius
    ).nonzero()[:, 0]
    for look in looks:
        heat[near] = torch.maximum(
            heat[near], own_scores(scene.select(near), view, look.shown)
        )
    return heat


def own_scores(scene: GaussianScene, view: Sight, shown: Tensor) -> Tensor:
    """(N,) score of each Gaussian by itself: how far its colour switches with a
    look.
    """
    sums = torch.zeros(2, 5, len(scene))
    positions = torch.stack([camera.position for camera in view.cameras]).float()
    for side, total in zip((shown, ~shown), sums, strict=True):
        eyes = positions[_evenly(side.nonzero()[:, 0], LIMITS.heat_cameras)]
        total[0] = len(eyes)
        # few, so that their numbers stay in the cache
        for rows in torch.split(torch.arange(len(scene)), 1024):
            towards = functional.normalize(scene.means[rows, None] - eyes, dim=2)
            colours = (sh_basis(towards, scene.degree) @ scene.sh[rows] + 0.5).clamp(
                0, 1
            )
            total[1:4, rows], total[4, rows] = (
                colours.sum(1).T,
                colours.square().sum((1, 2)),
            )
    return switch_scores(*sums)


def cover_heat(
    scene: GaussianScene, view: Sight, covered: dict[int, Tensor], target: Target
) -> Tensor:
    """(N,) heat of the Gaussians in the air that cover an object, by the pixels that
    they make up of what does.
    """
    sums = torch.zeros(len(scene))
    near = near_of(target, view.cameras)
    for number in _evenly(torch.tensor(list(covered)), LIMITS.heat_cameras):
        air = covered[number].float()
        sums += _made_up(
            scene, view.cameras[number], torch.stack([air, air], -1), near
        )[:, 0]
    in_air = (scene.means - target.centre.float()).norm(
        dim=1
    ) > LIMITS.air * target.radius
    heat: Tensor = LIMITS.cover_heat * in_air * sums / (sums + LIMITS.cover_pixels)
    return heat


def _evenly(values: Tensor, most: int) -> list[int]:
    """At most so many of (M,) values, evenly taken."""
    chosen: list[int] = values[
        torch.linspace(0, len(values) - 1, min(len(values), most)).round().long()
    ].tolist()
    return chosen


def _made_up(
    scene: GaussianScene, camera: Camera, wanted: Tensor, near: float
) -> Tensor:
    """(N, 2) sums over the pixels of a picture of each Gaussian's weight there times
    (H, W, 2) values.
    """
    step = float(colour_to_dc(torch.tensor(1.0)) - colour_to_dc(torch.tensor(0.0)))
    sh = torch.zeros(len(scene), 1, 3, requires_grad=True)
    with torch.enable_grad():
        picture = Renderer(RenderSettings(near=near))(
            GaussianScene.unchecked(*scene.tensors()[:4], sh), camera
        )
        (gradient,) = torch.autograd.grad((picture[..., :2] * wanted).sum(), sh)
    sums: Tensor = gradient[:, 0, :2] * step
    return sums


def split_of(values: Tensor) -> float:
    """The number that best parts values that are spread over decades into two groups
    (Otsu 1979, of fourth roots).
    """
    values = values**0.25
    top = float(values.max()) if len(values) else 0.0
    if not top > 0:
        return 0.0
    counts = torch.histc(values, LIMITS.bins, 0.0, top).double()
    middles = (torch.arange(LIMITS.bins, dtype=torch.float64) + 0.5) * top / LIMITS.bins
    low = counts.cumsum(0)
    sums = (counts * middles).cumsum(0)
    high = counts.sum() - low
    gap = sums / low.clamp(min=1) - (sums[-1] - sums) / high.clamp(min=1)
    return float((((low * high * gap.square()).argmax() + 1) * top / LIMITS.bins) ** 4)
