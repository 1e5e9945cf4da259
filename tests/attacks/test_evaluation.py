"""Scenes are seen through their files and 8 bits, by every detector; rates have a
denominator and an interval.
"""

import pytest
import torch
from scipy.stats import binomtest
from torch import Tensor

from attacks.detectors.base import Detections
from attacks.figures.rate import Rate
from attacks.observe.comparison import (
    classes_of,
    compare,
    compared_rows,
    contradicted_views,
    contradictions,
)
from attacks.observe.drawing import annotated
from attacks.observe.views import (
    ViewDetections,
    as_saved,
    detect_scenes,
    detect_views,
    object_boxes,
)
from mi_splat.cameras.camera import Camera
from mi_splat.io.images import through_png
from mi_splat.scene import GaussianScene
from tests.fakes import ColourDetector, blobs, camera, toy_scene


def test_views_without_the_object_do_not_count() -> None:
    scene, mask = toy_scene()
    hidden = scene.replace(opacities=torch.where(mask, 0.0, scene.opacities))
    (view,) = detect_scenes(
        {"clean": hidden}, mask, [camera()], [ColourDetector()], render=blobs
    )["clean"]
    assert view.box is None
    assert view.confidence("car") == 0.0
    looked = compared_rows({"clean": [view], "attacked": [view]}, original="car")
    rates = [rate for _, rate in compare(looked.rows) if isinstance(rate, Rate)]
    assert {rate.total for rate in rates} == {0}
    assert looked.rows["x0"].to_list() == [None, None]


def looked(
    view: int, label: str, score: float, detector: str = "fake_colour"
) -> ViewDetections:
    """A view in which one thing is reported, on the object."""
    box = torch.tensor([4.0, 4.0, 20.0, 20.0])
    return ViewDetections(
        view=view,
        camera=camera(),
        detector=detector,
        pixels=torch.zeros(32, 32, 3, dtype=torch.uint8),
        box=box,
        detections=Detections(box[None], torch.tensor([score]), (label,)),
    )


def test_a_miss_counts_where_the_clean_object_is_found() -> None:
    clean = [
        looked(0, "car", 0.9),
        looked(1, "car", 0.4),
        looked(2, "car", 0.5),
        looked(0, "car", 0.9, "other"),
    ]
    attacked = [
        looked(0, "person", 0.5),
        looked(1, "person", 0.9),
        looked(2, "person", 0.49),
    ]
    attacked += [looked(0, "car", 0.5, "other")]  # still counts
    splats = {"clean": clean, "attacked": attacked}
    rows = compared_rows(splats, target="person").rows
    figures = compare(rows)
    first = figures.where(detector="fake_colour")
    assert classes_of(rows)["fake_colour"] == ("car", "person")
    assert first.find("psnr") is None
    assert first.rate("missed") == Rate(successes=2, total=2)
    assert first.rate("found_clean") == Rate(successes=2, total=3)
    assert first.rate("target_attacked") == Rate(successes=2, total=3)
    assert figures.rate("missed", detector="other") == Rate(successes=0, total=1)
    lower = compare(rows, confidence=0.25)
    reported = lower.rate("target_attacked", detector="fake_colour")
    assert reported == Rate(successes=3, total=3)


def test_a_judge_contradicts_what_it_knows_better() -> None:
    """The detector reports a car, a person, nothing, a sign; the checker, which knows
    signs alone, one in views 0, 2.
    """
    labels = (("car", 0.9), ("person", 0.9), ("car", 0.4), ("stop sign", 0.9))
    clean = [looked(view, *label) for view, label in enumerate(labels)]
    checker = [
        looked(view, "stop sign", 0.9 if view in (0, 2) else 0.3, "checker")
        for view in range(4)
    ]
    seen = {
        "clean": [*clean, *checker],
        "attacked": [looked(view, "stop sign", 0.9) for view in range(4)] + checker,
    }
    rows = compared_rows(
        seen, original="car", target="person", checkers=("checker",)
    ).rows
    assert rows.filter(detector="checker")["target"].null_count() == 8
    assert set(rows.filter(detector="checker")["original"]) == {"stop sign"}
    measures = compare(rows).where(detector="checker").labels("measure")
    assert sorted(measures) == ["found_attacked", "found_clean", "missed"]
    checkers = {"checker": ["stop sign"]}
    figures = contradictions(rows, checkers)
    ((names, pair),) = figures.groups("detector", "checked_by").items()
    assert names == ("fake_colour", "checker")
    assert pair.rate("contradicted", splat="clean") == Rate(successes=3, total=4)
    assert pair.rate("contradicted", splat="attacked") == Rate(successes=2, total=4)
    views = contradicted_views(rows, checkers).filter("contradicted")
    assert views.select("splat", "view", "report", "verdict").rows() == [
        ("clean", 0, "car", "stop sign"),
        ("clean", 2, None, "stop sign"),
        ("clean", 3, "stop sign", None),
        ("attacked", 1, "stop sign", None),
        ("attacked", 3, "stop sign", None),
    ]


class Counting(ColourDetector):
    """Remembers how many images it got at once."""

    def __init__(self, name: str) -> None:
        self.name, self.sizes_seen = name, list[tuple[int, ...]]()

    def detect(self, images: Tensor) -> list[Detections]:
        self.sizes_seen.append(tuple(images.shape[:2]))
        return super().detect(images)


def test_every_camera_and_detector_in_batches_of_one_size() -> None:
    scene, mask = toy_scene()
    cameras = [
        camera(),
        camera(offset=0.2),
        camera(offset=0.4),
        camera(40),
        camera(40, offset=0.2),
    ]
    detectors = [Counting("a"), Counting("b")]
    rendered = 0

    def counted(scene: GaussianScene, camera: Camera) -> Tensor:
        nonlocal rendered
        rendered += 1
        return blobs(scene, camera)

    boxes = object_boxes(scene, mask, cameras, render=blobs)
    values = detect_views(
        scene, cameras, detectors, render=counted, boxes=boxes, batch=2
    )
    assert rendered == 0
    seen = list(values)
    assert rendered == len(cameras)
    assert [one.sizes_seen for one in detectors] == [[(2, 32), (1, 32), (2, 40)]] * 2
    order = [(one.detector, one.view) for one in seen]
    assert order == [
        (name, view)
        for views in ((0, 1), (2,), (3, 4))
        for name in "ab"
        for view in views
    ]
    for one in seen:
        alone = through_png(blobs(scene, cameras[one.view]))
        assert torch.equal(one.image, alone)
        (expected,) = ColourDetector().detect(alone[None])
        assert one.detections.labels == expected.labels
        torch.testing.assert_close(one.detections.scores, expected.scores)
        assert one.box is boxes[one.view]
        assert one.camera is cameras[one.view]
    assert seen[0].confidence("car") == seen[0].confidence() > 0.9
    assert seen[0].confidence("person") == 0.0
    assert seen[0].direction((0.0, 0.0, 0.0)).azimuth == pytest.approx(270.0)
    bare = next(detect_views(scene, cameras, detectors, render=blobs))
    assert (bare.box, bare.confidence("car")) == (None, 0.0)


def test_scenes_are_seen_as_their_files_hold_them() -> None:
    scene, mask = toy_scene()
    wide = GaussianScene(*(value.double() for value in scene.tensors()))
    wide = wide.replace(rotations=torch.nn.functional.normalize(wide.rotations, dim=-1))
    rendered: list[GaussianScene] = []

    def recorded(scene: GaussianScene, camera: Camera) -> Tensor:
        rendered.append(scene)
        return blobs(scene, camera)

    detect_scenes(
        {"clean": wide}, mask, [camera()], [ColourDetector()], render=recorded
    )
    judged = rendered[-1]
    saved = as_saved(wide)
    assert judged.means.dtype == torch.float32
    for value, expected in zip(judged.tensors(), saved.tensors(), strict=True):
        assert torch.equal(value, expected)


def test_detections_are_drawn_from_a_confidence_on() -> None:
    picture = torch.zeros(64, 64, 3)
    box = torch.tensor([[16.0, 16.0, 48.0, 48.0]])
    detections = Detections(box, torch.tensor([0.4]), ("car",))
    drawn = annotated(picture, detections, "title")
    assert drawn.shape == (512, 512, 3)
    assert drawn[128:384, 128].any()
    assert not annotated(picture, detections, "", min_confidence=0.5)[
        128:384, 128
    ].any()


@pytest.mark.parametrize(("successes", "total"), [(0, 10), (10, 10), (3, 7), (78, 80)])
def test_wilson_interval_against_scipy(successes: int, total: int) -> None:
    expected = binomtest(successes, total).proportion_ci(method="wilson")
    assert Rate(successes=successes, total=total).interval == pytest.approx(
        (expected.low, expected.high)
    )
