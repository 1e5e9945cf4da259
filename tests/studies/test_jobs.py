"""Jobs of attacks and looks: everything that a result depends on is in its key, and
nothing else is.
"""

import dataclasses
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from attacks.figures.frame import read_figures
from attacks.observe.rows import rows
from attacks.studies.attack import Attack
from attacks.studies.result import EVALUATION, SETTING, SURVIVAL
from mi_splat.cameras.camera import Camera
from mi_splat.errors import InvalidValueError
from mi_splat.io.camera_records import describe
from mi_splat.io.documents import save_json
from mi_splat.io.folders import RECORD
from mi_splat.io.parsing import read_json
from mi_splat.ledger import Done, Job
from tests.fakes import ColourDetector, camera
from tests.studies.toy import SCENE, done, key_of, settings, work_of, write_toy

pytestmark = pytest.mark.usefixtures("toys")


def nudged(by: float) -> Camera:
    pose = camera().to_world.clone()
    pose[0, 3] += by
    return dataclasses.replace(camera(), to_world=pose)


CHANGES: dict[str, dict[str, Any]] = {
    "a camera that moved by less than is printed": {
        "cameras": {**SCENE.cameras, "front": nudged(4e-5)}
    },
    "a camera less": {"cameras": {"front": camera()}},
    "another near plane": {"settings": dataclasses.replace(SCENE.settings, near=0.5)},
    "other Gaussians": {
        "scene": SCENE.scene.replace(opacities=SCENE.scene.opacities * 0.99)
    },
}


def the_job(folder: Path, **changes: Any) -> Job:
    (attempt,) = work_of(settings(folder, **changes)).attempts
    return attempt.job


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("study", ["dagger", "dagger-eot"])
def test_a_result_belongs_to_all_that_the_attack_saw(
    change: str, study: str, tmp_path: Path
) -> None:
    for name, changes in {"before": {}, "same": {}, "after": CHANGES[change]}.items():
        write_toy(tmp_path / name, **changes)
    before, same, after = (
        key_of(the_job(tmp_path / name, study=study), tmp_path / "store")
        for name in ("before", "same", "after")
    )
    assert before == same != after


def test_weights_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_toy(tmp_path)
    before = key_of(the_job(tmp_path), tmp_path)
    monkeypatch.setattr(ColourDetector, "fingerprint", "another")
    assert key_of(the_job(tmp_path), tmp_path) != before


@pytest.fixture(scope="module")
def attacked(tmp_path_factory: pytest.TempPathFactory, toys: None) -> Path:
    """A folder with the toy scene and a store."""
    folder = tmp_path_factory.mktemp("attacked")
    write_toy(folder)
    return folder


def looks_of(folder: Path, **attack: Any) -> list[str]:
    """Keys of the looks at the splat of an attack."""
    table = settings(
        folder, attack={"eps": 12.0, "steps": 4, "noise_draws": 0, **attack}
    )
    results = done(
        work_of({**table, "evaluate_with": {"condition": ".spz"}}), folder / "store"
    )
    return [
        result.key
        for result in results.values()
        if isinstance(result, Done) and result.record["kind"].endswith("look")
    ]


def test_a_splat_that_is_made_anew_is_judged_anew(attacked: Path) -> None:
    """A look belongs to the bytes of the splat, not to the name or the settings of the
    attack.
    """
    first = looks_of(attacked)
    assert looks_of(attacked, step_factor=1.5) != first
    assert looks_of(attacked, noise_draws=1) == first  # the same splat


REGION: dict[str, Any] = {
    "study": "dagger-eot",
    "attack": {"steps": 1, "batch": 1, "pool": 1, "validation": 1, "held_out": 2},
    "cameras": {
        "azimuths": [-120.0, -60.0],
        "elevations": [0.0, 10.0],
        "distances": [0.9, 1.1],
    },
}


@pytest.mark.parametrize("table", [{}, REGION])
def test_a_splat_is_looked_at_from_further_away_and_the_box_is_where_it_shows(
    table: dict[str, Any], attacked: Path
) -> None:
    evaluation = {"matrix": {"condition": ["", "1.5 x distance"]}}
    work = work_of({**settings(attacked), **table, "evaluate_with": evaluation})
    results = done(work, attacked / "store")
    (attempt,) = work.attempts
    widths = []
    distances = []
    for label in attempt.looks:
        look = results[label]
        assert isinstance(look, Done)
        widths.append(look.rows[0]["x1"] - look.rows[0]["x0"])
        distances.append(look.rows[0]["distance"])
    assert distances[1] == pytest.approx(1.5 * distances[0])
    assert widths[1] < widths[0]


AROUND: dict[str, Any] = {
    "around": {"angle": 8.0},
    "images": {"sizes": [1.0, 1.0]},
    "only_detected": True,
    "attack": {
        "steps": 2,
        "batch": 1,
        "pool": 2,
        "validation": 2,
        "held_out": 3,
        "validate_every": 2,
    },
    "objective": {"strict": True},
}


def test_an_attack_around_a_camera_is_judged_from_there_on_plain_images(
    attacked: Path, tmp_path: Path
) -> None:
    evaluation = {"matrix": {"condition": ["", "JPEG 75", "1.5 x size"]}, "views": 2}
    matrix = {"camera": [0, 1], "attack.object_psnr": [20.0]}
    table = {
        **settings(attacked),
        **AROUND,
        "matrix": matrix,
        "evaluate_with": evaluation,
    }
    work = work_of(table)
    results = done(work, attacked / "store")
    first, second = (attempt.job.config for attempt in work.attempts)
    assert first.transformations.images.jpeg == 50
    assert first.evaluation.images.jpeg == 0
    assert first.camera != second.camera
    attack = results[work.attempts[0].title]
    assert isinstance(attack, Done)
    positions = {(row["x"], row["y"], row["z"]) for row in attack.rows}
    assert len(positions) == 3
    work.write(results, tmp_path)
    figures = read_figures(tmp_path).where(splat="attacked")
    (over_cameras,) = figures.where(scope=SETTING).rates("detected")
    assert over_cameras.total == 6
    survived = figures.where(scope=SURVIVAL, condition="JPEG 75")
    assert [rate.total for rate in survived.rates("detected")] == [4]


def test_changes_of_images_need_views_around_a_camera(attacked: Path) -> None:
    with pytest.raises(InvalidValueError, match="around with images"):
        work_of({**settings(attacked), "images": {"jpeg": 50}})


def test_an_attack_that_two_parts_have_counts_in_both(
    attacked: Path, tmp_path: Path
) -> None:
    table = settings(
        attacked,
        case=[{"name": "one"}, {"name": "same"}],
        evaluate_with={"condition": ".spz"},
    )
    work = work_of(table)
    work.write(done(work, attacked / "store"), tmp_path)
    record = read_json(tmp_path / RECORD)
    figures = read_figures(tmp_path)
    settings_of = figures.where(scope=SETTING)
    looks = figures.where(scope=EVALUATION)
    for part in ("one", "same"):
        assert settings_of.rate("reached", part=part, splat="attacked").total == 1
        (targeted,) = looks.where(part=part).rates("targeted")
        assert targeted.total == 1
    assert len(record["attacks"]) == 2


def test_a_seed_moves_the_camera_and_the_start(tmp_path: Path) -> None:
    write_toy(tmp_path)
    for seed in (0, 2):
        config = the_job(tmp_path, seed=seed).config
        assert isinstance(config, Attack)
        assert (config.attack.seed, config.attack.random_start) == (seed, seed > 0)
    with pytest.raises(InvalidValueError, match="attack in toy: expected no seed"):
        the_job(tmp_path, attack={"seed": 1})


def test_attacks_from_cameras_of_a_file_count_those_that_show_the_object(
    tmp_path: Path,
) -> None:
    write_toy(tmp_path)
    # too small in the last
    cameras = [camera(), camera(offset=0.3), camera(offset=9.0)]
    file = str(tmp_path / "cameras.json")
    save_json(
        {"cameras": [describe(str(n), one) for n, one in enumerate(cameras)]},
        Path(file),
    )
    table = settings(
        tmp_path, cameras=file, objective={"strict": True, "confidence": 0.5}
    )
    work = work_of({**table, "matrix": {"camera": [0, 1, 2], "seed": [1, 2]}})
    work.write(done(work, tmp_path / "store"), tmp_path)
    group = read_figures(tmp_path).where(scope=SETTING)
    seen = rows(tmp_path)
    # the seed moves none of them
    assert sorted(set(seen["x"])) == pytest.approx([0.0, 0.3, 9.0])
    assert group.rate("detected", splat="attacked").counts == "4 of 6"
    near = seen.filter(pl.col("x") < 1)
    for name in ("attacked", "noise"):
        counts = group.where(splat=name)
        wanted, gone = (
            near.filter(splat=name)[f"{column}_score"]
            for column in ("target", "original")
        )
        strict = counts.rate("strict_if_detected")
        assert strict.successes == ((wanted >= 0.5) & (gone < 0.5)).sum()
        assert strict.total == 4
        success = counts.rate("success_if_detected")
        assert success.successes == (wanted >= 0.5).sum()
        assert counts.rate("lost_if_detected").successes == (gone < 0.5).sum()
    attacked, noise = (
        group.rate("strict_if_detected", splat=splat) for splat in ("attacked", "noise")
    )
    assert attacked.successes > noise.successes
    of_attack, of_noise = (
        group.value("psnr_object_if_detected", splat=splat)
        for splat in ("attacked", "noise")
    )
    assert of_attack == pytest.approx(of_noise, abs=1.0)
    for wrong, expected in (
        ({"camera": 3}, "expected 0 to 2, got 3"),
        ({"cameras": "no.json"}, "a JSON file"),
    ):
        with pytest.raises(InvalidValueError, match=expected):
            the_job(tmp_path, **{"cameras": file, **wrong})


def test_a_look_has_noise_that_changes_the_object_as_much_as_the_attack(
    attacked: Path,
) -> None:
    work = work_of(
        settings(attacked, evaluate_with={"controls": ["noise", "norm-noise"]})
    )
    look = done(work, attacked / "store")[next(iter(work.attempts[0].looks))]
    assert isinstance(look, Done)
    psnr = {row["splat"]: row["object_psnr"] for row in look.rows}
    assert psnr["clean"] is None
    assert psnr["noise"] == pytest.approx(psnr["attacked"], abs=0.5)
    assert psnr["norm-noise"] > psnr["attacked"] + 3
