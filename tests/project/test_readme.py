"""What the README shows is true: its example, its scene and its commands run."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text()


def blocks(language: str, text: str = README) -> list[str]:
    """Contents of the fenced blocks in one language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL)


PAGES = "\n".join([README, *(page.read_text() for page in sorted((ROOT / "docs").glob("*.md")))])
"""The README and the documentation."""


def commands(program: str, text: str = README) -> list[list[str]]:
    """Arguments of every call of `program` in the shell blocks."""
    lines = [line for block in blocks("sh", text) for line in block.splitlines()]
    words = [shlex.split(line, comments=True) for line in lines]
    return [line[1:] for line in words if line and line[0] == program]


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """An empty folder from which the scenes can be seen, and where a command may write."""
    (tmp_path / "scenes").symlink_to(ROOT / "scenes")
    return tmp_path


@pytest.mark.slow
def test_the_python_example_runs(checkout: Path) -> None:
    (example,) = blocks("python")
    assert len([line for line in example.splitlines() if line.strip()]) <= 20
    done = subprocess.run([sys.executable, "-c", example], cwd=checkout, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "success: True" in done.stdout
    assert (checkout / "attacked.ply").is_file()


@pytest.mark.slow
def test_the_examples_of_the_api_run(checkout: Path) -> None:
    """As they stand, but with the smallest set and a training of some steps."""
    dagger, cloak = blocks("python", (ROOT / "docs" / "api.md").read_text())
    capture = "capture car:900004 --rgba --cameras hemisphere:12 --size 24 --samples 1 --points 200 --out out/car-alone"
    done = subprocess.run([sys.executable, "-c", dagger], cwd=checkout, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "person reported from the other cameras, given_found" in done.stdout
    assert (checkout / "out" / "person" / "result.json").is_file()
    subprocess.run([sys.executable, "-m", "attacks", *capture.split()], cwd=checkout, check=True, capture_output=True)
    short = cloak.replace("iterations=2000", "iterations=8")
    assert short != cloak
    done = subprocess.run([sys.executable, "-c", short], cwd=checkout, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_scene_example_renders(tmp_path: Path) -> None:
    (example,) = blocks("xml")
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
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    command = [sys.executable, "-m", "attacks", "render", "example.xml", "--out", "street.png"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "street.png").is_file()


@pytest.mark.parametrize("words", commands("mi-splat", PAGES), ids=" ".join)
def test_every_command_is_understood(words: list[str]) -> None:
    from attacks.cli import COMMANDS
    from attacks.cli.parsing import parse

    assert words[0] in COMMANDS
    parse(words[0], COMMANDS[words[0]], words[1:])


@pytest.mark.parametrize("words", commands("make"), ids=" ".join)
def test_every_make_target_exists(words: list[str]) -> None:
    makefile = (ROOT / "Makefile").read_text()
    targets = [word for word in words if "=" not in word]
    assert targets
    for target in targets:
        assert re.search(rf"^{target}:", makefile, flags=re.MULTILINE), target
    for name in (word.split("=")[0] for word in words if "=" in word):
        assert re.search(rf"^{name} \?=", makefile, flags=re.MULTILINE), name


def test_every_path_exists() -> None:
    named = [link for link in re.findall(r"\]\(([^)#:]+)\)", README) if "//" not in link]
    assert named
    for path in named:
        assert (ROOT / path).exists(), path


def test_the_readme_is_short() -> None:
    assert len(README.splitlines()) <= 150


@pytest.mark.parametrize("path", [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")], ids=lambda p: str(p.name))
def test_nothing_is_left_to_fill_in(path: Path) -> None:
    assert not re.findall(r"TODO|TBD|FIXME|to be measured", path.read_text())
