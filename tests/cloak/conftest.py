"""What tests of CLOAK share: a finished tiny study, and the objects."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.cloak.tiny_study import known
from tests.project.layers import ROOT
from tests.warm import Warm


@pytest.fixture(autouse=True)
def _tiny() -> Iterator[None]:
    with known():
        yield


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory, warm: Warm) -> Path:
    """The folder of a finished study.

    A process of its own made it; beside it MODULES names what that has loaded.
    """
    folder = tmp_path_factory.mktemp("study") / "out"
    warm.run("-m", "tests.cloak.tiny_study", str(folder), cwd=ROOT, check=True)
    return folder
