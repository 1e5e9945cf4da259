"""Images that were poisoned are told from the others, and no group is named in an
honest set.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from attacks import cli
from attacks.cloak.config import AttackConfig, CameraConfig, SceneConfig
from attacks.cloak.poisoning import poison
from attacks.cloak.setup import Setup
from attacks.report.results import read_section
from mi_splat.audit import audit_images, observations
from mi_splat.audit.image_splits import UNDECIDED
from mi_splat.audit.images import ImageAudit, surface_points
from mi_splat.audit.observations import median_of, observe
from mi_splat.cameras.camera import View
from mi_splat.capture.path_tracer import tracing_variant
from mi_splat.capture.surface_points import surface_samples
from mi_splat.datasets import Dataset, PointCloud, load_dataset
from mi_splat.errors import InvalidValueError
from scenes.recipes.audit_images import (
    CHOSEN_ON,
    HONEST,
    INSTEAD,
    KINDS,
    PLAIN,
    TRIED,
    drawn,
    ranking,
    read,
    table,
    tried,
)
from tests.datasets.sets import VIEWS, write_transforms
from tests.project.documented_commands import ROOT

# `scenes/cloak_demo.toml` with fewer and smaller images
DEMO = AttackConfig(
    name="overhead",
    appearance="remove",
    elevation=(38.2, 90.0),
    mask="difference",
    reach=1,
    poison_margin=7.0,
)
CAMERAS = CameraConfig(train=60, distance=7.4, size=64, samples=4)
POINTS = 3000


@dataclass(frozen=True, kw_only=True, eq=False)
class Captured:
    """Honest images, the same with poison, and which these are."""

    honest: list[View]
    poisoned: list[View]
    changed: Tensor
    points: PointCloud

    def written(self, folder: Path, views: list[View]) -> Dataset:
        """A set of files."""
        write_transforms(folder, views, points=self.points)
        return load_dataset(folder)


@pytest.fixture(scope="module")
def captured() -> Captured:
    setup = Setup(scene=SceneConfig(), cameras=CAMERAS, attacks=(DEMO,))
    scene = setup.mesh_scene
    with tracing_variant():
        honest = [View(one, scene.picture(one)) for one in setup.training_cameras]
        done = poison(honest, setup.poisonings(), centre=setup.centre, masks=scene.mask)
    parts = [
        surface_samples(scene.target, POINTS // 2, seed=0).points,
        surface_samples(scene.surroundings, POINTS // 2, seed=0).points,
    ]
    points = torch.cat([torch.from_numpy(part) for part in parts]).float()
    changed = torch.zeros(len(honest), dtype=torch.bool)
    changed[[change.index for change in done.changes]] = True
    return Captured(
        honest=honest,
        poisoned=list(done.views),
        changed=changed,
        points=PointCloud(points, torch.full_like(points, 0.5)),
    )


def named(judged: ImageAudit) -> set[int]:
    """The numbers of the images in group B."""
    return set(judged.groups[1].nonzero()[:, 0].tolist())


def test_the_poisoned_images_of_the_demo_are_named_and_no_honest_one(
    captured: Captured, tmp_path: Path
) -> None:
    judged = audit_images(captured.written(tmp_path, captured.poisoned))
    wanted = set(captured.changed.nonzero()[:, 0].tolist())
    assert judged.verdict == "two groups"
    assert named(judged) <= wanted
    assert len(named(judged)) >= 0.9 * len(wanted)
    assert judged.split is not None
    lowest = judged.split.scores[captured.changed].quantile(0.05)
    assert float(lowest) > float(judged.split.scores[~captured.changed].quantile(0.95))
    assert judged.split.pair is not None
    one, other = judged.split.pair
    assert one in wanted
    assert other not in wanted
    assert torch.equal(judged.left_out("A"), judged.groups[1])
    assert torch.equal(judged.left_out("B"), judged.groups[0])


def test_an_honest_set_falls_into_no_groups(captured: Captured, tmp_path: Path) -> None:
    judged = audit_images(captured.written(tmp_path, captured.honest))
    assert judged.verdict == "nothing found"
    assert named(judged) == set()
    assert not bool(judged.left_out("A").any())


def test_the_exposure_of_each_image_is_no_contradiction(
    captured: Captured, tmp_path: Path
) -> None:
    generator = torch.Generator().manual_seed(0)
    gains = 0.7 + 0.3 * torch.rand(len(captured.honest), generator=generator)
    views = [
        replace(view, image=view.image * gain)
        for view, gain in zip(captured.honest, gains, strict=True)
    ]
    assert audit_images(captured.written(tmp_path, views)).verdict == "nothing found"


def test_the_falloff_of_a_lens_is_no_contradiction(
    captured: Captured, monkeypatch: pytest.MonkeyPatch
) -> None:
    height, width = captured.honest[0].image.shape[:2]
    down = torch.linspace(-1, 1, height)[:, None]
    across = torch.linspace(-1, 1, width)
    light = 1 - 0.4 * (down.square() + across.square()) / 2
    darkened = [
        replace(view, image=view.image * light[..., None]) for view in captured.honest
    ]

    def departure(views: list[View]) -> float:
        found = observe(views, captured.points.points, most=1000)
        usual = median_of(found.colours, found.seen)
        return float((found.colours - usual)[found.seen].abs().mean())

    honest = departure(captured.honest)
    corrected = departure(darkened)
    monkeypatch.setattr(
        observations, "_falloff", lambda *given: torch.zeros_like(given[2])
    )
    assert corrected - honest < (departure(darkened) - honest) / 3


def test_groups_of_one_size_are_said_to_be_nearly_equal(
    captured: Captured, tmp_path: Path
) -> None:
    kept = torch.cat(
        [part.nonzero()[:20, 0] for part in (captured.changed, ~captured.changed)]
    )
    views = [captured.poisoned[number] for number in sorted(kept.tolist())]
    judged = audit_images(captured.written(tmp_path, views))
    assert judged.verdict == "two groups"
    assert judged.is_nearly_equal


def test_a_set_without_points_is_compared_on_a_surface_that_is_trained(
    captured: Captured, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mi_splat.audit.images.SURFACE_STEPS", 12)
    monkeypatch.setattr("mi_splat.audit.images.SURFACE_GAUSSIANS", 300)
    monkeypatch.setattr("mi_splat.audit.images.SOLID", 0.05)
    write_transforms(tmp_path, captured.poisoned)
    steps = []
    views = load_dataset(tmp_path)
    found = surface_points(views, on_step=lambda done, total: steps.append(total))
    assert found.shape[1] == 3
    assert len(found) > 0
    assert steps == [12] * 12
    assert audit_images(views).count == len(views)


def test_few_images_are_refused(tmp_path: Path) -> None:
    write_transforms(tmp_path, VIEWS)
    with pytest.raises(InvalidValueError, match="images: expected at least 12, got 6"):
        audit_images(load_dataset(tmp_path))


def test_points_that_no_image_sees_judge_nothing(
    captured: Captured, tmp_path: Path
) -> None:
    away = PointCloud(captured.points.points + 1000.0, captured.points.colours)
    write_transforms(tmp_path, captured.poisoned, points=away)
    judged = audit_images(load_dataset(tmp_path))
    assert judged.verdict == "not judged"
    assert named(judged) == set()


def test_the_command_names_both_groups_and_shows_a_pair(
    captured: Captured, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    views = captured.written(tmp_path / "set", captured.poisoned)
    out = tmp_path / "out"
    words = ["audit", str(tmp_path / "set"), "--out", str(out)]
    assert cli.main(words) == 3
    said = capsys.readouterr().out
    record = json.loads((out / "result.json").read_text())
    assert record["verdict"] == "two groups"
    assert "which group shows the truth, images cannot tell" in said
    groups = record["groups"]
    assert sum(map(len, groups.values())) == len(views)
    changed = {
        views.paths[number].name for number in captured.changed.nonzero()[:, 0].tolist()
    }
    assert set(groups["B"]) <= changed
    assert all(record["scores"][name] > UNDECIDED for name in groups["B"])
    assert {file.name for file in out.iterdir()} == {
        "result.json",
        "manifest.json",
        "pair.png",
    }
    section = read_section(out)
    assert section.kind == "audit of images"
    assert section.headline.words == "two groups"
    assert cli.main(["audit", str(tmp_path / "set"), "--cameras", "orbit:20@20"]) == 2


TRAIN = ("--iterations", "2", "--max-gaussians", "4000", "--eval-interval", "0")


def trained(source: Path, out: Path, *words: str) -> tuple[int, set[str]]:
    """The exit status of a short training, and the images that it left out."""
    status = cli.main(["train", str(source), "--out", str(out), *TRAIN, *words])
    if status:
        return status, set()
    settings = json.loads((out / "config.json").read_text())["settings"]
    return status, set(settings.get("left_out", ()))


def test_a_training_leaves_out_the_group_that_is_not_trusted(
    captured: Captured, tmp_path: Path
) -> None:
    views = captured.written(tmp_path / "set", captured.poisoned)
    larger, smaller = audit_images(views).groups
    names = [path.name for path in views.paths]
    for words, group in (
        (("--trust", "A"), smaller),
        (("--trust", "B"), larger),
        (("--robust",), smaller),
    ):
        out = tmp_path / "".join(words)
        status, left_out = trained(tmp_path / "set", out, *words)
        assert status == 0
        assert left_out == {names[number] for number in group.nonzero()[:, 0].tolist()}
    named_one = trained(tmp_path / "set", tmp_path / "one", "--leave-out", names[3])
    assert named_one == (0, {names[3]})


def test_a_training_that_can_trust_neither_group_stops(
    captured: Captured,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    captured.written(tmp_path / "set", captured.poisoned)
    monkeypatch.setattr("mi_splat.audit.images.EQUAL", 0.1)
    assert trained(tmp_path / "set", tmp_path / "out", "--robust") == (3, set())
    assert "nearly equal" in capsys.readouterr().err
    assert not (tmp_path / "out" / "splat.ply").exists()


def test_what_cannot_be_left_out_is_refused(
    captured: Captured, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    views = captured.written(tmp_path / "set", captured.poisoned)
    source = tmp_path / "set"
    assert trained(source, tmp_path / "a", "--leave-out", "nobody.png")[0] == 2
    assert "expected an image of the set" in capsys.readouterr().err
    assert trained(source, tmp_path / "b", "--robust", "--trust", "B")[0] == 2
    names = [path.name for path in views.paths]
    assert trained(source, tmp_path / "c", "--leave-out", *names)[0] == 1
    assert "expected images to train on" in capsys.readouterr().err


def test_the_page_has_the_tables_of_its_rows() -> None:
    tables = ROOT / "docs" / "tables"
    page = (ROOT / "docs" / "audit.md").read_text()
    unseen = read(tables / "audit_images_test.csv")
    assert "\n".join(table(unseen)) in page
    assert "\n".join(table(read(tables / "audit_images_photographs.csv"))) in page
    for row in unseen:
        number = int(row["set"].removeprefix("test-"))
        assert number >= CHOSEN_ON
        assert row["kind"] == KINDS[number % len(KINDS)]


def counted(rows: Sequence[dict[str, str]]) -> str:
    """Of sets of which fewer than half is poisoned: images that are, that are named,
    and rightly, and the mean AUROC.
    """
    plain = [
        row
        for row in rows
        if row["kind"] in (*PLAIN, *INSTEAD, "image")
        and 2 * int(row["poisoned"]) <= int(row["images"])
    ]
    poisoned, named, right = (
        sum(int(row[key]) for row in plain) for key in ("poisoned", "named", "right")
    )
    mean = sum(float(row["auroc"]) for row in plain) / len(plain)
    return f"{len(plain)}: {poisoned}, {named}, {right}, {mean:.3f}"


def test_the_page_counts_names_as_its_rows_do() -> None:
    tables = ROOT / "docs" / "tables"
    page = (ROOT / "docs" / "audit.md").read_text()
    rows = read(tables / "audit_images_test.csv")
    newest = [row for row in rows if row["set"] >= "test-085"]
    assert counted(rows) == "36: 679, 582, 565, 0.965"
    assert "679 images are, 582 are named, 565 of them rightly" in page
    assert (len(rows), len(newest)) == (93, 36)
    assert counted(newest) == "14: 285, 231, 215, 0.941"
    assert "285 are, 231 are named, 215 rightly" in page
    photographs = read(tables / "audit_images_photographs.csv")
    assert counted(photographs) == "12: 135, 86, 85, 0.862"
    assert "Mean AUROC 0.86, 8 of 12 called, 85 of 86 named rightly" in page
    readme = (ROOT / "README.md").read_text()
    assert "565/582 and 85/86 of the named images are poisoned" in readme
    honest = {row["set"]: row["verdict"] for row in rows if row["kind"] == HONEST}
    assert honest.pop("test-042") == "nothing found"  # it led to a rule
    assert [*honest.values()] == ["nothing found"] * 26
    assert "honest synthetic sets called: 0/26" in readme
    assert "0 of 26 honest sets are called" in page
    earlier = read(tables / "audit_images_photographs_earlier.csv")
    assert counted(earlier) == "23: 229, 162, 161, 0.842"
    assert "sets is 0.84, 18 are called, and 161 of 162 named rightly" in page
    for row in photographs:
        if row["kind"] != HONEST:
            start = f"| {row['object']} | {row['images']} | {row['kind']} |"
            counts = f"| {row['named']} | {row['right']} | {float(row['auroc']):.2f} |"
            (line,) = [line for line in page.split("\n") if line.startswith(start)]
            assert line.endswith(counts)


def test_every_development_set_has_a_name_of_its_own() -> None:
    names = [tried(number).name for number in range(len(TRIED) + 2)]
    assert len(set(names)) == len(names)


def test_a_ranking_counts_pairs_and_half_of_ties() -> None:
    scores = torch.tensor([0.1, 0.5, 0.5, 0.9])
    changed = torch.tensor([False, False, True, True])
    assert ranking(scores, changed) == pytest.approx((2 + 1 + 0.5) / 4)


@pytest.mark.parametrize("number", range(len(KINDS)))
def test_every_kind_of_set_can_be_drawn(number: int, tmp_path: Path) -> None:
    one = drawn(number, tmp_path)
    assert one.kind == KINDS[number]
    assert (one.setup.attacks == ()) == (one.kind == "honest")
    assert drawn(number, tmp_path).setup.attacks == one.setup.attacks
    if one.setup.attacks:
        held = one.setup.owners(0)
        assert 0 < len(held) < len(one.setup.training_cameras)
