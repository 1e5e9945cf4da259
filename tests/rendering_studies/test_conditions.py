"""Files of rendering studies, and the conditions under which splats are judged."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from attacks.cli.attack_scenes import read_attack_scene
from attacks.observe.conditions import SunTable, fewer_bands, half_precision, through_file
from attacks.rendering_studies.conditions import condition_names, conditions_of
from attacks.rendering_studies.config import JudgeTable, RenderingStudy, read_rendering_study
from attacks.rendering_studies.jobs import attacks_of
from mi_splat.cameras import Camera, look_at
from mi_splat.comparison.methods import load_method
from mi_splat.errors import InvalidValueError
from mi_splat.mixed_scenes import MixedScene
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene import GaussianScene
from tests.dagger.test_study import toy
from tests.gaussians import random_scene
from tests.project.layers import ROOT

SHIPPED = sorted((ROOT / "scenes" / "studies").glob("*.toml"))
STREET = "scenes/mixed/car_among_meshes.xml"
SETTINGS = RenderSettings()


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_shipped_study_can_be_read(path: Path) -> None:
    study = read_rendering_study(path)
    assert study.name == path.stem
    assert study.seeds == 3
    assert len({job.name for job in attacks_of(study)}) == len(attacks_of(study))
    for pair in study.pairs:
        place = read_attack_scene(ROOT / "scenes" / f"{pair.scene}.xml")
        assert pair.object in place.objects
        assert pair.camera < len(place.cameras)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ("[judge]\n", "judge: expected conditions, got none"),
        ('[judge]\nown_renderer = true\nfiles = [".spz"]\n', "both kinds"),
        ("[judge]\nhours = [7]\n", "hours"),
        ('[judge.sun]\nscene = "a.xml"\nhours = "noon"\n', "a list"),
    ],
)
def test_a_file_that_means_nothing_is_refused(change: str, match: str, tmp_path: Path) -> None:
    path = tmp_path / "study.toml"
    head = 'name = "a"\nquestion = "?"\n[[pairs]]\nscene = "a"\nobject = "b"\ntarget = "c"\n[[attacks]]\neps = [1.0]\n'
    path.write_text(head + change)
    with pytest.raises(InvalidValueError, match=match):
        read_rendering_study(path)
    with pytest.raises(InvalidValueError, match="at least one"):
        RenderingStudy(name="a", question="?", pairs=(), attacks=(), judge=JudgeTable(own_renderer=True))


def test_conditions_have_the_names_of_the_tables() -> None:
    judge = JudgeTable(renderers=("tile", "ray"), files=(".spz",), sh_degrees=(1, 0), float16=True)
    names = ("tile", "ray", ".spz", "SH in float16", "SH of degree 1", "SH of degree 0")
    assert condition_names(judge) == names
    assert tuple(conditions_of(judge, toy(), "thing")) == names
    assert condition_names(JudgeTable(sun=SunTable(scene="a", hours=(7.0, 9.5)))) == ("07:00", "09:30")


def view_of(scene: GaussianScene, name: str) -> torch.Tensor:
    pose = look_at((0.0, -4.0, 0.5), (0.0, 0.0, 0.0))
    seen = Camera(to_world=pose, focal=26.0, width=24, height=24, principal=(12.0, 12.0))
    return load_method(name, SETTINGS).render(scene, seen)


def test_each_variant_changes_what_it_is_called_by() -> None:
    scene = random_scene(60, seed=1)
    plain = view_of(scene, "tile")
    assert not torch.allclose(view_of(scene, "tile-near-3"), plain, atol=1e-3)
    far = scene.replace(means=scene.means + torch.tensor([0.0, 40.0, 0.0]))
    torch.testing.assert_close(view_of(far, "tile-near-3"), view_of(far, "tile"))
    tame = scene.replace(sh=0.05 * torch.tanh(scene.sh))  # all colours within (0, 1): nothing is cut anywhere
    loud = scene.replace(sh=20 * scene.sh)
    for name in ("tile-colours-in-0-1", "tile-colours-not-cut"):
        assert not torch.allclose(view_of(loud, name), view_of(loud, "tile"), atol=1e-2)
        torch.testing.assert_close(view_of(tame, name), view_of(tame, "tile"), rtol=0, atol=1e-5)
    with pytest.raises(InvalidValueError, match="tile-near-3"):
        load_method("unreal", SETTINGS)


def test_files_and_bands() -> None:
    scene = random_scene(40, seed=2)
    assert torch.equal(through_file(scene, ".ply").sh, scene.sh)
    assert not torch.equal(through_file(scene, ".splat").sh[:, :1], scene.sh[:, :1])
    half = half_precision(scene).sh
    assert not torch.equal(half, scene.sh)
    torch.testing.assert_close(half, scene.sh, rtol=1e-3, atol=1e-6)
    assert fewer_bands(scene, 0).degree == 0
    assert fewer_bands(scene, 3).degree == scene.degree
    with pytest.raises(InvalidValueError, match=r"\.splat"):
        through_file(scene, ".obj")


def test_the_car_stands_in_the_street_by_the_hour() -> None:
    place = read_attack_scene(ROOT / "scenes" / "car_street.xml")
    sun = SunTable(scene=STREET, hours=(8.0, 16.0), samples=1)
    found = conditions_of(JudgeTable(sun=sun), place, "car")
    assert list(found) == ["08:00", "16:00"]
    for condition in found.values():
        inside, render = condition.show(place.scene.with_degree(3))  # the scene's file has degree 1
        assert isinstance(render, MixedScene)
        assert inside.sh.shape == (len(render.splats.scene), 16, 3)
        assert torch.equal(inside.means, render.splats.scene.means)
    with pytest.raises(InvalidValueError, match="the Gaussians of street and no others"):
        conditions_of(JudgeTable(sun=sun), place, "street")
    with pytest.raises(InvalidValueError, match="when the sun is up"):
        conditions_of(JudgeTable(sun=SunTable(scene=STREET, hours=(3.0,))), place, "car")


def test_stored_splats_are_rendered_as_the_scene_is() -> None:
    place = toy()
    condition = conditions_of(JudgeTable(files=(".ply",)), place, "thing")[".ply"]
    changed, render = condition.show(place.scene)
    camera = place.cameras[0]
    torch.testing.assert_close(render(changed, camera), Renderer(SETTINGS)(place.scene, camera))
