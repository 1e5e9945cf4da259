"""Hidden looks are found, honest splats are not called so, and a file that cannot be
judged gets no verdict.
"""

import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from attacks import cli
from mi_splat.audit import Audit, Look, ObjectAudit, Occluder, audit, linting
from mi_splat.audit.evidence import cover_heat, cover_of
from mi_splat.audit.explanations import support_of
from mi_splat.audit.objects import Target, frame_of, targets
from mi_splat.audit.results import headline
from mi_splat.audit.surfaces import Elements, Sight
from mi_splat.audit.thresholds import LIMITS
from mi_splat.audit.viewpoints import cameras_around, lattice
from mi_splat.cameras.camera import Camera, look_at
from mi_splat.cameras.lens import Lens
from mi_splat.errors import InvalidValueError
from mi_splat.io import load_splat, save_splat
from mi_splat.maths.rotation import to_matrix
from mi_splat.scene import GaussianScene, Similarity, merge
from scenes.recipes.audit_set import far_roof, fogged, smooth
from tests.audit import scenes
from tests.audit.scenes import ROAD, Made, cone, direction, hidden, sector, standing


@pytest.fixture(autouse=True, scope="module")
def _few_small_pictures() -> object:
    """Of every object 60 images of 72 pixels, not 150 of 128."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(vars(LIMITS), "image_size", 72)
        patch.setitem(vars(LIMITS), "cameras", 60)
        patch.setitem(vars(LIMITS), "cameras_all_around", 96)
        patch.setattr(linting, "SIZE", 256)
        yield


@pytest.fixture(scope="module")
def suitcase() -> Made:
    return standing("suitcase", count=1500)


@pytest.fixture(scope="module")
def from_above(suitcase: Made) -> Made:
    return hidden(suitcase, cone(direction(90, 0), 50))


@pytest.fixture(scope="module")
def judged(from_above: Made) -> Audit:
    return _finer(from_above.scene)


def _finer(scene: GaussianScene) -> Audit:
    """An audit with 70 images of 96 pixels."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(vars(LIMITS), "image_size", 96)
        patch.setitem(vars(LIMITS), "cameras", 70)
        return audit(scene)


def overlap(
    item: ObjectAudit, inside: Callable[[Tensor], Tensor], look: Look | None = None
) -> float:
    """Intersection over union of the cameras that are said to see an appearance with
    those that do.
    """
    truth = inside(item.directions.float())
    shown = (look or item.look).shown
    return float((shown & truth).sum() / (shown | truth).sum())


def test_a_look_from_above_is_found_with_its_directions_and_gaussians(
    judged: Audit, from_above: Made
) -> None:
    assert judged.verdict == "hidden look"
    item = judged.strongest
    assert item.up == pytest.approx((0, 0, 1), abs=0.02)
    assert overlap(item, cone(direction(90, 0), 50)) > 0.7
    assert item.look.region.axis[2] > 0.97
    assert item.look.region.half_width == pytest.approx(50, abs=10)
    assert item.look.direction > 1.2 * max(item.look.incidence, item.look.mirror)
    ours = judged.heat[from_above.rows]
    others = judged.heat[~from_above.rows]
    assert float(ours.median()) > 4 * float(others.median())
    assert (
        float(
            (judged.mask & from_above.rows).sum()
            / (judged.mask | from_above.rows).sum()
        )
        > 0.8
    )
    assert len(item.looks) == 1
    pair = item.look.pair
    assert pair is not None
    assert pair.change > 0.1
    positions = torch.stack(
        [pair.inside.position, pair.outside.position]
    ) - torch.tensor(item.centre)
    heights = (positions[:, 2] / positions.norm(dim=1)).asin().rad2deg()
    assert heights[0] > heights[1] + 3


@pytest.mark.nightly
def test_layers_and_what_is_smooth_over_azimuth_are_found(suitcase: Made) -> None:
    for made in (scenes.layered(suitcase), smooth(suitcase, azimuth=40.0)):
        assert audit(made.scene).verdict == "hidden look"


def test_a_sector_is_found(suitcase: Made) -> None:
    inside = sector(180, 40, -10, 45)
    judged = audit(hidden(suitcase, inside, colour=(0.75, 0.12, 0.1)).scene)
    assert judged.verdict == "hidden look"
    assert overlap(judged.strongest, inside) > 0.55
    assert judged.strongest.look.region.axis[0] < -0.8


MORE_MATERIALS = [
    pytest.param(make, marks=pytest.mark.nightly)
    for make in (scenes.metal, scenes.velvet)
]


@pytest.mark.parametrize("make", [scenes.glossy, scenes.noisy, *MORE_MATERIALS])
def test_honest_splats_are_not_called_hidden(make: Callable[[Made], Made]) -> None:
    judged = audit(make(standing("car", count=1200)).scene)
    assert judged.verdict == "nothing found"
    assert not judged.mask.any()


def test_a_thin_sign_is_an_object_and_not_the_ground_of_its_pole() -> None:
    frame = frame_of(standing("stop sign", count=1500).scene)
    objects = targets(frame.scene)
    assert len(objects[0].rows) > 1000
    for item in objects:
        assert item.up is not None
        assert frame.direction(item.up).tolist() == pytest.approx([0, 0, 1], abs=0.02)
    for item in targets(frame.scene, frame.own((0.0, -3.0, 0.0))):
        assert item.up is not None
        assert frame.direction(item.up).tolist() == pytest.approx([0, -1, 0], abs=1e-6)


def test_what_covers_an_object_from_far_above_is_suspicious(suitcase: Made) -> None:
    """Leaves are no ground either, though they lie in a plane nearly; nobody can tell
    them from a roof that hides.
    """
    for made in (scenes.leaves(suitcase), far_roof(suitcase)):
        judged = audit(made.scene)
        assert judged.verdict == "suspicious"
        assert judged.strongest.up == pytest.approx((0, 0, 1), abs=0.02)
        assert judged.strongest.roofed
        assert "far above" in headline(judged)


def test_an_honest_neighbour_of_what_hides_something_is_not_called_so(
    suitcase: Made, from_above: Made
) -> None:
    """They stand so near that each shows among what is around the other."""
    part = from_above.scene.select(from_above.rows)
    size = float(part.means[:, 0].max() - part.means[:, 0].min())
    moved = part.replace(means=part.means + torch.tensor([1.3 * size, 0.0, 0.0]))
    judged = audit(merge(suitcase.scene.with_degree(3), moved))
    honest, hides = sorted(judged.objects, key=lambda item: item.centre[0])
    assert honest.verdict != "hidden look"
    assert hides.verdict == "hidden look"
    assert headline(judged).startswith(
        f"object {1 + judged.objects.index(judged.strongest)}, "
    )


def test_what_changes_hardly_any_surface_is_no_evidence_from_given_cameras(
    judged: Audit,
) -> None:
    item = judged.strongest
    assert item.look.changed > 0.1
    for share, verdict in ((0.0, "nothing found"), (1.0, "hidden look")):
        look = dataclasses.replace(item.look, changed=share, given=True)
        assert dataclasses.replace(item, looks=(look,)).verdict == verdict


def test_where_one_side_sees_fog_a_splat_is_never_called_hidden_nor_cleared(
    judged: Audit,
) -> None:
    item = judged.strongest
    for lost, air, net in (
        (0.6, 1.0, 1.0),
        (0.0, 0.3, 0.0),
        (0.0, 0.3, 1.0),
        (0.0, 6.0, 1.0),
    ):
        look = dataclasses.replace(item.look, net=net, lost=lost, air=air)
        fogged = dataclasses.replace(
            judged, objects=(dataclasses.replace(item, looks=(look,)),)
        )
        assert fogged.verdict == "suspicious"
        assert "pass --cameras" in headline(fogged)


def test_support_falls_where_the_smaller_side_loses_surface_and_clear_air() -> None:
    """Ten cameras, of which three see a look; they miss half of the pieces that the
    others see.
    """
    target = Target(
        rows=torch.arange(1),
        centre=torch.zeros(3, dtype=torch.float64),
        radius=1.0,
        up=None,
    )
    cameras = cameras_around(target)[:10]
    moments = torch.ones(10, 8, 5)
    moments[:3, 4:, 0] = 0.0
    toward = (
        torch.stack([camera.position for camera in cameras])
        .float()
        .mean(0, keepdim=True)
    )
    pieces = Elements(
        moments=moments,
        positions=torch.zeros(8, 3),
        normals=torch.nn.functional.normalize(toward, dim=1).expand(8, 3),
        judged=torch.ones(8, dtype=torch.bool),
        size=0.1,
        of_seen=torch.zeros(0, dtype=torch.int64),
        unseen=0,
    )
    view = _view(cameras, clear=torch.tensor([0.2] * 3 + [0.8] * 7))
    assert support_of(pieces, view, torch.arange(10) < 3) == pytest.approx((0.5, 0.25))


def test_what_covers_an_object_and_geometry_are_suspicious_and_no_proof(
    judged: Audit,
) -> None:
    """An honest canopy covers an object as well; Gaussians of one colour change only in
    which of them shows.
    """
    item = judged.strongest
    assert dataclasses.replace(item, plain=True).verdict == "suspicious"
    dark = torch.ones(len(item.directions))
    cover = Occluder(axis=(0.0, 0.0, 1.0), blocked=dark, transparent=0.8, score=0.5)
    plain = dataclasses.replace(item.look, net=0.0)
    covered = dataclasses.replace(
        judged, objects=(dataclasses.replace(item, looks=(plain,), occluder=cover),)
    )
    assert covered.verdict == "suspicious"
    assert (
        "something in the air covers an object from around (0.00 0.00 1.00)"
        in headline(covered)
    )


def test_the_verdict_does_not_depend_on_axes_units_and_rows(
    judged: Audit, from_above: Made
) -> None:
    scene = from_above.scene
    turn = to_matrix(
        torch.nn.functional.normalize(
            torch.tensor([0.3, -0.5, 0.7, 0.2], dtype=torch.float64), dim=0
        )
    )
    shift = torch.tensor([30.0, -5.0, 12.0], dtype=torch.float64)
    order = torch.randperm(len(scene), generator=torch.Generator().manual_seed(3))
    moved = scene.transform(
        Similarity(rotation=turn, translation=shift, scale=0.05)
    ).select(order)
    again = _finer(moved)
    assert again.verdict == judged.verdict
    first = judged.strongest.look
    second = again.strongest.look
    assert second.net == pytest.approx(first.net, rel=0.25)
    turned = turn @ torch.tensor(first.region.axis, dtype=torch.float64)
    assert float(
        turned @ torch.tensor(second.region.axis, dtype=torch.float64)
    ) > math.cos(math.radians(5))
    same = (again.mask == judged.mask[order]).double().mean()
    assert float(same) > 0.95


def test_given_cameras_say_from_where_an_object_is_looked_at(from_above: Made) -> None:
    eyes = (
        7
        * lattice(45, 5.0, 85.0)
        * float(from_above.scene.means[from_above.rows].norm(dim=1).max())
        / 2
    )
    cameras = [
        Camera(
            to_world=look_at(eye.tolist(), (0.0, 0.0, 0.1)),
            lens=Lens(focal=200.0, size=(160, 120)),
        )
        for eye in eyes
    ]
    judged = audit(from_above.scene, cameras=cameras)
    assert judged.verdict == "hidden look"
    assert len(judged.objects) == 1
    # none from above
    assert audit(from_above.scene, cameras=cameras[:15]).verdict == "nothing found"
    foggy = fogged(from_above, seed=0).scene
    assert audit(foggy).strongest.fogged
    assert not audit(foggy, cameras=cameras).strongest.fogged
    with pytest.raises(InvalidValueError, match="cameras: expected at least 12, got 3"):
        audit(from_above.scene, cameras=cameras[:3])
    away = [
        Camera(
            to_world=look_at(eye.tolist(), (2 * eye).tolist()),
            lens=Lens(focal=200.0, size=(64, 64)),
        )
        for eye in eyes
    ]
    with pytest.raises(
        InvalidValueError,
        match=r"pieces of surface .* pass cameras that see more of it",
    ):
        audit(from_above.scene, cameras=away)


def test_what_cannot_be_judged_gets_no_verdict(suitcase: Made) -> None:
    scene = suitcase.scene
    clear = scene.replace(opacities=torch.full((len(scene),), 0.01))
    for empty in (clear, scene.select(slice(0, 0))):
        with pytest.raises(
            InvalidValueError, match=r"Gaussians with an opacity above 0\.1, got none"
        ):
            audit(empty)
    with pytest.raises(
        InvalidValueError, match="Gaussians at several places, got all at one"
    ):
        audit(scene.select(slice(0, 1)))
    with pytest.raises(InvalidValueError, match="pieces of surface"):
        audit(scene.select(torch.tensor([0, 700])))


def _view(
    cameras: tuple[Camera, ...],
    depths: tuple[Tensor, ...] = (),
    clear: Tensor | None = None,
) -> Sight:
    """What cameras see of which only depths or clear rays are asked."""
    none = torch.zeros(0, dtype=torch.int64)
    return Sight(
        cameras=cameras,
        directions=torch.nn.functional.normalize(
            torch.stack([camera.position for camera in cameras]), dim=1
        ),
        depths=depths,
        clear=torch.ones(len(cameras)) if clear is None else clear,
        keys=none,
        seen_by=none,
        sums=torch.zeros(0, 10),
        pixels={},
    )


def test_what_covers_an_object_from_above_and_lets_others_through() -> None:
    """By depths alone: a lid that cameras above see, and no camera at the side does."""
    centre = torch.zeros(3, dtype=torch.float64)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    target = Target(rows=torch.arange(2), centre=centre, radius=1.0, up=up)
    cameras = cameras_around(target)
    directions = torch.stack([camera.position for camera in cameras]) / 2.6
    lid = torch.full((72, 72), 1.0)
    behind = torch.full((72, 72), 2.6)
    depths = tuple(lid if float(d[2]) > 0.7 else behind for d in directions)
    view = _view(cameras, depths)
    scene = GaussianScene(
        means=torch.tensor([[0.0, 0.0, -0.2], [0.0, 0.0, 0.2], [0.0, 0.0, 1.6]]),
        scales=torch.full((3, 3), 0.1),
        rotations=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(3, 4).contiguous(),
        opacities=torch.ones(3),
        sh=torch.zeros(3, 1, 3),
    )
    cover, covered = cover_of(scene, view, target)
    assert cover is not None
    assert torch.equal(cover.blocked > 0.3, directions[:, 2] > 0.7)
    assert cover.transparent > 0.9
    assert cover.score == pytest.approx(
        float((directions[:, 2] > 0.7).double().mean()), rel=0.1
    )
    by_itself, _ = cover_of(
        scene, view, dataclasses.replace(target, rows=torch.arange(3))
    )
    assert by_itself is not None
    # right above, where its own Gaussian is
    assert float((cover.blocked - by_itself.blocked).max()) > 0.3
    heat = cover_heat(scene, view, covered, target)
    assert float(heat[2]) > 0.1
    assert not heat[:2].any()


def test_the_command_writes_what_it_found(
    from_above: Made, suitcase: Made, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_splat(from_above.scene, tmp_path / "bad.ply")
    save_splat(
        suitcase.scene.replace(opacities=torch.full((len(suitcase.scene),), 0.02)),
        tmp_path / "clear.ply",
    )
    out = tmp_path / "out"
    command = ["audit", str(tmp_path / "bad.ply"), "--up", "z"]
    assert cli.main([*command, "--only", "looks"]) == 0  # information, no alarm
    assert cli.main([*command, "--out", str(out), "--strict"]) == 3
    text = capsys.readouterr().out
    assert "bad.ply: differs: an object has other colours within" in text
    assert ", from above" in text
    record = json.loads((out / "result.json").read_text())
    assert record["story"] == "audit"
    assert record["verdict"] == "differs"
    assert "up is z" in text
    assert record["up"] == [0, 0, 1]
    assert record["objects"][0]["up"] == pytest.approx([0, 0, 1], abs=1e-6)
    assert record["summary"][0].startswith("differs: an object has other colours")
    assert {camera["name"] for camera in record["cameras"]} >= {"inside", "outside"}
    with Image.open(out / "pair.png") as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    assert pixels.shape == (512, 1032, 3)
    assert np.abs(pixels[200:400, 100:400] - pixels[200:400, 620:920]).mean() > 5
    mask = np.load(out / "mask.npy")
    assert len(load_splat(out / "heat.ply")) == len(mask) == len(from_above.scene)
    words = [
        "select",
        str(tmp_path / "bad.ply"),
        "--mask",
        str(out / "mask.npy"),
        "--size",
        "32",
        "--json",
    ]
    assert cli.main(words) == 0
    assert (
        json.loads(capsys.readouterr().out)["gaussians"]
        == int(mask.sum())
        == record["carrying"]
    )
    assert cli.main(["audit", str(tmp_path / "clear.ply")]) == 1
    assert "expected Gaussians with an opacity above 0.1" in capsys.readouterr().err


# Several looks of one object are found one after the other


def test_two_looks_of_one_object_are_both_found(suitcase: Made) -> None:
    """Grey from above and red from the rear, as the demonstration of CLOAK has it."""
    above = cone(direction(90, 0), 45)
    rear = sector(180, 40, -10, 40)

    def shade(own: Tensor, normals: Tensor, views: Tensor) -> Tensor:
        shown = torch.where(above(views)[:, None, None], torch.tensor(ROAD), own[None])
        return torch.where(
            rear(views)[:, None, None], torch.tensor((0.75, 0.12, 0.1)), shown
        )

    item = audit(suitcase.with_colours(shade).scene).strongest
    assert len(item.looks) == 2
    assert item.verdict == "hidden look"
    assert all(look.evidence >= LIMITS.suspicion for look in item.looks)
    assert not bool((item.looks[0].shown & item.looks[1].shown).any())
    overlaps = [
        [overlap(item, inside, look) for look in item.looks] for inside in (above, rear)
    ]
    assert sorted(max(range(2), key=row.__getitem__) for row in overlaps) == [0, 1]
    assert min(max(row) for row in overlaps) > 0.4
