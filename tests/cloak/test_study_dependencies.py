"""Which jobs of a study depend on one of its fields, and that what they left is used only as it was left."""

import functools
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
    SceneConfig,
    StudyConfig,
    SurrogateConfig,
    TrainingConfig,
)
from attacks.cloak.layer_config import LayerConfig, LayersConfig
from attacks.cloak.setup import Setup
from attacks.cloak.steps import StudySteps
from mi_splat.errors import InvalidValueError
from mi_splat.import_closure import closure
from mi_splat.ledger import Job, Part
from mi_splat.ledger.values import canonical
from tests.capture.trucks import truck, write_ply
from tests.cloak.tiny_study import STUDY as TINY
from tests.cloak.tiny_study import Redness, steps_of

ATTACK = AttackConfig(name="overhead", appearance="remove", texture="grass", elevation=(40.0, 90.0))
STUDY = StudyConfig(
    name="keys",
    attack=(ATTACK,),
    cameras=CameraConfig(train=12, size=32, distance=7.4, samples=2, points=100),
    training=TrainingConfig(iterations=100, near=0.05),
    layers=LayersConfig(attacks=("overhead",)),
    cleaning=CleaningConfig(lowest_opacity=0.1),
)
SEEN = frozenset({"seen", "training_views", "compared"})
MADE = frozenset({"pictures", "looks", "poisoned", "true_pictures", "layered"}) | SEEN
"""Jobs that know the scene itself; a splat is made of pictures, and known by their content."""
SCENE: dict[str, tuple[Any, frozenset[str]]] = {
    "object": ("bird", MADE),
    "label": ("vehicle", frozenset({"seen", "training_views"})),
    "seed": (900006, MADE),
    "colour": ((0.1, 0.2, 0.6), MADE),
    "ground": ("grass", MADE),
    "ground_size": (12.0, MADE),
    "sun_azimuth": (10.0, MADE),
    "sun_elevation": (30.0, MADE),
    "background": ((0.0, 0.0, 0.0), (MADE - {"pictures"}) | {"trained"}),
    "up": ("y", frozenset()),  # of mesh files alone
    "scale": (2.0, frozenset()),
    "rotate": ((0.0, 0.0, 90.0), frozenset()),
    "front": ("-x", frozenset()),
}
CAMERAS: dict[str, tuple[Any, frozenset[str]]] = {
    "train": (14, MADE),
    "distance": (8.0, MADE),
    "distances": ((0.8, 1.1), MADE),
    "elevations": ((10.0, 40.0, 80.0), MADE),
    "height": (0.9, MADE),
    "fov": (50.0, MADE),
    "size": (40, MADE),
    "samples": (3, MADE),
    "points": (120, MADE),
}
SHOWN = frozenset({"looks", "poisoned", "true_pictures"})
ATTACKS: dict[str, tuple[Any, frozenset[str]]] = {
    "name": ("another", SEEN | {"poisoned", "layered"}),  # which the manifest and the rows say
    "appearance": ("paint", SHOWN),
    "texture": ("road", SHOWN),
    "other_object": ("bird", SHOWN),
    "elevation": ((50.0, 90.0), SHOWN | SEEN | {"layered"}),
    "azimuth": ((180.0, 30.0), SHOWN | SEEN | {"layered"}),
    "poison_margin": (4.0, frozenset({"looks", "poisoned", "seen", "training_views"})),
    "poison_fraction": (0.5, frozenset({"poisoned", "training_views"})),
    "target_class": ("bird", SEEN),
    "emphasis": (2.0, frozenset({"poisoned"})),
    "emphasis_depth": (9.0, frozenset({"poisoned"})),
    "paint_direction": ((90.0, 10.0), SHOWN),
    "reach": (3, SHOWN),
    "occluder_radius": (5.0, SHOWN),
    "occluder_edge": (20.0, SHOWN),
    "blur_width": (0.1, SHOWN),
}
SPLAT = frozenset({"trained"})
TRAINING: dict[str, tuple[Any, frozenset[str]]] = {
    "iterations": (120, SPLAT),
    "strategy": ("mcmc", SPLAT),
    "max_gaussians": (500, SPLAT),
    "sh_degree": (2, SPLAT),
    "sh_degree_interval": (20, SPLAT),
    "outliers": (10, SPLAT),
    "point_deviations": (2.0, SPLAT),
    "near": (0.1, SPLAT | SEEN | {"layered"}),
}
COMPARED = frozenset({"compared"})
EVALUATION: dict[str, tuple[Any, frozenset[str]]] = {
    "detectors": (("yolov8n_small",), frozenset()),  # each of them has jobs of its own
    "cameras": (300, frozenset({"seen", "compared"})),
    "seed": (1, frozenset({"seen", "compared"})),
    "min_separation": (2.0, frozenset({"seen", "compared"})),
    "confidence": (0.4, frozenset()),  # rows hold scores; rates are counted from them
    "well_inside": (6.0, COMPARED),
    "far_outside": (12.0, COMPARED),
    "reference_views": (7, COMPARED),
    "meridians": (2, COMPARED | {"true_pictures"}),
    "meridian_step": (10.0, COMPARED | {"true_pictures"}),
    "true_pictures": (True, frozenset()),  # has jobs of its own
}
OWN = frozenset({"layered"})
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
    "repair": (True, CLEANED),
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
def built(scene: SceneConfig, cameras: CameraConfig) -> dict[str, Any]:
    """The meshes of a study and their digest: most fields have no part in them, and they take the longest."""
    setup = Setup(replace(STUDY, scene=scene, cameras=cameras))
    return {name: getattr(setup, name) for name in ("target", "mesh_scene", "source")}


def planned(study: StudyConfig) -> StudySteps:
    steps = StudySteps(study=study, folder=Path("nowhere"))
    vars(steps.setup).update(built(study.scene, study.cameras))
    return steps


def jobs(study: StudyConfig, *, seed: int = 0) -> list[Job]:
    steps, attack = planned(study), study.attack[0]
    arc = [camera for _, camera in steps.setup.arc_cameras]
    clean = steps.trained("clean", seed)
    return [
        *(steps.pictures(), steps.look(attack), steps.poisoned(seed), clean, steps.trained("cloaked", seed)),
        *(steps.splat("clean", seed), steps.true_pictures(arc, study.overhead or attack)),
        *(steps.seen(clean, Redness()), steps.seen_in_training(clean, Redness(), seed), steps.compared(clean)),
    ]


def keys(study: StudyConfig, *, seed: int = 0) -> dict[str, str]:
    """What each kind of job depends on besides the content of its inputs, as text."""
    return {job.kind.rpartition(".")[2]: canonical(job.config_json) for job in jobs(study, seed=seed)}


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
    before = replace(ATTACK, appearance="blur") if name == "blur_width" else ATTACK  # others have no such field
    both = (before, replace(before, **{name: value}))
    was, now = (keys(replace(STUDY, attack=(one,), layers=LayersConfig(attacks=(one.name,)))) for one in both)
    assert {kind for kind in was if was[kind] != now[kind]} == stages


@pytest.mark.parametrize("name", TOP)
def test_names_and_seeds_of_a_study_change_nothing(name: str) -> None:
    value, stages = TOP[name]
    assert changed(replace(STUDY, **{name: value})) == stages


def test_surrogates_count_by_what_they_are_and_by_the_gain() -> None:
    """Rounds, steps and seed of a surrogate are in its own job, which is an input."""

    def poisoned(**values: Any) -> Job:
        return planned(replace(STUDY, surrogate=SurrogateConfig(**values))).poisoned(0)

    plain, one = planned(STUDY).poisoned(0), poisoned()
    assert [name for name in one.inputs if name not in plain.inputs] == ["surrogate 1"]
    assert canonical(one.config_json) != canonical(plain.config_json)
    assert canonical(one.config_json) == canonical(poisoned(rounds=3, iterations=7, seed=5).config_json)
    assert canonical(one.config_json) != canonical(poisoned(gain=2.0).config_json)
    assert len(poisoned(rounds=3).inputs) == len(plain.inputs) + 3


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


def test_the_seed_counts_where_something_is_drawn() -> None:
    usual, seeded = keys(STUDY), keys(STUDY, seed=1)
    assert {name for name in usual if usual[name] != seeded[name]} == {"trained", "layered"}
    part = replace(STUDY, attack=(replace(ATTACK, poison_fraction=0.5),))
    assert keys(part)["poisoned"] != keys(part, seed=1)["poisoned"]


def test_inputs_are_files_and_no_more_of_them_than_are_read() -> None:
    """A splat that was trained again to the same bytes is the same to whoever looks at it."""
    parts = {
        (job.kind.rpartition(".")[2], name): source.pattern
        for job in jobs(STUDY)
        for name, source in job.inputs.items()
        if isinstance(source, Part)
    }
    assert parts == {
        **{("looks", "pictures"): "set/*", ("poisoned", "pictures"): "set/*", ("trained", "pictures"): "set/*"},
        **{("poisoned", "look of overhead"): "*.png", ("layered", "pictures"): "set/*"},
        **{("layered", "clean"): "splat.ply", ("cleaned", "splat"): "splat.ply", ("seen", "splat"): "splat.ply"},
        ("training_views", "splat"): "splat.ply",
        **{("true_pictures", "plain"): "*.png", ("compared", "splat"): "splat.ply"},
        **{("compared", name): "*.png" for name in ("far", "edge", "benign", "hidden")},
    }


def test_without_a_near_plane_it_follows_the_object() -> None:
    free = replace(STUDY, training=replace(STUDY.training, near=None))
    bird = replace(free, scene=replace(free.scene, object="bird"))
    assert keys(free)["trained"] != keys(bird)["trained"]


def test_a_mesh_file_is_an_input_by_its_content(tmp_path: Path) -> None:
    """Its path counts nowhere, and the jobs read the file."""
    (tmp_path / "moved").mkdir()
    files = [write_ply(folder, truck()) for folder in (tmp_path, tmp_path / "moved")]
    scenes = [SceneConfig(object=str(file), label="truck", up="z") for file in files]
    one, other = (jobs(replace(STUDY, scene=scene)) for scene in scenes)
    for job, same in zip(one, other, strict=True):
        assert canonical(job.config_json) == canonical(same.config_json)
        reads = [source for source in job.inputs.values() if isinstance(source, Path)]
        assert reads == ([] if job.kind.endswith(("trained", "cleaned")) else [files[0]])
    mirrored = jobs(replace(STUDY, scene=replace(scenes[0], up="-z")))
    assert canonical(mirrored[0].config_json) != canonical(one[0].config_json)


def test_defaults_are_part_of_what_a_job_depends_on() -> None:
    """A default that changes must not find what another one made."""
    config = {job.kind.rpartition(".")[2]: job.config_json for job in jobs(STUDY)}
    asked = {name: config[name]["asked"] for name in ("trained", "layered", "poisoned")}
    assert asked["trained"]["training"]["sh_degree_interval"] == 1000
    assert asked["trained"]["training"]["outliers"] == 0
    assert asked["trained"]["training"]["point_deviations"] is None
    assert asked["layered"]["layers"]["making"]["gap"] == 5.0
    assert asked["layered"]["layers"]["making"]["apart"] is False
    assert asked["poisoned"]["attack"][0]["emphasis_depth"] == 20.0


def test_a_splat_that_was_edited_is_refused(tmp_path: Path) -> None:
    study = replace(TINY, training=replace(TINY.training, iterations=2))
    steps = steps_of(tmp_path, study)
    splat = steps.do(steps.splat("clean", 0), "").folder / "splat.ply"
    splat.write_bytes(splat.read_bytes() + b"\0")
    again = steps_of(tmp_path, study)
    with pytest.raises(InvalidValueError, match=r"expected the files that it wrote, got another splat\.ply"):
        again.finished(again.splat("clean", 0))
    with pytest.raises(InvalidValueError, match="expected the files that it wrote"):
        again.do(again.seen(again.splat("clean", 0), Redness()), "")


KINDS = (
    *("pictures", "looks", "poisoned", "trained", "layered", "cleaned", "true_pictures"),
    *("seen", "training_views", "compared"),
)


@pytest.mark.parametrize("kind", KINDS)
def test_the_code_of_a_job_is_all_that_it_may_run(kind: str) -> None:
    code = set(closure(f"attacks.cloak.kinds.{kind}"))
    assert "mi_splat.scene" in code
    if kind in ("poisoned", "trained", "layered", "seen", "training_views", "compared"):
        assert {"mi_splat.sh", "mi_splat.rasterization.projection"} <= code
    assert ("attacks.detectors.registry" in code) is (kind in ("seen", "training_views"))
    assert not {"attacks.cloak.study", "attacks.cloak.steps", "mi_splat.ledger.store"} & code


def test_every_kind_is_named() -> None:
    folder = Path(setup.__file__).parent / "kinds"
    names = {file.stem for file in folder.glob("*.py") if "\ndef run(" in file.read_text()}
    assert names == set(KINDS) == {*keys(STUDY)}
