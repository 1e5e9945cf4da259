"""The jobs of a page are commands: their arguments are read back, and their results are opened."""

import shlex
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from attacks import cli
from attacks.cli.view import attack_job, audit_job
from mi_splat.audit.files import write as write_files
from mi_splat.cli.cameras import find_cameras
from mi_splat.errors import InvalidValueError
from mi_splat.io import save_splat
from mi_splat.rendering import Renderer
from mi_splat.scene_files import open_scene
from mi_splat.viewer.content import Content, content_of_file
from mi_splat.viewer.orbit import Orbit
from mi_splat.viewer.painter import Painter
from mi_splat.viewer.picking import Picked
from mi_splat.viewer.runner import JobKind, JobRequest, JobRunner, Value
from tests.audit.accounts import account, look
from tests.project.layers import ROOT
from tests.viewer.contents import ball

CAMERA = Orbit(target=(0.1, -0.2, 0.05), azimuth=33.0, elevation=-12.5, distance=4.25, fov=40.0)
MASK, STREET = Path("mask.npy"), ROOT / "scenes" / "car_street.xml"


@pytest.fixture
def content(tmp_path: Path) -> Content:
    save_splat(ball((0.8, 0.1, 0.1)), tmp_path / "ball.ply")
    return replace(content_of_file(tmp_path / "ball.ply"), size=(40, 32))


def request(kind: JobKind, content: Content, **values: Value) -> JobRequest:
    fields = {field.name: field.valid(values.get(field.name)) for field in kind.fields}
    picked = Picked(splat=content.names[0], mask=torch.arange(len(content.splats[0].scene)) < 15)
    return JobRequest(content=content, orbit=CAMERA, values=fields, picked=picked)


def read_back(kind: JobKind, wanted: JobRequest) -> Any:
    """The options of the command for a request."""
    name, *words = kind.arguments(wanted, MASK, kind.out)
    return cli.parse(name, words)


def test_the_command_of_an_attack_is_that_attack_from_this_camera(content: Content) -> None:
    attack = attack_job()
    chosen: dict[str, Value] = {"objective": "hide", "norm": "linf", "eps": 0.3, "steps": 7.0}
    wanted = request(attack, content, detector="yolov8n_small", **chosen)
    options = read_back(attack, wanted)
    assert (options.objective, options.target, options.detectors) == ("hide", None, ("yolov8n_small",))
    assert (options.config.norm, options.config.eps, options.config.steps) == ("linf", (0.3,), 7)
    assert (options.scene, options.selection.mask, options.out) == (content.splats[0].path, MASK, Path("out/dagger"))
    (camera,) = find_cameras(open_scene(options.scene), options.view).values()
    assert torch.equal(camera.to_world, CAMERA.camera(content.size).to_world)
    assert (camera.fx, camera.width, camera.height) == (CAMERA.camera((40, 32)).fx, 40, 32)
    relabelled = read_back(attack, request(attack, content, target="stop sign"))
    assert (relabelled.objective, relabelled.target) == ("relabel", "stop sign")
    loaded, street = open_scene(STREET), content_of_file(STREET)
    named = replace(request(attack, street), orbit=street.cameras["rear"])
    (camera,) = find_cameras(loaded, read_back(attack, named).view).values()
    assert torch.equal(camera.to_world, loaded.cameras["rear"].to_world)  # to the bit, as the file has it
    with pytest.raises(InvalidValueError, match="click on one"):
        attack.arguments(replace(wanted, picked=None), MASK, Path("out"))


def test_the_detector_of_the_page_is_the_default_with_its_weights(content: Content) -> None:
    attack = attack_job("yolov8n_small", weights=Path("w.pth"))
    assert "--detectors yolov8n_small --weights w.pth" in shlex.join(
        attack.arguments(request(attack, content), MASK, Path("out"))
    )


def test_an_audit_shows_the_splat_with_its_heat_map(content: Content, tmp_path: Path) -> None:
    audit, scene, out = audit_job(content), content.splats[0].scene, tmp_path / "result"
    assert read_back(audit, request(audit, content)).file == content.splats[0].path
    assert read_back(audit, request(audit, content.turned((0.0, -1.0, 0.0)))).up == (0.0, -1.0, 0.0)
    write_files(account(look(), count=len(scene)), scene, out, source="elsewhere.ply")
    result = audit.opened(request(audit, content), out)
    assert result.content is not None
    assert result.content.names == ("audited", "heat")
    assert result.lines[0].startswith("hidden look")
    assert read_back(audit, request(audit, result.content)).file == content.splats[0].path  # not its heat map


@pytest.mark.slow
def test_an_interrupted_attack_shows_its_best_so_far(content: Content, tmp_path: Path, variant: str) -> None:
    attack = attack_job("fasterrcnn_small")
    runner = JobRunner(Painter(content, Renderer(content.settings)), [attack])
    wanted = request(attack, content, objective="hide", steps=500.0)
    runner._picked = wanted.picked
    runner.start(attack, CAMERA, dict(wanted.values))
    end = time.monotonic() + 300
    while runner.running:
        assert time.monotonic() < end, runner.lines
        runner.turn()
        if "attacking: loss" in runner.lines[0] and not runner._stopped:
            runner.stop()
        time.sleep(0.05)
    assert runner.content.names == ("clean", "attacked"), runner.lines
    assert any("The search was stopped after step" in line for line in runner.lines)
    runner.close()
