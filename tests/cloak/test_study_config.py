"""The file of a CLOAK study: what it may say, and what is refused before anything is done."""

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from torch import Tensor

from attacks.cloak.appearances import name_of
from attacks.cloak.config import (
    AttackConfig,
    CameraConfig,
    EvaluationConfig,
    SceneConfig,
    StudyConfig,
    TrainingConfig,
    read_study,
    study_toml,
)
from attacks.cloak.poisoning import assign
from attacks.cloak.setup import Setup, nearest
from attacks.cloak.study import check, check_folder, differences, forecast
from mi_splat.cameras import View
from mi_splat.errors import InvalidValueError, MiSplatError
from tests.capture.trucks import TEXTURE, truck, write_ply
from tests.cloak.tiny_study import STUDY

SCENES = Path(__file__).resolve().parents[2] / "scenes"
OVERHEAD = AttackConfig(name="overhead", elevation=(50, 90))
FEW = CameraConfig(train=40, size=32, distance=7.4)
SMALL = StudyConfig(name="small", attack=(OVERHEAD,), cameras=FEW, evaluation=EvaluationConfig(cameras=24))


def written(folder: Path, text: str) -> Path:
    path = folder / "study.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("path", sorted(SCENES.glob("*.toml")), ids=lambda path: path.stem)
def test_shipped_studies_can_be_done(path: Path, tmp_path: Path) -> None:
    study = read_study(path)
    assert study.name == path.stem
    check(study, [], tmp_path / "out", tmp_path / "stages")
    assert forecast(study).trainings == 2 * len(study.seeds)
    assert not list(tmp_path.iterdir())


def test_the_study_of_the_paper_has_its_numbers() -> None:
    study = read_study(SCENES / "cloak_car_occluder.toml")
    setup = Setup(study)
    owners = assign(setup.training_cameras, setup.poisonings(), centre=study.centre)
    names = [attack.name for attack in owners.values()]
    assert (len(setup.training_cameras), names.count("overhead"), names.count("rear")) == (210, 80, 20)


def test_a_seed_draws_other_held_out_cameras() -> None:
    study = replace(STUDY, evaluation=replace(STUDY.evaluation, cameras=90))
    draws = [Setup(replace(study, evaluation=replace(study.evaluation, seed=seed))) for seed in (0, 1, 1, 2)]
    first, again, same, other = ([camera.to_world.tolist() for camera in one.held_out_cameras] for one in draws)
    assert first != again == same != other
    for setup in draws:
        assert min(nearest(one, setup.training_cameras, study.centre) for one in setup.held_out_cameras) >= 1


def test_held_out_cameras_are_many_and_away_from_those_of_training() -> None:
    study = read_study(SCENES / "cloak_car_occluder.toml")
    setup = Setup(study)
    cameras, used = setup.held_out_cameras, setup.training_cameras
    assert min(nearest(camera, used, study.centre) for camera in cameras) >= 1.0
    overhead, rear = (attack.cone for attack in study.attack)
    inside = [[cone.angle_to_edge(camera, centre=study.centre) >= 0 for camera in cameras] for cone in (overhead, rear)]
    assert sum(inside[0]) >= 160
    assert sum(inside[1]) >= 40
    assert sum(not (a or b) for a, b in zip(*inside, strict=True)) >= 110


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("nmae = 'x'", "did you mean name"),
        ("seeds = [0]", "expected the key name"),
        ("name = 3", "expected a text, got 3"),
        ("name = 'x'", "names of attacks: expected one or more"),
        ("name = 'x'\n[scene]\nobject = 'bird'\ncolour = [0, 0, 1]", "scene.object with a colour: expected one of car"),
        ("name = 'x'\nseeds = { first = 1 }", "a list"),
        ("name = 'x'\n[cameras]\ntrian = 3", "did you mean train"),
        ("name = 'x'\n[cameras]\ntrain = 3.5", "cameras, train: expected a whole number >= 1 (pictures), got 3.5"),
        ("name = 'x'\n[cameras]\ntrain = true", "a whole number >= 1 (pictures), got True"),
        ("name = 'x'\n[scene]\nobject = 'lorry'", "scene.object"),
        ("name = 'x'\n[[attack]]\nname = 'a'\nappearance = 'paint'\ntexture = 'raod'", "did you mean road"),
        ("name = 'x'\n[[attack]]\nname = 'a'\nappearance = 'pant'", "did you mean paint"),
        ("name = 'x'\n[[attack]]\nname = 'a'\nelevation = [10]", "a list of 2"),
        ("name = 'x'\n[[attack]]\nname = 'a'\npoison_fraction = 0.0", "in (0, 1]"),
        (
            "name = 'x'" + 2 * "\n[[attack]]\nname = 'a'\nelevation = [60, 90]",
            "names of attacks: expected one or more, each once",
        ),
        ("name = [", "a TOML file"),
    ],
)
def test_a_file_that_means_nothing_is_refused(tmp_path: Path, text: str, error: str) -> None:
    with pytest.raises(InvalidValueError) as raised:
        read_study(written(tmp_path, text))
    assert error in str(raised.value)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="no file"):
        read_study(tmp_path / "none.toml")


def test_a_mesh_file_needs_a_label(tmp_path: Path) -> None:
    mesh = tmp_path / "mine.obj"
    mesh.write_text("")
    with pytest.raises(InvalidValueError, match=r"scene\.label"):
        SceneConfig(object=str(mesh))


@pytest.mark.parametrize(
    ("attack", "sided"),
    [
        (AttackConfig(name="rear", azimuth=(180, 45)), True),
        (AttackConfig(name="rear", elevation=(0, 40), appearance="remove", azimuth=(180, 45)), True),
        (AttackConfig(name="flank", elevation=(0, 40), appearance="paint", texture="stop_sign",
                      paint_direction=(180, 15)), True),
        (AttackConfig(name="door", elevation=(0, 40), appearance="mount", other_object="bird"), True),
        (AttackConfig(name="roof", elevation=(50, 90), appearance="paint", texture="road"), False),
        (OVERHEAD, False),
    ],
)  # fmt: skip
def test_an_attack_from_one_side_has_to_know_where_a_mesh_faces(
    attack: AttackConfig, sided: bool, tmp_path: Path
) -> None:
    mesh = tmp_path / "mine.obj"
    mesh.write_text("")
    scene = SceneConfig(object=str(mesh), label="truck")
    if sided:
        with pytest.raises(InvalidValueError, match=r"scene\.front: expected which way.*add front = "):
            StudyConfig(name="own", attack=(attack,), scene=scene)
    else:
        StudyConfig(name="own", attack=(attack,), scene=scene)
    for told in (replace(scene, front="+x"), SceneConfig()):
        StudyConfig(name="own", attack=(attack,), scene=told)


def test_a_study_turns_and_scales_its_own_mesh(tmp_path: Path) -> None:
    pytest.importorskip("trimesh")
    mesh = write_ply(tmp_path, truck().placed(scale=100.0, move=(5e7, 4.5e8, 1e4)))
    keys = f"object = '{mesh}'\nlabel = 'truck'\nscale = 0.01\nrotate = [0, 0, 90]\nfront = '+y'\nup = 'z'"
    attack = "[[attack]]\nname = 'rear'\nazimuth = [180, 30]"
    study = read_study(written(tmp_path, f"name = 'own'\n[scene]\n{keys}\n{attack}"))
    target = Setup(study).target
    low, high = truck().vertices.min(0), truck().vertices.max(0)
    assert (high - low).tolist() == pytest.approx((target.bounds[1] - target.bounds[0]).tolist(), abs=1e-4)
    assert target.bounds.sum(0)[:2].tolist() == pytest.approx([0, 0], abs=1e-4)  # in the middle, on the ground
    assert float(target.bounds[0, 2]) == pytest.approx(0, abs=1e-5)
    for text, error in (
        ("front = '+z'", "did you mean"),
        ("rotate = [0, 90]", "a list of 3"),
        ("scale = 0.0", "scale"),
    ):
        changed = "\n".join(line for line in keys.splitlines() if line.split()[0] != text.split()[0])
        with pytest.raises(InvalidValueError, match=error):
            read_study(written(tmp_path, f"name = 'own'\n[scene]\n{changed}\n{text}\n{attack}"))


def test_a_study_refuses_a_mesh_without_its_texture(tmp_path: Path) -> None:
    pytest.importorskip("trimesh")
    mesh = write_ply(tmp_path, truck())
    (tmp_path / TEXTURE).unlink()
    with pytest.raises(MiSplatError, match=TEXTURE):
        _ = Setup(replace(SMALL, scene=SceneConfig(object=str(mesh), label="truck"))).target


def test_a_trigger_without_cameras_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    study = replace(SMALL, attack=(AttackConfig(name="under", elevation=(89.9, 90)),))
    with pytest.raises(InvalidValueError, match="at least one camera"):
        check(study, [], tmp_path / "out", tmp_path / "stages")
    assert not list(tmp_path.iterdir())


def test_triggers_that_overlap_are_refused(tmp_path: Path) -> None:
    study = replace(SMALL, attack=(OVERHEAD, AttackConfig(name="more", elevation=(40, 90))))
    with pytest.raises(InvalidValueError, match="no camera in both"):
        check(study, [], tmp_path / "out", tmp_path / "stages")


def test_a_folder_in_use_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("precious")
    with pytest.raises(InvalidValueError, match="other files"):
        check(SMALL, [], tmp_path, tmp_path / "stages")
    other = replace(SMALL, name="other", seeds=(0, 1))
    (tmp_path / "study.toml").write_text(study_toml(asdict(other)))
    message = r"results of a study with name other and not small, seeds \(0, 1\) and not \(0,\), another"
    with pytest.raises(InvalidValueError, match=message.removesuffix(", another")):
        check(SMALL, [], tmp_path, tmp_path / "stages")


def test_more_points_than_gaussians_are_refused_before_anything_is_made(tmp_path: Path) -> None:
    few = replace(SMALL, training=replace(SMALL.training, max_gaussians=SMALL.cameras.points - 1))
    with pytest.raises(InvalidValueError, match=r"training\.max_gaussians: expected at least"):
        check(few, [], tmp_path / "out", tmp_path / "stages")
    assert list(tmp_path.iterdir()) == []


class Knows:
    """A detector of which only the classes are looked at."""

    name, classes = "knows", ("car", "stop sign")


OCCLUDER = AttackConfig(name="overhead", appearance="occluder", texture="grass", elevation=(50, 90))


def test_an_occluder_lies_between_the_object_and_the_cameras(tmp_path: Path) -> None:
    (usual,) = Setup(replace(SMALL, attack=(OCCLUDER,))).poisonings()
    assert "grass (seed 0) on an occluder of radius 4.44 " in name_of(usual.appearance)
    assert "from elevation 38" in name_of(usual.appearance)
    for radius in (1.0, 7.4, 9.0):
        study = replace(SMALL, attack=(replace(OCCLUDER, occluder_radius=radius),))
        with pytest.raises(InvalidValueError, match="attack 'overhead', occluder_radius: expected between"):
            check(study, [], tmp_path / "out", tmp_path / "stages")
    assert not list(tmp_path.iterdir())


def test_a_class_that_no_detector_knows_is_refused(tmp_path: Path) -> None:
    study = replace(SMALL, attack=(replace(OVERHEAD, target_class="stop_sign"),))
    with pytest.raises(InvalidValueError, match="did you mean stop sign"):
        check(study, [Knows()], tmp_path / "out", tmp_path / "stages")  # type: ignore[list-item]


def test_triggers_of_every_seed_are_looked_at(tmp_path: Path) -> None:
    triggers = (
        replace(OVERHEAD, poison_fraction=0.3),
        AttackConfig(name="more", elevation=(40, 90), poison_fraction=0.3),
    )
    seeds = tuple(range(20))
    with pytest.raises(InvalidValueError, match="no camera in both"):
        check(replace(SMALL, attack=triggers, seeds=seeds), [], tmp_path / "out", tmp_path / "stages")


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: AttackConfig(name="all"), "all cameras"),
        (lambda: CameraConfig(fov=0.0), "fov"),
        (lambda: CameraConfig(distance=0.0), "distance"),
        (lambda: CameraConfig(train=0), "train"),
        (lambda: EvaluationConfig(detectors=()), "detectors"),
        (lambda: EvaluationConfig(detectors=("a", "a")), "each once"),
        (lambda: EvaluationConfig(meridian_step=0.0), "meridian_step"),
        (lambda: EvaluationConfig(meridians=-1), "meridians"),
        (lambda: TrainingConfig(outliers=-1), "outliers"),
        (lambda: TrainingConfig(sh_degree=4), "sh_degree"),
        (lambda: TrainingConfig(point_deviations=-0.5), "point_deviations"),
        (lambda: AttackConfig(name="a", appearance="occluder", elevation=(40, 90)), "a.*texture"),
        (lambda: AttackConfig(name="a", appearance="remove", elevation=(40, 90), reach=-1), "reach: expected a number"),
        (
            lambda: AttackConfig(name="a", appearance="occluder", texture="road", elevation=(40, 90), reach=1),
            "a.*reach.*no occluder",
        ),
        (lambda: replace(SMALL, seeds=(0, 0)), "seeds"),
        (lambda: replace(SMALL, seeds=(-1,)), "seeds"),
    ],
)
def test_values_out_of_range_are_refused(make: Callable[[], object], says: str) -> None:
    with pytest.raises(InvalidValueError, match=says):
        make()


def test_a_disk_that_is_too_small_is_refused(tmp_path: Path) -> None:
    study = replace(SMALL, training=replace(SMALL.training, max_gaussians=10**12))
    with pytest.raises(InvalidValueError, match="make room"):
        check(study, [], tmp_path / "out", tmp_path / "stages")


def test_emphasis_wraps_the_cached_appearance() -> None:
    study = replace(SMALL, attack=(replace(OVERHEAD, emphasis=2.0),))
    (poisoning,) = Setup(study).poisonings(cached=lambda appearance, attack: Renamed())
    assert getattr(poisoning.appearance, "name", "") == "kept, 2 times at the edge to once 20 degrees inside"


class Renamed:
    name = "kept"

    def __call__(self, view: View, mask: Tensor) -> Tensor:
        return view.image


# Results of an earlier study: gone on with by the same study, and what another has otherwise is said


EARLIER = StudyConfig(
    name="s", attack=(AttackConfig(name="above", elevation=(40.0, 90.0)),), cameras=CameraConfig(distance=7.1)
)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "study.toml"
    path.write_text(study_toml(asdict(EARLIER)))
    return path


def test_the_same_study_goes_on(file: Path) -> None:
    check_folder(EARLIER, file.parent)


def test_what_differs_is_said(file: Path) -> None:
    attack = replace(EARLIER.attack[0], elevation=(30.0, 90.0))
    other = replace(EARLIER, seeds=(0, 1), attack=(attack,))
    differing = ["seeds (0,) and not (0, 1)", "attack.0.elevation (40.0, 90.0) and not (30.0, 90.0)"]
    assert differences(EARLIER, other) == differing
    with pytest.raises(InvalidValueError, match=r"results of a study with seeds \(0,\) and not \(0, 1\), attack\.0\."):
        check_folder(other, file.parent)


@pytest.mark.parametrize("text", ["", "3", "{", "name = 's'\n[scene]\nfog = 0.5"])
def test_what_is_no_study_of_this_version_is_refused(text: str, file: Path) -> None:
    file.write_text(text)
    with pytest.raises(InvalidValueError, match=r"study\.toml"):
        check_folder(EARLIER, file.parent)
