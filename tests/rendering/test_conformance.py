"""The scenes of the 3DGS image: each wrong renderer shows in one of them, and its cause
is found.
"""

import io
import json
import re
import shutil
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from attacks import cli
from mi_splat.cli.conform import DIFFERS, _as_read
from mi_splat.conformance import DEVIATIONS, Deviation, Setup, error, find_deviations
from mi_splat.conformance_scenes import conformance_scenes
from mi_splat.datasets import load_dataset
from mi_splat.io import load_splat
from mi_splat.io.camera_records import recorded_cameras
from mi_splat.io.documents import save_png
from mi_splat.oracle import Array, render_rays
from mi_splat.render.renderer import Renderer, RenderSettings, load_floats, save_floats
from tests.browser import CHROMIUM

pytestmark = pytest.mark.shipped

SCENES = {scene.name: scene for scene in conformance_scenes()}
SETUPS = {name: scene.setup for name, scene in SCENES.items()}
RIGHT = {name: setup.render().image for name, setup in SETUPS.items()}
BY_NAME = {(deviation.switch, deviation.value): deviation for deviation in DEVIATIONS}


def shown(setup: Setup, *deviations: Deviation) -> Array:
    """The image of a renderer with deviations, in 8 bits."""
    for deviation in DEVIATIONS:
        setup = deviation.change(setup) if deviation in deviations else setup
    image: Array = np.round(np.clip(setup.render().image, 0, 1) * 255) / 255
    return image


@pytest.mark.parametrize(
    "deviation",
    DEVIATIONS,
    ids=lambda deviation: f"{deviation.switch}, {deviation.value}",
)
def test_every_deviation_shows(deviation: Deviation) -> None:
    images = (
        (deviation.change(setup).render().image, RIGHT[name])
        for name, setup in SETUPS.items()
    )
    shows = (
        changed.shape != right.shape or error(changed, right) > 5e-6
        for changed, right in images
    )
    assert any(shows), "no scene shows it in 8 bits"


@pytest.mark.parametrize(
    "names",
    [
        [("order", "by distance, not by depth")],
        [("largest alpha", "1"), ("quaternions", "conjugated")],
        [
            ("clamp of colours", "to 0 to 1"),
            ("low-pass filter", "none"),
            ("direction of SH", "from Gaussian to camera"),
        ],
    ],
    ids=len,
)
def test_causes_are_found(names: list[tuple[str, str]]) -> None:
    few = {
        name: SETUPS[name]
        for name in (
            "quaternion",
            "sh_1",
            "above_1",
            "order",
            "largest_alpha",
            "low_pass",
        )
    }
    images = {
        name: shown(setup, *(BY_NAME[key] for key in names))
        for name, setup in few.items()
    }
    found = find_deviations(images, few)
    assert {(cause.deviation.switch, cause.deviation.value) for cause in found} == set(
        names
    )
    assert [cause.decibels for cause in found] == sorted(
        (cause.decibels for cause in found), reverse=True
    )


def test_a_right_renderer_has_no_deviations() -> None:
    few = {name: SETUPS[name] for name in ("quaternion", "order")}
    assert (
        find_deviations({name: shown(setup) for name, setup in few.items()}, few) == []
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
        cli.main(["conform", "--export", str(folder), "--formats", ".ply", ".spz"]) == 0
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
        error = np.abs(
            image - np.stack([exr[channel] for channel in "RGB"], axis=2)
        ).max()
        assert error < (5e-5 if name == "far_from_origin" else 1e-5), name
        gradients = np.load(pack / "gradients" / f"{name}.npz")
        assert gradients["sh"].shape == tuple(splat.sh.shape)
    capsys.readouterr()
    assert cli.main(["conform", "--read", str(pack / "splats"), "--json"]) == 0
    files = json.loads(capsys.readouterr().out)["files"]
    assert len(files) == 2 * len(SETUPS) + 2  # two glTF
    assert max(row["largest_changes"]["opacity"] for row in files) < 0.01
    # also by the node of a glTF
    assert max(row["largest_changes"]["means, world units"] for row in files) < 1e-4
    assert cli.main(["conform", "--gradients", str(pack / "gradients")]) == 0


def test_rounding_of_a_gradient_of_zero_conforms_and_an_error_does_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Rotations of isotropic Gaussians have no gradient; what rounding leaves of it is
    no error.
    """
    random = np.random.default_rng(0)
    exact = dict(np.load("scenes/conformance/gradients/sh_1.npz"))
    rounded = {
        key: values + 1e-9 * random.normal(size=values.shape)
        for key, values in exact.items()
    }

    def judged(gradients: dict[str, Any]) -> tuple[int, dict[str, float]]:
        np.savez(tmp_path / "sh_1.npz", **gradients)
        status = cli.main(["conform", "--gradients", str(tmp_path), "--json"])
        (row,) = json.loads(capsys.readouterr().out)["gradients"]
        return status, row["relative_errors"]

    assert judged(rounded)[0] == 0
    wrong_rotations = {**rounded, "rotations": exact["rotations"] + 1e-4}
    status, errors = judged(wrong_rotations)
    assert status == 3
    assert [key for key, error in errors.items() if error > 1e-3] == ["rotations"]
    assert judged({**rounded, "means": 1.01 * exact["means"]})[0] == 3


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
    wrong = BY_NAME["order", "by distance, not by depth"]
    (tmp_path / "images").mkdir()
    for name in ("order", "quaternion"):
        save_png(
            (shown(SETUPS[name], wrong) * 255).round().astype(np.uint8),
            tmp_path / "images" / f"{name}.png",
        )
    save_png(np.zeros((8, 64, 3), dtype=np.uint8), tmp_path / "images" / "needles.png")
    words = ["conform", str(tmp_path / "images"), "--out", str(tmp_path / "page")]
    assert cli.main(words) == DIFFERS
    said = capsys.readouterr()
    assert "order             differs" in said.out
    assert "quaternion        conforms" in said.out
    assert "needles           differs   64 x 8 pixels" in said.out
    assert (
        "likely cause      order: by distance, not by depth (another choice; explains"
        in said.out
    )
    assert "no image of quaternion_length, quaternion_sign" in said.err
    assert (tmp_path / "page" / "order.png").is_file()
    assert not (tmp_path / "page" / "quaternion.png").exists()
    assert "| order | differs |" in (tmp_path / "page" / "conformance.md").read_text()


def test_images_of_a_ray_tracer_are_sent_to_its_reference(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("needles", "wide_angle"):
        image, _ = render_rays(SETUPS[name].splat, SETUPS[name].camera)
        save_png(
            (np.clip(image, 0, 1) * 255).round().astype(np.uint8),
            tmp_path / f"{name}.png",
        )
    assert cli.main(["conform", str(tmp_path)]) == DIFFERS
    assert (
        "2 images conform to the reference of --model ray: compare with that."
        in capsys.readouterr().out
    )
    assert cli.main(["conform", str(tmp_path), "--model", "ray"]) == 0
    assert "--model" not in capsys.readouterr().out


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
@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium")
def test_a_web_viewer_is_driven_by_its_adapter(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One that draws backgrounds alone, and refuses a file."""
    # which take a minute here
    monkeypatch.setattr("mi_splat.conformance.find_deviations", lambda *_: [])
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
    assert "no image of needles: " in said.err
    rows = {row["name"]: row for row in json.loads(said.out)["scenes"]}
    assert set(rows) == set(SETUPS) - {"needles"}
    with Image.open(tmp_path / "images" / "background.png") as image:
        assert image.convert("RGB").getpixel((0, 0)) == tuple(
            round(255 * v) for v in SETUPS["background"].background
        )


def test_what_a_format_cannot_hold_is_no_error(tmp_path: Path) -> None:
    kept = _as_read(SCENES["sh_layout"], ".splat").render().image
    save_png(
        (np.clip(kept, 0, 1) * 255).round().astype(np.uint8), tmp_path / "sh_layout.png"
    )
    assert cli.main(["conform", str(tmp_path)]) == DIFFERS
    assert cli.main(["conform", str(tmp_path), "--format", ".splat"]) == 0


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
                "expected images such as quaternion.png, got none; render what mi-splat"
                " conform --export writes"
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


def test_gradients_that_are_no_arrays_or_large_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "quaternion.npz"
    for content, said in (
        (np.zeros(10**6), "more than"),
        (np.array(["a", {}], dtype=object), "pickled objects"),
    ):
        np.savez_compressed(file, means=content)
        assert cli.main(["conform", "--gradients", str(tmp_path)]) == 1
        assert said in capsys.readouterr().err
    file.write_bytes(b"PK")
    assert cli.main(["conform", "--gradients", str(tmp_path)]) == 1


def damaged(whole: bytes) -> list[bytes]:
    """A ZIP of an array as it comes: with an unknown method, a broken stream, a
    password, cut off.
    """
    info = zipfile.ZipFile(io.BytesIO(whole)).infolist()[0]
    start = (
        info.header_offset
        + 30
        + len(info.filename)
        + int.from_bytes(whole[28:30], "little")
    )
    central = whole.index(b"PK\1\2")
    changes = (
        {start: 255, start + 1: 255},
        {central + 10: 97, 8: 97},
        {central + 8: 1, 6: 1},
        {central + 10: 12, 8: 12},
    )
    made = []
    for change in changes:
        data = bytearray(whole)
        for place, value in change.items():
            data[place] = value
        made.append(bytes(data))
    return [*made, whole[:-30]]


def test_damaged_gradients_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "quaternion.npz"
    np.savez_compressed(file, means=np.arange(3.0))
    for data in damaged(file.read_bytes()):
        file.write_bytes(data)
        assert cli.main(["conform", "--gradients", str(tmp_path)]) == 1
        error = capsys.readouterr().err
        assert "quaternion.npz: expected arrays shaped as those exported" in error
        assert len(error.splitlines()) == 1


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
