"""What is installed: everything that is imported is a dependency or an extra, and
without an extra nothing half done.

Each command that needs an extra is run in a process that does not have it: one line
says what to install, before anything is written.
"""

import importlib
import re
import shutil
import sys
from pathlib import Path

import pytest

from attacks.cli.doctor import EXTRAS
from tests.project.documented_commands import blocks
from tests.project.layers import PACKAGES, ROOT, edges
from tests.training.sets import write_set
from tests.warm import Warm

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
ALSO = {"PIL": "pillow", "pxr": "usd-core"} | {
    "rapidocr_onnxruntime": "rapidocr-onnxruntime"
}
ALSO |= {"cv2": "opencv-python-headless"}
"""Modules that are not called as their package is."""
MODULES = [module for modules in EXTRAS.values() for module in modules]


def packages(requirements: list[str]) -> set[str]:
    return {re.split(r"[^\w-]", requirement)[0] for requirement in requirements}


def test_doctor_knows_the_extras() -> None:
    extras = {
        name: packages(needed) - {"mi-splat"}
        for name, needed in PROJECT["optional-dependencies"].items()
        if name not in ("dev", "docs")
    }
    assert {
        name: {ALSO.get(module, module) for module in modules}
        for name, modules in EXTRAS.items()
    } == extras


def test_what_is_imported_is_installed() -> None:
    installed = packages(PROJECT["dependencies"]) | {
        ALSO.get(module, module) for module in MODULES
    }
    for package in PACKAGES:
        for name, other in edges(package):
            top = other.split(".")[0]
            is_brought = top in PACKAGES or top in sys.stdlib_module_names
            # pytest is there where it loads a plug-in of its own
            if not is_brought and not name.endswith("pytest_plugin"):
                assert ALSO.get(top, top) in installed, (
                    f"{name} imports {other}, which no dependency brings"
                )


def test_notice_names_extras_that_exist() -> None:
    named = set(re.findall(r'extra "(\w+)"', (ROOT / "NOTICE").read_text("utf-8")))
    assert named
    assert named <= set(PROJECT["optional-dependencies"])


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        ("report", ["report", "scenes"]),
        ("ocr", ["detect", "scenes/stop_sign.xml", "--detectors", "rapidocr"]),
        ("photos", ["prepare", "docs/images"]),
        ("yolo", ["dagger", "scenes/car_street.xml", "--detectors", "yolov8n_small"]),
        ("view", ["view", "scenes/car_street.xml"]),
        ("yolo", ["cloak", "scenes/cloak_demo.toml", "--detectors", "yolov8n_small"]),
    ],
    ids=lambda value: value if isinstance(value, str) else " ".join(value),
)
def test_a_missing_extra_is_told_before_anything_is_written(
    extra: str, words: list[str], tmp_path: Path, warm: Warm
) -> None:
    out = tmp_path / {"report": "out.html"}.get(extra, "out")
    given = [*words]
    given += [] if extra == "view" else ["--out", str(out)]
    done = warm.run("-m", "attacks", *given, cwd=ROOT, missing=EXTRAS[extra])
    assert done.returncode == 1, done.stderr
    assert f"pip install -e '.[{extra}]'" in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr
    assert not out.exists()


@pytest.mark.slow
def test_training_needs_no_extra(tmp_path: Path, warm: Warm) -> None:
    out = tmp_path / "out"
    words = [
        "train",
        str(write_set(tmp_path / "set")),
        "--out",
        str(out),
        "--iterations",
        "3",
        "--eval-interval",
        "1",
    ]
    done = warm.run("-m", "attacks", *words, cwd=ROOT, missing=MODULES)
    assert done.returncode == 0, done.stderr
    assert "SSIM" in done.stdout
    assert (out / "splat.ply").is_file()


# The examples of the documentation run: of the first page, of the Python API, and the
# scene


README = (ROOT / "README.md").read_text()
START, RENDERING = (
    (ROOT / "docs" / f"{name}.md").read_text() for name in ("start", "rendering")
)


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """An empty folder from which the scenes can be seen, and where a command may
    write.
    """
    (tmp_path / "scenes").symlink_to(ROOT / "scenes")
    return tmp_path


@pytest.mark.nightly
def test_the_python_example_runs(checkout: Path, warm: Warm) -> None:
    (example,) = blocks("python", START)
    assert len([line for line in example.splitlines() if line.strip()]) <= 20
    done = warm.run("-c", example, cwd=checkout)
    assert done.returncode == 0, done.stderr
    assert "success: True" in done.stdout
    assert (checkout / "attacked.ply").is_file()


@pytest.mark.nightly
def test_the_examples_of_the_api_run(checkout: Path, warm: Warm) -> None:
    """As they stand, but with the smallest set and a training of some steps."""
    dagger, curve, aim, cloak = blocks("python", (ROOT / "docs" / "api.md").read_text())
    capture = (
        "capture car --rgba --cameras hemisphere:12 --size 24 --samples 1"
        " --points 200 --out out/car-alone"
    )
    done = warm.run(
        "-c",
        "\n".join([dagger, curve, aim, "print('aim:', result.objective.name)"]),
        cwd=checkout,
    )
    assert done.returncode == 0, done.stderr
    assert "from the other cameras, target_attacked: " in done.stdout
    assert re.findall(r"^(\d\.0) (?:True|False) ", done.stdout, re.MULTILINE) == [
        "1.0",
        "2.0",
        "5.0",
    ]
    assert "aim: success" in done.stdout
    assert (checkout / "out" / "person" / "result.json").is_file()
    warm.run("-m", "attacks", *capture.split(), cwd=checkout, check=True)
    short = cloak.replace("iterations=2000", "iterations=8")
    assert short != cloak
    done = warm.run("-c", short, cwd=checkout)
    assert done.returncode == 0, done.stderr


def test_the_scene_example_renders(tmp_path: Path, warm: Warm) -> None:
    (example,) = blocks("xml", RENDERING)
    for name in re.findall(r'name="filename" value="([^"]+)"', example):
        shutil.copy(ROOT / "scenes" / name, tmp_path)
    (tmp_path / "example.xml").write_text(example)
    code = """
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
import mi_splat.render.plugins
import numpy as np
scene = mi.load_file("example.xml")
assert {"car.data", "car.opacities", "car.sh_coeffs"} <= set(mi.traverse(scene).keys())
picture = np.asarray(mi.render(scene))
assert picture.shape == (240, 320, 3), picture.shape
assert picture.std() > 0.05
"""
    done = warm.run("-c", code, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    done = warm.run(
        "-m", "attacks", "render", "example.xml", "--out", "street.png", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "street.png").is_file()


def test_the_setup_script_names_what_there_is() -> None:
    text = (ROOT / ".ci" / "setup.sh").read_text()
    for module, name in re.findall(r"from ([\w.]+) import (\w+)", text):
        assert hasattr(importlib.import_module(module), name), f"{module}.{name}"
