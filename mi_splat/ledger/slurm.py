"""Jobs as arrays of SLURM, one for each level of the graph, and what an element of an array runs.

`python -m mi_splat.ledger.slurm STORE JOBS FIRST LAST` does some of the jobs of a file.
"""

import json
import shlex
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from mi_splat.errors import InvalidValueError
from mi_splat.import_closure import closure
from mi_splat.io.documents import save_text
from mi_splat.io.parsing import DocumentReader
from mi_splat.ledger.engines import Processes
from mi_splat.ledger.job import Job, Part, by_depth, decoded
from mi_splat.ledger.plans import Driver, grid
from mi_splat.processes import INTERRUPTED, TERMINATED, python_command, sigterm_as_interrupt

JOBS, SUBMIT = "jobs.json", "submit.sh"
MOST_ELEMENTS = 1000  # most elements of an array; SLURM itself has 1,001 unless its administrator says otherwise
_READER = DocumentReader(expected="exported jobs", do="export the study again", most=1 << 30)


def export(jobs: Iterable[Job], folder: Path, store: Path, *, options: Sequence[str] = ()) -> list[int]:
    """Write the jobs, a script for each level of their graph, and `submit.sh`, which hands them to SLURM in order."""
    levels = by_depth(jobs)
    ordered = [job for level in levels for job in level]
    numbers = {job.identity: number for number, job in enumerate(ordered)}
    folder.mkdir(parents=True, exist_ok=True)

    def as_json(source: Part | Path) -> Any:
        return [numbers[source.job.identity], source.pattern] if isinstance(source, Part) else str(source.absolute())

    lines = [[job.kind, job.config_json, {n: as_json(s) for n, s in job.sources.items()}] for job in ordered]
    save_text(json.dumps(lines), folder / JOBS)
    first, submit = 0, ["#!/bin/sh", "set -e", 'cd "$(dirname "$0")"', "after="]
    for number, level in enumerate(levels):
        each = -(-len(level) // MOST_ELEMENTS)
        elements = -(-len(level) // each)
        command = python_command("mi_splat.ledger.slurm", str(store.absolute()), str(folder.absolute() / JOBS))
        script = [
            "#!/bin/sh",
            *(f"#SBATCH {option}" for option in (f"--array=0-{elements - 1}", *options)),
            f"first=$(({first} + SLURM_ARRAY_TASK_ID * {each}))",
            f"last=$((first + {each} < {first + len(level)} ? first + {each} : {first + len(level)}))",
            f'exec {shlex.join(command)} "$first" "$last"',
        ]
        save_text("\n".join(script) + "\n", folder / f"level-{number}.sbatch")
        submit.append(f"after=$(sbatch --parsable ${{after:+--dependency=afterany:$after}} level-{number}.sbatch)")
        first += len(level)
    save_text("\n".join(submit) + "\n", folder / SUBMIT)
    return [len(level) for level in levels]


def read_jobs(path: Path) -> list[Job]:
    """The jobs of an exported file, each after those that it reads."""
    jobs: list[Job] = []
    for kind, config, inputs in _READER.read_json_value(path):
        sources: dict[str, Job | Part | Path] = {}
        for name, source in inputs.items():
            if isinstance(source, str):
                sources[name] = Path(source)
            elif source[0] < len(jobs):
                sources[name] = jobs[source[0]].part(source[1])
            else:
                raise InvalidValueError.of(str(path), "jobs in their order", source, "export the study again")
        jobs.append(Job(kind=kind, config=decoded(config, closure(kind)), inputs=sources))
    return jobs


def run(store: Path, jobs: Path, first: int, last: int) -> int:
    """Do a part of the jobs of an exported file."""
    chosen = {str(number): job for number, job in enumerate(read_jobs(jobs)) if first <= number < last}
    results = Driver(store, Processes(store, workers=1)).run([grid(chosen)])
    failed = {number: result for number, result in results.items() if isinstance(result, str)}
    for number, text in failed.items():
        sys.stderr.write(f"job {number}: {text}\n")
    return len(failed)


if __name__ == "__main__":
    with sigterm_as_interrupt() as terminated:
        try:
            sys.exit(min(1, run(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))))
        except KeyboardInterrupt:
            sys.exit(TERMINATED if terminated() else INTERRUPTED)
