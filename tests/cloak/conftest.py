"""What tests of CLOAK share: a finished tiny study, and the objects."""

from functools import cache
from pathlib import Path

import pytest

from attacks.cloak import setup
from attacks.detectors import registry
from mi_splat.assets import build
from tests.cloak.tiny_study import KNOWN
from tests.project.layers import ROOT
from tests.warm import Warm

built = cache(build)


@pytest.fixture(autouse=True)
def _objects_are_built_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A car takes 0.2 s, each study asks for it many times, and nobody changes one."""
    monkeypatch.setattr(setup, "build", built)


@pytest.fixture(autouse=True)
def _jobs_know_the_detector(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, spec in KNOWN.items():
        monkeypatch.setitem(registry.DETECTORS.own, name, spec)


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory, warm: Warm) -> Path:
    """The folder of a finished study. A process of its own made it; beside it MODULES names what that has loaded."""
    folder = tmp_path_factory.mktemp("study") / "out"
    warm.run("-m", "tests.cloak.tiny_study", str(folder), cwd=ROOT, check=True)
    return folder
