"""The scenes of the 3DGS image: each wrong renderer shows in one of them, and its cause
is found.
"""

import json
import os
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from attacks import cli
from mi_splat.cli.conform import DIFFERS
from mi_splat.cli.conform_pack import as_read
from mi_splat.conformance import (
    CAPABILITIES,
    DEVIATIONS,
    PROFILES,
    Setup,
    compare,
    conformance_scenes,
)
from mi_splat.conformance.capabilities import not_applicable
from mi_splat.conformance.comparison import as_meant
from mi_splat.conformance.deviations import applied, changes
from mi_splat.conformance.tolerances import difference, tolerance_of
from mi_splat.datasets import load_dataset
from mi_splat.errors import InvalidValueError
from mi_splat.io import load_splat
from mi_splat.io.camera_records import recorded_cameras
from mi_splat.io.documents import save_png
from mi_splat.oracle import Array
from mi_splat.render.renderer import Renderer, RenderSettings, load_floats, save_floats
from tests.browser import CHROMIUM

pytestmark = pytest.mark.shipped

SCENES = {scene.name: scene for scene in conformance_scenes()}
SETUPS = {name: scene.setup for name, scene in SCENES.items()}
RIGHT = {name: setup.render()[0] for name, setup in SETUPS.items()}
DEFAULTS = {
    "clamp=below-0",
    "order=depth",
    "low-pass=0.3",
    "compensation=off",
    "cut-off=none",
    "largest-alpha=0.99",
    "stop=1/10000",
    "jacobian-limit=1.3",
    "near=0.2",
}
"""What 3DGS does, which other profiles may not do."""
OTHERS = [name for name in SETUPS if name not in ("order", "quaternion", "needles")]


BESIDE = {"dots=smallest-dropped": ["low-pass=0.075"]}
"""Beside what a deviation shows, where it does not alone."""


def shown(setup: Setup, *keys: str) -> Array:
    """The image of a renderer with deviations, in bytes."""
    return in_bytes(applied(setup, keys).render()[0])


def in_bytes(image: Array) -> Array:
    found: Array = np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)
    return found


@pytest.mark.parametrize("key", [key for key in DEVIATIONS if key not in DEFAULTS])
def test_every_deviation_shows(key: str) -> None:
    beside = BESIDE.get(key, [])
    shows = (
        not tolerance_of(setup, 8).holds(
            difference(
                shown(setup, *beside, key) / 255, applied(setup, beside).render()[0]
            )
        )
        for setup in SETUPS.values()
    )
    assert any(shows), "no scene shows it in 8 bits"


@pytest.mark.parametrize("factor", [-1.0, 0.0, 0.5, 0.75, 0.9, 1.1, 1.25, 1.5, 2.0])
@pytest.mark.parametrize("coefficient", range(1, 16))
def test_a_wrong_constant_of_sh_does_not_conform_in_8_bits(
    coefficient: int, factor: float
) -> None:
    holds = []
    for name in ("sh_1", "sh_2", "sh_3", "sh_layout"):
        setup = SETUPS[name]
        sh = setup.stored.sh.astype(np.float64)
        if sh.shape[1] > coefficient:
            sh[:, coefficient] *= factor
            wrong = replace(setup, stored=setup.stored._replace(sh=sh))
            error = difference(shown(wrong) / 255, RIGHT[name])
            holds.append(tolerance_of(setup, 8).holds(error))
    assert not all(holds)


def test_what_3dgs_does_is_no_deviation_of_it() -> None:
    for key in DEFAULTS:
        assert not any(changes(setup, DEVIATIONS[key]) for setup in SETUPS.values()), (
            key
        )


def test_sizes_in_pixels_stay() -> None:
    small, large = (
        {w.name: w.setup for w in conformance_scenes(size)}["low_pass"]
        for size in (64, 256)
    )
    sizes = [
        np.exp(setup.stored.scales[:25].astype(float)) * setup.camera.fx
        for setup in (small, large)
    ]
    np.testing.assert_allclose(sizes[0], sizes[1], rtol=1e-5)


NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")


def assert_same_text(text: str, expected: str, *, tolerance: float) -> None:
    """The same words, and the same numbers but for rounding, which depends on the
    processor.
    """
    assert NUMBER.sub("#", text) == NUMBER.sub("#", expected)
    numbers, expected_numbers = (
        np.array(list(map(float, NUMBER.findall(t)))) for t in (text, expected)
    )
    np.testing.assert_allclose(
        numbers, expected_numbers, rtol=tolerance, atol=tolerance
    )


@pytest.fixture(scope="module")
def pack(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("conformance") / "pack"
    assert (
        cli.main(
            ["conform", "--export", str(folder), "--formats", ".ply", ".spz", ".glb"]
        )
        == 0
    )
    return folder


def test_the_shipped_pack_is_what_the_command_writes(pack: Path) -> None:
    shipped = Path("scenes/conformance")
    files = {path.relative_to(pack) for path in pack.rglob("*") if path.is_file()}
    assert files == {
        path.relative_to(shipped) for path in shipped.rglob("*") if path.is_file()
    }
    for path in files:
        if path.suffix == ".exr":
            old, new = (load_floats(folder / path) for folder in (shipped, pack))
        elif path.suffix == ".npz":
            old, new = (dict(np.load(folder / path)) for folder in (shipped, pack))
        elif path.suffix in (".ply", ".html"):
            assert (shipped / path).read_bytes() == (pack / path).read_bytes(), path
            continue
        elif path.suffix == ".txt" or path.name == "cameras.json":
            assert_same_text(
                (pack / path).read_text(), (shipped / path).read_text(), tolerance=1e-9
            )
            continue
        else:
            continue
        for key in old:
            np.testing.assert_allclose(
                new[key], old[key], rtol=1e-4, atol=1e-5, err_msg=f"{path} {key}"
            )


def test_text_is_compared_with_a_tolerance_for_numbers_only() -> None:
    """Processors round the last digits of a pose in their own ways."""
    line = "1 0.5286830463685022 -0.7232121889523843 6.1e-16 2 a.png"
    assert_same_text(
        line.replace("022", "031").replace("6.1e-16", "-2.3e-16"), line, tolerance=1e-9
    )
    for other in (
        line.replace("0.52", "0.53"),
        line.replace("-0.7", "0.7"),
        line.replace("a.png", "b.png"),
        line[:-1],
    ):
        with pytest.raises(AssertionError):
            assert_same_text(other, line, tolerance=1e-9)


def test_our_renderer_conforms_from_the_exported_files(
    pack: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cameras = recorded_cameras(pack / "cameras.json")
    assert cameras is not None
    assert (
        set(cameras)
        == set(SETUPS)
        == {path.stem for path in (pack / "splats").glob("*.ply")}
    )
    assert len(load_dataset(pack).cameras) == len(SETUPS)
    for name in set(SETUPS) - {"broken_rows"}:
        splat = load_splat(pack / "splats" / f"{name}.ply")
        image = Renderer(RenderSettings(background=SETUPS[name].background))(
            splat, cameras[name]
        ).numpy()
        exr = load_floats(pack / "images" / f"{name}.exr")
        exact = np.stack([exr[channel] for channel in "RGB"], axis=2)
        error = np.abs(image - exact).max() / max(1.0, exact.max())
        assert error < (5e-5 if name == "far_from_origin" else 1e-5), name
        gradients = np.load(pack / "gradients" / f"{name}.npz")
        assert gradients["sh"].shape == tuple(splat.sh.shape)
    capsys.readouterr()
    assert cli.main(["conform", "--read", str(pack / "splats"), "--json"]) == 0
    files = json.loads(capsys.readouterr().out)["files"]
    assert len(files) == 3 * len(SETUPS)
    assert max(row["largest_changes"]["opacity"] for row in files) < 0.01
    # also by the node of a glTF
    assert max(row["largest_changes"]["means, world units"] for row in files) < 1e-4
    assert cli.main(["conform", "--gradients", str(pack / "gradients")]) == 0


def test_a_converted_file_that_cannot_be_read_is_one_of_several(
    pack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copy(pack / "splats" / "order.ply", tmp_path)
    shutil.copy(pack / "splats" / "sh_1.spz", tmp_path / "quaternion.spz")
    (tmp_path / "order.spz").write_bytes(b"no splat")
    assert cli.main(["conform", "--read", str(tmp_path), "--json"]) == DIFFERS
    other, good, bad = json.loads(capsys.readouterr().out)["files"]
    assert [row["conforms"] for row in (other, good, bad)] == [False, True, False]
    assert good["largest_changes"]["opacity"] == 0
    assert "order.spz" in bad["unreadable"]


def test_images_of_a_wrong_viewer_are_explained(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "images").mkdir()
    for name in ("order", "quaternion"):
        image = shown(SETUPS[name], "order=distance")
        save_png(image, tmp_path / "images" / f"{name}.png")
    save_png(np.zeros((8, 64, 3), dtype=np.uint8), tmp_path / "images" / "needles.png")
    words = ["conform", str(tmp_path / "images"), "--out", str(tmp_path / "page")]
    assert cli.main(words) == DIFFERS
    said = capsys.readouterr()
    assert "order             differs" in said.out
    assert "quaternion        conforms" in said.out
    assert "needles           differs   64 x 8 pixels" in said.out
    assert (
        "likely cause      order=distance: sorted by distance, not by depth (another"
        " choice; explains order)" in said.out
    )
    assert f"1 of {len(SETUPS)} images conform to 3dgs." in said.out
    assert "missing           quaternion_length, quaternion_sign" in said.out
    assert "unexplained       needles" in said.out
    assert (tmp_path / "page" / "order.png").is_file()
    assert not (tmp_path / "page" / "quaternion.png").exists()
    assert "| order | differs |" in (tmp_path / "page" / "conformance.md").read_text()


@pytest.fixture
def no_causes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Causes are not looked for, which takes a while."""
    where = "mi_splat.conformance.comparison.find_causes"
    monkeypatch.setattr(where, lambda *_: [])


@pytest.mark.usefixtures("no_causes")
def test_images_of_a_ray_tracer_are_sent_to_its_reference(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, setup in SETUPS.items():
        image, _ = replace(setup, model="ray").render()
        save_png(in_bytes(image), tmp_path / f"{name}.png")
    assert cli.main(["conform", str(tmp_path)]) == DIFFERS
    said = capsys.readouterr().out
    assert "More images conform to the profile ray: compare with it." in said
    assert cli.main(["conform", str(tmp_path), "--profile", "ray"]) == 0
    assert "the profile" not in capsys.readouterr().out


def test_images_that_are_missing_are_no_success(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_png(in_bytes(RIGHT["quaternion"]), tmp_path / "quaternion.png")
    assert cli.main(["conform", str(tmp_path)]) == DIFFERS
    assert "missing           quaternion_length" in capsys.readouterr().out
    others = [name for name in SETUPS if name != "quaternion"]
    assert cli.main(["conform", str(tmp_path), "--accept", *others]) == 0
    assert "1 of 1 images conform" in capsys.readouterr().out


def test_scenes_that_need_what_a_renderer_lacks_are_not_applicable(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    needed = {
        "off-centre": {"principal_point"},
        "non-square-pixels": {"focal_lengths"},
        "non-square-images": {"portrait"},
        "roll": {"rolled", "from_below"},
        "vertical": {"from_above"},
        "wide-angle": {"wide_angle"},
        "near": {"near_plane", "near_and_large"},
        "background": {"background", "anisotropic", "limits"},
    }
    assert {key: {*not_applicable(SETUPS, [key])} for key in CAPABILITIES} == needed
    lacking = {*needed["off-centre"], *needed["near"]}
    for name in SETUPS:
        if name not in lacking:
            save_png(in_bytes(RIGHT[name]), tmp_path / f"{name}.png")
    assert cli.main(["conform", str(tmp_path)]) == DIFFERS
    assert "not applicable" not in capsys.readouterr().out
    words = ["conform", str(tmp_path), "--cannot", "off-centre", "near"]
    assert cli.main(words) == 0
    said = capsys.readouterr().out
    assert f"{len(SETUPS) - 3} of {len(SETUPS) - 3} images conform" in said
    assert "not applicable    principal_point: needs off-centre" in said
    assert "missing" not in said
    # an image of it is not counted, even a wrong one
    save_png(in_bytes(1 - RIGHT["near_plane"]), tmp_path / "near_plane.png")
    assert cli.main(words) == 0
    capsys.readouterr()
    assert cli.main([*words, "off-center"]) == 1
    assert "did you mean off-centre?" in capsys.readouterr().err


@pytest.mark.usefixtures("no_causes")
def test_a_difference_that_is_meant_is_accepted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("order", "quaternion", "needles"):
        image = shown(SETUPS[name], "order=distance")
        save_png(image, tmp_path / f"{name}.png")
    words = ["conform", str(tmp_path), "--accept", *OTHERS]
    assert cli.main(words) == DIFFERS
    assert cli.main([*words, "order=distance"]) == 0
    # a difference that is accepted is asked for
    assert cli.main([*words, "order=file"]) == DIFFERS
    capsys.readouterr()
    assert cli.main([*words, "order=distanse"]) == 1
    assert "did you mean order=distance?" in capsys.readouterr().err


@pytest.mark.usefixtures("no_causes")
@pytest.mark.parametrize("profile", PROFILES)
def test_a_renderer_conforms_to_its_own_profile_only(profile: str) -> None:
    meant = {name: as_meant(setup, profile) for name, setup in SETUPS.items()}
    images = {name: in_bytes(setup.render()[0]) for name, setup in meant.items()}
    assert compare(images, profile=profile).conforms
    if profile != "3dgs":
        few = {name: images[name] for name in ("near_plane", "low_pass", "cut_off")}
        names = [name for name in SETUPS if name not in few]
        assert not compare(few, accept=names).conforms


def test_a_wrong_size_is_refused_at_once() -> None:
    with pytest.raises(InvalidValueError, match="64, 256, 512 pixels on each side"):
        compare({"quaternion": np.zeros((100, 100, 3), dtype=np.uint8)})


ADAPTER = """
export async function run(url, camera, canvas, settled) {
  if (camera.name === "needles") throw new Error("refused");
  const drawing = canvas.getContext("2d");
  const shade = camera.background.map((value) => Math.round(255 * value)).join(",");
  const bytes = new Uint8Array(await (await fetch(url)).arrayBuffer());
  return settled(() => {
    drawing.fillStyle = bytes[0] === 112 ? `rgb(${shade})` : "red"; // "p" of "ply"
    drawing.fillRect(0, 0, canvas.width, canvas.height);
  });
}
"""


@pytest.mark.slow
@pytest.mark.usefixtures("no_causes")
@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium")
def test_a_web_viewer_is_driven_by_its_adapter(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One that draws backgrounds alone, and refuses a file."""
    (tmp_path / "adapter.js").write_text(ADAPTER)
    words = [
        "conform",
        str(tmp_path / "images"),
        "--browser",
        str(tmp_path / "adapter.js"),
        "--json",
    ]
    assert cli.main(words) == DIFFERS
    said = capsys.readouterr()
    assert "adapter.js, needles: Error: refused" in said.err
    document = json.loads(said.out)
    assert document["missing"] == ["needles"]
    rows = {row["name"] for row in document["scenes"]}
    assert rows == set(SETUPS) - {"needles"}
    with Image.open(tmp_path / "images" / "background.png") as image:
        assert image.convert("RGB").getpixel((0, 0)) == tuple(
            round(255 * v) for v in SETUPS["background"].background
        )


FAKE = """#!{python}
import sys, urllib.request
page = sys.argv[-1]
base = page.rpartition("/")[0]
def get(path):
    return urllib.request.urlopen(f"{{base}}/{{path}}").read().decode(errors="replace")
def put(path, body):
    request = urllib.request.Request(f"{{base}}/{{path}}", data=body, method="PUT")
    urllib.request.urlopen(request).read()
assert '<script type="importmap">{{"imports": {{"three": "./three.js"}}}}</script>' in (
    get("viewer.html?send")
)
assert get("three.js") == "export const three = 3;"
assert get("splats/order.ply").startswith("ply")
put("error/needles", b"TypeError: x is undefined")
put("image/../order", b"elsewhere")
put("image/order", open({image!r}, "rb").read())
put("end", b"")
"""


@pytest.mark.usefixtures("no_causes")
def test_errors_of_an_adapter_are_shown_and_modules_beside_it_are_served(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """To what asks for them as a browser does."""
    save_png(in_bytes(RIGHT["order"]), tmp_path / "right.png")
    script = FAKE.format(python=sys.executable, image=str(tmp_path / "right.png"))
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "chromium").write_text(script)
    (tmp_path / "bin" / "chromium").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path / "bin"), prepend=os.pathsep)
    (tmp_path / "adapter.js").write_text('import { three } from "three";')
    (tmp_path / "three.js").write_text("export const three = 3;")
    (tmp_path / "importmap.json").write_text('{"imports": {"three": "./three.js"}}')
    images = tmp_path / "images"
    words = ["conform", str(images), "--browser", str(tmp_path / "adapter.js")]
    assert cli.main(words) == DIFFERS
    said = capsys.readouterr()
    assert "adapter.js, needles: TypeError: x is undefined" in said.err
    assert f"1 of {len(SETUPS)} images conform to 3dgs." in said.out
    assert [path.name for path in images.glob("*.png")] == ["order.png"]


@pytest.mark.usefixtures("no_causes")
def test_what_a_format_cannot_hold_is_no_error(tmp_path: Path) -> None:
    kept, _ = as_read(SCENES["sh_layout"], ".splat").render()
    save_png(in_bytes(kept), tmp_path / "sh_layout.png")
    others = [name for name in SETUPS if name != "sh_layout"]
    words = ["conform", str(tmp_path), "--accept", *others]
    assert cli.main(words) == DIFFERS
    assert cli.main([*words, "--format", ".splat"]) == 0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            [],
            (
                "expected one of a folder of images, --list, --export, --read and"
                " --gradients"
            ),
        ),
        (["--list", "--read", "."], "pass only one"),
        (
            ["EMPTY"],
            (
                "expected images such as quaternion.png, got none; render the splats of"
                " the pack"
            ),
        ),
        (["--read", "EMPTY"], "expected files such as quaternion.spz, got none"),
        (["--export", "EMPTY/pack", "--formats", ".obj"], ".obj"),
    ],
)
def test_bad_calls_say_what_to_do(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(
        ["conform", *(word.replace("EMPTY", str(tmp_path)) for word in words)]
    ) in (1, 2)
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_damaged_float_image_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plane = np.random.default_rng(0).random((32, 32), np.float32)
    save_floats({"R": plane, "G": plane, "B": plane}, tmp_path / "whole.exr")
    whole = (tmp_path / "whole.exr").read_bytes()
    (tmp_path / "whole.exr").unlink()
    for data in (whole[:2000], whole[:400], whole[:-1500] + bytes(1500)):
        (tmp_path / "quaternion.exr").write_bytes(data)
        assert cli.main(["conform", str(tmp_path)]) in (1, DIFFERS)
        assert "Traceback" not in capsys.readouterr().err
    (tmp_path / "quaternion.exr").write_bytes(whole[:2000])
    assert cli.main(["conform", str(tmp_path)]) == 1
    assert "quaternion.exr: expected an OpenEXR image" in capsys.readouterr().err
