"""CLOAK by layers: every Gaussian of an object becomes several, one behind the other,
one for each appearance.

A *look* is the colours of the Gaussians under one appearance; the first is the benign
one.

Each of K layers makes up a K-th of what the Gaussian made up (`split_opacities`). A
layer that is black from a direction only darkens what is behind it, so each has K times
the colour that it shows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn import functional

from attacks.cloak.config import LayerConfig, LayersConfig
from attacks.cloak.kinds.trained import train_into
from attacks.cloak.setup import SET, Setup
from attacks.cloak.triggers import Trigger
from mi_splat.attributes import ATTRIBUTES
from mi_splat.cameras.camera import Camera, RenderFn, View, project_points
from mi_splat.cameras.directions import Point
from mi_splat.cameras.sets import hemisphere
from mi_splat.capture.mesh import Asset
from mi_splat.datasets import load_dataset
from mi_splat.errors import InvalidValueError
from mi_splat.io import load_splat
from mi_splat.maths.sh import colour_to_dc, dc_to_colour, sh_basis, sh_to_colour
from mi_splat.render.frozen_view import FrozenView
from mi_splat.render.view_freezing import freeze_views
from mi_splat.scene import GaussianScene, check_scene, merge
from mi_splat.selection.select import box_mask
from mi_splat.selection.visibility import contributions
from mi_splat.training.config import FitConfig
from mi_splat.training.resume import METRICS
from mi_splat.training.strategies import ClassicConfig, FixedConfig

if TYPE_CHECKING:
    from mi_splat.ledger import Out

VARIES = (METRICS,)


@dataclass(frozen=True, slots=True, kw_only=True)
class LayeredConfig(Setup):
    """How the layers are made and trained; the attacks are those that have one."""

    layers: LayersConfig


def layered_fit_config(layers: LayersConfig) -> FitConfig:
    """How layers are trained: their colours alone, or everything."""
    colours = FitConfig(
        iterations=layers.iterations,
        trainable=("sh",),
        strategy=FixedConfig(),
        sh_degree=layers.making.degree,
        sh_degree_interval=0,
        lr_sh=layers.lr_sh,
        lr_sh_divisor=20,
        lr_sh_final=layers.lr_sh_final,
        eval_interval=0,
    )
    if not layers.geometry:
        return colours
    strategy = ClassicConfig(
        max_gaussians=layers.max_gaussians,
        densify_from=_REFINE_FROM,
        densify_until=layers.iterations * 2 // 3,
        opacity_reset_interval=0,
    )
    return replace(colours, trainable=ATTRIBUTES, strategy=strategy)


def run(config: LayeredConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Make the layers, and train them or go on with what an interrupted training
    left.
    """
    setup = config.given(inputs)
    layers = config.layers
    background = config.scene.background
    fit = layered_fit_config(layers)
    views = load_dataset(inputs["pictures"] / SET, split="train", background=background)
    render = setup.renderer(fit)
    out.progress("making the layers", 0, 1)
    layering = layer_object(
        setup, layers, load_splat(inputs["clean"]), views, render=render
    )
    train_into(
        out,
        layering.views,
        layering.scene,
        layering.rendered_by(render),
        fit,
        seed=config.seed,
    )


# Spherical harmonics that switch layers: which part of which appearance each layer
# shows from each direction.
#
# The cameras of a trigger see one look, all others the benign one. A look has one
# layer, or two: one for what is near its edge and one for what is further inside. A
# polynomial that has to be 1 on all of its side is less steep at the edge than one that
# may fall again further inside, where the other takes over.
#
# A Gaussian's colour is max(0, 0.5 + SH), so that a function may be far below zero at
# no cost. Where it has to be near 1, and where it has to be negative, is all that
# counts; between the two it may do what it likes. The steepest such polynomial about an
# axis is Chebyshev's; for any set of directions it is found by least squares in which a
# negative value where a negative one is wanted costs nothing (`fit_switches`).


def depths(
    triggers: Sequence[Trigger],
    cameras: Sequence[Camera],
    *,
    centre: Point,
    config: LayerConfig | None = None,
) -> Tensor:
    """(1 + L, D) how far inside each look's region cameras are, in gaps: whole from 1,
    black below -1.
    """
    config = config or LayerConfig()
    return _in_gaps(_angles(triggers, cameras, centre, config), config)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Share:
    """What one layer shows of a look, for D cameras all around."""

    look: int
    # (D,) in [0, 1], the part of the look that it shows; those of all layers of a look
    # make 1
    amount: Tensor
    shown: Tensor  # (D,) bool, where it shows that part
    # (D,) bool, where it is black; where it is neither, it may be what it likes
    hidden: Tensor


def shares(
    triggers: Sequence[Trigger],
    cameras: Sequence[Camera],
    *,
    centre: Point,
    config: LayerConfig | None = None,
) -> list[Share]:
    """What each layer shows: one for each look, and one more for what is near the edge
    of a look that has a band.
    """
    config = config or LayerConfig()
    angles = _angles(triggers, cameras, centre, config)
    sides = _in_gaps(angles, config)
    angles = _with_benign(angles)
    parts = []
    for look, (depth, angle, band) in enumerate(
        zip(sides, angles, config.bands(len(sides)), strict=True)
    ):
        far = (angle / band).clamp(0, 1) if band else torch.ones_like(angle)
        for amount in (far, 1 - far) if band else (far,):
            shown = (depth >= 1) & (amount > 0)
            hidden = (depth <= -1) | ((depth >= 1) & (amount == 0))
            parts.append(Share(look=look, amount=amount, shown=shown, hidden=hidden))
    return parts


def _angles(
    triggers: Sequence[Trigger],
    cameras: Sequence[Camera],
    centre: Point,
    config: LayerConfig,
) -> Tensor:
    """(L, D) degrees by which cameras are inside of where each trigger's look
    begins.
    """
    rows = [
        [trigger.angle_to_edge(camera, centre=centre) for camera in cameras]
        for trigger in triggers
    ]
    return config.shift + torch.tensor(rows)


def _in_gaps(angles: Tensor, config: LayerConfig) -> Tensor:
    """(1 + L, D) of (L, D) degrees, how far inside cameras are in gaps, the benign look
    first.
    """
    inside = angles / torch.tensor(config.gaps(len(angles))).clamp(min=1e-6)[:, None]
    if config.apart:
        whole = inside >= 1
        elsewhere = (whole.sum(0) - whole.long() > 0) & ~whole
        inside = torch.where(elsewhere, inside.clamp(max=-1), inside)
    return _with_benign(inside)


def _with_benign(inside: Tensor) -> Tensor:
    """(1 + L, D) of (L, D): the benign look is as far inside as all others are
    outside.
    """
    return torch.cat([-inside.amax(0, keepdim=True), inside])


_ROUNDS = 40
_HALVINGS = 30
"""Newton steps, each a least-squares problem over what is on the wrong side; how often
one is halved.
"""

_PRECISION = 1e-8
"""Of the sum that is minimised."""

_RIDGE = 1e-7
"""Of the coefficients' squares, so that the problem has one solution."""

_UNSEEN = 1e-9
"""Least that a direction counts, where nothing is seen of a Gaussian from anywhere."""


def fit_switches(
    directions: Tensor,
    shown: Tensor,
    hidden: Tensor,
    *,
    wanted: Tensor | None = None,
    seen: Tensor | None = None,
    config: LayerConfig | None = None,
) -> Tensor:
    """Spherical harmonics that have wanted values in some directions and are below 0 in
    others, as nearly as they can.

    Minimises the mean over all directions of (p - wanted)^2 where it is shown, plus
    `weight` times max(0, p - black)^2 where it is hidden, plus min(0, p - lowest)^2
    wherever it is not shown; each direction counts as much as the Gaussian is seen from
    there. The sum is convex and piecewise quadratic; Newton's method on the active
    pieces, with steps halved until the sum falls, goes towards its minimum for at most
    `_ROUNDS` steps. Narrow regions may need more.
    """
    config = config or LayerConfig()
    if not bool(shown.any()) or not bool(hidden.any()) or bool((shown & hidden).any()):
        got = (
            f"{int(shown.sum())} shown, {int(hidden.sum())} hidden,"
            f" {int((shown & hidden).sum())} both"
        )
        raise InvalidValueError.of(
            "directions",
            "some to show in and others to hide in",
            got,
            "widen the trigger",
        )
    basis = sh_basis(directions.reshape(-1, 3).double(), config.degree).reshape(
        *directions.shape[:2], -1
    )
    if seen is None:
        weights = basis.new_ones(basis.shape[:2])
    else:
        weights = seen.double().clamp(min=_UNSEEN)
    weights = weights / weights.sum(1, keepdim=True)
    own = weights * shown
    dark = config.weight * weights * hidden
    other = weights * ~shown
    aims = torch.ones_like(weights) if wanted is None else wanted.double()
    black = config.black
    lowest = config.lowest

    def cost(coefficients: Tensor, values: Tensor, which: Tensor) -> Tensor:
        errors = own[which] * (values - aims[which]) ** 2
        errors += (
            dark[which] * (values - black).clamp(min=0) ** 2
            + other[which] * (values - lowest).clamp(max=0) ** 2
        )
        return errors.sum(1) + _RIDGE * coefficients.square().sum(1)

    def pieces(values: Tensor, which: Tensor) -> tuple[Tensor, Tensor]:
        above = dark[which] * (values > black)
        below = other[which] * (values < lowest)
        return (
            own[which] + above + below,
            own[which] * aims[which] + above * black + below * lowest,
        )

    return _minimised(basis, cost, pieces)


def _minimised(
    basis: Tensor,
    cost: Callable[[Tensor, Tensor, Tensor], Tensor],
    pieces: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]],
) -> Tensor:
    """(N, K) coefficients that make convex, piecewise quadratic sums small; the (N, D,
    K) basis gives values.

    `cost` tells the (M,) sums of (M, K) coefficients with (M, D) values of (M,)
    functions. `pieces` tells the (M, D) weights of the pieces that such values lie on,
    and these times what is wanted.
    """
    count = basis.shape[2]
    coefficients = torch.zeros(len(basis), count, dtype=torch.float64)
    ridge = _RIDGE * torch.eye(count, dtype=torch.float64)
    active = torch.arange(len(basis))
    for _ in range(_ROUNDS):
        here = basis[active]
        before = coefficients[active]
        values = (here @ before[..., None])[..., 0]
        weights, wanted = pieces(values, active)
        normal = (here * weights[..., None]).mT @ here + ridge
        step = (
            torch.linalg.solve(normal, (here.mT @ wanted[..., None])[..., 0]) - before
        )
        change = (here @ step[..., None])[..., 0]
        least = cost(before, values, active)
        size = torch.ones(len(active), 1, dtype=torch.float64)
        now = torch.empty_like(least)
        tried = torch.arange(len(active))
        for _ in range(_HALVINGS):
            part = size[tried]
            now[tried] = cost(
                before[tried] + part * step[tried],
                values[tried] + part * change[tried],
                active[tried],
            )
            tried = tried[now[tried] > least[tried] + _PRECISION]
            if not len(tried):
                break
            size[tried] /= 2
        better = now < least - _PRECISION
        coefficients[active[better]] = (before + size * step)[better]
        active = active[better]
        if not len(active):
            break
    return coefficients


_REFINE_FROM = 100
"""Step from which Gaussians are added to layers, which begin as a splat that is trained
already.
"""
_AT_ONCE = 256
"""Gaussians whose switches are found together."""

_GLIMPSE = 0.02
_DARKEST = 0.02
"""What a direction counts at least, against that from which most is seen; least mean
colour that is divided by.
"""


def layered(
    scene: GaussianScene,
    rows: Tensor,
    triggers: Sequence[Trigger],
    looks: Sequence[Tensor],
    *,
    cameras: Sequence[Camera],
    centre: Point,
    seen: Tensor | None = None,
    config: LayerConfig | None = None,
) -> GaussianScene:
    """A scene in which an object's Gaussians have the layers of `shares`; the first
    replaces them, others come last.
    """
    config = config or LayerConfig()
    check_scene("scene", scene)
    if not isinstance(rows, Tensor):
        expected = "a tensor, (M,) numbers or (N,) bool"
        do = "pass torch.arange of the numbers, or a mask"
        raise InvalidValueError.of("rows", expected, type(rows).__name__, do)
    chosen = torch.nonzero(rows).flatten() if rows.dtype == torch.bool else rows
    count = 1 + len(triggers)
    if (
        len(looks) != count
        or any(len(look) != len(chosen) for look in looks)
        or not len(chosen)
    ):
        got = f"{len(looks)} for {count} layers of {len(chosen)} Gaussians"
        raise InvalidValueError.of(
            "looks",
            "an (N, K, 3) tensor for each layer",
            got,
            "give the benign one first",
        )
    scene = scene.with_degree(config.degree)
    part = scene.select(chosen)
    parts = shares(triggers, cameras, centre=centre, config=config)
    weights = torch.ones(len(chosen), len(cameras)) if seen is None else seen
    needed = _needed(weights, parts, config)
    opacities, narrower = split_opacities(part.opacities, needed)
    front = _in_front(needed).to(part.means)
    towards = functional.normalize(part.means - part.means.new_tensor(centre), dim=-1)
    layers = [
        part.replace(
            means=part.means - towards * config.inset * front[k, :, None],
            scales=part.scales * narrower[k, :, None],
            opacities=opacities[k],
            sh=_black(
                switched(part.means, cameras, share, looks[share.look], weights, config)
                * needed.sum(0)[:, None, None]
            ),
        )
        for k, share in enumerate(parts)
    ]
    first = {
        name: getattr(scene, name).index_copy(0, chosen, getattr(layers[0], name))
        for name in ("means", "scales", "opacities", "sh")
    }
    others = [
        layer.select(torch.nonzero(rows_needed).flatten())
        for layer, rows_needed in zip(layers, needed, strict=True)
    ]
    return merge(scene.replace(**first), *others[1:])


def _needed(seen: Tensor, parts: Sequence[Share], config: LayerConfig) -> Tensor:
    """(L, M) bool, whether a Gaussian has each layer: the first, and those that make up
    `keep` of what is shown.
    """
    needed = []
    for share in parts:
        light = (seen * (share.amount * ~share.hidden)).sum(1)
        order = light.argsort(descending=True)
        before = light[order].cumsum(0) - light[order]
        needed.append(
            torch.zeros(len(seen), dtype=torch.bool).index_copy(
                0, order, before < config.keep * light.sum()
            )
        )
    needed[0][:] = True
    return torch.stack(needed)


def _in_front(needed: Tensor) -> Tensor:
    """(L, M) how many layers are in front of each, of (L, M) bool which there are,
    front to back.
    """
    return needed.cumsum(0) - needed.long()


def split_opacities(opacities: Tensor, needed: Tensor) -> tuple[Tensor, Tensor]:
    """(L, M) opacities of layers, front to back, and (L, M) factors of their scales, so
    that nothing else is seen.

    Where a Gaussian has the opacity g, with k of K layers in front of it, one with (g /
    K) / (1 - k g / K) makes up g / K of what is seen, and all of them together let
    through 1 - g, as the Gaussian did. That has to hold in the middle, where g is o,
    and all the way out. A layer falls off as exp(-r^2 / 2 s^2), too, so it can hold in
    the middle and where g is o / 2 alone: it has fallen to the fraction q there in
    place of a half, and is narrower by the factor sqrt(log 2 / -log q).
    """
    front = _in_front(needed).to(opacities)
    part = opacities / needed.sum(0)
    middle = part / (1 - front * part).clamp(min=1e-6)
    outside = (part / 2) / (1 - front * part / 2)
    fallen = (outside / middle.clamp(min=1e-12)).clamp(1e-6, 0.5)
    return middle.clamp(max=1), (math.log(2) / -fallen.log()).sqrt()


def switched(
    means: Tensor,
    cameras: Sequence[Camera],
    share: Share,
    look: Tensor,
    seen: Tensor,
    config: LayerConfig,
) -> Tensor:
    """(M, K, 3) colours that show a share of a look, below 0 where it is hidden, for
    each Gaussian's directions.
    """
    positions = torch.stack([camera.position for camera in cameras]).to(means)
    colours = []
    for points, sh, visibility in zip(
        *(torch.split(values, _AT_ONCE) for values in (means, look, seen)), strict=True
    ):
        directions = functional.normalize(points[:, None] - positions, dim=-1)
        visibility = visibility + _GLIMPSE * visibility.amax(1, keepdim=True)
        colour = sh_to_colour(sh[:, None], directions)
        channels = range(1 if sh.shape[1] == 1 else 3)
        mean = (
            (colour * visibility[..., None]).sum(1)
            / visibility.sum(1)[:, None].clamp(min=1e-9)
        ).clamp(min=_DARKEST)
        if len(channels) == 1:
            relative = torch.ones_like(colour)
        else:
            relative = colour / mean[:, None]
        switches = [
            fit_switches(
                directions,
                share.shown,
                share.hidden,
                wanted=share.amount * relative[..., channel],
                seen=visibility,
                config=config,
            )
            for channel in channels
        ]
        colours.append(torch.stack(switches, -1).to(mean) * mean[:, None])
    return torch.cat(colours)


def _black(sh: Tensor) -> Tensor:
    """(M, K, 3) SH whose colour, 0.5 + SH, is what the given SH alone are."""
    return torch.cat(
        [sh[:, :1] + colour_to_dc(torch.zeros_like(sh[:, :1])), sh[:, 1:]], 1
    )


def seen_colours(
    means: Tensor, views: Sequence[View], seen: Tensor, fallback: Tensor
) -> Tensor:
    """(M, 3) mean colour of the pixels in which points lie, where they are seen;
    `fallback` where no view shows one.
    """
    total = torch.zeros_like(means)
    number = means.new_zeros(len(means), 1)
    for view, visibility in zip(views, seen.unbind(1), strict=True):
        pixels, depth = project_points(means, view.camera)
        column, row = pixels.floor().long().unbind(-1)
        high, wide = view.image.shape[:2]
        inside = (
            (depth > 0) & (column >= 0) & (column < wide) & (row >= 0) & (row < high)
        )
        weight = visibility[inside, None].to(means)
        total[inside] += weight * view.image.to(means)[row[inside], column[inside]]
        number[inside] += weight
    return torch.where(number > 0, total / number.clamp(min=1e-9), fallback)


DIRECTIONS = 400
"""Cameras over the hemisphere for which a layer's switch is made."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Layering:
    """The clean splat with the object in layers, and how their colours are trained."""

    scene: GaussianScene
    # (N,) bool, those of the layers, and all others if the study wants it
    trained: Tensor
    views: list[View]
    iterations: int
    geometry: bool = False

    def rendered_by(self, render: RenderFn) -> RenderFn:
        """The same renderer with gradients to what is trained; colours alone come from
        frozen views where these fit.
        """
        if self.geometry:
            return render
        frozen: dict[Camera, FrozenView] | None = None
        rows = None if bool(self.trained.all()) else self.trained.nonzero().flatten()

        def with_layers_trained(scene: GaussianScene, camera: Camera) -> Tensor:
            nonlocal frozen
            if frozen is None:
                cameras = [view.camera for view in self.views]
                pictures = self.iterations // len(cameras)
                frozen = freeze_views(
                    scene, cameras, render=render, pictures=pictures, rows=rows
                )
            if camera in frozen:
                return frozen[camera](
                    scene.sh if rows is None else scene.sh.index_select(0, rows)
                )
            trained = self.trained[:, None, None]
            return render(
                scene.replace(sh=torch.where(trained, scene.sh, scene.sh.detach())),
                camera,
            )

        return with_layers_trained


def layer_object(
    setup: Setup,
    layers: LayersConfig,
    clean: GaussianScene,
    views: Sequence[View],
    *,
    render: RenderFn,
) -> Layering:
    """The clean splat with the object in layers."""
    making = layers.making
    centre = setup.centre
    cones = [attack.cone for attack in setup.attacks if attack.name in layers.attacks]
    inside = depths(
        cones, [view.camera for view in views], centre=centre, config=making
    )
    decided = (inside.abs() >= 1).all(0)
    rows = torch.nonzero(object_rows(layers, clean, setup.target)).flatten()
    part = clean.select(rows)
    benign = dc_to_colour(part.sh[:, :1]).clamp(0, 1)[:, 0]
    looks = [part.sh]
    for depth in inside[1:]:
        showing = [
            view
            for view, keep in zip(views, (decided & (depth > 0)).tolist(), strict=True)
            if keep
        ]
        seen = contributions(
            clean, [view.camera for view in showing], render=render, rows=rows
        )
        looks.append(
            colour_to_dc(seen_colours(part.means, showing, seen, benign))[:, None]
        )
    cameras = hemisphere(centre, count=DIRECTIONS, **setup.lens)
    scene = layered(
        clean,
        rows,
        cones,
        looks,
        cameras=cameras,
        centre=centre,
        seen=contributions(clean, cameras, render=render, rows=rows),
        config=making,
    )
    most = layers.max_gaussians
    if layers.geometry and len(scene) > most:
        got = f"{most:,}, and the layers make the splat one of {len(scene):,}"
        raise InvalidValueError.of(
            "layers.max_gaussians", "room for the layers", got, "raise it"
        )
    trained = torch.arange(len(scene)) >= len(clean)
    trained[rows] = True
    kept = [view for view, keep in zip(views, decided.tolist(), strict=True) if keep]
    return Layering(
        scene=scene,
        trained=trained | layers.surroundings | layers.geometry,
        views=kept,
        iterations=layers.iterations,
        geometry=layers.geometry,
    )


def object_rows(layers: LayersConfig, scene: GaussianScene, target: Asset) -> Tensor:
    """(N,) bool, the Gaussians in the box around the object, a little larger."""
    (x0, y0, z0), (x1, y1, z1) = target.bounds.tolist()
    margin = layers.margin
    return box_mask(
        scene,
        (
            x0 - margin,
            y0 - margin,
            z0 + layers.clearance,
            x1 + margin,
            y1 + margin,
            z1 + margin,
        ),
    )
