"""Read damaged files by hand.

`python -m tests.campaign` reads `MI_SPLAT_MUTANTS` mutants of every kind,
`python -m tests.campaign KIND` of one, and `python -m tests.campaign KIND NUMBER` reads
one in this process and shows its traceback; `MI_SPLAT_SEED` repeats.
"""

import os
import sys
import tempfile
import time
from pathlib import Path

from mi_splat.errors import MiSplatError
from tests.campaign.driving import Driver, mutants, seed_of_today
from tests.campaign.kinds import KINDS
from tests.campaign.reading import mutated, whole


def repeat(name: str, number: int) -> None:
    """Read one mutant here; it stays in a folder of its own."""
    folder = Path(tempfile.mkdtemp(prefix="mutant-"))
    inside = folder / "in"
    inside.mkdir()
    os.chdir(folder)
    kind = KINDS[name]
    path, data = whole(kind, inside)
    path.write_bytes(mutated(kind, seed_of_today(), number, data))
    print(f"reading {path}")  # noqa: T201
    try:
        print(repr(kind.read(path))[:500])  # noqa: T201
    except MiSplatError as error:
        print(f"refused: {error}")  # noqa: T201


def campaign(names: list[str]) -> int:
    """Read mutants of kinds, and show what was wrong; the exit status."""
    seed = seed_of_today()
    driver = Driver()
    faults = 0
    print(f"MI_SPLAT_SEED={seed}", flush=True)  # noqa: T201
    for name in names:
        start = time.monotonic()
        account = driver.run(KINDS[name], seed=seed, count=mutants())
        faults += len(account.faults)
        print(  # noqa: T201
            f"{name}: {account.read} mutants, {time.monotonic() - start:.1f} s",
            flush=True,
        )
        if account.faults:
            print(account.in_words(seed), flush=True)  # noqa: T201
    driver.close()
    print(f"{faults} faults")  # noqa: T201
    return int(faults > 0)


if __name__ == "__main__":
    if len(sys.argv) == 3:
        repeat(sys.argv[1], int(sys.argv[2]))
    else:
        sys.exit(campaign(sys.argv[1:] or list(KINDS)))
