"""Every rule of lint has a file that it finds, and one that it does not; the validator
of glTF, and what is refused.
"""

import dataclasses
import json
import os
import pickle
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image

from attacks import cli
from attacks.report.results import read_section
from mi_splat import load_splat, save_splat
from mi_splat.audit import linting
from mi_splat.audit.linting import lint_file, lint_scene, validate
from mi_splat.audit.rules import RULES, Rule, Stored
from mi_splat.cameras.camera import Camera, look_at
from mi_splat.cameras.lens import Lens
from mi_splat.io import SplatFileError
from mi_splat.io.formats.gltf import open_glb
from mi_splat.io.loaded import Arrays
from mi_splat.io.parsing import Fields
from mi_splat.io.splat_files import write_splat_file
from mi_splat.render.overdraw import most_layers
from mi_splat.scene import GaussianScene
from tests.audit import scenes
from tests.gaussians import splat_names

pytestmark = pytest.mark.shipped

COUNT = 60
BY_NAME = {rule.name: rule for rule in RULES}


@pytest.fixture(autouse=True, scope="module")
def _small_pictures() -> object:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(linting, "SIZE", 256)
        yield


def cloud(count: int = COUNT, *, degree: int = 1, seed: int = 0) -> GaussianScene:
    """Honest: small round Gaussians in a ball, of different colours."""
    generator = torch.Generator().manual_seed(seed)
    sh = 0.3 * torch.randn(count, (degree + 1) ** 2, 3, generator=generator)
    return GaussianScene(
        means=torch.randn(count, 3, generator=generator),
        scales=torch.full((count, 3), 0.05),
        rotations=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        opacities=torch.full((count,), 0.9),
        sh=sh,
    )


def arrays_of(scene: GaussianScene) -> Arrays:
    values = (value.numpy().copy() for value in scene.tensors())
    return dict(
        zip(("means", "scales", "rotations", "opacities", "sh"), values, strict=True)
    )


def stored(arrays: Arrays) -> Stored:
    from mi_splat.io.loaded import validated

    return Stored.of(validated(*arrays.values()))


def _set(name: str, value: float, rows: int = 1) -> Callable[[Arrays], None]:
    def change(arrays: Arrays) -> None:
        arrays[name][3 : 3 + rows] = value  # type: ignore[index]

    return change


def _thin(ratio: float) -> Callable[[Arrays], None]:
    def change(arrays: Arrays) -> None:
        arrays["scales"][3] = (0.5, 0.5 / ratio, 0.5 / ratio)

    return change


def _repeat(rows: int) -> Callable[[Arrays], None]:
    def change(arrays: Arrays) -> None:
        for value in arrays.values():
            value[3 : 3 + rows] = value[40]

    return change


def _bands(rows: slice) -> Callable[[Arrays], None]:
    def change(arrays: Arrays) -> None:
        arrays["sh"][rows, 1:] = 0

    return change


def _nothing(arrays: Arrays) -> None:
    pass


CASES: dict[
    str, tuple[Callable[[Arrays], None], Callable[[Arrays], None], list[int]]
] = {
    "not-finite": (_set("means", np.nan), _set("means", 1e8), [3]),
    "out-of-range": (_set("scales", 0.0), _set("scales", 1e-9), [3]),
    "quaternion": (_set("rotations", 0.0), _set("rotations", 0.1), [3]),
    "giant": (_set("scales", 9.0), _set("scales", 7.0), [3]),
    "needle": (_thin(2000), _thin(500), [3]),
    "invisible": (
        _set("opacities", 0.003, 4),
        _set("opacities", 0.004, 4),
        [3, 4, 5, 6],
    ),
    "duplicate": (_repeat(2), _nothing, [4, 40]),
    "colour": (_set("sh", -4.0), _set("sh", -1.0), [3]),
    "empty-degree": (_bands(slice(None)), _nothing, list(range(COUNT))),
    "partial-degree": (_bands(slice(4, None)), _bands(slice(4, 20)), [0, 1, 2, 3]),
}
"""Of each rule: what it must find, what it must not find, and the rows of the first."""


OF_FILES = {"infinite"}
"""Rules about how a file holds a value, which no array shows; tests/io has them."""


@pytest.mark.parametrize(
    "rule",
    [rule for rule in RULES if rule.name not in OF_FILES],
    ids=lambda rule: str(rule.name),
)
def test_each_rule_finds_its_rows_and_only_these(rule: Rule) -> None:
    bad, good, rows = CASES[rule.name]
    broken = arrays_of(cloud())
    fine = arrays_of(cloud())
    bad(broken)
    good(fine)
    finding = rule(stored(broken))
    assert finding is not None
    assert list(finding.rows) == rows
    assert finding.count == len(rows)
    assert finding.severity == rule.severity
    assert finding.reason.endswith(".")
    assert rule(stored(fine)) is None
    assert rule(stored(arrays_of(cloud()))) is None


@pytest.mark.parametrize("made", [scenes.glossy, scenes.noisy, scenes.velvet])
def test_honest_gloss_and_noise_have_no_finding(
    made: Callable[[scenes.Made], scenes.Made],
) -> None:
    assert lint_scene(made(scenes.standing("suitcase", count=300)).scene).findings == ()


@pytest.mark.parametrize(
    "suffix", [".ply", ".compressed.ply", ".glb", ".spz", ".sog", ".splat"]
)
def test_no_converter_makes_a_finding(suffix: str, tmp_path: Path) -> None:
    save_splat(cloud(400, degree=0), tmp_path / f"s{suffix}")
    assert lint_file(tmp_path / f"s{suffix}").findings == ()


# --- cost


def test_overdraw_is_the_length_of_the_rasteriser_s_lists() -> None:
    import mitsuba as mi

    from mi_splat.render.tile import layouts, pinhole
    from mi_splat.render.tile.frozen import aligned
    from mi_splat.render.tile.pipeline import rasterize

    scene = scenes.standing("suitcase", count=300).scene
    eyes = [(9, 1, 1), (2, 1, 1), (2, 1, 9), (3, 1, 1)]
    cameras = [
        Camera(to_world=look_at(eye, (0, 0, 0.2)), lens=Lens(focal=60, size=(71, 50)))
        for eye in eyes
    ]
    alone = [most_layers(scene, [camera], near=0.05)[1].mean() for camera in cameras]
    worst, layers, tried = most_layers(scene, cameras, near=0.05)
    assert (worst, layers.mean(), tried) == (1, max(alone), 4)
    assert most_layers(scene, cameras, near=0.05, stop=alone[3])[::2] == (1, 2)
    assert most_layers(scene, cameras[::2], near=0.05, stop=alone[0])[::2] == (0, 1)
    arrays = tuple(
        aligned(mi.Float(value.contiguous().flatten())) for value in scene.tensors()
    )
    state = rasterize(
        layouts.TENSORS,
        arrays,
        pinhole.Pinhole(camera=cameras[worst], near=0.05),
        (0, 0, 0),
    ).state
    assert state is not None
    first, last = (edge.numpy().astype(np.int64) for edge in state.pair_ranges)
    assert layers.shape == (13, 18)
    assert np.array_equal(layers.ravel(), last - first)
    assert layers.max() > 5


def masked(count: int = 5000, *, spread: float = 0.01) -> GaussianScene:
    """A crowd at one place, and two Gaussians far away."""
    crowd = cloud(count, degree=0)
    means = crowd.means * spread
    means[7], means[1500] = (
        torch.tensor([1e5, -3e4, 2e5]),
        torch.tensor([-1e6, 3.0, 1e4]),
    )
    return crowd.replace(means=means, scales=torch.full((count, 3), 0.5))


def test_what_stops_a_renderer_is_found() -> None:
    assert ("overdraw", "error") in [
        (finding.rule, finding.severity) for finding in lint_scene(masked()).findings
    ]
    assert lint_scene(masked(spread=40.0)).findings == ()


# --- glTF

Json = dict[str, Any]
ROTATION = "KHR_gaussian_splatting:ROTATION"


def glb(path: Path, scene: GaussianScene | None = None) -> Path:
    save_splat(scene or cloud(20), path)
    return path


def faults(path: Path, change: Callable[[Json], object]) -> list[tuple[str, str]]:
    """What is found in the document of a file after a change."""
    document = open_glb(path.read_bytes(), str(path))
    root = json.loads(json.dumps(document.root.values))
    change(root)
    fields = Fields(root, str(path))
    changed = dataclasses.replace(
        document,
        root=fields,
        accessors=fields.objects("accessors"),
        views=fields.objects("bufferViews"),
    )
    return [(finding.rule, finding.severity) for finding in validate(changed)]


def _primitive(root: Json) -> Json:
    primitive: Json = root["meshes"][0]["primitives"][0]
    return primitive


def _extension(root: Json) -> Json:
    extension: Json = _primitive(root)["extensions"]["KHR_gaussian_splatting"]
    return extension


def _accessor(root: Json, name: str) -> Json:
    accessor: Json = root["accessors"][_primitive(root)["attributes"][name]]
    return accessor


FAULTS: dict[str, tuple[Callable[[Json], object], tuple[str, str]]] = {
    "no points": (lambda root: _primitive(root).update(mode=4), ("gltf-mode", "error")),
    "not used": (
        lambda root: root.update(extensionsUsed=[]),
        ("gltf-extension", "error"),
    ),
    "no kernel": (
        lambda root: _extension(root).pop("kernel"),
        ("gltf-extension", "error"),
    ),
    "no colour space": (
        lambda root: _extension(root).pop("colorSpace"),
        ("gltf-extension", "error"),
    ),
    "number": (
        lambda root: _extension(root).update(projection=3),
        ("gltf-extension", "error"),
    ),
    "other kernel": (
        lambda root: _extension(root).update(kernel="cube"),
        ("gltf-extension", "warning"),
    ),
    "no rotation": (
        lambda root: _primitive(root)["attributes"].pop(ROTATION),
        ("gltf-attribute", "error"),
    ),
    "half a degree": (
        lambda root: _primitive(root)["attributes"].pop(
            "KHR_gaussian_splatting:SH_DEGREE_1_COEF_1"
        ),
        ("gltf-degree", "error"),
    ),
    "strange attribute": (
        lambda root: _primitive(root)["attributes"].update(
            {"KHR_gaussian_splatting:GLOW": 0}
        ),
        ("gltf-attribute", "warning"),
    ),
    "wrong type": (
        lambda root: _accessor(root, ROTATION).update(type="VEC3"),
        ("gltf-accessor", "error"),
    ),
    "wrong kind": (
        lambda root: _accessor(root, ROTATION).update(componentType=5121),
        ("gltf-accessor", "error"),
    ),
    "no accessor": (
        lambda root: _primitive(root)["attributes"].update({ROTATION: 99}),
        ("gltf-accessor", "error"),
    ),
    "other count": (
        lambda root: _accessor(root, ROTATION).update(count=5),
        ("gltf-accessor", "error"),
    ),
    "past the end": (
        lambda root: _accessor(root, ROTATION).update(byteOffset=64),
        ("gltf-accessor", "error"),
    ),
    "no bounds": (
        lambda root: _accessor(root, "POSITION").pop("min"),
        ("gltf-bounds", "error"),
    ),
    "huge bounds": (
        lambda root: _accessor(root, "POSITION").update(max=[10**400, 0, 0]),
        ("gltf-bounds", "error"),
    ),
    "wrong bounds": (
        lambda root: _accessor(root, "POSITION").update(max=[0, 0, 0]),
        ("gltf-bounds", "error"),
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_of_a_gltf_is_found_and_nothing_else(
    fault: str, tmp_path: Path
) -> None:
    change, expected = FAULTS[fault]
    assert faults(glb(tmp_path / "s.glb"), change) == [expected]


def test_what_is_right_in_a_gltf_is_not_found(tmp_path: Path) -> None:
    path = glb(tmp_path / "s.glb")
    assert faults(path, lambda root: None) == []
    assert (
        faults(
            path, lambda root: _extension(root).update(colorSpace="lin_rec709_display")
        )
        == []
    )
    assert faults(path, lambda root: _extension(root).pop("projection")) == []


@pytest.mark.parametrize(
    ("attribute", "value", "words"),
    [
        ("ROTATION", 0.4, "a quaternion has length 1"),
        ("SCALE", -4.0, "logarithms"),
        ("OPACITY", 1.5, "an opacity lies in"),
        ("OPACITY", np.nan, "not finite"),
    ],
)
def test_values_of_a_gltf_are_checked_with_their_rows(
    attribute: str, value: float, words: str, tmp_path: Path
) -> None:
    path = glb(tmp_path / "s.glb")
    document = open_glb(path.read_bytes(), str(path))
    index = (
        document.root.objects("meshes")[0].objects("primitives")[0].object("attributes")
    )
    view = document.views[
        document.accessors[
            index.whole(f"KHR_gaussian_splatting:{attribute}", 0, 99)
        ].whole("bufferView", 0, 99)
    ]
    data = bytearray(path.read_bytes())
    start = len(data) - len(document.buffer) + view.whole("byteOffset", 0, len(data))
    values: NDArray[np.float32] = np.frombuffer(
        data, "<f4", view.whole("byteLength", 0, len(data)) // 4, start
    )
    values.reshape(20, -1)[4:18] = value
    path.write_bytes(data)
    finding = lint_file(path).findings[0]
    assert (finding.rule, finding.severity, finding.count, finding.rows[0]) == (
        "gltf-values",
        "error",
        14,
        4,
    )
    assert words in finding.reason


def test_a_gltf_that_is_refused_is_described(tmp_path: Path) -> None:
    path = glb(tmp_path / "s.glb")
    path.write_bytes(path.read_bytes().replace(b'"colorSpace"', b'"colourSpac"'))
    lint = lint_file(path)
    assert [finding.rule for finding in lint.findings] == ["gltf-extension"]
    assert lint.gaussians is None


def test_the_render_mode_of_a_file_is_a_note(tmp_path: Path) -> None:
    write_splat_file(cloud(), tmp_path / "a.ply", antialiased=True)
    save_splat(cloud(), tmp_path / "b.ply")
    assert "render-mode" in [
        finding.rule for finding in lint_file(tmp_path / "a.ply").findings
    ]
    assert "render-mode" not in [
        finding.rule for finding in lint_file(tmp_path / "b.ply").findings
    ]


# --- the command


def broken_ply(path: Path) -> Path:
    """Row 7 has no position, row 9 no opacity."""
    save_splat(cloud(), path)
    head, _, body = path.read_bytes().partition(b"end_header\n")
    names = splat_names(1)
    rows = np.frombuffer(bytearray(body), "<f4").reshape(-1, len(names))
    rows[7, 0], rows[9, names.index("opacity")] = np.nan, np.nan
    path.write_bytes(head + b"end_header\n" + rows.tobytes())
    return path


def run(
    capsys: pytest.CaptureFixture[str], *words: object
) -> tuple[int, Mapping[str, Any]]:
    status = cli.main(["audit", *map(str, words), "--json"])
    return status, json.loads(capsys.readouterr().out)


def test_a_file_that_is_refused_has_a_finding_and_no_verdict(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = broken_ply(tmp_path / "s.ply")
    with pytest.raises(SplatFileError):
        load_splat(path)
    status, account = run(capsys, path, "--out", tmp_path / "out")
    assert status == 3
    assert account["verdict"] is None
    assert "valid Gaussians" in account["summary"][0]
    (finding,) = account["lint"]
    assert (finding["rule"], finding["severity"]) == ("not-finite", "error")
    assert (finding["rows"], finding["count"]) == ([7, 9], 2)
    record = json.loads((tmp_path / "out" / "result.json").read_text())
    assert record["lint"] == account["lint"]
    with Image.open(tmp_path / "out" / "overdraw.png") as picture:
        assert picture.size == (192, 192 + 70)
    section = read_section(tmp_path / "out")
    assert (section.headline.words, len(section.pictures)) == ("1", 1)


def test_warnings_are_listed_and_do_not_change_the_exit_status(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    giant = cloud()
    giant.scales[3] = 9.0
    save_splat(giant, tmp_path / "giant.ply")
    save_splat(cloud(), tmp_path / "fine.ply")
    for more in ([], ["--strict"]):
        status, account = run(capsys, tmp_path / "giant.ply", "--only", "lint", *more)
        assert (status, account["lint"][0]["severity"]) == (0, "warning")
    status, account = run(capsys, tmp_path / "fine.ply", "--only", "lint", "--strict")
    assert (status, account["lint"]) == (0, [])
    assert account["cost"]["overdraw"]["cameras"] >= 14


def test_what_stops_a_renderer_is_not_looked_at(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_splat(masked(), tmp_path / "masked.ply")
    status, account = run(capsys, tmp_path / "masked.ply")
    assert status == 3
    assert account["verdict"] is None
    assert "would stop the renderer" in account["summary"][0]


@pytest.mark.parametrize("name", ["s.pth", "s.ckpt", "S.PT", "s.pkl"])
def test_a_checkpoint_is_never_unpickled(name: str, tmp_path: Path) -> None:
    class Program:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return os.mkdir, (str(tmp_path / "ran"),)

    for write in (
        torch.save,
        lambda value, path: path.write_bytes(pickle.dumps(value)),
    ):
        write({"splats": Program()}, tmp_path / name)
        with pytest.raises(SplatFileError, match="can be a program"):
            lint_file(tmp_path / name)
        assert not (tmp_path / "ran").exists()


def test_the_documentation_has_every_rule() -> None:
    text = Path("docs/audit.md").read_text()
    names = [
        *BY_NAME,
        "overdraw",
        *{expected[0] for _, expected in FAULTS.values()},
        "gltf-values",
    ]
    assert not [name for name in names if f"`{name}`" not in text]
