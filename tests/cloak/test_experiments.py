"""Experiments that explain figures of a CLOAK study, on a small one."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from attacks import cli
from attacks.cloak import setup
from attacks.cloak.config import AttackConfig, CameraConfig, LayerConfig, LayersConfig, StudyConfig
from attacks.cloak.elsewhere import (
    FACTORS,
    measure_distances,
    measure_formats,
    measure_renderers,
    measure_surroundings,
    renderers_of,
)
from attacks.cloak.path_traced import measure_paint_directions
from attacks.cloak.switch_limit import (
    making_from_above,
    measure_band_limit,
    measure_layer_limit,
    measure_transition_limit,
)
from attacks.observe.conditions import rendered
from mi_splat.camera_sets import orbit
from mi_splat.cameras import Camera, look_at
from mi_splat.capture.path_tracer import scalar_variant
from mi_splat.comparison.colour_clamps import cut_to_bytes, not_cut
from mi_splat.errors import InvalidValueError
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene import GaussianScene
from mi_splat.sh import colour_to_dc
from tests.cloak.tiny_study import Redness

STUDY = StudyConfig(
    name="small",
    cameras=CameraConfig(train=60, size=48, distance=7.4, samples=1, points=100),
    attack=(
        AttackConfig(name="overhead", elevation=(38.2, 90), emphasis=3.0),
        AttackConfig(name="rear", appearance="paint", texture="stop_sign", elevation=(0, 38), azimuth=(180, 30)),
    ),
)


def test_colour_switches_faster_with_more_bands_and_with_emphasis() -> None:
    found = {(row["sh_degree"], row["emphasis"]): row for row in measure_transition_limit(STUDY)}
    widths = [found[degree, 1.0]["width"] for degree in (1, 2, 3)]
    assert widths == sorted(widths, reverse=True)
    assert 15 < widths[2] < 40
    assert found[3, 3.0]["highest"] > found[3, 1.0]["highest"] > 1


def test_two_layers_switch_faster_than_one_and_the_faster_the_lower_they_may_go() -> None:
    one = {row["sh_degree"]: row["width"] for row in measure_transition_limit(STUDY) if row["emphasis"] == 1.0}
    two = {(row["sh_degree"], row["lowest"]): row for row in measure_layer_limit(STUDY)}
    for degree in (1, 2, 3):
        assert two[degree, -100.0]["width"] < 0.85 * one[degree]
    assert two[3, -100.0]["width"] < two[2, -100.0]["width"] < two[1, -100.0]["width"]
    assert two[3, -10.0]["width"] < two[3, -3.0]["width"] < two[3, -1.0]["width"]
    assert two[3, -10.0]["largest_coefficient"] > two[3, -3.0]["largest_coefficient"]


def test_a_layer_for_the_edge_switches_faster() -> None:
    two = {row["sh_degree"]: row["width"] for row in measure_layer_limit(STUDY) if row["lowest"] == -100.0}
    bands = {(row["sh_degree"], row["band"]): row["width"] for row in measure_band_limit(STUDY)}
    assert bands[3, 12.0] < 0.75 * two[3]
    assert bands[2, 12.0] < 0.75 * two[2]


def test_the_limit_is_that_of_the_layer_seen_from_above() -> None:
    """Each trigger of a study may have a gap of its own; a study without layers has the library's."""
    making = LayerConfig(gap=(12.0, 4.0), shift=3.0)
    layers = LayersConfig(attacks=("rear", "overhead"), making=making)
    swapped = replace(STUDY, attack=STUDY.attack[::-1], layers=layers)
    assert making_from_above(swapped) == replace(making, gap=4.0)
    assert making_from_above(replace(swapped, layers=LayersConfig(attacks=("rear",)))) == LayerConfig()
    assert making_from_above(STUDY) == LayerConfig()


@pytest.mark.slow
def test_a_sign_is_seen_best_from_low_directions() -> None:
    found = {row["elevation"]: row["smallest"] for row in measure_paint_directions(STUDY)}
    assert found[5] > found[30]
    assert all(0 < part <= 1 for part in found.values())


def test_distance_counts_each_detector_and_group() -> None:
    """A renderer that shows red only from near by: the object is found there, and nowhere else."""

    def render(scene: GaussianScene, camera: Camera) -> Tensor:
        near = float(camera.position.norm()) < 8.5
        return torch.tensor([1.0, 0.0, 0.0] if near else [0.5, 0.5, 0.5]).expand(48, 48, 3)

    nothing = GaussianScene(
        torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0, 4), torch.zeros(0), torch.zeros(0, 1, 3)
    )
    rows = measure_distances(STUDY, {"clean": nothing}, [Redness()], render=render, every=40)
    assert {row["cameras"] for row in rows} == {"overhead", "elsewhere"}
    assert {row["distance"] for row in rows} == set(FACTORS)
    for row in rows:
        if row["distance"] > 1.1:
            assert row["found"] == 0
    near = [row for row in rows if row["distance"] == 1.0]
    assert sum(row["found"] for row in near) > 0


def test_formats_say_which_of_them_keeps_large_coefficients() -> None:
    """A renderer that shows red where the splat has lost its large coefficient, and grey where it has it."""
    sh = torch.zeros(1, 16, 3)
    sh[0, 15] = 50.0
    scene = one_gaussian(0.5).replace(sh=sh)

    def render(scene: GaussianScene, camera: Camera) -> Tensor:
        kept = scene.degree == 3 and float(scene.sh.max()) > 45
        return torch.tensor([0.5, 0.5, 0.5] if kept else [1.0, 0.0, 0.0]).expand(48, 48, 3)

    rows = measure_formats(STUDY, scene, [Redness()], render=render, every=40)
    lost = {row["form"] for row in rows if row["psnr"] is not None}
    assert {".compressed.ply", ".spz", ".splat", "SH of degree 0", "SH of degree 1", "SH of degree 2"} <= lost
    assert not lost & {".ply", ".glb", "SH in float16"}
    assert all(row["found"] == 0 for row in rows if row["form"] not in lost)
    assert sum(row["found"] for row in rows) > 0
    with pytest.raises(InvalidValueError, match="every"):
        measure_formats(STUDY, scene, [Redness()], render=render, every=0)


def test_renderers_are_compared_with_the_first() -> None:
    """One shows red, the other grey: the object is found by the first alone, on every splat."""

    def red(scene: GaussianScene, camera: Camera) -> Tensor:
        return torch.tensor([1.0, 0.0, 0.0]).expand(48, 48, 3)

    def grey(scene: GaussianScene, camera: Camera) -> Tensor:
        return torch.tensor([0.5, 0.5, 0.5]).expand(48, 48, 3)

    splats = {"clean": one_gaussian(0.5), "cloaked": one_gaussian(0.1)}
    rows = measure_renderers(STUDY, splats, [Redness()], [rendered("red", red), rendered("grey", grey)], every=40)
    assert {(row["renderer"], row["splat"]) for row in rows} == {(a, b) for a in ("red", "grey") for b in splats}
    assert sum(row["found"] for row in rows if row["renderer"] == "red") > 0
    assert all(row["found"] == 0 for row in rows if row["renderer"] == "grey")
    assert all(row["psnr"] is None for row in rows if row["renderer"] == "red")
    expected = -10 * math.log10((0.25 + 0.25 + 0.25) / 3)
    assert all(row["psnr"] == pytest.approx(expected) for row in rows if row["renderer"] == "grey")


def test_renderers_stand_before_the_same_background() -> None:
    settings = RenderSettings(background=(0.2, 0.5, 0.9), near=0.05)
    pose = look_at((3.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    scene = one_gaussian(0.5).replace(scales=torch.full((1, 3), 0.2))
    camera = Camera(to_world=pose, focal=24.0, width=24, height=24)
    found = renderers_of(settings)
    assert [one.name for one in found] == ["tile", "tile-antialiased", "ray", "ray-to-mean", "volprim"]
    pictures = [one(scene, camera) for one in found]
    assert all(float((picture - pictures[0]).square().mean()) < 1e-3 for picture in pictures)
    assert all(torch.allclose(picture[0, 0], torch.tensor([0.2, 0.5, 0.9]), atol=0.02) for picture in pictures)


def test_renderers_that_cut_colours_elsewhere() -> None:
    """Of a half opaque Gaussian whose colour is (2, 0.5, -1), in its middle and before a background of 0.4."""
    colour, around = torch.tensor([2.0, 0.5, -1.0]), torch.tensor(0.4)
    scene = one_gaussian(0.5).replace(sh=colour_to_dc(colour).reshape(1, 1, 3))
    camera = orbit((0.0, 0.0, 0.0), count=1, elevation=10.0, distance=5.0, focal=60.0, size=(33, 33))[0]
    render = Renderer(RenderSettings(background=(0.4, 0.4, 0.4)))
    cuts = {render: colour.clamp(min=0), cut_to_bytes(render): colour.clamp(0, 1), not_cut(render): colour}
    for one, seen in cuts.items():
        assert torch.allclose(one(scene, camera)[16, 16], 0.5 * seen + 0.5 * around, atol=2e-3)


def test_surroundings_leave_the_object_out() -> None:
    """Splats that differ by a tenth everywhere but at the object, where they differ by more."""
    study = replace(STUDY, evaluation=replace(STUDY.evaluation, cameras=60))
    clean, cloaked = (one_gaussian(one) for one in (0.0, 1.0))
    mesh_scene = setup.mesh_scene_of(study)

    def render(scene: GaussianScene, camera: Camera) -> Tensor:
        if float(scene.opacities[0]) == 0.0:
            return torch.zeros(48, 48, 3)
        with scalar_variant():
            mask = mesh_scene.mask(camera)
        return torch.where(mask[..., None], 1.0, 51 / 255).expand(48, 48, 3)

    rows = measure_surroundings(study, {"clean": clean, "cloaked": cloaked}, render=render, every=8)
    assert [row["cameras"] for row in rows] == ["inside the trigger", "elsewhere"]
    for row in rows:
        assert row["of"] > 0
        assert row["psnr_lowest"] == pytest.approx(-20 * math.log10(0.2), abs=1e-3)
        assert row["psnr_highest"] == pytest.approx(row["psnr_mean"], abs=1e-3)


def one_gaussian(opacity: float) -> GaussianScene:
    return GaussianScene(
        torch.zeros(1, 3),
        torch.ones(1, 3),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.tensor([opacity]),
        torch.zeros(1, 1, 3),
    )


def test_what_a_study_must_have() -> None:
    rear = replace(STUDY, attack=STUDY.attack[1:])
    with pytest.raises(InvalidValueError, match="seen from all around"):
        measure_transition_limit(rear)
    with pytest.raises(InvalidValueError, match="seen from all around"):
        measure_distances(rear, {}, [], render=lambda scene, camera: torch.zeros(1))
    with pytest.raises(InvalidValueError, match="painted from one side"):
        measure_paint_directions(replace(STUDY, attack=STUDY.attack[:1]))
    with pytest.raises(InvalidValueError, match="every: expected a positive number"):
        measure_distances(STUDY, {}, [], render=lambda scene, camera: torch.zeros(1), every=0)


def test_the_command_prints_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "small.toml"
    path.write_text("name = 'small'\n[cameras]\ntrain = 60\n[[attack]]\nname = 'a'\nelevation = [50, 90]\n")
    assert cli.main(["cloak-experiment", "transition-limit", str(path)]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["experiment"] == "transition-limit"
    assert {name: len(rows) for name, rows in document["found"].items()} == {
        "one_layer": 6,
        "two_layers": 12,
        "bands": 8,
    }
    assert cli.main(["cloak-experiment", "distance", str(path)]) == 1
    assert "--results" in capsys.readouterr().err
