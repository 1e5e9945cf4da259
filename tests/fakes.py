"""A renderer and a detector of a few lines, so that attacks can be tested without
Mitsuba and without weights.
"""

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import pytest
import torch
from torch import Tensor

from attacks.detectors import DetectorSpec, registry
from attacks.detectors.base import Candidates, Detections, Detector, check_images
from mi_splat.cameras.camera import Camera, look_at, project_points
from mi_splat.cameras.lens import Lens
from mi_splat.maths.sh import colour_to_dc, sh_to_colour
from mi_splat.scene import GaussianScene


def blobs(scene: GaussianScene, camera: Camera) -> Tensor:
    """Soft discs of the Gaussians' colours, a weighted mean in any order;
    differentiable in all five tensors.
    """
    pixels, depth = project_points(scene.means, camera)
    y, x = torch.meshgrid(
        torch.arange(camera.height) + 0.5,
        torch.arange(camera.width) + 0.5,
        indexing="ij",
    )
    gap = torch.stack([x, y], -1).to(pixels)[:, :, None] - pixels
    # The first column of the rotation matrix tilts the disc, so that quaternions
    # matter.
    w, a, b, c = scene.rotations.unbind(-1)
    tilt = torch.stack([1 - 2 * (b * b + c * c), 2 * (a * b + w * c)], -1)
    radius = (scene.scales.mean(-1) * camera.fx / depth)[None, None]
    weight = scene.opacities * torch.exp(
        -0.5 * ((gap / radius[..., None]) ** 2).sum(-1)
        - 0.1 * (gap * tilt).sum(-1) ** 2 / radius**2
    )
    directions = torch.nn.functional.normalize(
        scene.means - camera.position.to(scene.means), dim=-1
    )
    total = (weight[..., None] * sh_to_colour(scene.sh, directions)).sum(2)
    return total / weight.sum(2).clamp(min=1)[..., None]


class ColourDetector:
    """Finds patches of colour: a red one is a car, a green one a person, a blue one a
    stop sign; dark is nothing.
    """

    name: str = "fake_colour"
    classes: tuple[str, ...] = ("car", "person", "stop sign")
    fingerprint: str = "00000000c0104e5f"
    min_confidence: float = 0.05
    sizes: tuple[int, ...] = (12, 16, 20, 24)
    stride = 2

    def candidates(self, images: Tensor) -> list[Candidates]:
        check_images(images)
        by_picture = []
        for image in images:
            grids = [self._grid(image, size) for size in self.sizes]
            boxes, means = (torch.cat(column) for column in zip(*grids, strict=True))
            area = (boxes[:, 2:] - boxes[:, :2]).prod(-1, keepdim=True) / (
                image.shape[0] * image.shape[1]
            )
            logits = torch.cat(
                [150 * (means - 0.25) * area, torch.full_like(area, 5.0)], -1
            )
            scores = logits.softmax(-1)[:, :3]
            by_picture.append(Candidates(boxes[:, None].expand(-1, 3, -1), scores))
        return by_picture

    def _grid(self, image: Tensor, size: int) -> tuple[Tensor, Tensor]:
        """Boxes of one size and the mean colour in each."""
        means = torch.nn.functional.avg_pool2d(
            image.permute(2, 0, 1), size, self.stride
        )
        rows, columns = means.shape[1:]
        y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
        corner = self.stride * torch.stack([x, y], -1).reshape(-1, 2).to(image)
        return torch.cat([corner, corner + size], -1), means.permute(1, 2, 0).reshape(
            -1, 3
        )

    def detect(self, images: Tensor) -> list[Detections]:
        """The best box of each class, if it scores `min_confidence` or more."""
        results = []
        for candidates in self.candidates(images):
            best = candidates.scores.detach().max(0)
            order = [
                int(c)
                for c in best.values.argsort(descending=True)
                if best.values[c] >= self.min_confidence
            ]
            rows = best.indices[order]
            if order:
                boxes = candidates.boxes.detach()[rows, order]
            else:
                boxes = torch.zeros(0, 4)
            results.append(
                Detections(
                    boxes, best.values[order], tuple(self.classes[c] for c in order)
                )
            )
        return results


class CoarseDetector(ColourDetector):
    """Another one, with a coarser grid and fewer sizes."""

    name = "fake_coarse"
    fingerprint = "00000000c0a45e00"
    sizes = (14, 22)
    stride = 3


def camera(size: int = 32, *, offset: float = 0.0) -> Camera:
    """Looks along world +y at the origin from three metres."""
    return Camera(
        to_world=look_at((offset, -3.0, 0.0), (0.0, 0.0, 0.0)),
        lens=Lens(focal=1.2 * size, size=(size, size)),
    )


def toy_scene(
    *, degree: int = 1, seed: int = 0, count: int = 30
) -> tuple[GaussianScene, Tensor]:
    """A red object of `count` Gaussians at the origin, and ten dark grey ones around
    it; with the object's mask.
    """
    generator = torch.Generator().manual_seed(seed)
    total = count + 10
    mask = torch.arange(total) >= 10
    means = 0.3 * (2 * torch.rand(total, 3, generator=generator) - 1)
    means[:10] += torch.tensor([1.1, 0.0, 0.9])
    colours = torch.where(
        mask[:, None], torch.tensor([0.9, 0.15, 0.1]), torch.tensor([0.2, 0.2, 0.2])
    )
    sh = 0.02 * torch.randn(total, (degree + 1) ** 2, 3, generator=generator)
    sh[:, 0] = colour_to_dc(colours)
    scene = GaussianScene(
        means=means,
        scales=torch.full((total, 3), 0.12),
        rotations=torch.nn.functional.normalize(
            torch.randn(total, 4, generator=generator), dim=-1
        ),
        opacities=torch.full((total,), 0.9),
        sh=sh,
    )
    return scene, mask


def _given(detector: Detector, weights: Path | None) -> Detector:
    return detector


def register(
    monkeypatch: pytest.MonkeyPatch, detectors: Mapping[str, Detector]
) -> None:
    """Make detectors known by name to every command, as those of an installed package
    are.
    """
    for name, detector in detectors.items():
        spec = DetectorSpec(
            name=name,
            load=partial(_given, detector),
            classes=detector.classes,
            origin="a test",
            licence="none",
        )
        monkeypatch.setitem(registry.DETECTORS.own, name, spec)
