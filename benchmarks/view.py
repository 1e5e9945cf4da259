"""How many images a second does `mi-splat view` make while the camera moves, and how
soon does it react at rest?

    python benchmarks/view.py [--gaussians 100000] [--canvas 1000 700]
        [--images 120] [--json]

A camera goes around a shell of Gaussians. Timed is what the server does for each
image: rendering, putting together, and encoding as JPEG, at the resolution that the
pace settles on; once with one splat, once with two side by side. The browser's own work
and the network are not in it. `cpu_ms` is the processor time of an image, which other
programs on the machine change less than the clock's. The first quarter of the images,
in which kernels are compiled and the pace settles, does not count; the very first one
is timed apart, without the time that kernels take to compile.

A reaction is what a user waits for who moves the camera while a full image is made:
until that is interrupted, and the coarse image is made. It is the slowest of
movements at several moments of a full image.
"""

import argparse
import contextlib
import io
import json
import statistics
import sys
import time
from dataclasses import replace
from pathlib import Path

from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from render import shell  # of this folder

from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.render.tile.frozen import PictureInterruptedError, interrupted_by
from mi_splat.scene import GaussianScene
from mi_splat.viewer.content import Content, ShownSplat, whole
from mi_splat.viewer.painter import Painter
from mi_splat.viewer.server import JPEG_QUALITY
from mi_splat.viewer.session import Pace, Step, ViewState, display_modes

MOMENTS = 12  # of a full image, at which the camera moves


def measure(
    scene: GaussianScene, splats: int, canvas: tuple[int, int], pictures: int
) -> dict[str, float]:
    """Images a second while the camera moves, and what a full image takes."""
    settings = RenderSettings()
    names = ("clean", "attacked")[:splats]
    shown = tuple(
        ShownSplat(name=name, scene=scene, path=Path(f"{name}.ply")) for name in names
    )
    content = Content(
        title="benchmark",
        splats=shown,
        settings=settings,
        start=whole(scene),
        size=(640, 480),
    )
    state = ViewState(orbit=content.start, mode=display_modes(names)[0], canvas=canvas)
    firsts = []
    for _ in range(2):  # the second one finds the kernels compiled
        painter = Painter(content, Renderer(settings))
        pace = Pace()
        firsts.append(_timed(painter, state, Step.COARSE, pace)[0])
    times: list[float] = []
    busy = 0.0
    every = 1
    for number in range(pictures):
        if number == pictures // 4:
            busy = time.process_time()
        state = replace(state, orbit=replace(state.orbit, azimuth=3.0 * number))
        seconds, every = _timed(painter, state, Step.COARSE, pace)
        times.append(seconds)
        pace = pace.after(seconds)
    busy = time.process_time() - busy
    settled = times[pictures // 4 :]
    half, full = (
        statistics.median(_timed(painter, state, step, pace)[0] for _ in range(5))
        for step in (Step.HALF, Step.FULL)
    )
    reactions = [
        _reaction(painter, state, pace, full * part / MOMENTS)
        for part in range(1, MOMENTS)
    ]
    return {
        "splats": splats,
        "pictures_a_second": round(len(settled) / sum(settled), 1),
        "cpu_ms": round(1000 * busy / len(settled), 1),
        "slowest_ms": round(1000 * max(settled), 1),
        "scale": round(pace.scale, 2),
        "every": every,
        "first_ms": round(1000 * firsts[1], 1),
        "half_ms": round(1000 * half, 1),
        "full_ms": round(1000 * full, 1),
        "reaction_ms": round(1000 * max(reactions), 1),
    }


def _reaction(painter: Painter, state: ViewState, pace: Pace, after: float) -> float:
    """Seconds from a movement, so long after a full image was begun, to the coarse
    image.
    """
    moved = time.perf_counter() + after
    with (
        contextlib.suppress(PictureInterruptedError),
        interrupted_by(lambda: time.perf_counter() > moved),
    ):
        _timed(painter, state, Step.FULL, pace)
    _timed(painter, state, Step.COARSE, pace)
    return time.perf_counter() - moved


def _timed(
    painter: Painter, state: ViewState, step: Step, pace: Pace
) -> tuple[float, int]:
    """Seconds for an image, and of how many Gaussians it shows one."""
    started = time.perf_counter()
    painting = painter.paint(state, step, pace)
    Image.fromarray(painting.pixels).save(
        io.BytesIO(), format="JPEG", quality=JPEG_QUALITY[step]
    )
    return time.perf_counter() - started, painting.every


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0] if __doc__ else None
    )
    parser.add_argument("--gaussians", type=int, default=100_000)
    parser.add_argument("--canvas", type=int, nargs=2, default=(1000, 700))
    parser.add_argument("--images", type=int, default=120)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    scene = shell(options.gaussians)
    canvas = (options.canvas[0], options.canvas[1])
    lines = [measure(scene, splats, canvas, options.images) for splats in (1, 2)]
    if options.json:
        sys.stdout.write(json.dumps(lines, indent=2) + "\n")
        return
    for line in lines:
        sys.stdout.write(
            f"{line['splats']} x {options.gaussians:,} Gaussians at {canvas[0]} x"
            f" {canvas[1]}: {line['pictures_a_second']} images a second at"
            f" {line['scale']:.0%} of the width, one of {line['every']} Gaussians,"
            f" processor {line['cpu_ms']} ms, slowest {line['slowest_ms']} ms, the"
            f" first {line['first_ms']} ms; half the width {line['half_ms']} ms, a full"
            f" image {line['full_ms']} ms; a movement meanwhile is seen after"
            f" {line['reaction_ms']} ms\n"
        )


if __name__ == "__main__":
    main()
