"""Which jobs of a study depend on one of its fields."""

import functools
from dataclasses import fields, replace
from typing import Any

import pytest

from attacks.cloak.config import (
    AttackConfig,
    CameraConfig,
    LayerConfig,
    LayersConfig,
    SceneConfig,
    StudyConfig,
)
from attacks.cloak.config import TrainingConfig as Training
from attacks.cloak.setup import Setup
from attacks.cloak.steps import StudySteps
from mi_splat.import_closure import closure
from mi_splat.ledger import Job, Part
from mi_splat.ledger.job import canonical
from tests.cloak.tiny_study import Redness

ATTACK = AttackConfig(
    name="overhead", appearance="remove", texture="grass", elevation=(40.0, 90.0)
)
STUDY = StudyConfig(
    name="keys",
    attack=(ATTACK,),
    cameras=CameraConfig(train=12, size=32, distance=7.4, samples=2, points=100),
    training=Training(iterations=100, near=0.05),
    layers=LayersConfig(attacks=("overhead",)),
)
SEEN = {"seen", "compared"}
SHOWN = {"appearances", "poisoned", "true_pictures"}
MADE = {"pictures", "layered"} | SHOWN | SEEN
"""Jobs that know the scene itself; a splat is made of images, and known by their
content.
"""
KINDS = (
    *(
        f"attacks.cloak.kinds.{kind}"
        for kind in ("pictures", "trained", "seen", "compared")
    ),
    *("attacks.cloak.layers", "attacks.poisons.poisoned"),
)

CASES: list[tuple[str, set[str], dict[str, Any]]] = [
    (
        "scene",
        MADE,
        {"object": "bird", "ground": "grass"},
    ),
    # in a study's rows, what detectors call the object
    ("scene", {"seen"}, {"label": "truck"}),
    ("scene", MADE, {"ground_size": 12.0, "sun_azimuth": 10.0, "sun_elevation": 30.0}),
    ("scene", (MADE - {"pictures"}) | {"trained"}, {"background": (0.0, 0.0, 0.0)}),
    (
        "cameras",
        MADE,
        {
            "train": 14,
            "distance": 8.0,
            "distances": (0.8, 1.1),
            "elevations": (10.0, 40.0, 80.0),
        },
    ),
    (
        "cameras",
        MADE,
        {
            "height": 0.9,
            "fov": 50.0,
            "size": 40,
            "samples": 3,
            "points": 120,
            "hold_out": 4,
        },
    ),
    ("cameras", MADE, {"azimuths": (0.0, 90.0)}),
    (
        "training",
        {"trained"},
        {"iterations": 120, "strategy": "mcmc", "max_gaussians": 500, "sh_degree": 2},
    ),
    ("training", {"trained"}, {"sh_degree_interval": 20, "outliers": 10}),
    ("training", {"trained", "layered"} | SEEN, {"near": 0.1}),
    (
        "evaluation",
        {"seen", "compared"},
        {"cameras": 300, "seed": 1, "min_separation": 2.0},
    ),
    # each detector has jobs of its own, rows hold scores from which rates are counted,
    # and true images their own jobs
    ("evaluation", set(), {"detectors": ("yolov8n_small",), "confidence": 0.4}),
    (
        "evaluation",
        {"compared"},
        {"well_inside": 6.0, "far_outside": 12.0, "reference_views": 7},
    ),
    (
        "evaluation",
        {"compared", "true_pictures"},
        {"meridians": 2, "meridian_step": 10.0},
    ),
    (
        "layers",
        {"layered"},
        {
            "making": LayerConfig(gap=7.0),
            "margin": 0.1,
            "surroundings": True,
            "geometry": True,
        },
    ),
    (
        "layers",
        {"layered"},
        {"max_gaussians": 1000, "clearance": 0.02, "iterations": 50, "lr_sh": 0.02},
    ),
    ("layers", {"layered"}, {"lr_sh_final": 0.02}),
    # which the manifest and the rows say
    ("attack", SEEN | {"poisoned", "layered"}, {"name": "another"}),
    (
        "attack",
        SHOWN,
        {"appearance": "paint", "texture": "road", "other_object": "bird", "reach": 3},
    ),
    ("attack", SHOWN, {"paint_direction": (90.0, 10.0)}),
    (
        "attack",
        SHOWN,
        {"blur_width": 0.1, "mask": "difference", "lying": True},
    ),
    (
        "attack",
        SHOWN | SEEN | {"layered"},
        {"elevation": (50.0, 90.0), "azimuth": (180.0, 30.0)},
    ),
    ("attack", {"appearances", "poisoned", "seen"}, {"poison_margin": 4.0}),
    ("attack", {"poisoned"}, {"poison_fraction": 0.5}),
    ("attack", SEEN, {"target_class": "bird"}),
    # the seed of a job is a field of its own
    ("", set(), {"name": "other", "seeds": (3,)}),
]


@functools.cache
def built(scene: SceneConfig, cameras: CameraConfig) -> dict[str, Any]:
    """The meshes of a study and their digest: most fields have no part in them, and
    they take the longest.
    """
    setup = Setup(scene=scene, cameras=cameras)
    return {name: getattr(setup, name) for name in ("target", "mesh_scene", "source")}


def planned(study: StudyConfig) -> StudySteps:
    steps = StudySteps(study=study)
    vars(steps.setup).update(built(study.scene, study.cameras))
    return steps


def jobs(study: StudyConfig, *, seed: int = 0) -> dict[str, Job]:
    steps = planned(study)
    attack = study.attack[0]
    arc = [camera for _, camera in steps.setup.arc_cameras]
    clean = steps.splat("clean", seed)
    return {
        "pictures": steps.pictures(),
        "appearances": steps.appearance(attack),
        "poisoned": steps.poisoned(seed),
        "trained": clean,
        "layered": steps.splat("cloaked", seed),
        "true_pictures": steps.true_pictures(arc, study.overhead or attack),
        "seen": steps.seen(clean, Redness()),
        "compared": steps.compared(clean),
    }


@functools.cache
def keys(study: StudyConfig, *, seed: int = 0) -> dict[str, str]:
    """What each job depends on besides the content of its inputs, as text."""
    return {
        name: canonical(job.config_json) for name, job in jobs(study, seed=seed).items()
    }


def changed(before: StudyConfig, after: StudyConfig, **how: Any) -> set[str]:
    usual = keys(before)
    now = keys(after, **how)
    return {name for name in usual if usual[name] != now[name]}


def with_attack(attack: AttackConfig) -> StudyConfig:
    return replace(STUDY, attack=(attack,), layers=LayersConfig(attacks=(attack.name,)))


EACH = [
    (section, field, value, names)
    for section, names, values in CASES
    for field, value in values.items()
]


@pytest.mark.parametrize(
    ("section", "field", "value", "names"),
    EACH,
    ids=[f"{section}.{field}" for section, field, *_ in EACH],
)
def test_a_field_changes_the_jobs_that_it_has_a_part_in(
    section: str, field: str, value: Any, names: set[str]
) -> None:
    if section == "attack":
        # others have no such field
        before = replace(ATTACK, appearance="blur") if field == "blur_width" else ATTACK
        assert (
            changed(with_attack(before), with_attack(replace(before, **{field: value})))
            == names
        )
        return
    part = getattr(STUDY, section) if section else STUDY
    assert getattr(part, field) != value
    changes: dict[str, Any] = {field: value}
    other = replace(part, **changes)
    changes = {section: other}
    assert changed(STUDY, replace(STUDY, **changes) if section else other) == names


def test_every_field_has_a_case() -> None:
    known = {(section, field) for section, field, *_ in EACH}
    for section in ("scene", "cameras", "training", "evaluation", "layers"):
        assert {(section, entry.name) for entry in fields(getattr(STUDY, section))} - {
            ("layers", "attacks")
        } <= known
    assert {("attack", entry.name) for entry in fields(AttackConfig)} <= known


def test_the_seed_counts_where_something_is_drawn() -> None:
    assert changed(STUDY, STUDY, seed=1) == {"trained", "layered"}
    part = with_attack(replace(ATTACK, poison_fraction=0.5))
    assert changed(part, part, seed=1) == {"trained", "layered", "poisoned"}


def test_inputs_are_files_and_no_more_of_them_than_are_read() -> None:
    """A splat that was trained again to the same bytes is the same to whoever looks at
    it.
    """
    parts = {
        (name, source): part.pattern
        for name, job in jobs(STUDY).items()
        for source, part in job.inputs.items()
        if isinstance(part, Part)
    }
    assert parts == {
        **{(name, "pictures"): "set/*" for name in ("poisoned", "trained", "layered")},
        ("appearances", "set"): "set/*",
        **{(name, "splat"): "splat.ply" for name in ("seen", "compared")},
        **{("compared", name): "*.png" for name in ("far", "edge", "benign", "hidden")},
        ("poisoned", "appearance of overhead"): "*.png",
        ("layered", "clean"): "splat.ply",
        ("true_pictures", "plain"): "*.png",
    }


def test_without_a_near_plane_it_follows_the_object() -> None:
    free = replace(STUDY, training=replace(STUDY.training, near=None))
    assert "trained" in changed(
        free, replace(free, scene=replace(free.scene, object="bird"))
    )


@pytest.mark.parametrize("kind", KINDS)
def test_the_code_of_a_job_is_all_that_it_may_run(kind: str) -> None:
    code = set(closure(kind))
    assert (
        not {"attacks.cloak.study", "attacks.cloak.steps", "mi_splat.ledger.store"}
        & code
    )
    assert {job.kind for job in jobs(STUDY).values()} == set(KINDS)
