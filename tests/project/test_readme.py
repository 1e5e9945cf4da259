"""What the README shows is true: its example and its scene run, and so do those of the Python API."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from tests.project.documented_commands import ROOT, blocks, pages
from tests.warm import Warm

README = (ROOT / "README.md").read_text()


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """An empty folder from which the scenes can be seen, and where a command may write."""
    (tmp_path / "scenes").symlink_to(ROOT / "scenes")
    return tmp_path


@pytest.mark.slow
def test_the_python_example_runs(checkout: Path, warm: Warm) -> None:
    (example,) = blocks("python", README)
    assert len([line for line in example.splitlines() if line.strip()]) <= 20
    done = warm.run("-c", example, cwd=checkout)
    assert done.returncode == 0, done.stderr
    assert "success: True" in done.stdout
    assert (checkout / "attacked.ply").is_file()


@pytest.mark.slow
def test_the_examples_of_the_api_run(checkout: Path, warm: Warm) -> None:
    """As they stand, but with the smallest set and a training of some steps."""
    dagger, cloak = blocks("python", (ROOT / "docs" / "api.md").read_text())
    capture = "capture car:900004 --rgba --cameras hemisphere:12 --size 24 --samples 1 --points 200 --out out/car-alone"
    done = warm.run("-c", dagger, cwd=checkout)
    assert done.returncode == 0, done.stderr
    assert "from the other cameras, target_attacked: " in done.stdout
    assert (checkout / "out" / "person" / "result.json").is_file()
    warm.run("-m", "attacks", *capture.split(), cwd=checkout, check=True)
    short = cloak.replace("iterations=2000", "iterations=8")
    assert short != cloak
    done = warm.run("-c", short, cwd=checkout)
    assert done.returncode == 0, done.stderr


def test_the_scene_example_renders(tmp_path: Path, warm: Warm) -> None:
    (example,) = blocks("xml", README)
    for name in re.findall(r'name="filename" value="([^"]+)"', example):
        shutil.copy(ROOT / "scenes" / name, tmp_path)
    (tmp_path / "example.xml").write_text(example)
    code = """
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
import mi_splat.plugins
import numpy as np
scene = mi.load_file("example.xml")
assert {"car.data", "car.opacities", "car.sh_coeffs"} <= set(mi.traverse(scene).keys())
picture = np.asarray(mi.render(scene))
assert picture.shape == (240, 320, 3), picture.shape
assert picture.std() > 0.05
"""
    done = warm.run("-c", code, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    done = warm.run("-m", "attacks", "render", "example.xml", "--out", "street.png", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "street.png").is_file()


def test_the_readme_is_short() -> None:
    prose = re.sub(r"^```.*?^```$", "", README, flags=re.MULTILINE | re.DOTALL)
    assert len(README.splitlines()) <= 150
    assert len(prose.split()) <= 900
    results = re.findall(r"^\| \[.*$", README, flags=re.MULTILINE)
    assert len(results) == 6
    assert max(len(cell.split()) for row in results for cell in row.split("|")) <= 30


@pytest.mark.parametrize("path", pages(), ids=lambda path: str(path.name))
def test_nothing_is_left_to_fill_in(path: Path) -> None:
    assert not re.findall(r"TODO|TBD|FIXME|to be measured", path.read_text())
