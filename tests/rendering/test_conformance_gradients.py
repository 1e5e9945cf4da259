"""Gradients that are right conform, and of wrong ones the cause is named."""

import io
import json
import shutil
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from attacks import cli
from mi_splat.cli.conform import DIFFERS
from mi_splat.cli.conform_pack import camera_of
from mi_splat.conformance import compare_gradients, conformance_scenes, weights
from mi_splat.conformance.gradients import ATTRIBUTES, exact_gradients
from mi_splat.conformance.setups import C0, Setup
from mi_splat.oracle import (
    DEFAULT,
    Array,
    Splat,
    attribute_gradients,
    gradients,
    project,
    projected_gradients,
)
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.scene import GaussianScene

pytestmark = pytest.mark.shipped

PACK = Path("scenes/conformance/gradients")
SETUPS = {scene.name: scene.setup for scene in conformance_scenes()}
EXACT = {name: exact_gradients(setup) for name, setup in SETUPS.items()}
Found = dict[str, dict[str, Array]]


def changed(**factors: Any) -> Found:
    """The exact gradients, some attributes times a factor."""
    return {
        name: {key: arrays[key] * factors.get(key, 1.0) for key in ATTRIBUTES}
        for name, arrays in EXACT.items()
    }


def words(found: Found) -> set[str]:
    report = compare_gradients(found)
    assert not report.conforms
    assert report.unexplained == ()
    return {f"{cause.attribute}: {cause.text}" for cause in report.causes}


def test_the_shipped_gradients_conform() -> None:
    assert compare_gradients(PACK).conforms


def rasterised(name: str) -> dict[str, Array]:
    """The gradients of our rasteriser, which is in float32 and knows unit quaternions
    only.
    """
    splat = SETUPS[name].splat
    lengths = np.linalg.norm(splat.rotations, axis=1, keepdims=True)
    splat = splat._replace(rotations=splat.rotations / lengths)
    leaves = [torch.tensor(v, dtype=torch.float32).requires_grad_() for v in splat]
    camera = camera_of(SETUPS[name].camera)
    render = Renderer(RenderSettings(background=SETUPS[name].background))
    on_image = torch.tensor(weights(camera.height, camera.width), dtype=torch.float32)
    loss = (render(GaussianScene(*leaves), camera) * on_image).sum()
    torch.autograd.backward(loss)
    found = {}
    for key, leaf in zip(ATTRIBUTES, leaves, strict=True):
        assert leaf.grad is not None
        found[key] = leaf.grad.numpy().astype(float)
    found["rotations"] /= lengths
    return found


def test_a_renderer_in_float32_conforms() -> None:
    """Ours, which shares no code with the reference: rounding of gradients that are 0
    is no error.
    """
    report = compare_gradients({name: rasterised(name) for name in SETUPS})
    assert report.conforms, str(report)


@pytest.mark.parametrize("factor", [2.0, 0.5, 1.01, -1.0])
def test_a_factor_is_named(factor: float) -> None:
    for key in ATTRIBUTES:
        text = f"it is {factor:.4g} times too large"
        if factor < 0:
            text = "its sign is wrong"
        assert words(changed(**{key: factor})) == {f"{key}: {text}"}


def found(setup: Setup, **options: Any) -> Splat:
    """Gradients of a setup, with other options than its own."""
    on_image = weights(setup.camera.height, setup.camera.width)
    chosen = {"background": setup.background, **options}
    return gradients(setup.splat, setup.camera, on_image, **chosen)


def test_a_background_that_is_left_out_is_named() -> None:
    wrong = {
        name: found(setup, background=(0.0, 0.0, 0.0))._asdict()
        for name, setup in SETUPS.items()
    }
    assert words(wrong) == {
        f"{key}: the background is left out" for key in ATTRIBUTES if key != "sh"
    }


def with_fixed_colours(setup: Setup) -> Setup:
    """Gaussians that have from everywhere the colours that the camera sees."""
    splat = setup.splat
    colours = project(splat, setup.camera).colour
    fixed = splat._replace(
        scales=np.log(splat.scales),
        opacities=np.log(splat.opacities / (1 - splat.opacities)),
        sh=(colours[:, None] - 0.5) / C0,
    )
    return replace(setup, stored=fixed)


def test_directions_that_are_left_out_are_named() -> None:
    wrong = changed()
    for name, setup in SETUPS.items():
        wrong[name]["means"] = found(with_fixed_colours(setup)).means
    assert words(wrong) == {
        "means: the direction in which SH are evaluated is left out"
    }


def test_limits_that_pass_gradients_are_named() -> None:
    wrong = {}
    for name, setup in SETUPS.items():
        camera = setup.camera
        parts = projected_gradients(
            project(setup.splat, camera),
            camera,
            weights(camera.height, camera.width),
            background=setup.background,
            through_limit=True,
        )
        open_colours = replace(DEFAULT, clamp="none")
        passed = attribute_gradients(setup.splat, camera, parts, open_colours)
        limited = attribute_gradients(setup.splat, camera, parts)
        wrong[name] = limited._replace(sh=passed.sh)._asdict()
    limit = "an alpha at its limit passes its gradient on"
    assert words(wrong) == {
        "sh: a colour below 0 passes its gradient on",
        *(f"{key}: {limit}" for key in ATTRIBUTES if key != "sh"),
    }


def test_gradients_by_stored_values_are_named() -> None:
    wrong = changed()
    for name, setup in SETUPS.items():
        splat = setup.splat
        wrong[name]["scales"] *= splat.scales
        wrong[name]["opacities"] *= splat.opacities * (1 - splat.opacities)
    by_stored = "by the logarithm or logit of the file, not by the value"
    assert words(wrong) == {f"scales: {by_stored}", f"opacities: {by_stored}"}


def test_an_error_without_a_known_cause_is_unexplained() -> None:
    random = np.random.default_rng(0)
    wrong = changed()
    for arrays in wrong.values():
        arrays["scales"] *= random.uniform(0.5, 1.5, arrays["scales"].shape)
    report = compare_gradients(wrong)
    assert (report.causes, report.unexplained) == ((), ("scales",))


def test_gradients_that_are_missing_do_not_conform(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Neither a scene nor an attribute may be left out."""
    shutil.copytree(PACK, tmp_path, dirs_exist_ok=True)
    words = ["conform", "--gradients", str(tmp_path), "--json"]
    assert cli.main(words) == 0
    (tmp_path / "limits.npz").unlink()
    capsys.readouterr()
    assert cli.main(words) == DIFFERS
    assert json.loads(capsys.readouterr().out)["missing"] == ["limits"]
    for path in PACK.glob("*.npz"):
        np.savez(tmp_path / path.name, sh=np.load(path)["sh"])
    assert cli.main(words) == DIFFERS
    rows = json.loads(capsys.readouterr().out)["gradients"]
    assert not any(row["conforms"] for row in rows)
    assert rows[0]["relative_errors"]["means"] is None


def test_gradients_that_are_no_arrays_or_large_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "quaternion.npz"
    for content, said in (
        (np.zeros(10**6), "more than"),
        (np.array(["a", {}], dtype=object), "an array"),
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
        assert "quaternion.npz: expected arrays shaped as those of the pack" in error
        assert len(error.splitlines()) == 1
