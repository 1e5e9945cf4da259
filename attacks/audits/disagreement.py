"""What detectors report on the objects of a splat along paths of cameras: evidence for people, and no rule.

Where the class on an object changes along a path and comes back, something shows from there alone. A clean object does
that as well, for a detector that does not know it from above.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch.nn import functional

from attacks.detectors.base import Detector
from attacks.observe.observations import report_cells
from attacks.observe.views import detect_views
from mi_splat.audit.surfaces import basis, frame_of, targets
from mi_splat.cameras import Camera, focal_of, look_at, project_box
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene import GaussianScene

AROUND, OVER = "around it, 20 degrees above", "over it, from one side to the other"
"""The two paths."""
CONFIDENCE = 0.5
_SIZE, _FOV, _DISTANCE, _STEP = 256, 45.0, 2.6, 10.0
_BACKGROUND = (0.55, 0.7, 0.9)


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """What one detector reports on one object along one path."""

    number: int  # of the object, from 1, the largest first
    path: str  # `AROUND` or `OVER`
    detector: str
    degrees: tuple[float, ...]  # along the path
    labels: tuple[str | None, ...]  # the class with most confidence at each place; None below `CONFIDENCE`
    scores: tuple[float, ...]  # its confidence; 0 for none

    @property
    def runs(self) -> list[str]:
        """The classes in their order along the path, each once for all neighbouring degrees."""
        return [label or "nothing" for label, _ in itertools.groupby(self.labels)]

    @property
    def comes_back(self) -> bool:
        """Whether a class changes, and is there again further along."""
        return any(self.runs.count(label) > 1 for label in set(self.runs) - {"nothing"})


def seen_along_paths(scene: GaussianScene, detectors: Sequence[Detector]) -> Iterator[Seen]:
    """Look at each object of a splat with detectors along two paths: around it, and over it."""
    frame = frame_of(scene)
    for number, target in enumerate(targets(frame.scene), 1):
        centre = frame.point(target.centre).double()
        radius = target.radius * frame.to_world.scale
        up = torch.tensor([0.0, 0.0, 1.0]) if target.up is None else frame.direction(target.up)
        turn = basis(functional.normalize(up.double(), dim=0))
        points = scene.means[frame.order[target.rows]]
        for path, samples in _paths().items():
            cameras = [
                _camera(centre + _DISTANCE * radius * (turn @ direction), centre, turn[:, 2])
                for _, direction in samples
            ]
            boxes = [project_box(points, camera) for camera in cameras]
            render = Renderer(RenderSettings(background=_BACKGROUND, near=0.02 * _DISTANCE * radius))
            told: dict[str, list[tuple[str | None, float]]] = {detector.name: [] for detector in detectors}
            for view in detect_views(scene, cameras, detectors, render=render, boxes=boxes):
                best = report_cells(view.detections, view.box, original=None)
                score = float(best["score"] or 0.0)
                known = score >= CONFIDENCE
                told[view.detector].append((str(best["label"]) if known else None, score if known else 0.0))
            for name, cells in told.items():
                labels, scores = zip(*cells, strict=True)
                degrees = tuple(degree for degree, _ in samples)
                yield Seen(number=number, path=path, detector=name, degrees=degrees, labels=labels, scores=scores)


def _paths() -> dict[str, list[tuple[float, torch.Tensor]]]:
    """Degrees along each path, and (3,) unit vectors there in a frame whose third axis is up."""
    ring = [(azimuth, _direction(20.0, azimuth)) for azimuth in _steps(0.0, 360.0)]
    arc = [(degree, _direction(degree, 0.0)) for degree in _steps(5.0, 180.0)]
    return {AROUND: ring, OVER: arc}


def _steps(first: float, end: float) -> list[float]:
    return [first + _STEP * number for number in range(math.ceil((end - first) / _STEP))]


def _direction(elevation: float, azimuth: float) -> torch.Tensor:
    e, a = math.radians(elevation), math.radians(azimuth)
    return torch.tensor([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)], dtype=torch.float64)


def _camera(eye: torch.Tensor, centre: torch.Tensor, up: torch.Tensor) -> Camera:
    pose = look_at(eye.tolist(), centre.tolist(), up=up.tolist())
    return Camera(to_world=pose, focal=focal_of(math.radians(_FOV), _SIZE), width=_SIZE, height=_SIZE)
