"""Jobs as arrays of SLURM, run here by a stand-in for `sbatch`; and results that are taken over to new code."""

import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

from mi_splat import import_closure
from mi_splat.errors import InvalidValueError
from mi_splat.ledger import Job, Ledger, Store, slurm
from mi_splat.ledger.engines import InProcess
from mi_splat.ledger.reuse import Reuse, reuse
from tests.core.test_import_closure import forget as forget_code
from tests.ledger.drive import walk
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


@pytest.fixture
def kind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file of a kind whose code the test changes, in the place of the project's folder."""
    package = tmp_path / "root" / "made"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    file = package / "doubled.py"
    file.write_text(
        "from dataclasses import dataclass\n"
        "VARIES = ('time.txt',)\n"
        "@dataclass(frozen=True, kw_only=True)\n"
        "class Config:\n"
        "    number: int = 0\n"
        "def run(config, inputs, out):\n"
        "    import time\n"
        "    (out / 'double.txt').write_text(str(2 * config.number))\n"
        "    (out / 'time.txt').write_text(str(time.time()))\n"
        "    return [{'double': 2 * config.number}]\n"
    )
    monkeypatch.setattr(import_closure, "ROOT", tmp_path / "root")
    monkeypatch.syspath_prepend(str(tmp_path / "root"))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # it would be today's for all that is written this second
    forget()
    return file


def forget() -> None:
    for name in ("made", "made.doubled"):
        sys.modules.pop(name, None)
    forget_code()


def changed(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))
    forget()


def made(folder: Path, numbers: range) -> dict[int, str]:
    """Keys of the kind's jobs, done by today's code."""
    config = importlib.import_module("made.doubled").Config
    ledger = Ledger(folder)
    return {n: ledger.do(Job(kind="made.doubled", config=config(number=n))).key for n in numbers}


def again(folder: Path, verify: int) -> Reuse:
    return reuse(Store(folder), "made.doubled", InProcess(folder), verify=verify, reason="a faster sum")


def test_results_of_older_code_are_taken_over_after_a_look_at_some(kind: Path, tmp_path: Path) -> None:
    store = Store(tmp_path / "store")
    before = made(store.folder, range(7))
    changed(kind, "2 * config.number))", "config.number + config.number))")
    reused = again(store.folder, 2)
    assert (len(reused.verified), len(reused.taken)) == (2, 5)
    after = made(store.folder, range(7))
    assert set(after.values()) == {*reused.verified, *reused.taken}
    assert not set(after.values()) & set(before.values())
    notes = {number: store.existing(key).record.get("reused") for number, key in after.items()}
    assert [number for number, note in notes.items() if note is None] == [
        number for number, key in after.items() if key in reused.verified
    ]
    for number in (number for number, note in notes.items() if note is not None):
        assert notes[number] == {
            "code": reused.code,
            "verified": list(reused.verified),
            "reason": "a faster sum",
            "from": before[number],
        }
        assert store.existing(after[number]).rows == [{"double": 2 * number}]
    assert again(store.folder, 2) == Reuse(code="", verified=(), taken=())


def test_a_field_that_is_new_has_its_default_in_what_is_taken_over(kind: Path, tmp_path: Path) -> None:
    made(tmp_path / "store", range(4))
    changed(kind, "    number: int = 0\n", "    number: int = 0\n    times: int = 1\n")
    taken = again(tmp_path / "store", 1).taken
    assert set(made(tmp_path / "store", range(4)).values()) > set(taken)
    assert {Store(tmp_path / "store").record(key)["config"]["times"] for key in taken} == {1}


def test_nothing_is_taken_over_when_one_has_other_bytes(kind: Path, tmp_path: Path) -> None:
    store = Store(tmp_path / "store")
    made(store.folder, range(4))
    changed(kind, "str(2 * config.number)", "str(3 * config.number)")
    with pytest.raises(InvalidValueError, match=r"expected the bytes of \w{32}, got another double.txt; run the study"):
        again(store.folder, 2)
    assert len(store.keys()) == 4 + 2
