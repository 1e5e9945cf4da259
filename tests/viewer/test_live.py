"""A page that follows a training changes nothing of it, shows where it stands, stops it and lets it go on."""

import dataclasses
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from mi_splat.datasets import Dataset, load_dataset
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene import GaussianScene
from mi_splat.training.initialization import from_points
from mi_splat.training.loop import Fit, Progress
from mi_splat.training.resume import train
from mi_splat.viewer import live as module
from mi_splat.viewer.live import SPLAT, LiveTraining, training_content
from mi_splat.viewer.painter import Painter
from mi_splat.viewer.server import Page
from tests.datasets.sets import write_transforms
from tests.training.sets import views_of, watching
from tests.training.test_resume import CONFIG
from tests.viewer.contents import START
from tests.viewer.wire import Browser, connection, headers_of

STEPS = 12


@pytest.fixture
def live(tmp_path: Path) -> LiveTraining:
    """Of a small set, two of whose pictures are held out."""
    _, views = views_of()
    write_transforms(tmp_path / "set", views[2:], test=views[:2])
    parts = [load_dataset(tmp_path / "set", split=split) for split in ("train", "test")]
    shown = training_content(
        parts, beginning(), dataset=tmp_path / "set", out=tmp_path / "out" / "splat.ply", settings=RenderSettings()
    )
    return LiveTraining(Painter(shown, Renderer()), STEPS)


def beginning() -> GaussianScene:
    truth, _ = views_of()
    return from_points(truth.means, torch.full((50, 3), 0.5))


def trained(folder: Path, live: LiveTraining | None = None) -> Fit:
    hooks: dict[str, Any] = {}
    if live is not None:
        hooks = {"on_start": live.begin, "on_step": live.note, "hold": live.hold}
    _, views = views_of()
    config = dataclasses.replace(CONFIG, iterations=STEPS)
    return train(views, beginning(), folder, render=watching(), config=config, held_out=views[:2], **hooks)


def says(browser: Browser, text: str) -> None:
    browser.until(lambda message: text in str(message))


def test_a_training_that_is_watched_pauses_continues_and_is_the_same(
    live: LiveTraining, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "REFRESH", 0.0)
    made: list[Fit] = []
    with Page(live, port=0) as page, connection(page.address, headers_of(page.address)) as browser:
        live.page = page
        live.toggle()  # it waits after its first step
        thread = threading.Thread(target=lambda: made.append(trained(tmp_path / "watched", live)))
        thread.start()
        browser.look(START)
        says(browser, f"Step 1 of {STEPS}, paused")
        assert browser.picture().shape[2] == 3
        (button,) = (message["uuid"] for message in browser.messages if message["type"] == "GuiButtonMessage")
        browser.say("GuiUpdateMessage", uuid=button, updates={"value": True})
        thread.join(60)
    plain = trained(tmp_path / "plain")
    assert all(torch.equal(a, b) for a, b in zip(made[0].scene.tensors(), plain.scene.tensors(), strict=True))
    assert (tmp_path / "watched" / "splat.ply").read_bytes() == (tmp_path / "plain" / "splat.ply").read_bytes()
    assert f"All held-out pictures at step {STEPS}: PSNR" in live.remarks[-1]


def test_the_first_picture_is_a_held_out_one_beside_its_photograph(live: LiveTraining) -> None:
    shown = live.content
    assert shown.names == ("photograph", SPLAT)
    assert "held out" in str(shown.camera_name(shown.start))
    assert sum("held out" in name for name in shown.cameras) == 2
    before = live.painter.picture(SPLAT, shown.start)
    live.painter.exchange(SPLAT, beginning().select(torch.arange(50) < 25))
    assert not torch.equal(live.painter.picture(SPLAT, shown.start), before)
    assert "--centre" in live.painter.commands(shown.start.changed())[SPLAT]


def test_a_photograph_that_cannot_be_read_is_reported_and_ends_nothing(live: LiveTraining) -> None:
    shown = live.content.photographs
    assert shown is not None
    assert isinstance(shown.views, Dataset)
    shown.views.paths[0].write_bytes(b"no picture")
    state = SimpleNamespace(scene=beginning)
    live.begin(state)  # type: ignore[arg-type]
    live.note(Progress(iteration=1, loss=0.5, count=50))
    assert live.turn()
    assert live.remarks[0] == f"Step 1 of {STEPS}"
    assert str(shown.views.paths[0]) in live.remarks[-1]
