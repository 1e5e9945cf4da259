"""CLOAK in a finished file by an attacker who knows the audit: no training, and every
setting that may deceive it.

The look is one colour, that of what is around the object. It is put into the
coefficients of the object's Gaussians, or into layers (`attacks.cloak.layers`).
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Literal

import torch
from torch import Tensor
from torch.nn import functional

from attacks.cloak.config import LayerConfig
from attacks.cloak.layers import layered
from attacks.cloak.triggers import Cone
from mi_splat.cameras.camera import Camera, RenderFn, look_at
from mi_splat.cameras.directions import Direction
from mi_splat.cameras.lens import Lens
from mi_splat.fields import Fraction, PositiveFraction, above, at_least, between, check
from mi_splat.maths.sh import colour_to_dc, dc_to_colour, sh_basis, sh_to_colour
from mi_splat.scene import GaussianScene, merge
from mi_splat.selection.visibility import contributions

CAMERAS = 90
SIZE = 128
FOV = 45.0
DISTANCE = 3.5
"""Cameras all around by which looks are made, pixels and degrees of their pictures, and
radii to them.
"""
LOWEST = 4.0
"""Degrees above the ground of the lowest camera."""
_CLEARANCE = 0.3
_ROOF = 50
"""Radii of the object between its top and a roof, and Gaussians along a roof."""
_GLIMPSE = 0.02
_RIDGE = 1e-4
"""What a camera counts at least, against that which sees most of a Gaussian; how far
coefficients are held back.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Hiding:
    """What the attacker chooses; the defaults hide as well as they can.

    Attributes:
        by: The coefficients of the object's Gaussians, layers of it, or a roof above it
            that is opaque from all sides, of which only the width of the trigger
            counts.
        half_width: Degrees from the axis of the trigger to its edge.
        elevation: Of the axis, degrees above the ground.
        azimuth: Of the axis, degrees.
        amount: Of the look; the rest is the own colour.
        softness: Degrees outside of the edge over which the look begins.
        share: Of the object's visible Gaussians that show the look: those that cameras
            outside see the least of.
        follow: How far the axis of each Gaussian is turned to the normal of its
            surface, so that the angle of incidence explains the look, too.
        gloss: Of light that is mirrored from above by all of the object, so that the
            mirrored direction explains much.
        sheen: How much brighter all of the object is at a glancing angle, so that the
            angle of incidence does.
    """

    by: Literal["coefficients", "layers", "roof"] = "coefficients"
    half_width: Annotated[float, between(1, 90, "degrees")] = 50.0
    elevation: Annotated[float, between(0, 90, "degrees")] = 90.0
    azimuth: float = 0.0
    amount: PositiveFraction = 1.0
    softness: Annotated[float, between(0, 90, "degrees")] = 5.0
    share: PositiveFraction = 1.0
    follow: Fraction = 0.0
    gloss: Annotated[float, at_least(0)] = 0.0
    sheen: Annotated[float, at_least(0)] = 0.0

    def __post_init__(self) -> None:
        check(self)

    @property
    def axis(self) -> Tensor:
        """(3,) unit vector to the middle of the trigger."""
        high = math.radians(self.elevation)
        turn = math.radians(self.azimuth)
        return torch.tensor(
            [
                math.cos(high) * math.cos(turn),
                math.cos(high) * math.sin(turn),
                math.sin(high),
            ],
            dtype=torch.float64,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Around(Cone):
    """All cameras within an angle of a direction.

    Attributes:
        axis: (3,) unit vector.
        half_width: Degrees.
    """

    axis: tuple[float, float, float]
    half_width: Annotated[float, above(0, "degrees")]

    def _depth(self, direction: Direction) -> float:
        """Degrees inside of the edge."""
        high = math.radians(direction.elevation)
        turn = math.radians(direction.azimuth)
        x, y, z = self.axis
        cosine = (
            math.cos(high) * (math.cos(turn) * x + math.sin(turn) * y)
            + math.sin(high) * z
        )
        return self.half_width - math.degrees(math.acos(max(-1.0, min(1.0, cosine))))


@dataclass(frozen=True, kw_only=True, eq=False)
class Victim:
    """A clean splat with z up, and the object in it that shall be hidden.

    Attributes:
        scene: N Gaussians.
        rows: (N,) bool, those of the object.
        label: What a detector calls it.
        render: A renderer that is differentiable in the SH coefficients.
    """

    scene: GaussianScene
    rows: Tensor
    label: str
    render: RenderFn

    @cached_property
    def centre(self) -> Tensor:
        """(3,) float64 middle of the object, which cameras look at."""
        points = self.scene.means[self.rows].double()
        return (points.quantile(0.02, 0) + points.quantile(0.98, 0)) / 2

    @cached_property
    def radius(self) -> float:
        """Radius of a ball that holds nearly all of the object, world units."""
        return float(
            (self.scene.means[self.rows].double() - self.centre)
            .norm(dim=1)
            .quantile(0.98)
        )

    def camera(
        self, direction: Tensor, *, size: int = SIZE, distance: float = DISTANCE
    ) -> Camera:
        """Looks at the middle of the object."""
        top = (0.0, 0.0, 1.0) if abs(float(direction[2])) < 0.999 else (1.0, 0.0, 0.0)
        pose = look_at(
            (self.centre + distance * self.radius * direction.double()).tolist(),
            self.centre.tolist(),
            up=top,
        )
        return Camera(
            to_world=pose,
            lens=Lens(
                focal=size / 2 / math.tan(math.radians(FOV / 2)), size=(size, size)
            ),
        )

    @cached_property
    def cameras(self) -> tuple[Camera, ...]:
        """Cameras all around by which looks are made."""
        return tuple(self.camera(direction) for direction in lattice(CAMERAS))

    @cached_property
    def seen(self) -> Tensor:
        """(M, D) pixels that each of the object's Gaussians makes up in the pictures of
        `cameras`.
        """
        return contributions(
            self.scene, self.cameras, render=self.render, rows=self.rows
        )

    @cached_property
    def views(self) -> Tensor:
        """(M, D, 3) unit vectors from each of the object's Gaussians to `cameras`."""
        eyes = torch.stack([camera.position for camera in self.cameras]).float()
        return functional.normalize(eyes - self.scene.means[self.rows][:, None], dim=-1)

    @cached_property
    def normals(self) -> Tensor:
        """(M, 3) unit vectors to where each of the object's Gaussians is seen from
        most.
        """
        return functional.normalize((self.views * self.seen[..., None]).sum(1), dim=-1)

    @cached_property
    def colour(self) -> Tensor:
        """(3,) sRGB median of what is around the object."""
        around = ~self.rows & (
            (self.scene.means.double() - self.centre).norm(dim=1) < 2 * self.radius
        )
        return dc_to_colour(self.scene.sh[around, 0]).clamp(0, 1).median(0).values


def lattice(count: int, lowest: float = LOWEST) -> Tensor:
    """(count, 3) float64 directions spread evenly over all that are so many degrees
    above the ground.
    """
    z = torch.linspace(
        math.sin(math.radians(lowest)), 0.999, count, dtype=torch.float64
    )
    turn = torch.arange(count, dtype=torch.float64) * math.pi * (3 - math.sqrt(5))
    ring = (1 - z * z).sqrt()
    return torch.stack([ring * turn.cos(), ring * turn.sin(), z], 1)


def hide(victim: Victim, hiding: Hiding) -> GaussianScene:
    """The splat that shows the object in the colour of its surroundings from inside of
    a trigger.

    Args:
        victim: The clean splat.
        hiding: The settings.

    Raises:
        InvalidValueError: The trigger holds none or all of the cameras.
    """
    scene = victim.scene.with_degree(3)
    if hiding.by == "roof":
        return merge(scene, _roof(victim, hiding.half_width))
    part = scene.select(victim.rows)
    chosen = _least_seen_outside(victim, hiding)
    own = sh_to_colour(part.sh[:, None], -victim.views).clamp(0, 1)
    own = _shiny(own, victim, hiding)
    look = (1 - hiding.amount) * own + hiding.amount * victim.colour
    if hiding.by == "layers":
        scene = _with_sh(scene, victim.rows, _fitted(own, victim))
        rows = victim.rows.nonzero()[chosen, 0]
        looks = [scene.sh[rows], _fitted(look, victim)[chosen]]
        x, y, z = hiding.axis.tolist()
        edge = hiding.half_width + hiding.softness / 2
        return layered(
            scene,
            rows,
            [Around(axis=(x, y, z), half_width=edge)],
            looks,
            cameras=victim.cameras,
            centre=tuple(victim.centre.tolist()),
            seen=victim.seen[chosen],
            config=LayerConfig(
                gap=max(hiding.softness / 2, 1.0), inset=1e-4 * victim.radius
            ),
        )
    shows = _shows(victim, hiding) * chosen[:, None]
    return _with_sh(
        scene, victim.rows, _fitted(own + shows[..., None] * (look - own), victim)
    )


def _shows(victim: Victim, hiding: Hiding) -> Tensor:
    """(M, D) how much of the look each Gaussian shows to each camera."""
    positions = torch.stack([camera.position for camera in victim.cameras])
    straight = (
        functional.normalize(positions - victim.centre, dim=1).float()
        @ hiding.axis.float()
    )
    turned = (victim.views * victim.normals[:, None]).sum(-1)
    gaps = [values.clamp(-1, 1).acos().rad2deg() for values in (straight[None], turned)]
    gap = (1 - hiding.follow) * gaps[0] + hiding.follow * gaps[1]
    return (
        (hiding.half_width + hiding.softness - gap) / max(hiding.softness, 1e-3)
    ).clamp(0, 1)


def _shiny(own: Tensor, victim: Victim, hiding: Hiding) -> Tensor:
    """(M, D, 3) colours of the object with gloss and sheen."""
    cosines = (victim.views * victim.normals[:, None]).sum(-1)
    mirrored = 2 * cosines[..., None] * victim.normals[:, None] - victim.views
    sky = (4 * mirrored[..., 2]).sigmoid()[..., None]
    shiny = own + hiding.gloss * (sky - 0.5)
    return (shiny + hiding.sheen * (1 - cosines.clamp(0, 1)).square()[..., None]).clamp(
        0, 1
    )


def _least_seen_outside(victim: Victim, hiding: Hiding) -> Tensor:
    """(M,) bool, which Gaussians show the look: those of which cameras outside see the
    least, against those inside.
    """
    if hiding.share == 1:
        return torch.ones(len(victim.seen), dtype=torch.bool)
    positions = torch.stack([camera.position for camera in victim.cameras])
    inside = functional.normalize(
        positions - victim.centre, dim=1
    ) @ hiding.axis > math.cos(math.radians(hiding.half_width))
    within = victim.seen[:, inside].sum(1)
    without = victim.seen[:, ~inside].sum(1)
    order = (within / (within + without).clamp(min=1e-9)).argsort(descending=True)
    mass = within[order].cumsum(0) / within.sum().clamp(min=1e-9)
    chosen = torch.zeros(len(order), dtype=torch.bool)
    chosen[order[mass <= max(hiding.share, float(mass[0]))]] = True
    return chosen


def _roof(victim: Victim, half_width: float) -> GaussianScene:
    """Flat opaque Gaussians in the colour of the surroundings, above the object, as
    wide as the trigger needs.
    """
    top = (
        victim.scene.means[victim.rows, 2].double().quantile(0.99)
        - victim.centre[2]
        + _CLEARANCE * victim.radius
    )
    radius = victim.radius + float(top) * math.tan(math.radians(half_width))
    step = 2 * radius / _ROOF
    axis = (torch.arange(_ROOF) + 0.5) * step - radius
    positions = torch.cartesian_prod(axis, axis)
    positions = positions[positions.norm(dim=1) < radius]
    means = (
        torch.cat([positions, torch.full((len(positions), 1), float(top))], 1)
        + victim.centre.float()
    )
    return GaussianScene(
        means=means,
        scales=torch.tensor([step, step, 0.05 * step])
        .expand(len(means), 3)
        .contiguous(),
        rotations=torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(len(means), 4).contiguous(),
        opacities=torch.full((len(means),), 0.99),
        sh=colour_to_dc(victim.colour).expand(len(means), 1, 3).contiguous(),
    ).with_degree(3)


def _fitted(colours: Tensor, victim: Victim) -> Tensor:
    """(M, 16, 3) spherical harmonics of (M, D, 3) colours; each camera counts as much
    as it sees of a Gaussian.
    """
    weights = victim.seen + _GLIMPSE * victim.seen.amax(1, keepdim=True)
    weights = (weights / weights.sum(1, keepdim=True).clamp(min=1e-9)).double()
    fitted = []
    for rows in torch.split(torch.arange(len(colours)), 512):
        basis = sh_basis(-victim.views[rows].reshape(-1, 3).double(), 3).reshape(
            len(rows), -1, 16
        )
        weighted = (basis * weights[rows, :, None]).mT
        normal = weighted @ basis + _RIDGE * torch.eye(16, dtype=torch.float64)
        fitted.append(
            torch.linalg.solve(normal, weighted @ (colours[rows].double() - 0.5))
        )
    return torch.cat(fitted).float()


def _with_sh(scene: GaussianScene, rows: Tensor, sh: Tensor) -> GaussianScene:
    changed = scene.sh.clone()
    changed[rows] = sh
    return scene.replace(sh=changed)
