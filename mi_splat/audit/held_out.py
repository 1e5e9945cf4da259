"""Held-out directions: what the other directions of a splat predict for a cone of them,
beside what the file shows there.

Each Gaussian gets the median of the colours that it shows towards the other directions,
and in a second prediction what shows almost only inside the cone is peeled off. The
file *contradicts* itself where features of file and prediction are far apart, less far
where the prediction looks more like the other views than the file does, or where a
detector recognises the object in a prediction only. Where the two merely look unlike
each other, the file *differs*, as honest captures do, too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import torch
from torch import Tensor
from torch.nn import functional

from mi_splat.audit.objects import Frame, Target
from mi_splat.audit.results import Answer, ConeView, Region, Vector, vector
from mi_splat.audit.viewpoints import SKY, basis, in_sight, in_world, near_of
from mi_splat.cameras.camera import Camera, project_points
from mi_splat.maths.medians import medians_without
from mi_splat.maths.sh import colour_to_dc, dc_to_colour, rotate_sh, sh_basis
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.render.scene_files import resized
from mi_splat.scene import GaussianScene
from mi_splat.selection.visibility import contributions

_CHUNK = 8192
_LESS = 0.99
_SAMPLED = 3  # one image in so many is scored before the others
_RISE = 2.0  # weight of the rise beside the distance
_AROUND = 2.2  # radii from the middle within which a lid may lie
_BRIM = 0.1  # share of an object's points that may lie beyond each edge


class Recogniser(Protocol):
    """What compares images of one object by what they show."""

    @property
    def classes(self) -> tuple[str, ...]:
        """C names of what `scores` knows."""
        ...

    @property
    def missing(self) -> str:
        """What it cannot compare, and what to do; empty if nothing is missing."""
        ...

    @property
    def scale(self) -> float:
        """Factor that brings cosine distances of its features to the scale of those of
        MobileNetV2, for which the thresholds were chosen.
        """
        ...

    def features(self, images: Tensor) -> Tensor:
        """(B, F) features of (B, S, S, 3) sRGB images in [0, 1]."""
        ...

    def scores(self, images: Tensor) -> Tensor:
        """(B, C) in [0, 1], the best confidence of each class in the middle."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldOutConfig:
    """How directions are held out, and from where an answer is given."""

    cameras: int = 44  # around each object
    size: int = 160  # pixels along each side of their images
    weighed: int = 96  # the same of the images that say what shows from where
    shown: int = 6  # cameras of a cone that are compared, at most
    filled: float = 0.45  # share of their images that most of an object fills,
    magnified: float = 3.0  # enlarged so many times at most
    core: float = 0.75  # share of the half width of a cone within which these stand
    least_inside: int = 3  # cameras in a cone that is judged,
    least_outside: int = 6  # and outside of it
    seen: float = 0.02  # of the most that a Gaussian shows, from which it is seen
    peeled: float = 0.7  # share of what a Gaussian shows that is inside, if it is
    # quantile of the confidence over all cameras by which a detector knows an object
    usual: float = 0.7
    known: float = 0.5  # that confidence at least
    gain: float = 0.8  # confidence of a prediction beyond that of the file
    # Cosine distance between the features of file and prediction, from which the file
    # departs,
    departs: float = 0.33
    # and from which it does if twice as much is added as the prediction is more like
    # the other views than the file is,
    departs_with_rise: float = 0.28
    differs: float = 0.16  # and from which it differs

    def evidence(
        self, *, gain: float, distance: float, rise: float, is_agreed: bool
    ) -> float:
        """How much a cone contradicts the others; from 1 it is said to.

        A gain alone is not enough unless half of the views agree on the class.
        """
        departure = distance / self.departs
        with_rise = (distance + _RISE * rise) / self.departs_with_rise
        recognised = gain / self.gain
        if not is_agreed:
            recognised = min(recognised, _LESS)
        return max(departure, with_rise, recognised)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cone:
    """A cone of directions around an object, in the frame."""

    axis: Tensor  # (3,) float64 unit vector from the centre
    half_width: float  # degrees

    def holds(self, directions: Tensor, share: float = 1.0) -> Tensor:
        """(K,) bool, which (K, 3) unit vectors lie inside a share of its width."""
        least = math.cos(math.radians(share * self.half_width))
        return directions @ self.axis > least


# elevation, azimuths and half width of the cones, in degrees: they overlap, so that a
# trigger of up to 60 degrees lies within one, or is the rest of another
_RINGS = (
    (90.0, (0.0,), 48.0),
    (25.0, (0.0, 60.0, 120.0, 180.0, 240.0, 300.0), 42.0),
    (58.0, (30.0, 120.0, 210.0, 300.0), 40.0),
)
_BELOW = (
    (-25.0, (30.0, 90.0, 150.0, 210.0, 270.0, 330.0), 42.0),
    (-58.0, (0.0, 90.0, 180.0, 270.0), 40.0),
    (-90.0, (0.0,), 48.0),
)


def cones_around(up: Tensor | None) -> list[Cone]:
    """One from above, six from the side and four in between; as many from below, where
    an object stands on no ground.
    """
    rings = _RINGS if up is not None else (*_RINGS, *_BELOW)
    turn = basis(up)
    cones = []
    for elevation, azimuths, half_width in rings:
        height = math.radians(elevation)
        for azimuth in azimuths:
            around = math.radians(azimuth)
            x = math.cos(height) * math.cos(around)
            y = math.cos(height) * math.sin(around)
            local = torch.tensor([x, y, math.sin(height)], dtype=torch.float64)
            cones.append(Cone(axis=turn @ local, half_width=half_width))
    return cones


class Prediction(NamedTuple):
    """A scene as cameras outside of a cone predict it."""

    painted: GaussianScene  # in the colours that it shows towards these cameras
    colours: Tensor  # (M, 3) sRGB of these
    lid: Tensor  # (M,) bool, what shows almost only inside, and may hide the rest

    @property
    def peeled(self) -> GaussianScene:
        """Without what shows almost only inside."""
        return self.painted.select((~self.lid).nonzero()[:, 0])


class _Recognised(NamedTuple):
    """The images of all K cameras around an object, and what they are known by."""

    shown: Tensor  # (K, S, S, 3)
    features: Tensor  # (K, F) of unit length
    scores: Tensor  # (K,) of the class
    kind: int  # number of the class that is seen most
    name: str | None  # of the class; None where no class is seen clearly
    is_agreed: bool  # whether half of the views show it

    def score(self, chosen: Sequence[int]) -> float:
        """Mean score of some of the cameras."""
        return float(self.scores[list(chosen)].mean())


def _recognised(
    shown: Tensor, scored: Sequence[int], recogniser: Recogniser, config: HeldOutConfig
) -> _Recognised:
    """What images show, by the scores of some of them; the others have none."""
    rows = torch.tensor(scored)
    is_first = torch.arange(len(rows)) % _SAMPLED == 0
    found = torch.zeros(len(rows), len(recogniser.classes))
    found[is_first] = recogniser.scores(shown[rows[is_first]])
    # a class that is in none of these is known in few of the others
    if bool((found >= config.known).any()):
        found[~is_first] = recogniser.scores(shown[rows[~is_first]])
    usual = found.quantile(config.usual, 0)
    kind = int(usual.argmax())
    is_known = float(usual[kind]) >= config.known
    scores = torch.zeros(len(shown))
    scores[rows] = found[:, kind]
    return _Recognised(
        shown=shown,
        features=functional.normalize(recogniser.features(shown), dim=1),
        scores=scores,
        kind=kind,
        name=recogniser.classes[kind] if is_known else None,
        is_agreed=float(found[:, kind].median()) >= config.known,
    )


class Consensus:
    """The Gaussians around an object, which of them each camera sees, and what some
    cameras predict for others.
    """

    def __init__(
        self,
        frame: Frame,
        target: Target,
        cameras: Sequence[Camera],
        config: HeldOutConfig,
    ) -> None:
        self.config = config
        self._frame = frame
        self._target = target
        solid = frame.scene.means[target.rows]
        self.cameras = [_filled(camera, solid, config) for camera in cameras]
        self._eyes = torch.stack([camera.position for camera in cameras])
        self.directions = functional.normalize(self._eyes - target.centre, dim=1)
        near = near_of(target, cameras)
        self._render = Renderer(RenderSettings(background=SKY, near=near))
        rows = in_sight(frame.scene, target, cameras)
        self.scene = frame.scene.select(rows)
        self.rows = frame.order[rows]  # (M,) rows of the file of these Gaussians
        small = [_square(camera, config.weighed) for camera in cameras]
        # (M, K) pixels of each camera that each Gaussian makes up
        self.weights = contributions(self.scene, small, render=self._render)
        most = self.weights.amax(1, keepdim=True).clamp(min=1e-6)
        # (M, K) bool, of those that each camera sees
        self.seen = self.weights > config.seen * most
        points = self.scene.means
        gaps = (points - target.centre.float()).norm(dim=1)
        own = gaps < _AROUND * target.radius
        # (M,) bool, of the object and what lies on it
        self.own = own & target.above(frame.scene, points, 0.02)

    def predicted(self, inside: Tensor) -> Prediction:
        """What the cameras that (K,) bool `inside` leaves predict."""
        return self._prediction(self.medians(inside[None])[0], inside)

    def medians(self, insides: Tensor) -> Tensor:
        """(C, M, 3) median colours of the Gaussians towards the cameras that each of
        (C, K) bool `insides` leaves.
        """
        everywhere = torch.ones(len(self.cameras), dtype=torch.bool)
        if self.scene.degree == 0:  # the same colours towards all
            colours = dc_to_colour(self.scene.sh[:, 0]).clamp(min=0)
            return colours.expand(len(insides), -1, -1)
        found = [
            medians_without(self.colours(part, everywhere), self.seen[part], insides)
            for part in self.parts()
        ]
        return torch.cat(found, 1)

    def _prediction(self, colours: Tensor, inside: Tensor) -> Prediction:
        sh = colour_to_dc(colours)[:, None]
        painted = GaussianScene.unchecked(*self.scene.tensors()[:4], sh)
        sides = torch.stack([inside, ~inside], 1).float()
        within, beyond = (self.weights @ (sides / sides.sum(0))).unbind(1)
        total = within + beyond
        is_inside = within > self.config.peeled * total
        lid = self.own & is_inside & (total > self.config.seen)
        return Prediction(painted, colours, lid)

    def parts(self) -> Sequence[Tensor]:
        """Numbers of the Gaussians in chunks, as those times cameras take memory."""
        return torch.split(torch.arange(len(self.scene)), _CHUNK)

    def towards(self, part: Tensor, cameras: Tensor) -> Tensor:
        """(P, K, C) basis of the directions from (K,) bool cameras to Gaussians."""
        offsets = self.scene.means[part][:, None] - self._eyes[cameras].float()
        return sh_basis(functional.normalize(offsets, dim=-1), self.scene.degree)

    def colours(self, part: Tensor, cameras: Tensor) -> Tensor:
        """(P, K, 3) colours that Gaussians show towards (K,) bool cameras."""
        values = self.towards(part, cameras) @ self.scene.sh[part] + 0.5
        return values.clamp(min=0)

    def departures(
        self, predicted: Prediction, inside: Tensor, *, peeled: bool
    ) -> Tensor:
        """(M,) by how much each Gaussian makes images from inside differ from the
        prediction: pixels times sRGB; all of what a lid shows, where it is peeled.
        """
        found = []
        for part in self.parts():
            shown = self.colours(part, inside)
            gaps = (shown - predicted.colours[part][:, None]).abs().mean(-1)
            if peeled:
                gaps[predicted.lid[part]] = 1.0
            found.append((gaps * self.weights[part][:, inside]).mean(1))
        return torch.cat(found)

    def images(self, scene: GaussianScene, numbers: Sequence[int]) -> Tensor:
        """(V, S, S, 3) images of some of the cameras."""
        with torch.no_grad():
            return self.rendered(scene, numbers)

    def rendered(self, scene: GaussianScene, numbers: Sequence[int]) -> Tensor:
        """The same, differentiable in the scene."""
        shown = [self._render(scene, self.cameras[number]) for number in numbers]
        return torch.stack(shown)[..., :3].clamp(0, 1)

    def compared(
        self, number: int, recogniser: Recogniser
    ) -> tuple[list[ConeView], str | None]:
        """What the file shows from each cone beside what the others predict, and the
        class of the object.
        """
        cones = {
            cone: chosen
            for cone in cones_around(self._target.up)
            if (chosen := self.chosen(cone))
        }
        if not cones:  # in a room, cameras may stand on one side only
            return [], None
        shown = self.images(self.scene, range(len(self.cameras)))
        scored = sorted({index for chosen in cones.values() for index in chosen})
        known = _recognised(shown, scored, recogniser, self.config)
        insides = torch.stack([cone.holds(self.directions) for cone in cones])
        views = [
            self._compared(number, cone, chosen, colours, known, recogniser)
            for (cone, chosen), colours in zip(
                cones.items(), self.medians(insides), strict=True
            )
        ]
        return views, known.name

    def _compared(
        self,
        number: int,
        cone: Cone,
        chosen: Sequence[int],
        colours: Tensor,
        known: _Recognised,
        recogniser: Recogniser,
    ) -> ConeView:
        """What the file shows from some cameras in a cone beside a prediction in (M, 3)
        colours.
        """
        inside = cone.holds(self.directions)
        candidates = self._prediction(colours, inside)
        own = known.features[chosen]
        if self.scene.degree == 0:  # what looks the same from everywhere
            prediction, predicted = known.shown[chosen], own
        else:
            prediction = self.images(candidates.painted, chosen)
            predicted = functional.normalize(recogniser.features(prediction), dim=1)
        others = known.features[~inside].T
        # how much the most similar of the other views resembles each
        nearest_own = (own @ others).amax(1).mean()
        nearest_predicted = (predicted @ others).amax(1).mean()
        likeness = (predicted * own).sum(1)
        distance = recogniser.scale * (1 - float(likeness.mean()))
        rise = recogniser.scale * float(nearest_predicted - nearest_own)
        score = known.score(chosen)
        gain = 0.0
        is_peeled = False
        # no gain is possible where the file shows the object clearly
        if known.name is not None and score <= 1 - self.config.gain:
            without_lid = self.images(candidates.peeled, chosen)
            for candidate in (prediction, without_lid):
                found = recogniser.scores(candidate)[:, known.kind].mean()
                if float(found) - score > gain:
                    gain = float(found) - score
                    prediction = candidate
                    is_peeled = candidate is without_lid
        evidence = self.config.evidence(
            gain=gain, distance=distance, rise=rise, is_agreed=known.is_agreed
        )
        # the view that departs most comes first
        order = likeness.argsort().tolist()
        ordered = [chosen[index] for index in order]
        return ConeView(
            object=number,
            region=self._region(cone),
            up=self.up,
            inside=inside,
            peeled=is_peeled,
            cameras=self._in_world(ordered),
            file=known.shown[ordered],
            prediction=prediction[order],
            distance=distance,
            rise=rise,
            known_as=known.name,
            file_score=score,
            gain=gain,
            evidence=evidence,
            answer=self._answer(evidence, distance),
        )

    def _answer(self, evidence: float, distance: float) -> Answer:
        if evidence >= 1:
            return "contradicted"
        if distance >= self.config.differs:
            return "differs"
        return "consistent"

    def chosen(self, cone: Cone) -> list[int]:
        """The cameras of a cone that are compared; none where too few are on a side."""
        inside = int(cone.holds(self.directions).sum())
        outside = len(self.directions) - inside
        core = cone.holds(self.directions, self.config.core).nonzero()[:, 0]
        few = inside < self.config.least_inside or outside < self.config.least_outside
        if few or not len(core):
            return []
        spread = torch.linspace(0, len(core) - 1, min(self.config.shown, len(core)))
        numbers: list[int] = core[spread.round().long()].tolist()
        return numbers

    def _region(self, cone: Cone) -> Region:
        axis = vector(self._frame.direction(cone.axis))
        return Region(axis=axis, half_width=cone.half_width)

    @property
    def up(self) -> Vector | None:
        """The direction of the world that is up for the object."""
        up = self._target.up
        return None if up is None else vector(self._frame.direction(up))

    def world_sh(self, sh: Tensor) -> Tensor:
        """(P, C, 3) coefficients of the frame as those of the file."""
        return rotate_sh(sh, self._frame.to_world.rotation)

    def _in_world(self, chosen: Sequence[int]) -> tuple[Camera, ...]:
        return tuple(in_world(self._frame, self.cameras[number]) for number in chosen)


def _square(camera: Camera, side: int) -> Camera:
    return resized(camera, (side, side))


def _filled(camera: Camera, points: Tensor, config: HeldOutConfig) -> Camera:
    """A camera whose square image shows (N, 3) points in its middle, and large."""
    side = config.size
    wide = _square(camera, side)
    pixels, _ = project_points(points, wide)
    edges = torch.tensor([_BRIM, 1 - _BRIM], dtype=pixels.dtype)
    low, high = pixels.quantile(edges, 0)
    extent = float((high - low).max()) / config.filled
    factor = min(max(side / max(extent, 1e-6), 1.0), config.magnified)
    corner = ((low + high) / 2 - side / (2 * factor)).tolist()
    across, down = wide.lens.scale
    lens = replace(
        wide.lens,
        focal=(factor * across, factor * down),
        principal=(factor * (wide.cx - corner[0]), factor * (wide.cy - corner[1])),
    )
    return replace(wide, lens=lens)
