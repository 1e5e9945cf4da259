"""What does an audit cost?

CPU seconds and peak memory of the command, beside a process that renders as many
images.

    python benchmarks/audit.py [--counts 5000 100000] [--rounds 3]
        [--against REVISION] [--json]

The splats are the car of discs of tests/audit/scenes.py on a ground, written as PLY.
Every process has one thread; all run in turn, the best of the rounds is the figure, and
a ratio is that of the medians. Kernels that Dr.Jit compiles are cached by the first
round, which is not counted. Memory includes that of `import torch`, which has a line of
its own. It is what is resident, much of it libraries that processes share; what of it
is anonymous is sampled every 5 ms (Linux). The last lines are of one process that has
judged the same file before, as a worker of the gate; a million Gaussians are only
linted.
"""

import argparse
import contextlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from cpu_time import checked_out

ROOT = Path(__file__).resolve().parent.parent
MADE = """
import sys
from mi_splat.io import save_splat
from tests.audit.scenes import standing
count = round(int(sys.argv[2]) * 2 / 3)
save_splat(standing("car", count=count).scene.with_degree(3), sys.argv[1])
"""
PEER = """
import sys, torch
from pathlib import Path
from mi_splat.render.renderer import Renderer
from mi_splat.cameras.framing import bounds
from mi_splat.cameras.sets import framing, orbit
from mi_splat.render.scene_files import open_scene
scene, render = open_scene(Path(sys.argv[1])).scene, Renderer()
centre, radius = bounds(scene)
distance, lens = framing(radius, fov=45.0, size=(128, 128))
for k in range(150):
    kind = {"start": 12.0 * k, "elevation": 4.0 + k / 2, "distance": distance}
    kind |= {"lens": lens}
    with torch.no_grad():
        render.outputs(scene, orbit(centre, count=1, **kind)[0])
"""

RUNNING = """
import json, resource, sys, time
from pathlib import Path
import drjit
drjit.set_thread_count(1)  # as a worker that has one core
from attacks.audits.recognition import Recognition
from mi_splat.audit import audit
from mi_splat.audit.linting import lint_file
from mi_splat.io import load_splat
recogniser = Recognition()
judges = {"lint": lint_file, "audit": lambda path: audit(load_splat(path), recogniser)}
judge = judges[sys.argv[1]]
taken = []
for _ in range(int(sys.argv[3]) + 1):
    begun = time.process_time()
    judge(Path(sys.argv[2]))
    taken.append(time.process_time() - begun)
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(json.dumps({"CPU seconds": round(min(taken[1:]), 3), "peak MB": round(peak)}))
"""


def running(kind: str, file: str, rounds: int) -> dict[str, float]:
    """CPU seconds of a process that has judged a file before, the best of some rounds,
    and its peak MB.
    """
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-W", "ignore", "-c", RUNNING, kind, file, str(rounds)]
    figures = subprocess.run(
        command, env=environment, cwd=ROOT, stdout=subprocess.PIPE, check=True
    ).stdout
    return dict(json.loads(figures))


def anonymous(process: int) -> float:
    """MB of anonymous memory that a process has now; 0 where the system does not
    tell.
    """
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{process}/status").read_text().splitlines():
            if line.startswith("RssAnon:"):
                return int(line.split()[1]) / 1024
    return 0.0


def spent(command: list[str], root: Path) -> tuple[float, float, float]:
    """CPU seconds, peak MB and anonymous ones of a process with the packages of one
    copy of the repository.
    """
    environment = {**os.environ, "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}
    child = subprocess.Popen(
        [sys.executable, *command], cwd=root, env=environment, stdout=subprocess.DEVNULL
    )
    ended = 0
    most = 0.0
    while not ended:
        time.sleep(0.005)
        most = max(most, anonymous(child.pid))
        ended, status, usage = os.wait4(child.pid, os.WNOHANG)
    if os.waitstatus_to_exitcode(status) not in (0, 3):  # 3: a finding of lint
        raise SystemExit(f"{command} failed")
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024, most


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0] if __doc__ else None
    )
    parser.add_argument(
        "--counts",
        type=int,
        nargs="+",
        default=[5000, 100_000],
        help="numbers of Gaussians, about",
    )
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument(
        "--against",
        help="a revision of git, or a folder with another copy of the repository",
    )
    parser.add_argument(
        "--json", action="store_true", help="one JSON object instead of lines"
    )
    given = parser.parse_args()
    with contextlib.ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        runs = {"import torch": (["-c", "import torch"], ROOT)}
        old = stack.enter_context(checked_out(given.against)) if given.against else None
        for count in given.counts:
            file = f"{folder}/{count}.ply"
            # elsewhere, as a child's peak is at least its parent's
            spent(["-c", MADE, file, str(count)], ROOT)
            runs[f"150 images of {count:,}"] = ["-c", PEER, file], ROOT
            runs[f"audit of {count:,}"] = ["-m", "attacks", "audit", file], ROOT
            if old is not None:
                runs[f"audit of {count:,}, {given.against}"] = (
                    ["-m", "attacks", "audit", file],
                    old,
                )
        taken: dict[str, list[tuple[float, float, float]]] = {name: [] for name in runs}
        for number in range(given.rounds + 1):
            for name, run in runs.items():
                figures = spent(*run)
                taken[name] += [figures] if number else []
        spent(["-c", MADE, f"{folder}/million.ply", "1000000"], ROOT)
        judged = {
            f"{kind} of {count:,}, running": running(
                kind, f"{folder}/{count}.ply", given.rounds
            )
            for count in given.counts
            for kind in ("lint", "audit")
        }
        judged["lint of 1,000,000, running"] = running(
            "lint", f"{folder}/million.ply", given.rounds
        )
    torch = statistics.median(seconds for seconds, *_ in taken["import torch"])
    result = {
        name: {
            "CPU seconds": round(min(seconds for seconds, *_ in rounds), 2),
            "times import torch": round(
                statistics.median(seconds for seconds, *_ in rounds) / torch, 2
            ),
            "peak MB": round(max(peak for _, peak, _ in rounds)),
            "anonymous": round(max(most for *_, most in rounds)),
        }
        for name, rounds in taken.items()
    } | judged
    lines = [
        f"{name:30}" + "   ".join(f"{key} {value}" for key, value in row.items())
        for name, row in result.items()
    ]
    sys.stdout.write((json.dumps(result) if given.json else "\n".join(lines)) + "\n")


if __name__ == "__main__":
    main()
