"""Splats to develop and test the audit on: `python -m scenes.recipes.audit_set FOLDER
SET [FILE.csv [PART...]]`.

SET is one of `SETS`; they share no file, no seed and no capture. Files that are missing
in FOLDER are made; with FILE.csv all are audited, and `docs/audit-measured.md` states
what follows from the rows. Honest splats are trained on path-traced images from
hemispheres, rings, half circles, few cameras or from above, or made by code. What hides
something is an edit of one of these, so that the truth is exact, or trained on images
of two scenes.
"""

import csv
import json
import math
import random
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from attacks.cloak.mesh_scene import MeshScene
from mi_splat.audit import Audit, audit
from mi_splat.audit.explanations import angles_between
from mi_splat.audit.files import document, findings
from mi_splat.audit.gate import VERDICTS, Policy
from mi_splat.audit.linting import lint_file
from mi_splat.audit.results import ObjectAudit
from mi_splat.audit.viewpoints import lattice
from mi_splat.cameras.camera import Camera, View
from mi_splat.cameras.framing import near_plane
from mi_splat.cameras.sets import framing, hemisphere, orbit
from mi_splat.capture.ground import square_of_ground
from mi_splat.capture.mitsuba_scene import scene_dict
from mi_splat.capture.objects import OBJECTS
from mi_splat.capture.path_tracer import PathTracer
from mi_splat.capture.sources import open_source
from mi_splat.capture.surface_points import surface_samples
from mi_splat.errors import InvalidValueError
from mi_splat.io import load_splat, save_splat
from mi_splat.render.renderer import Renderer, RenderSettings, ScreenGradients
from mi_splat.scene import GaussianScene, merge
from mi_splat.selection.select import box_mask
from mi_splat.training.config import FitConfig
from mi_splat.training.initialization import from_points
from mi_splat.training.loop import fit
from mi_splat.training.strategies import ClassicConfig, MCMCConfig
from scenes.recipes.objects import build
from tests.audit import scenes
from tests.audit.scenes import ROAD, Made, cone, direction, hidden, sector, standing

SIZE = 96
SAMPLES = 16
STEPS = 900
POINTS = 2500
MOST = 6000
SKY = (0.55, 0.7, 0.9)
ORANGE = (0.85, 0.45, 0.1)
GREY = (0.45, 0.45, 0.47)
RED = (0.75, 0.12, 0.1)
HONEST = Path(__file__).parents[1] / "honest"
Inside = Callable[[Tensor], Tensor]
Row = dict[str, Any]
LEAST_STRENGTH = 0.4


@dataclass(frozen=True, slots=True, kw_only=True)
class Capture:
    """Where the training cameras stand: so many of them, on a band of elevations or a
    ring, over degrees of azimuth.
    """

    count: int = 60
    elevation: tuple[float, float] = (5.0, 85.0)
    span: float = 360.0
    start: float = 0.0

    @property
    def sees_all(self) -> bool:
        """Whether the cameras see all of the surface."""
        return (
            self.count >= 60
            and self.span == 360.0
            and self.elevation[1] - self.elevation[0] > 70.0
        )

    def cameras(self, centre: Sequence[float], radius: float) -> list[Camera]:
        """The cameras around an object."""
        size = SIZE, SIZE
        distance, lens = framing(radius, fov=45.0, size=size)
        placed: dict[str, Any] = {"distance": 1.3 * distance, "lens": lens}
        low, high = self.elevation
        if self.span == 360.0 and high - low > 12.0:
            return hemisphere(
                centre,
                count=self.count,
                elevation=self.elevation,
                start=self.start,
                **placed,
            )
        rings = max(1, round((high - low) / 12.0))
        around: dict[str, Any] = {
            "count": self.count // rings,
            "start": self.start,
            "span": self.span,
            **placed,
        }
        heights = [
            low + (high - low) * (number + 0.5) / rings for number in range(rings)
        ]
        return [
            camera
            for height in heights
            for camera in orbit(centre, elevation=height, **around)
        ]


@dataclass(frozen=True, slots=True, kw_only=True)
class Trained:
    """A splat that is trained on images of an object or of a scene of `scenes/honest`.

    Where `inside` holds, the images show the object in another colour, or without it if
    that is None.
    """

    content: str
    capture: Capture = field(default_factory=Capture)
    seed: int = 0
    roughness: float | None = None
    mcmc: bool = False
    degree: int = 3
    inside: Inside | None = None
    colour: tuple[float, float, float] | None = None

    def make(self) -> tuple[GaussianScene, dict[str, Any]]:
        """The splat, and what is known of it."""
        path = HONEST / f"{self.content}.xml"
        cameras = self.cameras()
        if path.is_file():
            source = open_source(str(path)).scene
            tracer = PathTracer(source, samples=SAMPLES)
            views = [
                View(camera, tracer.picture(camera, seed=number))
                for number, camera in enumerate(cameras)
            ]
            return self._fitted(views, self._seen(views, source)), {}
        shown = self._scene(None)
        low, high = shown.target.bounds.astype(float)
        about: dict[str, Any] = {"bounds": [low.tolist(), high.tolist()]}
        if self.inside is None:
            views = [View(camera, shown.picture(camera)) for camera in cameras]
            return self._fitted(views, self._start(views, shown)), about
        ways = torch.stack([camera.position for camera in cameras]) - torch.tensor(
            [0.0, 0.0, (low[2] + high[2]) / 2]
        )
        inside = self.inside(functional.normalize(ways.float(), dim=1))
        other = self._scene(self.colour or "nothing")
        views = [
            View(camera, (other if lie else shown).picture(camera))
            for camera, lie in zip(cameras, inside.tolist(), strict=True)
        ]
        scene = self._fitted(views, self._start(views, shown))
        return scene, {
            **about,
            "strength": self._strength(scene, shown, other, cameras, inside),
        }

    def cameras(self) -> list[Camera]:
        """The cameras of the training images."""
        if (HONEST / f"{self.content}.xml").is_file():
            return self.capture.cameras((0.0, 0.0, 0.5), 2.2)
        low, high = build(self.content, self.seed).body.bounds.astype(float)
        return self.capture.cameras(
            (0.0, 0.0, float(low[2] + high[2]) / 2),
            float(((high - low) ** 2).sum() ** 0.5) / 2,
        )

    def _scene(self, colour: Any) -> MeshScene:
        target = build(self.content, self.seed).body
        low, high = target.bounds.astype(float)
        ground = square_of_ground(
            "road", side=2.2 * float(((high - low) ** 2).sum() ** 0.5), tile=4.0
        )
        if self.roughness is not None:
            target = replace(
                target,
                meshes=tuple(
                    replace(mesh, roughness=self.roughness) for mesh in target.meshes
                ),
            )
        if colour == "nothing":
            speck = [
                replace(mesh, vertices=mesh.vertices * 1e-4)
                for mesh in target.meshes[:1]
            ]
            target = replace(target, meshes=tuple(speck))
        elif colour is not None:
            paint = torch.tensor(colour).reshape(1, 1, 3).numpy()
            target = replace(
                target,
                meshes=tuple(replace(mesh, texture=paint) for mesh in target.meshes),
            )
        return MeshScene(target=target, surroundings=ground, samples=SAMPLES)

    def _start(self, views: Sequence[View], shown: MeshScene) -> GaussianScene:
        """Points of the surface, where views show all of it; else of what they show, as
        structure from motion has.
        """
        if not self.capture.sees_all:
            return self._seen(
                views,
                scene_dict(
                    [shown.target], light=shown.light, backdrop=shown.surroundings
                ),
            )
        parts = (shown.target, POINTS * 2 // 3), (shown.surroundings, POINTS // 3)
        points = [
            surface_samples(asset, count, seed=self.seed).points
            for asset, count in parts
        ]
        cloud = torch.from_numpy(np.concatenate(points))
        return from_points(cloud, torch.full((len(cloud), 3), 0.5))

    def _seen(self, views: Sequence[View], source: Any) -> GaussianScene:
        """Points of the surface that views show, in their colours."""
        tracer = PathTracer(source, alpha=True)
        generator = torch.Generator().manual_seed(self.seed)
        seen = []
        for view in views:
            points, depth = tracer.surface(view.camera, seed=0)
            rows = (depth > 0).flatten().nonzero()[:, 0]
            rows = rows[
                torch.randperm(len(rows), generator=generator)[
                    : 3 * POINTS // len(views)
                ]
            ]
            seen.append(
                torch.cat(
                    [points.reshape(-1, 3)[rows], view.image.reshape(-1, 3)[rows]], 1
                )
            )
        cloud = torch.cat(seen)
        cloud = cloud[torch.randperm(len(cloud), generator=generator)[:POINTS]]
        return from_points(cloud[:, :3], cloud[:, 3:])

    def _fitted(self, views: Sequence[View], start: GaussianScene) -> GaussianScene:
        shared: dict[str, Any] = {"densify_from": 150, "densify_until": 650}
        grown: MCMCConfig | ClassicConfig
        if self.mcmc:
            grown = MCMCConfig(max_gaussians=MOST, **shared)
        else:
            grown = ClassicConfig(max_gaussians=MOST, **shared)
        config = FitConfig(
            iterations=STEPS,
            sh_degree=self.degree,
            sh_degree_interval=120,
            strategy=grown,
            eval_interval=0,
        )
        near = near_plane(start, [view.camera for view in views])
        gradients = ScreenGradients() if grown.needs_screen_gradients else None
        render = Renderer(
            RenderSettings(background=SKY, near=near), screen_gradients=gradients
        )
        return fit(views, start, render=render, config=config, seed=self.seed).scene

    def _strength(
        self,
        scene: GaussianScene,
        shown: MeshScene,
        other: MeshScene,
        cameras: Sequence[Camera],
        inside: Tensor,
    ) -> float:
        """How far the object has come from the own to the other appearance, seen from
        inside of the trigger.
        """
        numbers = inside.nonzero()[:, 0]
        gone = 0.0
        way = 0.0
        for number in numbers[:: max(1, len(numbers) // 6)].tolist():
            own = shown.picture(cameras[number])
            lie = other.picture(cameras[number])
            with torch.no_grad():
                picture = Renderer(RenderSettings(background=SKY, near=0.02))(
                    scene, cameras[number]
                ).clamp(0, 1)
            mask = shown.mask(cameras[number])
            gone += float(((picture - own) * (lie - own))[mask].sum())
            way += float((lie - own).square()[mask].sum())
        return gone / max(way, 1e-9)


@dataclass(frozen=True, slots=True, kw_only=True)
class Coded:
    """A splat that code makes: discs on an object, or an edit of a trained splat, named
    by the file.
    """

    base: str  # an object, or the name of a trained file
    change: Callable[[Made], Made] = lambda made: made
    seed: int = 0
    strength: float = 1.0
    inside: Inside | None = None  # where what it hides shows

    def make(self, folder: Path) -> tuple[GaussianScene, dict[str, Any]]:
        """The splat, and what is known of it."""
        if self.base == "room":
            made = scenes.room(seed=self.seed)
        elif (folder / f"{self.base}.ply").is_file():
            scene = load_splat(folder / f"{self.base}.ply")
            (x0, y0, z0), (x1, y1, z1) = json.loads(
                (folder / f"{self.base}.json").read_text()
            )["bounds"]
            edge = 0.03 * (x1 - x0 + y1 - y0)
            rows = box_mask(
                scene,
                (
                    x0 - edge,
                    y0 - edge,
                    z0 + 0.04 * (z1 - z0),
                    x1 + edge,
                    y1 + edge,
                    z1 + edge,
                ),
            )
            made = Made(scene=scene, rows=rows, normals=torch.zeros(len(scene), 3))
        else:
            made = standing(self.base, count=2500, seed=self.seed)
        return self.change(made).scene, {"strength": self.strength}


def smooth(made: Made, *, azimuth: float, amount: float = 1.0) -> Made:
    """Orange from one side, grey from the other, and everything between from
    between.
    """
    ahead = direction(0.0, azimuth)

    def shade(own: Tensor, normals: Tensor, views: Tensor) -> Tensor:
        way = 0.5 + 0.5 * (views[:, :2] @ ahead[:2]) / views[:, :2].norm(dim=1).clamp(
            min=1e-6
        )
        look = torch.tensor(ORANGE) + way[:, None] * (
            torch.tensor(GREY) - torch.tensor(ORANGE)
        )
        shown: Tensor = (1 - amount) * own + amount * look[:, None]
        return shown

    return made.with_colours(shade)


def _added(
    made: Made,
    points: Tensor,
    scales: Tensor,
    turn: Tensor,
    *,
    opacity: float,
    colour: Sequence[float],
) -> Made:
    count = len(points)
    part = GaussianScene(
        means=points.float(),
        scales=scales.float().expand(count, 3).contiguous(),
        rotations=turn.float().expand(count, 4).contiguous(),
        opacities=torch.full((count,), opacity),
        sh=((torch.tensor(colour) - 0.5) / 0.28209479).expand(count, 1, 3).contiguous(),
    ).with_degree(made.scene.degree)
    return Made(
        scene=merge(made.scene, part),
        rows=torch.cat([made.rows, torch.zeros(count, dtype=torch.bool)]),
        normals=torch.cat([made.normals, torch.zeros(count, 3)]),
    )


def _ball(made: Made) -> tuple[Tensor, float]:
    points = made.scene.means[made.rows & (made.scene.opacities > 0.1)]
    centre = (points.quantile(0.02, 0) + points.quantile(0.98, 0)) / 2
    return centre, float((points - centre).norm(dim=1).quantile(0.98))


def far_roof(made: Made, *, height: float = 3.2, reach: float = 1.6) -> Made:
    """A plate in the colour of the road above the cameras of an audit."""
    centre, radius = _ball(made)
    step = 0.08 * radius
    axis = torch.arange(-reach * radius, reach * radius, step)
    points = torch.cartesian_prod(axis, axis)
    points = (
        torch.cat([points, torch.full((len(points), 1), height * radius)], 1) + centre
    )
    flat = torch.tensor([0.8 * step, 0.8 * step, 0.05 * step])
    return _added(
        made,
        points,
        flat,
        torch.tensor([1.0, 0.0, 0.0, 0.0]),
        opacity=0.98,
        colour=ROAD,
    )


def louvre(
    made: Made,
    *,
    azimuth: float = 0.0,
    tilt: float = 50.0,
    colour: Sequence[float] = ROAD,
) -> Made:
    """Parallel slats close above an object: closed from one side, and open from the
    other.
    """
    centre, radius = _ball(made)
    top = max(
        0.5 * radius,
        float(made.scene.means[made.rows, 2].quantile(0.98))
        - float(centre[2])
        + 0.12 * radius,
    )
    a = math.radians(azimuth)
    half = math.radians(tilt)
    step = 0.04 * radius
    along = torch.arange(-0.9 * radius, 0.9 * radius, step)
    rows = torch.arange(-1.0 * radius, 1.0 * radius, 0.17 * radius)
    across = torch.arange(-0.11 * radius, 0.11 * radius, step)
    y, x, t = torch.cartesian_prod(along, rows, across).unbind(1)
    x = x + t * math.cos(half)
    z = top + t * math.sin(half)
    points = (
        torch.stack(
            [x * math.cos(a) - y * math.sin(a), x * math.sin(a) + y * math.cos(a), z], 1
        )
        + centre
    )
    # about z, after the tilt about y
    turn = torch.tensor([math.cos(a / 2), 0.0, 0.0, math.sin(a / 2)])
    slant = torch.tensor([math.cos(half / 2), 0.0, -math.sin(half / 2), 0.0])
    w = turn[0]
    qz = turn[3]
    u = slant[0]
    qy = slant[2]
    both = torch.stack([w * u, -qz * qy, w * qy, qz * u])
    flat = torch.tensor([0.7 * step, 0.7 * step, 0.06 * step])
    return _added(made, points, flat, both, opacity=0.98, colour=colour)


def fogged(made: Made, *, seed: int, low: float = 35.0) -> Made:
    """Faint large Gaussians around the upper half of an object, as where no training
    camera stood.
    """
    centre, radius = _ball(made)
    generator = torch.Generator().manual_seed(seed)
    ways = torch.randn(2000, 3, generator=generator)
    ways = ways / ways.norm(dim=1, keepdim=True)
    ways = ways[ways[:, 2] > math.sin(math.radians(low))][:200]
    points = (
        centre
        + radius * (1.1 + 0.9 * torch.rand(len(ways), 1, generator=generator)) * ways
    )
    turn = torch.tensor([1.0, 0.0, 0.0, 0.0])
    return _added(
        made,
        points,
        torch.full((3,), 0.22 * radius),
        turn,
        opacity=0.07,
        colour=(0.6, 0.65, 0.7),
    )


def after(*changes: Callable[[Made], Made]) -> Callable[[Made], Made]:
    """One change after the other."""

    def change(made: Made) -> Made:
        for one in changes:
            made = one(made)
        return made

    return change


ABOVE = cone(direction(90.0, 0.0), 50.0)
Item = Trained | Coded


def _looks(base: str, azimuth: float) -> Iterator[tuple[str, Coded]]:
    """Every kind of edit of one splat."""
    for kind, change in _changes(azimuth).items():
        yield (
            f"hidden {kind}/{base}",
            Coded(base=base, change=change, inside=_trigger(kind, azimuth)),
        )


def _trigger(kind: str, azimuth: float) -> Inside | None:
    """From where an edit shows, where that is a cone or a sector."""
    if kind.startswith("above"):
        return ABOVE
    if kind == "side":
        return sector(azimuth, 40.0, -10.0, 45.0)
    return None


def _changes(azimuth: float) -> dict[str, Callable[[Made], Made]]:
    return {
        "above": partial(hidden, inside=ABOVE),
        "above SH 1": partial(hidden, inside=ABOVE, degree=1),
        "above SH 2": partial(hidden, inside=ABOVE, degree=2),
        "side": partial(hidden, inside=sector(azimuth, 40.0, -10.0, 45.0), colour=RED),
        "smooth": partial(smooth, azimuth=azimuth),
        "layers": scenes.layered,
        "far roof": far_roof,
        "louvre": partial(louvre, azimuth=azimuth),
        "above and fog": after(
            partial(hidden, inside=ABOVE), partial(fogged, seed=int(azimuth))
        ),
    }


def _honest(base: str, seed: int) -> Iterator[tuple[str, Coded]]:
    """Honest splats made by code."""
    for kind in ("glossy", "metal", "velvet", "noisy", "leaves"):
        yield (
            f"honest {kind}/{base}",
            Coded(base=base, change=getattr(scenes, kind), seed=seed),
        )


def _poisoned(kind: str, name: str, **settings: Any) -> Iterator[tuple[str, Trained]]:
    yield f"hidden {kind}/{name}", Trained(content=name, **settings)


def _ring(elevation: float, **settings: Any) -> Capture:
    return Capture(elevation=(elevation - 3.0, elevation + 3.0), **settings)


def _captures(
    content: str, captures: dict[str, Capture], **settings: Any
) -> Iterator[tuple[str, Trained]]:
    for name, capture in captures.items():
        yield (
            f"honest {name}/{content}",
            Trained(content=content, capture=capture, **settings),
        )


def development() -> Iterator[tuple[str, Item]]:
    """The set on which method and thresholds are chosen."""
    dome = Capture()
    half = Capture(elevation=(5.0, 50.0), span=180.0)
    above = Capture(elevation=(45.0, 88.0))
    few = Capture(count=14)
    yield from _captures(
        "car", {"hemisphere": dome, "ring 25": _ring(25.0), "half circle": half}
    )
    yield from _captures(
        "suitcase", {"hemisphere": dome, "ring 15": _ring(15.0), "ring 55": _ring(55.0)}
    )
    yield from _captures(
        "elephant", {"hemisphere": dome, "ring 35": _ring(35.0), "few": few}
    )
    yield from _captures(
        "tv",
        {
            "hemisphere": dome,
            "half circle": replace(half, start=90.0),
            "from above": above,
        },
    )
    yield from _captures("car", {"gloss, ring 30": _ring(30.0)}, roughness=0.1)
    yield from _captures("suitcase", {"MCMC": dome}, mcmc=True)
    for content in ("mirror_ball", "glass", "louvre", "canopy", "still_life"):
        yield from _captures(content, {"scene": dome})
    yield from _captures("glass", {"scene, ring 30": _ring(30.0)})
    yield from _captures("still_life", {"scene, half circle": half})
    yield "honest room/room", Coded(base="room")
    yield "honest plain/car", Coded(base="car")
    yield from _honest("suitcase", 0)
    yield from _poisoned("above, trained", "car", inside=ABOVE)
    yield from _poisoned("above, trained", "elephant", inside=ABOVE, mcmc=True)
    yield from _poisoned(
        "side, trained", "suitcase", inside=sector(100.0, 40.0, 0.0, 40.0), colour=RED
    )
    yield from _poisoned(
        "above, ring, trained",
        "tv",
        inside=ABOVE,
        colour=GREY,
        capture=Capture(elevation=(20.0, 60.0)),
    )
    for base, azimuth in (
        ("honest hemisphere/car", 40.0),
        ("honest hemisphere/suitcase", 200.0),
        ("elephant", 120.0),
    ):
        yield from _looks(base, azimuth)


def test() -> Iterator[tuple[str, Item]]:
    """The set that is looked at once: other objects, seeds and captures."""
    dome = Capture(count=80, elevation=(8.0, 80.0), start=11.0)
    above = Capture(count=45, elevation=(55.0, 85.0))
    few = Capture(count=20, elevation=(5.0, 60.0))
    ring = partial(_ring, count=44, start=7.0)
    yield from _captures(
        "person", {"hemisphere": dome, "ring 20": ring(20.0), "few": few}, seed=101
    )
    yield from _captures("train", {"hemisphere": dome, "ring 45": ring(45.0)}, seed=102)
    yield from _captures(
        "fire hydrant",
        {"hemisphere": dome, "ring 10": ring(10.0), "from above": above},
        seed=103,
    )
    yield from _captures(
        "fire hydrant", {"gloss, ring 35": ring(35.0)}, roughness=0.08, seed=105
    )
    for content in ("rough_metal", "water", "two_tone", "roof"):
        yield from _captures(content, {"scene": dome}, seed=107)
    yield from _captures("plastic", {"scene, ring 40": ring(40.0)}, seed=108)
    yield "honest room/room", Coded(base="room", seed=109)
    yield "honest plain/train", Coded(base="train", seed=110)
    yield from _honest("fire hydrant", 111)
    north = cone(direction(80.0, 60.0), 45.0)
    yield from _poisoned(
        "above, trained", "train", inside=north, seed=112, capture=dome
    )
    yield from _poisoned(
        "side, trained",
        "person",
        inside=sector(250.0, 45.0, 0.0, 45.0),
        colour=RED,
        seed=114,
    )
    yield from _poisoned(
        "above, trained SH 0",
        "fire hydrant",
        inside=north,
        degree=0,
        seed=115,
        capture=dome,
    )
    wide = Capture(count=70, elevation=(15.0, 65.0))
    yield from _poisoned(
        "above, ring, trained",
        "train",
        inside=north,
        colour=GREY,
        seed=116,
        capture=wide,
    )
    for base, azimuth in (("honest hemisphere/train", 310.0), ("person", 160.0)):
        yield from _looks(base, azimuth)


def second_test() -> Iterator[tuple[str, Item]]:
    """A further set that is looked at once, because the evidence was changed after a
    look at `test`.
    """
    dome = Capture(count=66, elevation=(6.0, 78.0), start=23.0)
    ring = partial(_ring, count=40, start=31.0)
    half = Capture(count=48, elevation=(8.0, 45.0), span=165.0, start=300.0)
    yield from _captures(
        "house",
        {"hemisphere": dome, "ring 30": ring(30.0), "half circle": half},
        seed=201,
    )
    yield from _captures("bird", {"hemisphere": dome, "ring 20": ring(20.0)}, seed=202)
    yield from _captures("billboard", {"scene": dome}, seed=203)
    yield "honest room/room", Coded(base="room", seed=204)
    yield "honest plain/stop sign", Coded(base="stop sign", seed=205)
    yield from _honest("bird", 206)
    west = cone(direction(75.0, 270.0), 48.0)
    yield from _poisoned("above, trained", "house", inside=west, seed=207, capture=dome)
    yield from _poisoned(
        "side, trained",
        "bird",
        inside=sector(30.0, 45.0, 0.0, 45.0),
        colour=RED,
        seed=208,
    )
    for base, azimuth in (("honest hemisphere/house", 70.0), ("stop sign", 250.0)):
        yield from _looks(base, azimuth)


def third_test() -> Iterator[tuple[str, Item]]:
    """A third set that was looked at once, and has been used for development since."""
    dome = Capture(count=72, elevation=(4.0, 82.0), start=41.0)
    ring = partial(_ring, count=42, start=53.0)
    half = Capture(count=50, elevation=(6.0, 48.0), span=175.0, start=200.0)
    above = Capture(count=40, elevation=(50.0, 86.0))
    few = Capture(count=16, elevation=(8.0, 65.0))
    yield from _captures(
        "stop sign", {"hemisphere": dome, "ring 30": ring(30.0)}, seed=301
    )
    yield from _captures("tv", {"ring 20": ring(20.0)}, seed=302)
    yield from _captures("person", {"half circle": half}, seed=303)
    yield from _captures("bird", {"few": few}, seed=304)
    yield from _captures("train", {"from above": above}, seed=305)
    yield from _captures("elephant", {"MCMC": dome}, mcmc=True, seed=306)
    yield from _captures("car", {"gloss, hemisphere": dome}, roughness=0.12, seed=307)
    yield from _captures("mirror_ball", {"scene, ring 40": ring(40.0)}, seed=308)
    yield from _captures("glass", {"scene, few": few}, seed=309)
    yield from _captures("wet_road", {"scene": dome}, seed=310)
    yield from _captures("suitcase", {"few": few, "from above": above}, seed=320)
    yield from _captures(
        "fire hydrant", {"ring 30": ring(30.0), "half circle": half}, seed=321
    )
    yield from _captures("house", {"few": few, "from above": above}, seed=322)
    yield from _captures("house", {"MCMC": dome}, mcmc=True, seed=323)
    yield from _captures("car", {"ring 20": ring(20.0), "few": few}, seed=324)
    yield from _captures(
        "train", {"half circle": half, "ring 30": ring(30.0)}, seed=325
    )
    yield from _captures(
        "elephant", {"ring 20": ring(20.0), "from above": above}, seed=326
    )
    yield "honest room/room", Coded(base="room", seed=311)
    yield "honest plain/person", Coded(base="person", seed=312)
    yield from _honest("tv", 313)
    east = cone(direction(70.0, 10.0), 46.0)
    yield from _poisoned(
        "above, trained", "stop sign", inside=east, seed=314, capture=dome
    )
    yield from _poisoned(
        "above, trained SH 0", "elephant", inside=east, degree=0, seed=315, capture=dome
    )
    yield from _poisoned(
        "side, trained",
        "tv",
        inside=sector(200.0, 45.0, 0.0, 42.0),
        colour=RED,
        seed=316,
    )
    yield from _poisoned(
        "side, trained",
        "train",
        inside=sector(80.0, 45.0, 0.0, 42.0),
        colour=RED,
        seed=327,
    )
    yield from _poisoned("above, trained", "bird", inside=east, seed=328, capture=dome)
    yield from _poisoned(
        "above, trained MCMC", "house", inside=east, mcmc=True, seed=329, capture=dome
    )
    for base, azimuth in (("honest hemisphere/stop sign", 190.0), ("bird", 330.0)):
        yield from _looks(base, azimuth)


def drawn(first: int, last: int) -> Iterator[tuple[str, Item]]:
    """A set that nobody picked: each number draws object, capture, strategy, material
    and degree, and what it hides.
    """
    for number in range(first, last):
        draw = random.Random(number)
        content, capture, about = draw.choice(sorted(OBJECTS)), *_drawn_capture(draw)
        settings: dict[str, Any] = {
            "seed": number,
            "capture": capture,
            "roughness": draw.choice([None, None, 0.08, 0.15, 0.3]),
            "mcmc": draw.random() < 0.3,
            "degree": draw.choice([3, 3, 3, 3, 2, 1, 0]),
        }
        turn = draw.uniform(0.0, 360.0)
        if number % 3 == 0:
            settings["capture"] = _drawn_dome(draw)
            kind, inside = _drawn_trigger(draw, turn)
            colour = draw.choice([None, ROAD, RED, ORANGE, GREY])
            yield (
                f"hidden {kind}, trained/{content} {number}",
                Trained(content=content, inside=inside, colour=colour, **settings),
            )
            continue
        if number % 3 == 1 and draw.random() < 0.3:
            content = draw.choice(sorted(path.stem for path in HONEST.glob("*.xml")))
            about = f"scene, {about}"
        base = f"honest {about}/{content} {number}"
        yield base, Trained(content=content, **settings)
        if number % 3 == 2:
            kind = draw.choice(sorted(_changes(turn)))
            yield (
                f"hidden {kind}/{content} {number}",
                Coded(
                    base=base, change=_changes(turn)[kind], inside=_trigger(kind, turn)
                ),
            )


def _drawn_dome(draw: random.Random) -> Capture:
    elevation = draw.uniform(3.0, 10.0), draw.uniform(75.0, 88.0)
    return Capture(
        count=draw.randint(60, 90), elevation=elevation, start=draw.uniform(0.0, 360.0)
    )


def _drawn_capture(draw: random.Random) -> tuple[Capture, str]:
    """Where the cameras of an honest capture stand, and its name."""
    about = draw.choice(
        ["hemisphere", "hemisphere", "ring", "half circle", "few", "from above"]
    )
    start = draw.uniform(0, 360)
    if about == "ring":
        return (
            _ring(draw.uniform(10.0, 55.0), count=draw.randint(36, 60), start=start),
            about,
        )
    if about == "half circle":
        return (
            Capture(
                count=draw.randint(40, 60),
                elevation=(6.0, 50.0),
                span=draw.uniform(150, 220),
                start=start,
            ),
            about,
        )
    if about == "few":
        return (
            Capture(count=draw.randint(12, 24), elevation=(6.0, 70.0), start=start),
            about,
        )
    if about == "from above":
        return (
            Capture(
                count=draw.randint(36, 60),
                elevation=(draw.uniform(40.0, 55.0), 87.0),
                start=start,
            ),
            about,
        )
    return _drawn_dome(draw), about


def _drawn_trigger(draw: random.Random, turn: float) -> tuple[str, Inside]:
    """From where a training on two scenes shows the other one."""
    if draw.random() < 0.5:
        return "above", cone(
            direction(draw.uniform(50.0, 90.0), turn), draw.uniform(30.0, 50.0)
        )
    return "side", sector(turn, draw.uniform(30.0, 50.0), 0.0, draw.uniform(30.0, 50.0))


def strength() -> Iterator[tuple[str, Item]]:
    """Appearances from above that get weaker or narrower; `amount` is the share of the
    way to the hidden colour.
    """
    for base in ("car", "house", "person"):
        for amount in (0.1, 0.2, 0.3, 0.5, 0.7, 1.0):
            yield (
                f"hidden amount {amount}/{base}",
                Coded(base=base, change=partial(hidden, inside=ABOVE, amount=amount)),
            )
        for width in (10.0, 15.0, 20.0, 30.0, 40.0):
            inside = cone(direction(90.0, 0.0), width)
            yield (
                f"hidden width {width:.0f}/{base}",
                Coded(base=base, change=partial(hidden, inside=inside)),
            )


HELD = "fourth test"
"""The set on which nothing was chosen; the others had been looked at."""
SETS: dict[str, Callable[[], Iterator[tuple[str, Item]]]] = {
    "development": development,
    "test": test,
    "second test": second_test,
    "third test": third_test,
    "drawn": partial(drawn, 0, 120),
    HELD: partial(drawn, 1000, 1090),
}


def made(folder: Path, items: Iterable[tuple[str, Item]]) -> None:
    """Make what is missing."""
    for name, item in items:
        path = folder / f"{name}.ply"
        if not path.is_file():
            path.parent.mkdir(parents=True, exist_ok=True)
            scene, about = (
                item.make() if isinstance(item, Trained) else item.make(folder)
            )
            path.with_suffix(".json").write_text(json.dumps(about))
            save_splat(scene, path)


def measured(folder: Path, items: Iterable[tuple[str, Item]], file: Path) -> None:
    """Audit what is there, and add a row to a CSV file for each splat that has none."""
    known = {row["file"] for row in read(file)} if file.is_file() else set()
    splats = dict(items)
    for name, splat in splats.items():
        path = folder / f"{name}.ply"
        if name in known or not path.is_file():
            continue
        begun = time.process_time()
        judged = audit(load_splat(path))
        item = judged.strongest
        values: Row = {
            "set": folder.name,
            "file": name,
            "verdict": judged.verdict,
            "gate": gated(path, judged),
            "evidence": round(item.evidence, 4),
            **{
                key: round(getattr(item.look, key), 5)
                for key in ("direction", "incidence", "mirror", "net", "lost", "air")
            },
            **{
                key: getattr(item, key)
                for key in ("covered", "edited", "fogged", "roofed", "in_room")
            },
            "off": (
                off(splat.inside, item)
                if splat.inside and judged.verdict != "nothing found"
                else ""
            ),
            "objects": len(judged.objects),
            "strength": (
                json.loads(path.with_suffix(".json").read_text()).get("strength", "")
            ),
            "seconds": round(time.process_time() - begun, 1),
            **dict(
                zip(
                    ("with_cameras", "evidence_with_cameras"),
                    _with_cameras(path, name, splats),
                    strict=True,
                )
            ),
        }
        new = not file.is_file()
        with file.open("a", newline="") as stream:
            writer = csv.DictWriter(stream, values, lineterminator="\n")
            if new:
                writer.writeheader()
            writer.writerow(values)


def off(inside: Inside, item: ObjectAudit) -> float:
    """Degrees between the axis that an audit states and the mean of the directions
    above the ground that are inside.
    """
    ways = lattice(5000, 0.0, 90.0)
    middle = functional.normalize(ways[inside(ways.float())].mean(0), dim=0)
    return round(
        float(angles_between(torch.tensor([item.look.region.axis]), middle[None])), 1
    )


def _with_cameras(
    path: Path, name: str, items: dict[str, Item]
) -> tuple[str, float | str]:
    """Verdict and evidence from where the training cameras stood; nothing where there
    were none.
    """
    item: Item | None = items[name]
    while isinstance(item, Coded):
        item = items.get(item.base)
    if item is None:
        return "", ""
    try:
        judged = audit(load_splat(path), cameras=item.cameras())
    except InvalidValueError:
        return "not judged", ""
    return judged.verdict, round(judged.strongest.evidence, 4)


def gated(path: Path, judged: Audit) -> str:
    """What `mi-splat gate --strict` says of an audited file without a policy."""
    found = findings(document(judged, lint_file(path)))
    actions = [
        Policy().action(rule.removeprefix("lint/"), severity)
        for rule, severity, _, _ in found
    ]
    return max(actions, key=VERDICTS.index, default="accept")


def read(file: Path) -> list[Row]:
    """The rows of a CSV file."""
    with file.open(newline="") as stream:
        return list(csv.DictReader(stream))


def hides(row: Row) -> bool:
    """Whether a splat hides something; a poisoning that brought less than 40 % of the
    way is a failed one.
    """
    return (
        str(row["file"]).startswith("hidden")
        and float(row["strength"] or 1) >= LEAST_STRENGTH
    )


def honest(row: Row) -> bool:
    """Whether a splat hides nothing."""
    return str(row["file"]).startswith("honest")


def ranked(rows: Sequence[Row], draws: int = 2000) -> tuple[float, float, float]:
    """Area under the ROC curve of the evidence, and its 95 % interval over splats drawn
    with replacement.
    """
    first, second = (
        np.array([float(row["evidence"]) for row in rows if of(row)])
        for of in (hides, honest)
    )
    above = (first[:, None] > second) + 0.5 * (first[:, None] == second)
    rng = np.random.default_rng(0)
    drawn = [
        above[rng.integers(0, len(first), len(first))][
            :, rng.integers(0, len(second), len(second))
        ].mean()
        for _ in range(draws)
    ]
    low, high = np.quantile(drawn, [0.025, 0.975])
    return float(above.mean()), float(low), float(high)


def called(rows: Iterable[Row]) -> tuple[int, int, int]:
    """How many are called hidden, how many at least suspicious, and how many there
    are.
    """
    verdicts = [row["verdict"] for row in rows]
    return (
        verdicts.count("hidden look"),
        sum(one != "nothing found" for one in verdicts),
        len(verdicts),
    )


def kind_of(row: Row) -> str:
    """The kind of a splat: what comes before the object in its name; all rings are one,
    and all scenes.
    """
    kind = str(row["file"]).partition("/")[0]
    kind = kind.partition(",")[0] if kind.startswith("honest") else kind
    if "ring" in kind:
        return kind.rstrip(" 0123456789")
    return kind


def lines(rows: Sequence[Row]) -> Iterator[str]:
    """Rows of the table in docs/audit-measured.md: called hidden, suspicious or hidden,
    and all of a kind.

    Columns: the sets on which thresholds were chosen, the other one, and that from
    where its training cameras stood.
    """
    kinds: dict[str, Callable[[Row], bool]] = {
        "all that hide": hides,
        "all honest": honest,
    }
    for kind in sorted(set(map(kind_of, rows))):
        kinds[kind] = partial(_is_of, kind)
    chosen, held = (
        [row for row in rows if (row["set"] == HELD) == is_held]
        for is_held in (False, True)
    )
    for kind, of in kinds.items():
        counts = [
            called(filter(of, part)) for part in (chosen, held, with_cameras(held))
        ]
        cells = ["{}, {} of {}".format(*count) if count[2] else "-" for count in counts]
        yield f"| {kind} | {' | '.join(cells)} |"


def with_cameras(rows: Iterable[Row]) -> list[Row]:
    """What an audit says of splats from where their training cameras stood, but for
    those that it cannot judge so.
    """
    judged = [row for row in rows if row["evidence_with_cameras"]]
    return [
        {
            **row,
            "verdict": row["with_cameras"],
            "evidence": row["evidence_with_cameras"],
        }
        for row in judged
    ]


def _is_of(kind: str, row: Row) -> bool:
    return kind_of(row) == kind and (hides(row) or honest(row))


def main(folder: str, name: str, file: str = "", *parts: str) -> None:
    """Make a set or parts of it, audit it, and say what follows."""
    items = [
        (key, item)
        for key, item in {**SETS, "strength": strength}[name]()
        if not parts or any(part in key for part in parts)
    ]
    made(Path(folder) / name, items)
    if file:
        measured(Path(folder) / name, items, Path(file))
        rows = read(Path(file))
        own = [row for row in rows if row["set"] == name]
        if any(map(honest, own)):
            ranks = "AUROC {:.3f} ({:.3f} to {:.3f})".format(*ranked(own))
        else:
            ranks = ""
        sys.stdout.write("\n".join([ranks, *lines(rows)]) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
