"""How does work grow with the number of points?

CPU seconds, peak memory and exponent of every operation on points.

    python benchmarks/growth.py [--counts 1000 10000 100000 1000000]
        [--only NAME ...] [--limit 60] [--json]

Each operation of `OPERATIONS` runs on each number of points in a process of its own
with one thread. The points lie on a ground and on balls above it, and a tenth of them
at one place, where a search by a tree may become quadratic. The exponent is that of the
last two counts: 1 is linear, 2 is all points with all. An operation that takes longer
than `--limit` seconds, or 1.6 as an exponent, is not run on more points. Exponents
above 1.6 end with status 1.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

COUNTS = (1_000, 10_000, 100_000, 1_000_000)
STEEP = 1.6
"""Exponent from which growth counts as that of all points with all; sorting and trees
stay below 1.4.
"""
TIMEOUT = 900
_OWN = "--one"


def points_of(count: int) -> Any:
    """(N, 3) float32: half on a ground, a tenth in one place, the rest on balls."""
    import torch
    from torch.nn import functional

    generator = torch.Generator().manual_seed(0)
    ground = count // 2
    same = count // 10
    flat = torch.rand(ground, 3, generator=generator) * torch.tensor([8.0, 8.0, 0.02])
    rest = count - ground - same
    balls = functional.normalize(torch.randn(rest, 3, generator=generator), dim=1)
    centres = torch.tensor([[2.0, 2.0, 1.0], [6.0, 3.0, 1.0], [4.0, 6.0, 1.0]])
    balls = balls * 0.8 + centres[torch.arange(rest) % 3]
    return torch.cat([flat, balls, torch.ones(same, 3)])


def scene_of(count: int) -> Any:
    """Gaussians on these points, of SH degree 1."""
    import torch

    from mi_splat.maths.rotation import normalise
    from mi_splat.scene import GaussianScene

    generator = torch.Generator().manual_seed(1)
    size = 8 / math.sqrt(count)
    return GaussianScene(
        means=points_of(count),
        scales=size * (0.1 + torch.rand(count, 3, generator=generator)),
        rotations=normalise(torch.randn(count, 4, generator=generator)),
        opacities=torch.rand(count, generator=generator),
        sh=0.3 * torch.randn(count, 4, 3, generator=generator),
    )


def cameras_around(scene: Any, count: int = 2) -> Any:
    """Cameras that see all of a scene, 128 x 128 pixels."""
    from mi_splat.cameras.framing import bounds
    from mi_splat.cameras.sets import framing, orbit

    centre, radius = bounds(scene)
    distance, lens = framing(radius, fov=45.0, size=(128, 128))
    return orbit(
        centre,
        count=count,
        elevation=20.0,
        distance=distance,
        lens=lens,
    )


# Operations: of a number of points, the function that is timed.


def _bounds(count: int) -> Callable[[], object]:
    from mi_splat.cameras.framing import bounds

    scene = scene_of(count)
    return lambda: bounds(scene)


def _clusters(count: int) -> Callable[[], object]:
    from mi_splat.selection.clusters import clusters

    scene = scene_of(count)
    return lambda: clusters(scene)


def _neighbours(count: int) -> Callable[[], object]:
    from mi_splat.maths.neighbours import nearest_neighbours

    points = points_of(count)
    return lambda: nearest_neighbours(points, 8)


def _nearest_of(count: int) -> Callable[[], object]:
    from mi_splat.maths.neighbours import nearest_of

    points = points_of(count)
    return lambda: nearest_of(points, 4)


def _from_points(count: int) -> Callable[[], object]:
    import torch

    from mi_splat.training.initialization import from_points

    points = points_of(count)
    return lambda: from_points(points, torch.full_like(points, 0.5))


def _transform(count: int) -> Callable[[], object]:
    import torch

    from mi_splat.scene import Similarity

    scene = scene_of(count)
    turn = Similarity(rotation=torch.eye(3), translation=torch.ones(3), scale=2.0)
    return lambda: scene.transform(turn)


def _relocate(count: int) -> Callable[[], object]:
    import torch

    from mi_splat.io.parameters import to_raw_parameters
    from mi_splat.training.strategies import MCMCConfig
    from mi_splat.training.strategies.mcmc import relocate

    values = to_raw_parameters(scene_of(count))
    generator = torch.Generator().manual_seed(0)
    return lambda: relocate(values, config=MCMCConfig(), generator=generator)


def _render(count: int) -> Callable[[], object]:
    from mi_splat.render.renderer import Renderer

    scene = scene_of(count)
    render = Renderer()
    (camera,) = cameras_around(scene, 1)
    render(scene, camera)
    return lambda: render(scene, camera)


def _overdraw(count: int) -> Callable[[], object]:
    from mi_splat.render.overdraw import most_layers

    scene = scene_of(count)
    cameras = cameras_around(scene)
    return lambda: most_layers(scene, cameras, near=0.01)


def _save(count: int) -> Callable[[], object]:
    return lambda: _file(count)


def _load(count: int) -> Callable[[], object]:
    from mi_splat.io import load_splat

    path = _file(count)
    return lambda: load_splat(path)


def _lint(count: int) -> Callable[[], object]:
    from mi_splat.audit.linting import lint_file

    path = _file(count)
    return lambda: lint_file(path)


def _audit(count: int) -> Callable[[], object]:
    from attacks.audits.recognition import Recognition
    from mi_splat.audit import audit

    scene = scene_of(count)
    recogniser = Recognition()
    return lambda: audit(scene, recogniser)


def _up(count: int) -> Callable[[], object]:
    from mi_splat.io.up_axis import ground_up

    scene = scene_of(count)
    means = scene.means.numpy()
    opacities = scene.opacities.numpy()
    return lambda: ground_up(means, opacities)


def _file(count: int) -> Path:
    from mi_splat.io import save_splat

    save_splat(scene_of(count), _path())
    return _path()


def _path() -> Path:
    return Path(tempfile.gettempdir()) / f"growth_{os.getpid()}.ply"


OPERATIONS: dict[str, Callable[[int], Callable[[], object]]] = {
    "bounds": _bounds,
    "neighbours.nearest_neighbours": _neighbours,
    "neighbours.nearest_of": _nearest_of,
    "selection.clusters": _clusters,
    "io.up_axis.ground_up": _up,
    "training.from_points": _from_points,
    "training.relocate (mcmc)": _relocate,
    "scene.transform": _transform,
    "io.save_splat": _save,
    "io.load_splat": _load,
    "lint_file": _lint,
    "rendering.Renderer": _render,
    "overdraw.most_layers": _overdraw,
    "audit": _audit,
}
"""What a user can do with points or Gaussians; add yours."""


def main() -> int:
    """Run and print; 1 where something grows as all points with all."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--counts", nargs="+", type=int, default=COUNTS)
    parser.add_argument("--only", nargs="+", choices=tuple(OPERATIONS), metavar="NAME")
    parser.add_argument(
        "--limit",
        type=float,
        default=60.0,
        help="CPU seconds beyond which no more points are tried",
    )
    parser.add_argument("--json", action="store_true")
    parser.add_argument(
        _OWN, nargs=2, metavar=("NAME", "COUNT"), help=argparse.SUPPRESS
    )
    options = parser.parse_args()
    if options.one:
        return _measure(options.one[0], int(options.one[1]))
    rows = list(
        _grown(
            options.only or OPERATIONS,
            sorted(options.counts),
            options.limit,
            options.json,
        )
    )
    if options.json:
        sys.stdout.write(json.dumps(rows, indent=2) + "\n")
    return int(
        any(row["exponent"] is not None and row["exponent"] > STEEP for row in rows)
    )


def _grown(
    names: Any, counts: list[int], limit: float, quiet: bool
) -> Iterator[dict[str, Any]]:
    for name in names:
        row: dict[str, Any] = {"name": name, "exponent": None, "runs": []}
        for count in counts:
            run = _in_process(name, count)
            row["runs"].append(run)
            if "seconds" not in run:
                break
            row["exponent"] = _exponent(row["runs"])
            steep = row["exponent"] is not None and row["exponent"] > STEEP
            if run["seconds"] > limit or (steep and run["seconds"] > 1):
                break
        if not quiet:
            sys.stdout.write(_line(row) + "\n")
            sys.stdout.flush()
        yield row


def _exponent(runs: list[dict[str, Any]]) -> float | None:
    """How the time grows over the last two counts; None where it is too short to
    tell.
    """
    if len(runs) < 2:
        return None
    before, after = runs[-2:]
    if after["seconds"] < 0.02:
        return None
    # What any call costs, and noise, count for little: a hundredth of a second is added
    # to both.
    grown = (after["seconds"] + 0.01) / (before["seconds"] + 0.01)
    return round(math.log(grown) / math.log(after["count"] / before["count"]), 2)


def _line(row: dict[str, Any]) -> str:
    runs = [
        (
            f"{run['count']:,}: {run['seconds']:.3g} s, {run['megabytes']:,} MB"
            if "seconds" in run
            else f"{run['count']:,}: {run['failed']}"
        )
        for run in row["runs"]
    ]
    exponent = "-" if row["exponent"] is None else f"{row['exponent']:.2f}"
    return f"{row['name']:32}{exponent:>6}   " + "; ".join(runs)


def _in_process(name: str, count: int) -> dict[str, Any]:
    command = [sys.executable, __file__, _OWN, name, str(count)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    try:
        done = subprocess.run(
            command,
            env=environment,
            capture_output=True,
            text=True,
            timeout=TIMEOUT,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return {"count": count, "failed": f"more than {TIMEOUT} s"}
    if done.returncode:
        return {
            "count": count,
            "failed": (done.stderr.strip().splitlines() or ["ended"])[-1][:100],
        }
    return dict(json.loads(done.stdout.splitlines()[-1]))


def _measure(name: str, count: int) -> int:
    """Time one operation, and print what it took beyond its input."""
    import contextlib
    import resource
    import time

    from cpu_time import one_thread

    one_thread()
    run = OPERATIONS[name](count)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    begun = time.process_time()
    with contextlib.redirect_stdout(None):
        run()
    seconds = time.process_time() - begun
    taken = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) >> 10
    _path().unlink(missing_ok=True)
    sys.stdout.write(
        json.dumps({"count": count, "seconds": round(seconds, 4), "megabytes": taken})
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
