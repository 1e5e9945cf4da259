"""What a user waits for: CPU seconds of whole commands, imports included, beside those of `import torch` alone.

    python benchmarks/waits.py [--rounds 5] [--only render]

Commands run in turn, each in a process of its own with one thread; the best of the rounds is the figure, and the ratio
is that of the medians. Kernels that Dr.Jit compiles are cached by the first round, which is not counted.
"""

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
COMMANDS = {
    "import torch": ["-c", "import torch"],
    "help": ["-m", "attacks", "--help"],
    "info": ["-m", "attacks", "info", str(ROOT / "mi_splat/examples/car_street_street.spz")],
    "render": ["-m", "attacks", "render", "example:stop_sign", "--cameras", "front", "--out", "image.png", "--force"],
    "detect": ["-m", "attacks", "detect", "example:car_street", "--cameras", "rear", "--out", "seen", "--force"],
    "demo": ["-m", "attacks", "demo", "--out", "demo", "--force"],
}


def seconds(command: list[str], folder: str) -> float:
    """CPU seconds of a process and its children."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, *command], cwd=folder, env=ENVIRONMENT, check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    """Time the commands and print a line for each."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--only", choices=COMMANDS, help="this command, and torch beside it")
    given = parser.parse_args()
    names = [name for name in COMMANDS if given.only in (None, name) or name == "import torch"]
    taken: dict[str, list[float]] = {name: [] for name in names}
    with tempfile.TemporaryDirectory() as folder:
        for number in range(given.rounds + 1):
            for name in names:
                time = seconds(COMMANDS[name], folder)
                if number:
                    taken[name].append(time)
    torch = statistics.median(taken["import torch"])
    for name, times in taken.items():
        ratio = statistics.median(times) / torch
        sys.stdout.write(f"{name:14}{min(times):6.2f} s{ratio:7.2f} times import torch\n")


if __name__ == "__main__":
    main()
