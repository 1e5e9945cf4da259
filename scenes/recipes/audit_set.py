"""Splats to test the audit on: honest ones are trained on path-traced images from
hemispheres, rings, half circles, few cameras or from above. What hides something is an
edit of one of these, so that the truth is exact, or trained on images of two scenes.
"""

import csv
import json
import math
import random
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
from mi_splat.cameras.camera import Camera, View
from mi_splat.cameras.framing import near_plane
from mi_splat.cameras.sets import framing, hemisphere, orbit
from mi_splat.capture.ground import square_of_ground
from mi_splat.capture.mesh import Asset, scaling, translation
from mi_splat.capture.mesh_files import load_mesh
from mi_splat.capture.mitsuba_scene import scene_dict
from mi_splat.capture.objects import OBJECTS, SUFFIX
from mi_splat.capture.path_tracer import PathTracer
from mi_splat.capture.sources import open_source
from mi_splat.capture.surface_points import surface_samples
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
    """A splat that is trained on images of an object, of a scene of `scenes/honest`, or
    of the mesh of a file.

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
        low, high = self._body().bounds.astype(float)
        return self.capture.cameras(
            (0.0, 0.0, float(low[2] + high[2]) / 2),
            float(((high - low) ** 2).sum() ** 0.5) / 2,
        )

    def _body(self) -> Asset:
        if not self.content.endswith(SUFFIX):
            return build(self.content, self.seed).body
        found = load_mesh(Path(self.content))
        low, high = found.bounds.astype(float)
        # of two metres from corner to corner, and on the ground
        x, y, _ = -(low + high) / 2
        size = float(((high - low) ** 2).sum() ** 0.5)
        return found.transformed(scaling(*[2 / size] * 3) @ translation(x, y, -low[2]))

    def _scene(self, colour: Any) -> MeshScene:
        target = self._body()
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


def _ring(elevation: float, **settings: Any) -> Capture:
    return Capture(elevation=(elevation - 3.0, elevation + 3.0), **settings)


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


def meshes(folder: Path) -> Iterator[tuple[str, Item]]:
    """Honest splats of the meshes of a folder, with captures as they are drawn."""
    for number, path in enumerate(sorted(folder.glob(f"*{SUFFIX}"))):
        capture, about = _drawn_capture(random.Random(number))
        trained = Trained(content=str(path), seed=number, capture=capture)
        yield f"honest {about}/{path.stem}", trained


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


def attackers() -> Iterator[tuple[str, Item]]:
    """Edits of an honest car by attackers who know how directions are held out."""
    base, car = next(drawn(2012, 2013))
    yield base, car
    top = direction(90.0, 0.0)
    beside = cone(direction(45.0, 230.0), 25.0)
    opposite = cone(direction(45.0, 320.0), 25.0)
    edits: dict[str, Callable[[Made], Made]] = {
        f"width {width:.0f}": partial(hidden, inside=cone(top, width))
        for width in (50.0, 30.0, 20.0, 10.0)
    }
    edits["two cones"] = partial(
        hidden, inside=lambda views: beside(views) | opposite(views)
    )
    edits["most directions"] = partial(hidden, inside=lambda views: views[:, 2] > 0.34)
    edits["red from above"] = partial(hidden, inside=cone(top, 50.0), colour=RED)
    edits["half way"] = partial(hidden, inside=cone(top, 50.0), amount=0.5)
    for name, change in edits.items():
        yield f"attacker/{name}", Coded(base=base, change=change)


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
