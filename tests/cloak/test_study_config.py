"""The file of a CLOAK study: what it may say, and what is refused before anything is
done.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from attacks.cloak.config import (
    AttackConfig,
    CameraConfig,
    EvaluationConfig,
    LayersConfig,
    SceneConfig,
    StudyConfig,
)
from attacks.cloak.poisoning import assign
from attacks.cloak.setup import Setup, nearest
from attacks.cloak.steps import StudySteps
from attacks.cloak.study import check_study
from mi_splat.errors import InvalidValueError
from tests.cloak.tiny_study import STUDY, study_in
from tests.project.layers import ROOT

pytestmark = pytest.mark.shipped

OVERHEAD = AttackConfig(name="overhead", elevation=(50, 90))
WIDER = AttackConfig(name="more", elevation=(40, 90))
GROUND = replace(OVERHEAD, appearance="ground")
FEW = CameraConfig(train=40, size=32, distance=7.4)
SMALL = StudyConfig(
    name="small",
    attack=(OVERHEAD,),
    cameras=FEW,
    evaluation=EvaluationConfig(cameras=24),
)


def written(folder: Path, text: str) -> Path:
    path = folder / "study.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    "path", sorted((ROOT / "scenes").glob("*.toml")), ids=lambda path: path.stem
)
def test_shipped_studies_can_be_done(path: Path) -> None:
    study = study_in(path)
    check_study(StudySteps(study=study), [])


def test_the_study_of_the_paper_has_its_numbers() -> None:
    setup = Setup.of(study_in(ROOT / "scenes" / "cloak_car_colour.toml"))
    names = [
        attack.name
        for attack in assign(
            setup.training_cameras, setup.poisonings(), centre=setup.centre
        ).values()
    ]
    assert (
        len(setup.training_cameras),
        names.count("overhead"),
        names.count("rear"),
    ) == (210, 80, 20)
    cameras = setup.held_out_cameras
    assert min(nearest(cameras, setup.training_cameras, setup.centre)) >= 1.0
    over, rear = (
        attack.cone.holds(cameras, centre=setup.centre) for attack in setup.attacks
    )
    assert int(over.sum()) >= 160
    assert int(rear.sum()) >= 40
    assert int((~(over | rear)).sum()) >= 110


def test_a_seed_draws_other_held_out_cameras() -> None:
    evaluations = [
        replace(STUDY.evaluation, cameras=90, seed=seed) for seed in (0, 1, 1, 2)
    ]
    draws = [
        Setup.of(replace(STUDY, evaluation=evaluation)) for evaluation in evaluations
    ]
    first, again, same, other = (
        [camera.to_world.tolist() for camera in one.held_out_cameras] for one in draws
    )
    assert first != again == same != other
    for setup in draws:
        assert (
            min(nearest(setup.held_out_cameras, setup.training_cameras, STUDY.centre))
            >= 1
        )


ONE = "[[attack]]\nname = 'a'\n"
CLOAK = "study = 'cloak'\n"


@pytest.mark.parametrize(
    ("text", "error"),
    [
        (CLOAK + "sedes = [0]", "did you mean seeds"),
        (
            CLOAK + "[scene]\nobject = 'cat'",
            "scene.object: expected a .glb file, or one of car, person, stop sign",
        ),
        (
            CLOAK + "[cameras]\ntrain = 3.5",
            "cameras, train: expected a whole number >= 1 (images), got 3.5",
        ),
        (CLOAK + "[scene]\nobject = 'lorry'", "scene.object"),
        (
            ONE + "appearance = 'paint'\nelevation = [60, 90]\ntexture = 'raod'",
            "did you mean road",
        ),
        (
            ONE + "elevation = [60, 90]\n[[attack]]\nname = 'a'\nelevation = [60, 90]",
            "names of attacks: expected one",
        ),
        ("name = [", "a TOML file"),
    ],
)
def test_a_file_that_means_nothing_is_refused(
    tmp_path: Path, text: str, error: str
) -> None:
    with pytest.raises(InvalidValueError) as raised:
        study_in(written(tmp_path, text))
    assert error in str(raised.value)


def test_what_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="no file"):
        study_in(tmp_path / "none.toml")


class Knows:
    """A detector of which only the classes are looked at."""

    name = "knows"
    classes = ("car", "stop sign")


@pytest.mark.parametrize(
    ("study", "message"),
    [
        (replace(SMALL, attack=()), "names of attacks: expected one or more"),
        (
            replace(SMALL, attack=(AttackConfig(name="under", elevation=(89.9, 90)),)),
            "at least one camera",
        ),
        (replace(SMALL, attack=(OVERHEAD, WIDER)), "no camera in both"),
        (
            replace(
                SMALL,
                attack=tuple(
                    replace(one, poison_fraction=0.3) for one in (OVERHEAD, WIDER)
                ),
                seeds=(*range(20),),
            ),
            "no camera in both",
        ),
        (
            replace(
                SMALL,
                training=replace(
                    SMALL.training, max_gaussians=SMALL.cameras.points - 1
                ),
            ),
            r"training\.max_gaussians: expected at least",
        ),
        (
            replace(SMALL, attack=(replace(OVERHEAD, target_class="stop_sign"),)),
            "did you mean stop sign",
        ),
        (replace(SMALL, scene=SceneConfig(object="bird")), "class for knows"),
        (
            replace(
                SMALL,
                attack=(replace(OVERHEAD, poison_margin=8),),
                layers=LayersConfig(attacks=("overhead",)),
            ),
            r"poison_margin.*shift",
        ),
    ],
)
def test_what_cannot_be_done_is_refused(study: StudyConfig, message: str) -> None:
    with pytest.raises(InvalidValueError, match=message):
        check_study(StudySteps(study=study), [Knows()])  # type: ignore[list-item]


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: AttackConfig(name="all"), "all cameras"),
        (lambda: EvaluationConfig(detectors=("a", "a")), "each once"),
        (
            lambda: AttackConfig(name="a", appearance="paint", elevation=(40, 90)),
            "a.*texture",
        ),
        (lambda: replace(GROUND, mask="difference"), "mask: expected object"),
        (lambda: replace(SMALL, seeds=(0, 0)), "seeds"),
    ],
)
def test_values_out_of_range_are_refused(make: Callable[[], object], says: str) -> None:
    with pytest.raises(InvalidValueError, match=says):
        make()


def test_a_fraction_of_the_cameras_depends_on_the_seed() -> None:
    setup = Setup.of(study_in(ROOT / "scenes" / "cloak_car_colour.toml"))
    half = replace(setup.attacks[0], poison_fraction=0.5)
    chosen = [
        half.trigger(seed).holds(setup.training_cameras, centre=setup.centre)
        for seed in (1, 1, 2)
    ]
    assert chosen[0].tolist() == chosen[1].tolist() != chosen[2].tolist()
    assert int(chosen[0].sum()) == int(chosen[2].sum()) == 40
