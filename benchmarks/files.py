"""How fast are splat files?

Loading and saving, side by side with NumPy on the same bytes, as ratios.

    python benchmarks/files.py [--count 1000000] [--degree 3] [--rounds 9]
        [--folder DIR] [--json]

The runs of one round follow each other, since a shared machine changes its speed within
minutes, and the median over the rounds of the ratio within a round is reported. NumPy
reads with `fromfile` from a warm cache. `save_splat` brings its file to the disk before
it gives it its name (a crash leaves the old file or the new one), so it is held against
`tofile` followed by fsync, which promises as much, and against plain `tofile`, which
only fills the system's cache.
"""

import argparse
import json
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from mi_splat.io import load_splat, save_splat
from mi_splat.maths.rotation import normalise
from mi_splat.scene import GaussianScene

PAIRS = {
    "load_splat": ("numpy read",),
    "save_splat": ("numpy write + fsync", "numpy write"),
}


def cloud(count: int, degree: int) -> GaussianScene:
    """`count` Gaussians of ordinary values."""
    torch.manual_seed(0)
    return GaussianScene(
        means=torch.randn(count, 3),
        scales=(torch.randn(count, 3) - 4).exp(),
        rotations=normalise(torch.randn(count, 4)),
        opacities=torch.randn(count).sigmoid(),
        sh=torch.randn(count, (degree + 1) ** 2, 3),
    )


def contestants(scene: GaussianScene, folder: Path) -> dict[str, Callable[[], object]]:
    """What is timed, by name; each writes to its own file, which is there before."""
    splat = folder / "splat.ply"
    save_splat(scene, splat)
    data = np.fromfile(splat, np.uint8)

    def write_through() -> None:
        with open(folder / "through.bin", "wb") as file:
            data.tofile(file)
            file.flush()
            os.fsync(file.fileno())

    return {
        "load_splat": lambda: load_splat(splat),
        "numpy read": lambda: np.fromfile(splat, np.uint8),
        "save_splat": lambda: save_splat(scene, folder / "saved.ply"),
        "numpy write": lambda: data.tofile(folder / "plain.bin"),
        "numpy write + fsync": write_through,
    }


def measure(
    runs: dict[str, Callable[[], object]], rounds: int
) -> dict[str, list[float]]:
    """Seconds of each run in each round, after one round that is not counted."""
    times: dict[str, list[float]] = {name: [] for name in runs}
    for index in range(rounds + 1):
        for name, run in runs.items():
            begin = time.perf_counter()
            run()
            if index:
                times[name].append(time.perf_counter() - begin)
    return times


def report(
    times: dict[str, list[float]], scene: GaussianScene, megabytes: float
) -> dict[str, object]:
    """Medians, and medians of ratios."""
    return {
        "count": len(scene),
        "degree": scene.degree,
        "megabytes": round(megabytes, 1),
        "rounds": len(times["load_splat"]),
        "cpus": os.cpu_count(),
        "milliseconds": {
            name: round(1000 * statistics.median(values), 1)
            for name, values in times.items()
        },
        "ratios": {
            f"{ours} / {name}": round(
                statistics.median(
                    a / b for a, b in zip(times[ours], times[name], strict=True)
                ),
                2,
            )
            for ours, names in PAIRS.items()
            for name in names
        },
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0] if __doc__ else None
    )
    parser.add_argument(
        "--count", type=int, default=1_000_000, help="number of Gaussians"
    )
    parser.add_argument(
        "--degree", type=int, default=3, choices=range(4), help="SH degree"
    )
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument(
        "--folder",
        type=Path,
        help="where to write (four times the splat's size); default: temporary",
    )
    parser.add_argument(
        "--json", action="store_true", help="one JSON object instead of the table"
    )
    options = parser.parse_args()
    scene = cloud(options.count, options.degree)
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        times = measure(contestants(scene, Path(folder)), options.rounds)
        result = report(
            times, scene, (Path(folder) / "splat.ply").stat().st_size / 2**20
        )
    if options.json:
        sys.stdout.write(json.dumps(result, indent=2) + "\n")
        return
    lines = [
        f"{len(scene):,} Gaussians of SH degree {scene.degree}, {result['megabytes']}"
        " MiB, medians of rounds"
    ]
    lines += [
        f"  {name:22s}{1000 * statistics.median(values):8.1f} ms"
        for name, values in times.items()
    ]
    ratios = result["ratios"]
    lines += [
        f"  {name:34s}{value:6.2f}"
        for name, value in (ratios.items() if isinstance(ratios, dict) else ())
    ]
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
