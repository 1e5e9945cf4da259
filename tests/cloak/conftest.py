"""A finished tiny study, made once for all tests that look at one."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cloak.tiny_study import done


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("study") / "out"
    done(folder)
    return folder
