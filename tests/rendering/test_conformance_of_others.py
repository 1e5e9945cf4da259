"""What the page on conformance says of other programs: the rows are those of results in
the repository, and what shows that an adapter is right shows wrong ones.
"""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import conformance_probes as probes
import numpy as np
import pytest
from conformance_converters import CONVERTERS

from mi_splat.conformance import DEVIATIONS, Setup, conformance_scenes
from mi_splat.conformance.deviations import applied
from tests.project.layers import ROOT

FOLDER = ROOT / "benchmarks" / "conformance"
PAGE = (ROOT / "docs" / "conformance.md").read_text()
NAMES = {scene.name for scene in conformance_scenes()}
ADAPTERS = [path.relative_to(FOLDER) for path in sorted(FOLDER.glob("*/adapter*.js"))]


def result_of(adapter: Path) -> dict[str, Any]:
    name = adapter.stem.replace("adapter", "result")
    read: dict[str, Any] = json.loads(
        (FOLDER / adapter).with_name(f"{name}.json").read_text()
    )
    return read


def viewer_row(adapter: Path) -> str:
    """The row of the page, made from the result."""
    result = result_of(adapter)
    versions = [f"{name} {version}" for name, version in result["packages"].items()]
    shape = result["probes"]["shape"]
    compensated = ", compensated" if shape["compensated"] else ""
    images = result["images"]
    causes = [f"`{key}` ({len(found)})" for key, found in images["causes"].items()]
    cells = [
        f"`{adapter}`: {', '.join(versions)}",
        str(len(images["conform"])),
        f"{shape['low_pass']:g}{compensated}; {shape['falloff']}; {shape['rms']:.4f}",
        ", ".join(causes),
        str(len(images["unexplained"])),
    ]
    return f"| {' | '.join(cells)} |"


def converter_row(name: str) -> str:
    """The same of a converter."""
    result = json.loads((FOLDER / name / "result.json").read_text())
    counts = [
        f"`{ending}` {len(found['conform'])}"
        for ending, found in result["formats"].items()
    ]
    return f"| {name} {result['version']} | {', '.join(counts)} |"


@pytest.mark.parametrize("adapter", ADAPTERS, ids=str)
def test_rows_about_viewers_are_those_of_results(adapter: Path) -> None:
    assert viewer_row(adapter) in PAGE
    result = result_of(adapter)
    package = json.loads((FOLDER / adapter).with_name("package.json").read_text())
    assert result["packages"] == package["dependencies"]
    assert result["probes"]["adapter_is_right"]
    found = result["images"]
    assert {*found["conform"], *found["differ"], *found["missing"]} == NAMES
    explained = {name for names in found["causes"].values() for name in names}
    assert explained | {*found["unexplained"]} <= {*found["differ"]}
    assert set(found["causes"]) <= set(DEVIATIONS)


@pytest.mark.parametrize("name", CONVERTERS)
def test_rows_about_converters_are_those_of_results(name: str) -> None:
    assert converter_row(name) in PAGE
    result = json.loads((FOLDER / name / "result.json").read_text())
    assert set(result["formats"]) == set(CONVERTERS[name].endings)
    for found in result["formats"].values():
        assert {*found["conform"], *found["differ"], *found["refused"]} == NAMES


def test_every_program_on_the_page_has_a_result() -> None:
    rows = [line for line in PAGE.splitlines() if line.startswith("| ")]
    about = PAGE[PAGE.index("## Who conforms in what") :]
    expected = {*map(viewer_row, ADAPTERS), *map(converter_row, CONVERTERS)}
    others = [row for row in rows if row in about and row not in expected]
    assert [row.split(" | ")[0] for row in others] == ["| adapter", "| converter"]


# ------------------------------------------------------------------------------ probes


def seen(change: Callable[[Setup], Setup]) -> dict[str, Any]:
    """What is measured of a viewer that draws changed scenes, in bytes."""
    images = {}
    for name, scene in probes.scenes().items():
        image, _ = change(scene.setup).render()
        images[name] = np.round(np.clip(image, 0, 1) * 255) / 255
    return probes.measured(images)


@pytest.mark.parametrize(
    ("keys", "low_pass", "compensated", "falloff"),
    [
        ((), 0.3, False, "exponential"),
        (("low-pass=0.075", "falloff=normalised"), 0.075, False, "normalised"),
        (("compensation=on",), 0.3, True, "exponential"),
    ],
)
def test_a_shape_is_measured_behind_a_right_adapter(
    keys: tuple[str, ...], low_pass: float, compensated: bool, falloff: str
) -> None:
    found = seen(lambda setup: applied(setup, keys))
    assert found["adapter_is_right"], found
    shape = found["shape"]
    assert shape["low_pass"] == pytest.approx(low_pass, abs=0.03)
    assert (shape["compensated"], shape["falloff"]) == (compensated, falloff)
    assert shape["rms"] < 0.001


@pytest.mark.parametrize(
    "key",
    [
        *("order=file", "order=reversed", "colour-space=encoded", "channels=bgr"),
        *("shift=right", "pose=transposed", "orientation=turned", "up=y"),
        *("sh-direction=to-camera", "sh-order=xyz", "axes=about-x"),
        *("pixel-centres=whole-numbers", "focal-lengths=half"),
    ],
)
def test_a_wrong_adapter_is_found(key: str) -> None:
    def change(setup: Setup) -> Setup:
        if key == "focal-lengths=half":
            camera = setup.camera
            return replace(setup, camera=replace(camera, fx=camera.fx / 2))
        return applied(setup, [key])

    assert not seen(change)["adapter_is_right"]


def test_a_background_that_is_left_out_is_found() -> None:
    found = seen(lambda setup: replace(setup, background=(0.0, 0.0, 0.0)))
    assert not found["adapter_is_right"]
