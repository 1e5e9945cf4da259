"""Processes of this library import nothing from the working directory, whoever has put
files there.
"""

import subprocess
from pathlib import Path

import pytest

from attacks.detectors.graphs import packages
from mi_splat.errors import MiSplatError
from mi_splat.ledger import Done
from mi_splat.ledger.engines import Cluster
from mi_splat.ledger.plans import Driver, grid
from mi_splat.processes import python_command
from tests.ledger.drive import walk


@pytest.fixture
def hostile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory, with modules and a Mitsuba plugin that note their use in a
    file.
    """
    for name in ("queue", "random", "sitecustomize", "runpy", "json"):
        (tmp_path / f"{name}.py").write_text(
            f"open({str(tmp_path / 'RAN')!r}, 'a').write('{name} ')"
        )
    (tmp_path / "plugins").mkdir()
    (tmp_path / "plugins" / "hdrfilm.so").write_text(
        "no library: whoever loads it fails"
    )
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_jobs(hostile: Path) -> None:
    store = hostile / "store"
    results = Driver(Cluster(store, workers=1)).run([grid({"one": walk(1, steps=1)})])
    assert isinstance(results["one"], Done)
    assert not (hostile / "RAN").exists()


def test_pip(hostile: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("XDG_CACHE_HOME", str(hostile))
    with pytest.raises(MiSplatError, match="pip download"):
        list(packages.fetch(["prototypes"]))
    assert not (hostile / "RAN").exists()


def test_what_this_process_can_import_the_other_can(
    hostile: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (hostile / "own").mkdir()
    (hostile / "own" / "of_the_user.py").write_text(
        "import sys; print(sys.argv[1:], __name__)"
    )
    monkeypatch.syspath_prepend(str(hostile / "own"))
    done = subprocess.run(
        python_command("of_the_user", "a", "b"),
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split("\n")[0] == "['a', 'b'] __main__"
