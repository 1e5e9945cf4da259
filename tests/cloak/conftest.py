"""What tests of CLOAK share: a finished tiny study, and the objects."""

from pathlib import Path

import pytest

from attacks.cloak import setup
from attacks.detectors import registry
from tests.cloak.tiny_study import KNOWN, asset
from tests.project.layers import ROOT
from tests.warm import Warm


@pytest.fixture(autouse=True)
def _a_car_is_a_block(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(setup, "_asset", asset)


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
