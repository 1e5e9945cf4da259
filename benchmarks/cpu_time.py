"""What work costs in CPU time of one thread, as ratios within one run: new code beside
old code, ours beside a peer's.

    python benchmarks/cpu_time.py FILE [--against REVISION] [--rounds 9]
        [--only NAME] [--json]

FILE is a program in Python with a function `runs()`, which makes what is needed and
returns a dictionary of functions without arguments; each is timed under its name. With
`--against main~3` (or a folder with another copy of this repository) the same FILE runs
in a second process with the packages of that revision, in turn with those of the
working tree, and each line ends with old / new. Each process keeps to one thread of
torch and of Dr.Jit.

Wall time lies on a machine that others use; CPU time does so less, but caches and clock
rates are shared as well. So everything is interleaved, the best of the rounds is the
figure, and a ratio is the median of the ratios in a round. The benchmarks of this
folder use the functions below: `--cpu` has them report CPU time of one thread.
"""

import argparse
import contextlib
import importlib
import json
import os
import runpy
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import ModuleType

Run = Callable[[], object]
Clock = Callable[[], float]
ROOT = Path(__file__).resolve().parent.parent
WARM_UP = 3


def add_cpu_flag(parser: argparse.ArgumentParser) -> None:
    """`--cpu`, for `clock`."""
    parser.add_argument(
        "--cpu",
        action="store_true",
        help="CPU time of one thread in place of wall time",
    )


def clock(cpu: bool) -> Clock:
    """The clock that a benchmark reads, in seconds; with `cpu` all work is held to one
    thread first.
    """
    if cpu:
        one_thread()
    if cpu:
        return time.process_time
    return time.perf_counter


def one_thread() -> None:
    """Hold torch and Dr.Jit to the calling thread, so that CPU time is that of the
    work.
    """
    import drjit as dr
    import torch

    torch.set_num_threads(1)
    dr.set_thread_count(1)


def interleaved(
    runs: Mapping[str, Run],
    *,
    rounds: int,
    warm_up: int = WARM_UP,
    now: Clock = time.process_time,
) -> dict[str, list[float]]:
    """Seconds of each run in each round; in a round all run in turn, after `warm_up`
    rounds that are not timed.
    """
    times: dict[str, list[float]] = {name: [] for name in runs}
    for number in range(warm_up + rounds):
        for name, run in runs.items():
            begun = now()
            run()
            if number >= warm_up:
                times[name].append(now() - begun)
    return times


def ratio(slower: list[float], faster: list[float]) -> float:
    """Median over the rounds of the ratio within a round: how many times as long the
    first takes.
    """
    return statistics.median(a / b for a, b in zip(slower, faster, strict=True))


def best_ms(times: list[float]) -> float:
    """The best round, in ms."""
    return 1e3 * min(times)


class _Tree:
    """A process that times the runs of a file with the packages of one copy of the
    repository.
    """

    def __init__(self, root: Path, file: Path, only: str) -> None:
        env = {**os.environ, "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}
        command = [
            sys.executable,
            str(Path(__file__).resolve()),
            str(file),
            "--answer",
            "--only",
            only,
        ]
        self._child = subprocess.Popen(
            command,
            env=env,
            cwd=root,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.names: list[str] = json.loads(self._line())

    def seconds(self, name: str) -> float:
        """CPU seconds of one run."""
        assert self._child.stdin is not None
        self._child.stdin.write(name + "\n")
        self._child.stdin.flush()
        return float(self._line())

    def close(self) -> None:
        """End the process."""
        assert self._child.stdin is not None
        self._child.stdin.close()
        self._child.wait()

    def _line(self) -> str:
        assert self._child.stdout is not None
        line = self._child.stdout.readline()
        if not line:
            raise SystemExit("the program that is timed ended; its error stands above")
        return line


def _packages() -> list[ModuleType]:
    return [importlib.import_module(name) for name in ("mi_splat", "attacks")]


def _answer(runs: Mapping[str, Run]) -> None:
    """Time what standard input names; print a line of JSON for each, and nothing
    else.
    """
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what the runs print goes to standard error
    answers.write(json.dumps(list(runs)) + "\n")
    answers.flush()
    for line in sys.stdin:
        begun = time.process_time()
        runs[line.strip()]()
        answers.write(json.dumps(time.process_time() - begun) + "\n")
        answers.flush()


@contextlib.contextmanager
def checked_out(revision: str) -> Iterator[Path]:
    """A folder with the repository at a revision; a folder is taken as it is."""
    if Path(revision).is_dir():
        yield Path(revision).resolve()
        return
    with tempfile.TemporaryDirectory() as folder:
        archive = subprocess.run(
            ["git", "archive", revision], cwd=ROOT, stdout=subprocess.PIPE, check=True
        ).stdout
        subprocess.run(["tar", "-x", "-C", folder], input=archive, check=True)
        yield Path(folder)


def compare(
    file: Path, against: str | None, rounds: int, only: str = ""
) -> dict[str, dict[str, float]]:
    """Best CPU time in ms of each run of `file`, and with `against` that of the old
    code and the ratio old / new.
    """
    with contextlib.ExitStack() as stack:
        roots = {
            "new": ROOT,
            **({"old": stack.enter_context(checked_out(against))} if against else {}),
        }
        trees = {}
        for which, root in roots.items():
            trees[which] = _Tree(root, file, only)
            stack.callback(trees[which].close)
        seconds = {}
        for name in trees["new"].names:
            runs = {which: name for which, tree in trees.items() if name in tree.names}
            times: dict[str, list[float]] = {which: [] for which in runs}
            for number in range(WARM_UP + rounds):
                for which in runs:
                    spent = trees[which].seconds(name)
                    if number >= WARM_UP:
                        times[which].append(spent)
            seconds[name] = {
                f"{which}_ms": round(best_ms(values), 3)
                for which, values in times.items()
            }
            if "old" in times:
                seconds[name]["old_to_new"] = round(
                    ratio(times["old"], times["new"]), 3
                )
        return seconds


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", type=Path, help="a program with a function runs()")
    parser.add_argument(
        "--against",
        help="a revision of git, or a folder with another copy of the repository",
    )
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--only", default="", help="only runs with this in their name")
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    parser.add_argument("--answer", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.answer:
        sys.path[0] = str(options.file.resolve().parent)
        # Before the file, which may put the working tree first; the packages are those
        # of PYTHONPATH.
        assert {Path(package.__file__ or "").parents[1] for package in _packages()} == {
            Path.cwd()
        }
        one_thread()
        runs = runpy.run_path(str(options.file))["runs"]()
        _answer({name: run for name, run in runs.items() if options.only in name})
        return
    seconds = compare(
        options.file.resolve(), options.against, options.rounds, options.only
    )
    if options.json:
        sys.stdout.write(json.dumps(seconds, indent=2) + "\n")
        return
    for name, figures in seconds.items():
        cells = "   ".join(
            f"{key.replace('_', ' ')} {value:,.3f}" for key, value in figures.items()
        )
        sys.stdout.write(f"{name:<40} {cells}\n")


if __name__ == "__main__":
    main()
