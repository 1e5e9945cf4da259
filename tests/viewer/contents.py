"""Small contents of a page, a detector of mean colours, and a job that does nothing."""

import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from PIL import ImageDraw
from torch import Tensor

from attacks.cloak.config import StudyConfig
from attacks.cloak.study import SUMMARY
from mi_splat.errors import InvalidValueError
from mi_splat.io import save_splat
from mi_splat.rendering import RenderSettings
from mi_splat.scene import GaussianScene
from mi_splat.sh import colour_to_dc
from mi_splat.viewer.content import Content, ShownSplat
from mi_splat.viewer.orbit import Orbit
from mi_splat.viewer.painter import Painter
from mi_splat.viewer.runner import Choice, JobKind, JobRequest, JobResult, JobRunner, Number
from tests.fakes import blobs

START = Orbit(target=(0.0, 0.0, 0.0), azimuth=30.0, elevation=20.0, distance=5.0, fov=45.0)
ABOVE = Orbit(target=(0.0, 0.0, 0.0), azimuth=30.0, elevation=80.0, distance=5.0, fov=45.0)


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
    (folder / SUMMARY).write_text(json.dumps({"story": "cloak", "study": asdict(study)}))


@dataclass(frozen=True)
class Mean:
    """The mean colour of a picture as a finding."""

    colour: tuple[int, ...]

    @property
    def text(self) -> str:
        return f"mean colour {self.colour}"

    def draw(self, draw: ImageDraw.ImageDraw, scale: float) -> None:
        draw.rectangle((0, 0, 4 * scale, 4 * scale), fill="#ffffff")


class MeanInspector:
    """Remembers the pictures that it has inspected."""

    def __init__(self) -> None:
        self.seen: list[Tensor] = []

    def __call__(self, picture: Tensor) -> Mean:
        self.seen.append(picture)
        return Mean(tuple(int(255 * value) for value in picture.mean((0, 1))))


def painter(splats: int = 2, inspector: MeanInspector | None = None) -> Painter:
    """A painter without Mitsuba."""
    return Painter(balls(splats), blobs, inspector)


_SCRIPT = """
import pathlib, sys, time
verb, eps, mask, out = sys.argv[1:]
print("mi-splat: working", flush=True)
try:
    while verb == "wait":
        time.sleep(0.01)
except KeyboardInterrupt:
    pass
if verb == "fail":
    sys.exit("mi-splat: expected to be done, got this")
pathlib.Path(out).write_text(eps)
sys.exit(130 if verb == "wait" else 0)
"""


def _arguments(request: JobRequest, mask: Path, out: Path) -> list[str]:
    if request.picked is None:
        raise InvalidValueError("Work: expected an object, got none; click on one")
    return [str(request.values["verb"]), f"--eps={request.values['eps']}", str(mask), str(out)]


WORK = JobKind(
    name="Work",
    fields=(
        Choice(name="verb", label="Verb", options=("do", "wait", "fail"), default="do"),
        Number(name="eps", label="eps", low=0.5, high=20.0, step=0.5, default=5.0),
    ),
    out=Path("out/work"),
    arguments=_arguments,
    opened=lambda request, out: JobResult(lines=(f"done with {out.read_text()}",), content=balls(2)),
)


def runner(**options: Any) -> JobRunner:
    """A page with a job that does nothing."""
    program = [sys.executable, "-c", _SCRIPT]
    return JobRunner(
        painter(1), [WORK], renderer=lambda settings: blobs, program=lambda *words: [*program, *words], **options
    )
