"""Reads mutants of files in a process of bounded memory: `python -m tests.fuzz.campaign SECONDS KIND ...`.

Prints each failure as a line of JSON: the kind and the number of the mutant, which make the same one again, and what
was raised in the place of a value or a MiSplatError; then for each kind how many mutants were read.
"""

import contextlib
import io
import json
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path
from random import Random
from types import FrameType

from mi_splat.errors import MiSplatError
from tests.fuzz.kinds import EVERY, Kind
from tests.fuzz.mutations import mutant

SEED = 11
MEMORY = 3 << 30
"""Bytes that a reader may take, besides what the process has when it begins."""
LIMIT = 10.0
"""Seconds for one mutant."""
MOST_FAILURES = 20


class TooSlowError(BaseException):
    """A mutant took too long."""


def main(seconds: float, names: list[str]) -> None:
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGALRM, _too_slow)
    for name in names:
        kind, number, failures = EVERY[name], 0, 0
        with tempfile.TemporaryDirectory() as folder:
            path = kind.make(Path(folder))
            whole = path.read_bytes()
            kind.read(path)  # whatever is imported late is imported now
            _bound_memory()
            end = time.monotonic() + seconds
            while time.monotonic() < end and failures < MOST_FAILURES:
                if (raised := fault(kind, path, mutated(name, number, whole))) is not None:
                    failures += 1
                    _say({"kind": name, "mutant": number, "raised": raised})
                number += 1
        _say({"kind": name, "mutants": number})


def mutated(name: str, number: int, whole: bytes) -> bytes:
    """A mutant of a kind of file, always the same for its number."""
    return mutant(whole, Random(f"{SEED} {name} {number}"), EVERY[name].document)


def fault(kind: Kind, path: Path, data: bytes) -> str | None:
    """What a reader raises besides MiSplatError; None for a value or such an error."""
    path.write_bytes(data)
    signal.setitimer(signal.ITIMER_REAL, LIMIT)
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            kind.read(path)
    except MiSplatError as error:
        try:
            str(error).encode()
        except UnicodeEncodeError:
            return f"a message that cannot be printed: {error!r}"
    except (Exception, TooSlowError) as error:  # noqa: BLE001  # this is what is looked for
        last_frame = traceback.extract_tb(error.__traceback__)[-1]
        ours = [frame for frame in traceback.extract_tb(error.__traceback__) if "site-packages" not in frame.filename]
        return f"{type(error).__name__}: {error} in {ours[-1].filename}:{ours[-1].lineno}, {last_frame.name}"[:400]
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    return None


def _say(line: dict[str, object]) -> None:
    sys.stdout.write(f"{json.dumps(line)}\n")
    sys.stdout.flush()


def _too_slow(number: int, frame: FrameType | None) -> None:
    raise TooSlowError(f"more than {LIMIT:g} s")


def _bound_memory() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if Path("/proc/self/statm").exists() else 0
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY, resource.RLIM_INFINITY))


if __name__ == "__main__":
    main(float(sys.argv[1]), sys.argv[2:])
