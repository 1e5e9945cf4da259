"""Small contents of a page, and a detector of mean colours."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from PIL import ImageDraw
from torch import Tensor

from attacks.cloak.config import StudyConfig
from attacks.cloak.study import SUMMARY
from mi_splat.io import save_splat
from mi_splat.maths.sh import colour_to_dc
from mi_splat.render.renderer import RenderSettings
from mi_splat.scene import GaussianScene
from mi_splat.viewer.content import Content, ShownSplat
from mi_splat.viewer.orbit import Orbit
from mi_splat.viewer.painter import Painter
from tests.fakes import blobs

START = Orbit(
    target=(0.0, 0.0, 0.0), azimuth=30.0, elevation=20.0, distance=5.0, fov=45.0
)
ABOVE = Orbit(
    target=(0.0, 0.0, 0.0), azimuth=30.0, elevation=80.0, distance=5.0, fov=45.0
)


def ball(colour: tuple[float, float, float], count: int = 20) -> GaussianScene:
    """Gaussians of one colour around the origin."""
    generator = torch.Generator().manual_seed(0)
    return GaussianScene(
        means=0.3 * torch.randn(count, 3, generator=generator),
        scales=torch.full((count, 3), 0.25),
        rotations=torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4).contiguous(),
        opacities=torch.full((count,), 0.9),
        sh=colour_to_dc(torch.tensor(colour)).expand(count, 1, 3).contiguous(),
    )


def balls(splats: int = 2, count: int = 20) -> Content:
    """A red ball, and a green one next to it if there are two."""
    colours = {"clean": (0.9, 0.1, 0.1), "attacked": (0.1, 0.8, 0.1)}
    settings = RenderSettings()
    return Content(
        title="balls <of> colour",
        splats=tuple(
            ShownSplat(name=name, scene=ball(colour, count), path=Path(f"{name}.ply"))
            for name, colour in list(colours.items())[:splats]
        ),
        settings=settings,
        start=START,
        size=(48, 32),
        cameras={"front": START, "above": ABOVE},
        describe=lambda camera: (f"{float(camera.position[2]):.1f} above the ground",),
    )


def save_study(folder: Path, study: StudyConfig) -> None:
    """Write the files of a study of CLOAK that are shown."""
    for name, colour in (("clean", (0.8, 0.1, 0.1)), ("cloaked", (0.1, 0.8, 0.1))):
        save_splat(ball(colour), folder / f"{name}.ply")
    (folder / SUMMARY).write_text(
        json.dumps({"story": "cloak", "study": asdict(study)})
    )


@dataclass(frozen=True)
class Mean:
    """The mean colour of an image as a finding."""

    colour: tuple[int, ...]

    @property
    def text(self) -> str:
        return f"mean colour {self.colour}"

    def draw(self, draw: ImageDraw.ImageDraw, scale: float) -> None:
        draw.rectangle((0, 0, 4 * scale, 4 * scale), fill="#ffffff")


class MeanInspector:
    """Remembers the images that it has inspected."""

    def __init__(self) -> None:
        self.seen: list[Tensor] = []

    def __call__(self, picture: Tensor) -> Mean:
        self.seen.append(picture)
        return Mean(tuple(int(255 * value) for value in picture.mean((0, 1))))


def painter(splats: int = 2, inspector: MeanInspector | None = None) -> Painter:
    """A painter without Mitsuba."""
    return Painter(balls(splats), blobs, inspector)
