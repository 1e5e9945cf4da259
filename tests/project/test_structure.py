"""The shape of the project: layers, light packages, what the wheel holds, sizes,
names.
"""

import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from hatchling.builders.sdist import SdistBuilder

from mi_splat.capture.objects import OBJECTS
from tests.project.layers import (
    DIAGRAM,
    PACKAGES,
    ROOT,
    circle,
    diagram,
    edges,
    layer_of,
    modules,
)

LONGEST_MODULE = 900

LOADERS = r"attacks|attacks\.(detectors|classifiers|cli|cloak\.kinds|report)\b.*"
"""Parts of attacks that know a particular detector, or judge it, or read weights as
detectors do.
"""
TRACERS = r"capture\.(path_tracer|mitsuba_scene)"
RENDERERS = (
    r"mi_splat\.render\."
    r"(tile|ray|plugins|setup|variant|renderer|frozen_view|overdraw|volprim)\b.*"
)
RULES = {
    "mi_splat_knows_nothing_of_attacks": (r"mi_splat\b.*", r"attacks\b.*", r""),
    "the_audit_looks_at_the_rest_and_not_the_other_way_round": (
        r"mi_splat\.(?!audit\b|cli\.(audit|bound|info|train)$).*",
        r"mi_splat\.audit\b.*",
        r"",
    ),
    "training_sees_renderers_as_functions": (
        r"mi_splat\.training\b.*",
        rf"{RENDERERS}|mi_splat\.render\.scene_files",
        r"",
    ),
    "attacks_see_detectors_through_one_interface": (
        rf"(?!({LOADERS})$)attacks\b.*",
        r"attacks\.detectors\b.*",
        r"attacks\.detectors\.(base|registry)",
    ),
    "pgd_knows_nothing_of_splats": (
        r"attacks\.search\b.*",
        r"(mi_splat|attacks)\b.*",
        r"mi_splat\.(errors|attributes|fields)|attacks\.(optimisers|search\b.*)",
    ),
    "only_renderers_import_mitsuba": (
        rf"(?!({RENDERERS}|mi_splat\.({TRACERS}|render\.scene_files))$).*",
        r"(mitsuba|drjit)\b.*",
        r"",
    ),
    "one_module_knows_ultralytics_which_is_agpl": (
        r"(?!attacks\.detectors\.ultralytics$).*",
        r"ultralytics\b.*",
        r"",
    ),
}
"""What modules may not import, but for what."""


def test_every_module_has_a_layer() -> None:
    for package in PACKAGES:
        for name in modules(package):
            assert name == package or layer_of(name), (
                f"{name} has no place in LAYERS: give it one"
            )


def test_imports_run_one_way() -> None:
    for package in PACKAGES:
        for name, other in edges(package):
            here = layer_of(name)
            there = layer_of(other)
            if here and there:
                assert there[0] <= here[0], (
                    f"{name} imports {other}, which lies above it"
                )


def test_imports_have_no_circle() -> None:
    assert circle() == []


@pytest.mark.parametrize("rule", RULES)
def test_modules_import_only_what_they_may(rule: str) -> None:
    importer, imported, allowed = map(re.compile, RULES[rule])
    for name, other in (edge for package in PACKAGES for edge in edges(package)):
        if importer.fullmatch(name) and imported.fullmatch(other):
            assert allowed.fullmatch(other), f"{name} imports {other}"


def test_the_diagram_is_today_s() -> None:
    assert DIAGRAM.read_text() == diagram(), "run python -m tests.project.layers"


@pytest.mark.parametrize("folder", ["mi_splat", "attacks", "tests"])
def test_modules_are_short(folder: str) -> None:
    for path in (ROOT / folder).rglob("*.py"):
        lines = len(path.read_text().splitlines())
        assert lines <= LONGEST_MODULE, (
            f"{path.relative_to(ROOT)} has {lines} lines; split it"
        )


@pytest.mark.parametrize("package", PACKAGES)
def test_no_grab_bags(package: str) -> None:
    for name in modules(package):
        assert name.rsplit(".", 1)[-1].strip("_") not in (
            "utils",
            "util",
            "helpers",
            "common",
            "misc",
            "tools",
        ), name


def test_packages_and_help_import_nothing_heavy() -> None:
    code = """
import contextlib, io, sys
import attacks, mi_splat
from attacks.cli import COMMANDS, main
helps = ([*name.split(), "--help"] for name in COMMANDS)
for words in (["--help"], ["--version"], *helps):
    with contextlib.redirect_stdout(io.StringIO()) as text:
        assert main(words) == 0, words
    assert text.getvalue().strip(), words
heavy = {"torch", "torchvision", "mitsuba", "drjit", "numpy", "PIL", "scipy"}
heavy |= {"matplotlib", "plyfile", "transformers", "ultralytics", "viser"}
heavy |= {"trimesh", "jinja2", "tqdm", "unittest", "asyncio"}
assert not heavy & set(sys.modules), heavy & set(sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def tracked() -> list[Path]:
    """Files under version control, relative to the root."""
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("not a checkout")
    done = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return [Path(name) for name in done.stdout.split("\0") if name]


def test_nothing_names_this_machine_or_a_registry() -> None:
    # Put together here, so that this file does not name them either.
    forbidden = [
        "../" + "shared",
        "pypi" + ".org",
        "python" + "hosted",
        "/" + "root/",
        "/" + "work/",
        "down" + "load.pytorch",
    ]
    for path in tracked():
        if (
            path.suffix in (".py", ".md", ".toml", ".xml", ".sh", ".cff", ".json", "")
            and (ROOT / path).is_file()
        ):
            text = (ROOT / path).read_text(errors="replace")
            assert not [word for word in forbidden if word in text], path


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    command = [
        sys.executable,
        "-m",
        "hatchling",
        "build",
        "-t",
        "wheel",
        "-d",
        str(folder),
    ]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    (built,) = folder.glob("*.whl")
    return built


def test_wheel_holds_the_two_packages_and_nothing_else(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == set(PACKAGES)
    assert {f"{package}/py.typed" for package in PACKAGES} <= set(names)
    assert "attacks/report/page.html" in names
    assert not [name for name in names if name.endswith((".pyc", ".pth", ".ply"))]
    for package in PACKAGES:
        ours = {str(path.relative_to(ROOT)) for path in modules(package).values()}
        assert ours <= set(names)
    licences = {name.rsplit("/", 1)[-1] for name in names if ".dist-info/" in name}
    assert {"LICENSE", "NOTICE", "METADATA", "entry_points.txt"} <= licences


def test_wheel_holds_the_weights_and_their_card(wheel: Path) -> None:
    sizes = {
        info.filename: info.file_size for info in zipfile.ZipFile(wheel).infolist()
    }
    assert 0 < sizes["attacks/detectors/fasterrcnn_small.safetensors"] <= 12_000_000
    assert any(
        name.startswith("attacks/detectors/") and name.endswith(".md") for name in sizes
    )


def test_wheel_holds_the_objects(wheel: Path) -> None:
    held = {
        info.filename: info.compress_size for info in zipfile.ZipFile(wheel).infolist()
    }
    folder = "mi_splat/capture/objects"
    for name in OBJECTS:
        assert f"{folder}/{name.replace(' ', '_')}.glb" in held
    assert "attacks/cloak/textures/clock.glb" in held
    assert sum(size for name, size in held.items() if name.endswith(".glb")) < 9_000_000


def test_sdist_holds_no_weights_under_another_licence() -> None:
    names = [
        file.relative_path for file in SdistBuilder(str(ROOT)).recurse_included_files()
    ]
    assert any(name.startswith("scenes/") for name in names)
    assert not [name for name in names if name.startswith("scenes/detectors/")]


def test_wheel_works_outside_a_checkout(wheel: Path, tmp_path: Path) -> None:
    site = tmp_path / "site"
    elsewhere = tmp_path / "elsewhere"
    zipfile.ZipFile(wheel).extractall(site)
    elsewhere.mkdir()
    code = f"""
import sys
sys.path.insert(0, {str(site)!r})
import attacks.cli, attacks.detectors.catalogue, mi_splat
assert attacks.__file__.startswith({str(site)!r})
assert mi_splat.__file__.startswith({str(site)!r})
assert attacks.detectors.catalogue.SMALL_WEIGHTS.is_file()
main = attacks.cli.main
capture = "capture car --cameras orbit:1@20 --size 8 --samples 1 --points 9 --out car"
commands = ["detectors --json", "info example:car_street", capture]
sys.exit(any(main(command.split()) for command in commands))
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=elsewhere, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


SCENES = sorted((ROOT / "scenes").glob("*.xml"))


def test_scenes_are_shipped_and_small() -> None:
    assert {"car_street.xml", "stop_sign.xml"} <= {path.name for path in SCENES}
    files = [
        path
        for path in (ROOT / "scenes").rglob("*")
        if path.is_file() and path.suffix != ".pyc"
    ]
    weights = sum(
        path.stat().st_size for path in files if path.parent.name == "detectors"
    )
    pack = sum(
        path.stat().st_size
        for path in files
        if ROOT / "scenes" / "conformance" in path.parents
    )
    objects = sum(
        path.stat().st_size for path in files if path.parent.name == "objects"
    )
    others = sum(path.stat().st_size for path in files) - weights - pack - objects
    assert weights <= 7_000_000
    assert pack <= 6_000_000
    assert objects <= 6_000_000
    assert others <= 8_000_000


@pytest.mark.parametrize("path", SCENES, ids=lambda path: str(path.stem))
def test_every_scene_renders(path: Path) -> None:
    from mi_splat.render.renderer import Renderer
    from mi_splat.render.scene_files import read_scene

    loaded = read_scene(path)
    assert loaded.cameras
    assert len(loaded.objects) >= 2
    for camera in loaded.cameras.values():
        picture = Renderer(loaded.settings)(loaded.scene, camera).detach()
        assert tuple(picture.shape) == (camera.height, camera.width, 3)
        assert bool(picture.isfinite().all())
        assert float(picture.std()) > 0.05
