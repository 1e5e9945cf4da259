"""Settings that every test runs under."""

import gc
import os
from collections.abc import Iterator
from typing import Any

import hypothesis
import pytest
import torch

from mi_splat.cameras.camera import Camera
from mi_splat.cli import console
from tests.browser import CHROMIUM, SWITCHES, patient
from tests.rewriting import rewrite_once
from tests.warm import Warm

# Dr.Jit and torch each bring a pool of threads, and with several test processes on few
# cores they fight.
torch.set_num_threads(1)
os.environ.setdefault("OMP_NUM_THREADS", "1")  # for the processes that tests start

rewrite_once()

# Until all tests are there nothing is garbage, and to look for it in a million objects
# takes half of that time.
gc.disable()

hypothesis.settings.register_profile(
    "mi-splat",
    derandomize=True,
    deadline=None,
    print_blob=False,
    database=None,
    max_examples=int(os.environ.get("MI_SPLAT_EXAMPLES", "50")),
)
hypothesis.settings.load_profile("mi-splat")


def pytest_collection_modifyitems(
    config: pytest.Config, items: list[pytest.Item]
) -> None:
    """Leave out what runs by night, unless it is asked for by its mark."""
    if "nightly" not in config.option.markexpr:
        nightly = [item for item in items if item.get_closest_marker("nightly")]
        config.hook.pytest_deselected(items=nightly)
        items[:] = [item for item in items if item not in nightly]


def pytest_collection_finish() -> None:
    """Garbage is looked for in what tests make, and not in all that they have
    imported.
    """
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session")
def variant() -> str:
    """The Mitsuba variant that can render splats, current for the rest of the
    session.
    """
    from mi_splat.render.variant import use

    return use()


@pytest.fixture(scope="session")
def warm() -> Iterator[Warm]:
    """Processes that need not import torch."""
    processes = Warm()
    yield processes
    processes.close()


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """A browser for all tests of the module."""
    api = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    with api.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=SWITCHES)
        browser.new_page, browser.new_context = (
            patient(browser.new_page),
            patient(browser.new_context),
        )
        yield browser
        browser.close()


@pytest.fixture
def scalar() -> Iterator[None]:
    """Mitsuba's scalar variant for a whole test of few images, which compiles
    nothing.
    """
    from mi_splat.capture.path_tracer import FEW_PICTURES, tracing_variant

    with tracing_variant(FEW_PICTURES):
        yield


@pytest.fixture
def frozen(monkeypatch: pytest.MonkeyPatch) -> list[Camera]:
    """The cameras of all images that frozen views make during the test."""
    from mi_splat.render.frozen_view import FrozenView

    seen: list[Camera] = []
    make = FrozenView.__call__

    def noted(view: FrozenView, sh: torch.Tensor) -> torch.Tensor:
        seen.append(view.camera)
        return make(view, sh)

    monkeypatch.setattr(FrozenView, "__call__", noted)
    return seen


@pytest.fixture(autouse=True)
def _seeded() -> None:
    """A test that forgets to seed torch is reproducible nevertheless, and one that
    changed threads changed its own.
    """
    torch.manual_seed(0)
    torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def _no_lines_of_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy machine any command may take so long that it says how far it is; tests
    look at what else it says.
    """
    monkeypatch.setattr(console, "LINE_SECONDS", float("inf"))
