"""Jobs as arrays of SLURM, run here by a stand-in for `sbatch`."""

import os
import subprocess
from pathlib import Path

import pytest

from mi_splat.ledger import Job, Store, slurm
from tests.ledger.drive import Ledger, walk
from tests.ledger.kinds.configs import NumbersConfig, Shift, Sign
from tests.ledger.test_engines import bytes_of
from tests.project.layers import ROOT

NUMBERS = "tests.ledger.kinds.numbers"
SBATCH = """#!/bin/sh
for script; do :; done
echo "$@" >> "$OUT/calls"
last=$(sed -n 's/^#SBATCH --array=0-//p' "$script")
for number in $(seq 0 "$last"); do
    SLURM_ARRAY_TASK_ID=$number sh "$script" >> "$OUT/log" 2>&1 || echo "failed $number" >> "$OUT/calls"
done
echo 4${script##*-}
"""


def graph(file: Path) -> dict[str, Job]:
    """Three levels of jobs, with parts, a file, and a configuration of several classes."""
    config = NumbersConfig(shift=Shift(by=0.1 + 0.2, sign=Sign.MINUS), most=3)
    first = [Job(kind=NUMBERS, config=config, inputs={"file": file}), walk(1), walk(2)]
    second = Job(kind=NUMBERS, config=config, inputs={"first": first[0].part("sum.txt")})
    third = Job(kind=NUMBERS, config=NumbersConfig(), inputs={"second": second, "first": first[0]})
    return {"third": third, "walk": first[1], "other": first[2], "after": walk(3, one=first[1])}


def test_arrays_leave_the_bytes_of_one_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(slurm, "MOST_ELEMENTS", 2)
    (tmp_path / "one.txt").write_text("1.0")
    jobs, store, out = graph(tmp_path / "one.txt"), tmp_path / "store", tmp_path / "out"
    assert slurm.export(jobs.values(), out, store, options=["--time=01:00:00"]) == [3, 2, 1]
    assert "#SBATCH --time=01:00:00" in (out / "level-0.sbatch").read_text()
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "sbatch").write_text(SBATCH)
    (tmp_path / "bin" / "sbatch").chmod(0o755)
    path = f"{tmp_path / 'bin'}:{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path, "OUT": str(tmp_path), "PYTHONPATH": str(ROOT)}
    subprocess.run(["sh", out / slurm.SUBMIT], env=environment, check=True)
    calls = (tmp_path / "calls").read_text().splitlines()
    assert calls == [
        "--parsable level-0.sbatch",
        "--parsable --dependency=afterany:40.sbatch level-1.sbatch",
        "--parsable --dependency=afterany:41.sbatch level-2.sbatch",
    ], (tmp_path / "log").read_text()
    whole = Ledger(tmp_path / "whole")
    for job in jobs.values():
        whole.do(job)
    assert bytes_of(store) == bytes_of(tmp_path / "whole")


def test_an_element_says_what_has_failed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    slurm.export([walk(0, trouble="kill"), walk(1)], tmp_path / "out", tmp_path / "store")
    assert slurm.run(tmp_path / "store", tmp_path / "out" / slurm.JOBS, 0, 2) == 1
    assert capsys.readouterr().err == "job 0: ended by SIGSEGV\n"
    assert len(Store(tmp_path / "store").keys()) == 1
