"""The code in a job's key is all that the job loads: nothing is loaded by a name that
its module does not have.
"""

import json
import pickle
from pathlib import Path
from typing import Any

from mi_splat.import_closure import closure
from tests.project.layers import PACKAGES, ROOT
from tests.studies.toy import settings, work_of, write_toy
from tests.warm import Warm

PROGRAM = """
import json, pickle, sys
from pathlib import Path
from mi_splat.ledger.engines import InProcess
from mi_splat.ledger.plans import Driver, grid
store, jobs = Path(sys.argv[1]), pickle.loads(Path(sys.argv[2]).read_bytes())
Driver(InProcess(store)).run([grid(dict(enumerate(jobs)))])
print(json.dumps(sorted(sys.modules)))
"""
EOT: dict[str, Any] = {
    "study": "dagger-eot",
    "attack": {"steps": 1, "batch": 1, "pool": 1, "validation": 1, "held_out": 1},
    "cameras": {
        "azimuths": [-120.0, -60.0],
        "elevations": [0.0, 10.0],
        "distances": [0.9, 1.1],
    },
    "evaluate_with": {"views": 1},
}
FIXED: dict[str, Any] = {
    "attack": {"steps": 1},
    "evaluate_with": {"matrix": {"condition": ["ray", ".spz"]}},
}


def test_jobs_load_no_code_that_is_not_in_their_keys(
    tmp_path: Path, warm: Warm
) -> None:
    write_toy(tmp_path)
    works = [
        work_of(settings(tmp_path, **{"detectors": "fasterrcnn_small", **table}))
        for table in (FIXED, EOT)
    ]
    jobs = [job for work in works for job in work.jobs().values()]
    (tmp_path / "jobs").write_bytes(pickle.dumps(jobs))
    done = warm.run(
        "-c",
        PROGRAM,
        str(tmp_path / "store"),
        str(tmp_path / "jobs"),
        cwd=ROOT,
        check=True,
    )
    loaded = {
        name
        for name in json.loads(done.stdout.splitlines()[-1])
        if name.split(".")[0] in PACKAGES
    }
    kinds = {job.kind for job in jobs}
    assert len(loaded) > 80
    assert loaded - set(closure(*kinds)) <= set(
        closure("mi_splat.ledger.plans", "mi_splat.ledger.engines")
    ), "name it in the kind's module"
