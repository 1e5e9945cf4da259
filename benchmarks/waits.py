"""What a user waits for: CPU seconds of whole commands, imports included, beside those
of `import torch` alone.

    python benchmarks/waits.py [--rounds 5] [--only render] [--against REVISION]
    # its kernels are compiled anew
    python benchmarks/waits.py --rounds 1 --only cloak

Commands run in turn, each in a process of its own with one thread of torch; the best of
the rounds is the figure, and the ratio is that of the medians. Kernels that Dr.Jit
compiles are cached by the first round, which is not counted. With `--against` the
commands of an older revision are timed in turn with these.
"""

import argparse
import contextlib
import os
import resource
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from cpu_time import ROOT, checked_out

SHORT = {
    "import torch": ["-c", "import torch"],
    "help": ["-m", "attacks", "--help"],
    "info": ["-m", "attacks", "info", "mi_splat/examples/car_street_street.spz"],
    "render": [
        "-m",
        "attacks",
        "render",
        "example:stop_sign",
        "--cameras",
        "front",
        "--out",
        "{out}/a.png",
    ],
    "detect": [
        "-m",
        "attacks",
        "detect",
        "example:car_street",
        "--cameras",
        "rear",
        "--out",
        "{out}/seen",
    ],
    "demo": ["-m", "attacks", "demo", "--out", "{out}/demo"],
    "plan": [
        "-m",
        "attacks",
        "study",
        "plan",
        "scenes/studies/dagger.toml",
        "--store",
        "{out}/store",
    ],
}
LONG = {
    "cloak": [
        "-m",
        "attacks",
        "cloak",
        "scenes/cloak_demo.toml",
        "--out",
        "{out}/cloak",
    ]
}


def seconds(command: list[str], root: Path) -> float:
    """CPU seconds of a process and its children, in a copy of the repository."""
    environment = {**os.environ, "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as out:
        parts = [sys.executable, *(part.replace("{out}", out) for part in command)]
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(
            parts, cwd=root, env=environment, check=True, capture_output=True
        )
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    """Time the commands and print a line for each."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument(
        "--only", choices=SHORT | LONG, help="this command, and torch beside it"
    )
    parser.add_argument(
        "--against",
        help="a revision of git, or a folder with another copy of the repository",
    )
    given = parser.parse_args()
    if given.only is None:
        commands = SHORT
    else:
        commands = {name: (SHORT | LONG)[name] for name in ("import torch", given.only)}
    with contextlib.ExitStack() as stack:
        roots = {
            "now": ROOT,
            **(
                {"before": stack.enter_context(checked_out(given.against))}
                if given.against
                else {}
            ),
        }
        taken: dict[tuple[str, str], list[float]] = {
            (name, which): [] for name in commands for which in roots
        }
        for number in range(given.rounds + (given.only not in LONG)):
            for name, which in taken:
                time = seconds(commands[name], roots[which])
                if number or given.only in LONG:
                    taken[name, which].append(time)
    for (name, which), times in taken.items():
        ratio = statistics.median(times) / statistics.median(
            taken["import torch", which]
        )
        sys.stdout.write(
            f"{name:14}{which:8}{min(times):6.2f} s{ratio:7.2f} times import torch\n"
        )


if __name__ == "__main__":
    main()
