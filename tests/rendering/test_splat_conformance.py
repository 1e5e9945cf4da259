"""The distribution `splat-conformance`, as its users have it: with NumPy and nothing
else.
"""

import json
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mi_splat.conformance.files import read_images
from mi_splat.errors import InvalidValueError
from tests.project.layers import ROOT, imports, modules

ONLY_NUMPY = """
import sys
sys.modules.update(dict.fromkeys(["torch", "PIL", "scipy", "mitsuba", "mi_splat"]))
"""
"""Without the packages that are there in the environment of the tests."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of packages with the wheel in it."""
    folder = tmp_path_factory.mktemp("distribution")
    words = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d"]
    source = ROOT / ".ci" / "splat-conformance"
    subprocess.run([*words, folder], cwd=source, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    zipfile.ZipFile(wheel).extractall(folder / "site")
    return folder / "site"


def ran(site: Path, folder: Path, code: str) -> subprocess.CompletedProcess[str]:
    words = [
        sys.executable,
        "-c",
        f"{ONLY_NUMPY}sys.path.insert(0, {str(site)!r})\n{code}",
    ]
    return subprocess.run(words, cwd=folder, capture_output=True, text=True)


def commanded(site: Path, folder: Path, *words: str) -> tuple[int, str]:
    """The exit status of a command and what it has said."""
    done = ran(
        site,
        folder,
        f"from splat_conformance.command import main\nsys.exit(main({list(words)!r}))",
    )
    assert "Traceback" not in done.stderr, done.stderr
    return done.returncode, done.stdout + done.stderr


def test_conformance_imports_only_what_its_wheel_holds() -> None:
    allowed = ("mi_splat.conformance", "mi_splat.oracle", "mi_splat.maths.srgb")
    for name, path in modules("mi_splat").items():
        if name.startswith("mi_splat.conformance"):
            for other in imports(name, path):
                inside = other.startswith(allowed) or other == "mi_splat.errors"
                assert inside or not other.startswith(("mi_splat", "attacks")), other


@pytest.mark.shipped
@pytest.mark.parametrize(
    ("words", "without"),
    [
        (["--list"], ["torch", "PIL", "scipy", "mitsuba"]),
        (["--gradients", "scenes/conformance/gradients"], ["torch", "PIL", "scipy"]),
        (["scenes/conformance/images"], ["torch", "mitsuba"]),
    ],
)
def test_the_command_of_mi_splat_needs_no_torch(
    words: list[str], without: list[str]
) -> None:
    code = (
        "import sys; from attacks.cli import main;"
        f" sys.modules.update(dict.fromkeys({without!r}));"
        " sys.exit(main(['conform', *sys.argv[1:]]))"
    )
    command = [sys.executable, "-c", code, *words]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "quaternion" in done.stdout


@pytest.mark.shipped
def test_the_pack_is_compared_with_nothing_but_numpy(
    site: Path, tmp_path: Path
) -> None:
    assert commanded(site, tmp_path, "export", "pack")[0] == 0
    assert commanded(site, tmp_path, "export", "pack")[0] == 1  # it exists
    status, said = commanded(site, tmp_path, "compare", "pack/images")
    assert status == 0, said
    status, said = commanded(site, tmp_path, "gradients", "pack/gradients", "--json")
    assert status == 0, said
    assert json.loads(said)["conforms"]
    (tmp_path / "pack" / "images" / "order.png").unlink()
    status, said = commanded(site, tmp_path, "compare", "pack/images")
    assert (status, said.splitlines()[-1]) == (3, "missing           order")
    words = ("compare", "pack/images", "--accept", "order", "order=distanse")
    status, said = commanded(site, tmp_path, *words)
    assert (status, "did you mean order=distance?" in said) == (1, True)


SHIM = """#!{python}
import sys
{only_numpy}
sys.path.insert(0, {site!r})
from splat_conformance.command import main
sys.exit(main())
"""
RENDERER = """#!/bin/sh
test "$1 $2 $3 $4 $5" = "--splats pack/splats --cameras pack/cameras.json --out"
ls "$2" "$4" && cp -r pack/images "$6"
"""
"""That draws what it is compared with."""


def test_the_job_of_the_read_me_runs_as_it_is_written(
    site: Path, tmp_path: Path
) -> None:
    text = (ROOT / ".ci" / "splat-conformance" / "README.md").read_text()
    job = text.partition("```yaml\n")[2].partition("```")[0]
    assert len(job.splitlines()) <= 15
    install, *steps = re.findall(r"- run: (.*)", job)
    assert install.startswith('pip install "git+')
    shim = SHIM.format(python=sys.executable, only_numpy=ONLY_NUMPY, site=str(site))
    for name, script in (("splat-conformance", shim), ("my-renderer", RENDERER)):
        (tmp_path / name).write_text(script)
        (tmp_path / name).chmod(0o755)
    path = f"{tmp_path}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["sh", "-ec", "\n".join(steps)],
        cwd=tmp_path,
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert "46 of 46 images conform to 3dgs." in done.stdout


def test_the_plug_in_holds_a_renderer_to_the_references(
    site: Path, tmp_path: Path
) -> None:
    (tmp_path / "test_renderer.py").write_text(
        "from splat_conformance import conformance_scenes\n"
        "OTHERS = [s.name for s in conformance_scenes() if s.name != 'order']\n"
        "def test_right(conforms_to_3dgs):\n"
        "    conforms_to_3dgs(lambda scene: scene.render()[0], accept=OTHERS)\n"
        "def test_wrong(conforms_to_3dgs):\n"
        "    conforms_to_3dgs(lambda scene: scene.render()[0] / 2, accept=OTHERS)\n"
    )
    # The wheel's entry point says where the plug-in is.
    words = ["-p", "no:cacheprovider", "-q", "test_renderer.py"]
    done = ran(site, tmp_path, f"import pytest\nsys.exit(pytest.main({words!r}))")
    assert "1 failed, 1 passed" in done.stdout, done.stdout + done.stderr
    assert "0 of 1 images conform to 3dgs." in done.stdout


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L", "LA"])
def test_png_is_read_as_pillow_reads_it(mode: str, tmp_path: Path) -> None:
    """With every filter that an encoder chooses."""
    random = np.random.default_rng(0)
    smooth = np.linspace(0, 255, 40)[:, None, None] * np.linspace(0.2, 1, 30)[:, None]
    noise = random.integers(0, 30, (40, 30, 4))
    pixels = np.clip(smooth + noise, 0, 255).astype(np.uint8)
    image = Image.fromarray(pixels, "RGBA").convert(mode)
    image.save(tmp_path / "order.PNG")
    found = read_images(tmp_path, ["order"])["order"]
    expected = np.asarray(image.convert("RGBA")) / 255
    expected[..., :3] *= expected[..., 3:]
    count = found.values.shape[2]
    np.testing.assert_allclose(found.values, expected[..., :count], atol=1e-12)
    assert count == (4 if "A" in mode else 3)
    assert found.bits == 8


def test_an_array_with_an_unfinished_header_is_refused(tmp_path: Path) -> None:
    header = b"{'descr': ("
    magic = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little")
    path = tmp_path / "lone.npy"
    path.write_bytes(magic + header)
    with pytest.raises(InvalidValueError, match=r"lone.npy: expected an image"):
        read_images(tmp_path, ["lone"])
