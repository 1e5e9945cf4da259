"""`mi-splat view`: what it refuses before anything is loaded, the page that it writes, and how it ends."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

from attacks import cli
from mi_splat.io import save_splat
from tests.project.layers import ROOT
from tests.viewer.exhibits import ball


@pytest.fixture
def splat(tmp_path: Path) -> Path:
    save_splat(ball((0.8, 0.3, 0.1)), tmp_path / "ball.ply")
    return tmp_path / "ball.ply"


def test_a_taken_port_is_told(splat: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        words = ["view", str(splat), "--port", str(taken.getsockname()[1])]
        pytest.importorskip("viser", reason="needs the extra `view`")
        assert cli.main(words) == 1
    assert "--port 0" in capsys.readouterr().err


def test_the_page_in_a_file(splat: Path, capsys: pytest.CaptureFixture[str], variant: str) -> None:
    out = splat.parent / "page.html"
    words = ["view", str(splat), "--clean", str(splat), "--views", "3", "1", "--size", "60x40", "--export", str(out)]
    assert cli.main([*words, "--detectors", "fasterrcnn_small"]) == 0
    out_text = capsys.readouterr().out
    assert "1 camera and 3 x 1 all around" in out_text
    assert "Up is z." in out_text
    page = out.read_text("utf-8")
    found = re.search(r'<script id="views" type="application/json">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    views = json.loads(found[1])
    assert len(views) == 3
    assert all("%" in part["found"] for view in views for part in view["splats"])
    assert cli.main(words) == 1
    assert out.read_text("utf-8") == page
    assert cli.main([*words, "--force"]) == 0
    assert out.read_text("utf-8") != page  # no detector this time


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_serves_until_it_is_told_to_stop(number: signal.Signals, splat: Path) -> None:
    pytest.importorskip("viser", reason="needs the extra `view`")
    command = [sys.executable, "-m", "attacks", "view", str(splat), "--port", "0", "--no-open"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        command, cwd=splat.parent, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None
            address = process.stdout.readline().removeprefix("Open ").strip()
            assert address.startswith("http://127.0.0.1:"), address
            with urllib.request.urlopen(address, timeout=10) as answer:
                assert answer.status == 200
            process.send_signal(number)
            out, errors = process.communicate(timeout=30)
        finally:
            process.kill()
    assert (process.returncode, errors) == (0, "")
    assert out.splitlines()[-1] == "The page is closed."
    port = int(address.partition("?")[0].rstrip("/").rpartition(":")[2])
    with socket.socket() as free:
        free.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        free.bind(("127.0.0.1", port))
