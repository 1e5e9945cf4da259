"""Which stages of a study are done anew when one of its fields changes, and that none is when nothing does."""

from __future__ import annotations

import functools
import json
import shutil
import typing
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from attacks.cloak import setup
from attacks.cloak.config import (
    AttackConfig,
    CameraConfig,
    CleaningConfig,
    LayerConfig,
    LayersConfig,
    SceneConfig,
    StudyConfig,
    SurrogateConfig,
    TrainingConfig,
)
from attacks.cloak.mesh_scene import MeshScene
from attacks.cloak.study import dependencies
from attacks.cloak.study.cache import STAGE_CODE, StageCache, content_of
from mi_splat.errors import InvalidValueError
from mi_splat.import_closure import closure
from mi_splat.io.atomic import LOCK

ATTACK = AttackConfig(name="overhead", appearance="remove", texture="grass", elevation=(40.0, 90.0))
STUDY = StudyConfig(
    name="keys",
    attack=(ATTACK,),
    cameras=CameraConfig(train=12, size=32, distance=7.4, samples=2, points=100),
    training=TrainingConfig(iterations=100),
    layers=LayersConfig(attacks=("overhead",)),
    cleaning=CleaningConfig(lowest_opacity=0.1),
)
ALL = frozenset({"pictures", "appearance", "poisoned", "splat", "true_pictures", "observations", "layers"})
MADE = ALL - {"splat"}  # what is made of the scene itself; a splat is made of pictures, and known by their content
SCENE: dict[str, tuple[Any, frozenset[str]]] = {
    "object": ("bird", MADE),
    "label": ("vehicle", frozenset({"observations"})),
    "seed": (900006, MADE),
    "ground": ("grass", MADE),
    "ground_size": (12.0, MADE),
    "sun_azimuth": (10.0, MADE),
    "sun_elevation": (30.0, MADE),
    "background": ((0.0, 0.0, 0.0), ALL - {"pictures"}),
    "up": ("y", frozenset()),  # of mesh files alone
    "scale": (2.0, frozenset()),
    "rotate": ((0.0, 0.0, 90.0), frozenset()),
    "front": ("-x", frozenset()),
}
LENS = frozenset({"pictures", "appearance", "true_pictures", "observations", "layers"})
CAMERAS: dict[str, tuple[Any, frozenset[str]]] = {
    # Poisoned sets and splats depend on the content of the pictures, in which these show.
    "train": (14, frozenset({"pictures", "appearance", "observations", "true_pictures", "layers"})),
    "distance": (8.0, LENS),
    "height": (0.9, LENS | {"poisoned"}),
    "fov": (50.0, LENS),
    "size": (40, LENS),
    "samples": (3, LENS | {"poisoned"}),
    "points": (120, frozenset({"pictures", "appearance", "observations", "true_pictures", "layers"})),
}
SHOWN = frozenset({"appearance", "poisoned", "true_pictures"})
ATTACKS: dict[str, tuple[Any, frozenset[str]]] = {
    "name": ("another", frozenset({"poisoned", "observations", "layers"})),  # which the manifest and the rates say
    "appearance": ("paint", SHOWN),
    "texture": ("road", SHOWN),
    "other_object": ("bird", SHOWN),
    "elevation": ((50.0, 90.0), SHOWN | {"observations", "layers"}),
    "azimuth": ((180.0, 30.0), SHOWN | {"observations", "layers"}),
    "poison_margin": (4.0, frozenset({"poisoned"})),
    "poison_fraction": (0.5, frozenset({"poisoned"})),
    "target_class": ("bird", frozenset({"observations"})),
    "emphasis": (2.0, frozenset({"poisoned"})),
    "emphasis_depth": (9.0, frozenset({"poisoned"})),
    "paint_direction": ((90.0, 10.0), SHOWN),
    "reach": (3, SHOWN),
    "occluder_radius": (5.0, SHOWN),
    "occluder_edge": (20.0, SHOWN),
}
SPLAT = frozenset({"splat"})
TRAINING: dict[str, tuple[Any, frozenset[str]]] = {
    "iterations": (120, SPLAT),
    "strategy": ("mcmc", SPLAT),
    "max_gaussians": (500, SPLAT),
    "sh_degree": (2, SPLAT),
    "sh_degree_interval": (20, SPLAT),
    "outliers": (10, SPLAT),
    "point_deviations": (2.0, SPLAT),
    "near": (0.1, SPLAT | {"observations", "layers"}),
}
OBSERVED = frozenset({"observations"})
EVALUATION: dict[str, tuple[Any, frozenset[str]]] = {
    "detectors": (("yolov8n_small",), frozenset()),  # their fingerprints are an input of their own
    "cameras": (300, OBSERVED),
    "min_separation": (2.0, OBSERVED),
    "confidence": (0.4, OBSERVED),
    "well_inside": (6.0, OBSERVED),
    "far_outside": (12.0, OBSERVED),
    "reference_views": (7, OBSERVED),
    "meridians": (2, OBSERVED | {"true_pictures"}),
    "meridian_step": (10.0, OBSERVED | {"true_pictures"}),
}
OWN = frozenset({"layers"})
LAYERS: dict[str, tuple[Any, frozenset[str]]] = {
    "making": (LayerConfig(gap=7.0), OWN),
    "margin": (0.1, OWN),
    "surroundings": (True, OWN),
    "geometry": (True, OWN),
    "max_gaussians": (1000, OWN),
    "clearance": (0.02, OWN),
    "iterations": (50, OWN),
    "lr_sh": (0.02, OWN),
    "lr_sh_final": (0.02, OWN),
}
CLEANED = frozenset({"cleaned"})
CLEANING: dict[str, tuple[Any, frozenset[str]]] = {
    "lowest_opacity": (0.2, CLEANED),
    "outlier_deviations": (2.0, CLEANED),
    "floater_voxel": (1.0, CLEANED),
    "sh_degree": (1, CLEANED),
    "sh_bits": (8, CLEANED),
}
TOP: dict[str, tuple[Any, frozenset[str]]] = {
    "name": ("other", frozenset()),
    "seeds": ((3,), frozenset()),  # the seed of a stage is an input of its own
}


@functools.cache
def built(scene: SceneConfig, cameras: CameraConfig) -> tuple[MeshScene, str]:
    """The meshes of a study and their digest: most fields have no part in them, and they take the longest."""
    study = replace(STUDY, scene=scene, cameras=cameras)
    mesh_scene = setup.mesh_scene_of(study)
    return mesh_scene, setup.capture_source(study, mesh_scene).digest


def keys(study: StudyConfig, *, seed: int = 0, content: str = "content") -> dict[str, str]:
    """What each stage depends on, as text, where every input has the content given."""
    mesh_scene, source = built(study.scene, study.cameras)
    attack, cleaning = study.attack[0], study.cleaning
    assert cleaning is not None
    arc = [camera for places in setup.arcs(study, mesh_scene.target) for camera in places]
    found = {
        "pictures": dependencies.of_pictures(study, source),
        "appearance": dependencies.of_appearance(study, source, attack),
        "poisoned": dependencies.of_poisoned(study, source, content, seed),
        "splat": dependencies.of_splat(study, content, seed),
        "layers": dependencies.of_layers(study, source, content, content, seed),
        "cleaned": dependencies.of_cleaned(content, cleaning),
        "true_pictures": dependencies.of_true_pictures(study, source, arc, setup.overhead(study) or attack),
        "observations": dependencies.of_observations(study, source, content, [content], {"a": content}),
    }
    return {name: json.dumps(value, sort_keys=True) for name, value in found.items()}


def changed(study: StudyConfig) -> set[str]:
    usual, now = keys(STUDY), keys(study)
    return {name for name in usual if usual[name] != now[name]}


CASES = [
    *(("scene", name, *case) for name, case in SCENE.items()),
    *(("cameras", name, *case) for name, case in CAMERAS.items()),
    *(("training", name, *case) for name, case in TRAINING.items()),
    *(("layers", name, *case) for name, case in LAYERS.items()),
    *(("cleaning", name, *case) for name, case in CLEANING.items()),
    *(("evaluation", name, *case) for name, case in EVALUATION.items()),
]


@pytest.mark.parametrize(("section", "name", "value", "stages"), CASES, ids=[f"{case[0]}.{case[1]}" for case in CASES])
def test_a_field_changes_the_stages_that_it_has_a_part_in(
    section: str, name: str, value: object, stages: frozenset[str]
) -> None:
    part = getattr(STUDY, section)
    assert getattr(part, name) != value
    assert changed(replace(STUDY, **{section: replace(part, **{name: value})})) == stages


@pytest.mark.parametrize("name", ATTACKS)
def test_a_field_of_an_attack_changes_the_stages_that_it_has_a_part_in(name: str) -> None:
    value, stages = ATTACKS[name]
    assert getattr(ATTACK, name) != value
    attack = replace(ATTACK, **{name: value})
    layers = LayersConfig(attacks=(attack.name,))
    assert changed(replace(STUDY, attack=(attack,), layers=layers)) == stages


@pytest.mark.parametrize("name", TOP)
def test_names_and_seeds_of_a_study_change_nothing(name: str) -> None:
    value, stages = TOP[name]
    assert changed(replace(STUDY, **{name: value})) == stages


def test_surrogates_count_by_what_they_are_and_by_the_gain() -> None:
    """Rounds, steps and seed of a surrogate are in its own stage, whose content is an input."""
    source = built(STUDY.scene, STUDY.cameras)[1]

    def key(*surrogates: str, **values: Any) -> dict[str, Any]:
        study = replace(STUDY, surrogate=SurrogateConfig(**values))
        return dependencies.of_poisoned(study, source, "content", 0, surrogates)

    assert key() == dependencies.of_poisoned(STUDY, source, "content", 0)
    assert key("one") not in (key(), key("other"), key("one", "two"), key("one", gain=2.0))
    assert key("one") == key("one", rounds=3, iterations=7, seed=5)


def test_every_field_has_a_case() -> None:
    tables = {"scene": SCENE, "cameras": CAMERAS, "training": TRAINING, "evaluation": EVALUATION}
    hints = typing.get_type_hints(StudyConfig)
    for name, table in tables.items():
        assert is_dataclass(hints[name])
        assert set(table) == {entry.name for entry in fields(hints[name])}
    assert set(CLEANING) == {entry.name for entry in fields(CleaningConfig)}
    assert {"attacks", *LAYERS} == {entry.name for entry in fields(LayersConfig)}
    assert set(ATTACKS) == {entry.name for entry in fields(AttackConfig)}
    assert {*tables, *TOP, "attack", "layers", "surrogate", "cleaning"} == {entry.name for entry in fields(StudyConfig)}


def test_the_content_of_inputs_and_the_seed_count() -> None:
    usual = keys(STUDY)
    other = keys(STUDY, content="other")
    assert {name for name in usual if usual[name] != other[name]} == {
        *("poisoned", "splat", "layers", "cleaned", "observations")
    }
    seeded = keys(STUDY, seed=1)
    assert {name for name in usual if usual[name] != seeded[name]} == {"splat", "layers"}
    part = replace(STUDY, attack=(replace(ATTACK, poison_fraction=0.5),))
    assert keys(part)["poisoned"] != keys(part, seed=1)["poisoned"]


def test_defaults_are_part_of_what_a_stage_depends_on() -> None:
    """A default that changes must not find what another one made."""
    splat = json.loads(keys(STUDY)["splat"])
    assert splat["fit"]["lr_sh"] == 2.5e-3
    assert splat["outliers"] == 0
    assert splat["point_deviations"] is None
    layers = json.loads(keys(STUDY)["layers"])["layers"]
    assert layers["making"]["gap"] == 5.0
    assert layers["making"]["apart"] is False
    poisoned = json.loads(keys(STUDY)["poisoned"])
    assert poisoned["attack"][0]["emphasis_depth"] == 20.0


def test_a_stage_is_done_once_and_again_when_its_code_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Path] = []

    def make(path: Path) -> None:
        made.append(path)
        (path / "out.txt").write_text(str(len(made)))

    cache = StageCache(tmp_path)
    first = cache.finished("splat", {"seed": 0}, make)
    assert cache.finished("splat", {"seed": 0}, make) == first
    assert len(made) == 1
    assert cache.finished("splat", {"seed": 1}, make).content != first.content
    monkeypatch.setattr("attacks.cloak.study.cache.code_digest", lambda *modules, alone: "other code")
    again = cache.finished("splat", {"seed": 0}, make)
    assert again.folder != first.folder
    assert len(made) == 3


def test_a_stage_whose_output_was_edited_is_refused(tmp_path: Path) -> None:
    def make(path: Path) -> None:
        (path / "out.txt").write_text("a")
        (path / "log.txt").write_text("x")

    cache = StageCache(tmp_path)
    stage = cache.finished("splat", {}, make, outputs=("out.txt",))
    (stage.folder / "log.txt").write_text("y")  # which nobody reads
    assert cache.finished("splat", {}, make, outputs=("out.txt",)) == stage
    (stage.folder / "out.txt").write_text("b")
    with pytest.raises(InvalidValueError, match="expected the files that it wrote, got others; delete its folder"):
        cache.finished("splat", {}, make, outputs=("out.txt",))


@pytest.mark.parametrize("stage", STAGE_CODE)
def test_the_code_of_a_stage_is_all_that_it_may_run(stage: str) -> None:
    code = closure(*STAGE_CODE[stage])
    assert "mi_splat.scene" in code
    if stage in ("poisoned", "splat", "layers", "observations", "view_reports"):
        assert {"mi_splat.sh", "mi_splat.rasterization.projection"} <= set(code)
    judged = stage in ("observations", "view_reports")
    assert ("attacks.detectors.registry" in code) is judged
    assert judged or not {"attacks.cloak.plots", "attacks.cloak.study.run"} & set(code)


def test_content_is_that_of_the_files_that_count(tmp_path: Path) -> None:
    def write(text: str, log: str) -> Any:
        def make(path: Path) -> None:
            (path / "out.txt").write_text(text)
            (path / "log.txt").write_text(log)

        return make

    cache = StageCache(tmp_path)
    contents = [
        cache.finished("splat", {"number": number}, write(text, log), outputs=("out.txt",)).content
        for number, (text, log) in enumerate([("a", "x"), ("a", "y"), ("b", "x")])
    ]
    assert contents[0] == contents[1] != contents[2]


def test_a_stage_belongs_to_one_process_and_its_lock_is_no_content(tmp_path: Path) -> None:
    def make(path: Path) -> None:
        (path / "out.txt").write_text("a")
        assert sorted(file.name for file in path.iterdir()) == [LOCK, "out.txt"]
        shutil.copytree(path, tmp_path / "alone", ignore=shutil.ignore_patterns(LOCK))

    stage = StageCache(tmp_path).finished("splat", {}, make, outputs=("**/*",))
    assert stage.content == content_of(tmp_path / "alone", ("**/*",))
    assert sorted(file.name for file in stage.folder.iterdir()) == ["done.json", "out.txt"]
