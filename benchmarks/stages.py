"""Where does the time of an image of `splat_tile` go, stage by stage?

And how long does the first image take?

    python benchmarks/stages.py [--rounds 9] [--large] [--splat FILE] [--json]

Each stage ends with a wait for its kernels, and so does the work between two stages, so
that the sum is a little more than the time of an image that is not held up. Everything
runs three times before it is timed; medians over the rounds. `--large` adds one million
Gaussians and an image of 2560 x 1440. The first image is timed in two processes of
their own: with an empty cache of Dr.Jit's kernels (cold), and with the one that the
first process has filled (warm); imports are not in it.
"""

import argparse
import contextlib
import functools
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import torch

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from render import shell

from mi_splat.cameras.camera import Camera, orbit_pose
from mi_splat.cameras.lens import Lens
from mi_splat.io import load_splat
from mi_splat.render import variant
from mi_splat.render.renderer import Renderer
from mi_splat.scene import GaussianScene

SETTINGS = ((10_000, (256, 256)), (100_000, (256, 256)), (100_000, (640, 640)))
LARGE = ((1_000_000, (640, 640)), (100_000, (2560, 1440)))
FIRST = """
import sys, time, torch
sys.path[:0] = [{root!r}, {here!r}]
from stages import camera_of, shell
from mi_splat.render import variant
from mi_splat.render.renderer import Renderer
variant.use()
scene, camera = shell(10_000), camera_of((256, 256))
begun = time.perf_counter()
leaf = scene.sh.clone().requires_grad_(True)
image = Renderer()(scene.replace(sh=leaf), camera)
forward = time.perf_counter() - begun
image.sum().backward()
print(forward, time.perf_counter() - begun)
"""


class Clock:
    """Times what happens between two looks, each of which waits for all kernels."""

    def __init__(self) -> None:
        self.spent: dict[str, float] = {}
        self._last = 0.0

    def start(self) -> None:
        """Forget what was spent, and begin."""
        import drjit as dr

        dr.sync_thread()
        self.spent, self._last = {}, time.perf_counter()

    def look(self, name: str) -> None:
        """All time since the last look was spent on `name`."""
        import drjit as dr

        dr.sync_thread()
        now = time.perf_counter()
        self.spent[name] = self.spent.get(name, 0.0) + now - self._last
        self._last = now


@contextlib.contextmanager
def watched(clock: Clock) -> Iterator[None]:
    """Let a clock look before and after each stage of the rasteriser."""
    import drjit as dr

    from mi_splat.render.tile import binning, frozen, pipeline

    def timed(name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def run(*arguments: Any) -> Any:
            clock.look("between stages")
            value = call(*arguments)
            dr.eval(value)
            clock.look(name)
            return value

        return run

    def run(stage: Callable[..., Any], *arguments: Any) -> Any:
        return timed(
            stage.__name__.replace("_", " "), functools.partial(frozen.run, stage)
        )(*arguments)

    sorts = [
        (dr, "argsort", "sort by depth"),
        (binning, "order_below", "sort by tile"),
        (binning, "by_length", "sort tiles"),
    ]
    with contextlib.ExitStack() as patches:
        patches.enter_context(mock.patch.object(pipeline, "run", run))
        for module, function, name in sorts:
            patches.enter_context(
                mock.patch.object(
                    module, function, timed(name, getattr(module, function))
                )
            )
        yield


def camera_of(size: tuple[int, int]) -> Camera:
    """The benchmark's camera with an image of this width and height."""
    pose = orbit_pose((0.0, 0.0, 0.0), azimuth=30.0, elevation=20.0, distance=3.0)
    return Camera(to_world=pose, lens=Lens(focal=float(size[1]), size=size))


def measure(scene: GaussianScene, camera: Camera, rounds: int) -> dict[str, Any]:
    """Median times in ms: of an image with its gradient as it is, and of its
    stages.
    """
    render = Renderer()
    leaves = [tensor.clone().requires_grad_(True) for tensor in scene.tensors()]
    learnt = GaussianScene(*leaves)
    clock = Clock()
    weights = torch.randn(
        camera.height, camera.width, 3, generator=torch.Generator().manual_seed(1)
    )

    def picture() -> None:
        for leaf in leaves:
            leaf.grad = None
        clock.start()
        image = render(learnt, camera)
        clock.look("between stages")
        forward.append(time.perf_counter() - begun)
        (image * weights).sum().backward()  # type: ignore[no-untyped-call]
        clock.look("between stages")
        both.append(time.perf_counter() - begun)

    forward: list[float] = []
    both: list[float] = []
    for _ in range(3):
        begun = time.perf_counter()
        picture()
    forward.clear()
    both.clear()
    stages: dict[str, list[float]] = {}
    for _ in range(rounds):
        begun = time.perf_counter()
        picture()
        with watched(clock):
            picture()
        forward.pop()
        both.pop()
        for name, spent in clock.spent.items():
            stages.setdefault(name, []).append(spent)
    return {
        "gaussians": len(scene),
        "size": [camera.width, camera.height],
        "forward_ms": _median_ms(forward),
        "both_ms": _median_ms(both),
        "stages_ms": {name: _median_ms(values) for name, values in stages.items()},
        "peak_memory_gib": round(
            resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2
        ),
    }


def _median_ms(values: list[float]) -> float:
    return round(1e3 * statistics.median(values), 2)


def first_pictures() -> dict[str, dict[str, float]]:
    """Seconds from the first call to the first image, and to its gradient: cold and
    warm.
    """
    here = Path(__file__).resolve().parent
    program = FIRST.format(root=str(here.parent), here=str(here))
    pictures = {}
    with tempfile.TemporaryDirectory() as home:
        for name in ("cold", "warm"):
            done = subprocess.run(
                [sys.executable, "-c", program],
                env={**os.environ, "HOME": home},
                capture_output=True,
                text=True,
            )
            done.check_returncode()
            forward, both = map(float, done.stdout.split())
            pictures[name] = {"forward_s": round(forward, 2), "both_s": round(both, 2)}
    return pictures


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Time the stages of splat_tile.")
    parser.add_argument("--rounds", type=int, default=9, help="runs of everything")
    parser.add_argument(
        "--large",
        action="store_true",
        help="one million Gaussians, and a large image, too",
    )
    parser.add_argument(
        "--splat",
        type=Path,
        help="a trained splat, seen from the benchmark's camera, too",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # torch's threads and Dr.Jit's would fight over the cores
    variant.use()
    settings = [*SETTINGS, *(LARGE if arguments.large else ())]
    rows = [
        measure(shell(count), camera_of(size), arguments.rounds)
        for count, size in settings
    ]
    if arguments.splat:
        rows.append(
            measure(
                load_splat(arguments.splat), camera_of((640, 640)), arguments.rounds
            )
        )
    document = {"settings": rows, "first_picture": first_pictures()}
    if arguments.json:
        print(json.dumps(document, indent=2))  # noqa: T201
        return
    for row in rows:
        width, height = row["size"]
        print(  # noqa: T201
            f"{row['gaussians']:,} at {width} x {height}: forward {row['forward_ms']}"
            f" ms, with the gradient {row['both_ms']} ms, memory of the process so far"
            f" {row['peak_memory_gib']} GiB"
        )
        for name, spent in row["stages_ms"].items():
            print(f"  {name:<22} {spent:8.2f} ms")  # noqa: T201
    for name, spent in document["first_picture"].items():  # type: ignore[attr-defined]
        print(  # noqa: T201
            f"first image, {name}: {spent['forward_s']} s, with its gradient"
            f" {spent['both_s']} s"
        )


if __name__ == "__main__":
    main()
