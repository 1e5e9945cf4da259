"""Losses have useful gradients on the right candidates; success is judged by overlap,
class and confidence.
"""

import dataclasses

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torchvision.ops import box_iou

from attacks.detectors.base import Candidates, Detections
from attacks.objectives.base import Objective, Target, confidence, overlap
from attacks.objectives.relabel import Relabel, relabel
from attacks.objectives.suppression import hide, untargeted
from attacks.objectives.verdicts import overall_verdict
from attacks.search.loop import Verdict
from mi_splat.errors import InvalidValueError

CLASSES = ("car", "person", "bird")
BOX = torch.tensor([10.0, 10.0, 50.0, 30.0])
TARGET = Target(box=BOX, label="person", classes=CLASSES, original="car")
OBJECTIVES: list[Objective] = [relabel("person"), hide(), untargeted()]


def candidates(logits: Tensor, boxes: Tensor | None = None) -> Candidates:
    """Scores by softmax over the classes and a background of logit 0; all candidates on
    the object unless told.
    """
    scores = torch.cat([logits, logits.new_zeros(len(logits), 1)], 1).softmax(1)[:, :3]
    boxes = BOX.repeat(len(logits), 1) if boxes is None else boxes
    return Candidates(boxes[:, None].expand(-1, 3, -1), scores)


def reports(*rows: tuple[str, float, Tensor]) -> Detections:
    boxes = torch.stack([box for _, _, box in rows]) if rows else torch.zeros(0, 4)
    return Detections(
        boxes,
        torch.tensor([score for _, score, _ in rows]),
        tuple(label for label, _, _ in rows),
    )


def shifted(pixels: float) -> Tensor:
    return BOX + torch.tensor([pixels, 0.0, pixels, 0.0])


def test_confidence_looks_at_the_object_and_the_label() -> None:
    seen = reports(
        ("car", 0.9, shifted(2.0)),
        ("person", 0.95, shifted(200.0)),
        ("person", 0.4, BOX),
    )
    assert confidence(seen, BOX) == pytest.approx(0.9)
    assert confidence(seen, BOX, labels=["person"]) == pytest.approx(0.4)
    assert confidence(seen, BOX, labels=[]) == 0.0
    assert confidence(reports(), BOX) == 0.0


@pytest.mark.parametrize("objective", OBJECTIVES)
@pytest.mark.parametrize(
    ("sure", "dtype"),
    [
        (0.0, torch.float32),
        (5.0, torch.float32),
        (12.0, torch.float32),
        (20.0, torch.float64),
    ],
)
def test_descending_the_loss_reaches_the_aim_from_a_detector_however_sure(
    objective: Objective, sure: float, dtype: torch.dtype
) -> None:
    """Steps of fixed length in the logits: only the direction of the gradient counts,
    as in PGD.

    From a logit of 16 on, a float32 score is exactly 1 and no gradient comes through
    it.
    """
    start = torch.zeros(6, 3, dtype=dtype)
    start[:, 0] = sure
    logits = start.clone().requires_grad_(True)
    for _ in range(60):
        (gradient,) = torch.autograd.grad(
            objective(candidates(logits), TARGET), [logits]
        )
        assert gradient.norm() > 0
        logits = (
            (logits - 1.0 * gradient / gradient.norm()).detach().requires_grad_(True)
        )
    scores = candidates(logits.detach()).scores
    best = scores.max(0)
    seen = reports(
        *[(name, float(best.values[c]), BOX) for c, name in enumerate(CLASSES)]
    )
    assert objective.verdict(seen, TARGET).success


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_only_candidates_on_the_object_are_pushed(objective: Objective) -> None:
    logits = torch.full((4, 3), 2.0).requires_grad_(True)
    spread = torch.stack([BOX, shifted(3.0), shifted(300.0), shifted(45.0)])
    candidate = candidates(logits, spread)
    if isinstance(objective, Relabel):
        objective = Relabel(label="person", top=2)
    (gradient,) = torch.autograd.grad(objective(candidate, TARGET), [logits])
    assert (gradient[:2].abs().sum(1) > 0).all()
    assert (gradient[2:] == 0).all()


def test_relabel_prefers_boxes_that_fit_and_has_a_gradient_when_none_is_near() -> None:
    far = torch.stack([shifted(60.0), shifted(400.0)])
    logits = torch.zeros(2, 3).requires_grad_(True)
    (gradient,) = torch.autograd.grad(
        Relabel(label="person", top=1)(candidates(logits, far), TARGET), [logits]
    )
    assert gradient.abs().sum() > 0
    moving = BOX.repeat(2, 1).add(8.0).requires_grad_(True)
    loss = relabel("person")(candidates(torch.zeros(2, 3), moving), TARGET)
    (pull,) = torch.autograd.grad(loss, [moving])
    assert (pull[:, 0] > 0).all()  # descent moves the left edge back to the left


def test_relabel_pushes_the_original_class_down_behind_another_label_too() -> None:
    logits = torch.zeros(1, 3).requires_grad_(True)
    aim = dataclasses.replace(relabel("person"), suppression=0.5)
    (gradient,) = torch.autograd.grad(aim(candidates(logits), TARGET), [logits])
    assert gradient[0, 1] < 0 < gradient[0, 0]
    assert gradient[0, 0] > gradient[0, 2]


def test_a_relabelling_that_spreads_pushes_every_box_of_the_original_class() -> None:
    logits = torch.tensor(
        [[0.0, 2.0, 0.0], [5.0, 0.0, 0.0], [5.0, 0.0, 0.0]]
    ).requires_grad_(True)
    seen = candidates(logits, torch.stack([BOX, BOX, shifted(300.0)]))
    (gradient,) = torch.autograd.grad(
        Relabel(label="person", top=1, spread=1.0)(seen, TARGET), [logits]
    )
    assert gradient[1, 1] < 0 < gradient[1, 0]
    (gradient,) = torch.autograd.grad(
        Relabel(label="person", top=1)(candidates(logits), TARGET), [logits]
    )
    assert (gradient[1] == 0).all()


@pytest.mark.parametrize(
    ("objective", "seen", "success", "score"),
    [
        (relabel("person"), reports(("person", 0.71, shifted(4.0))), True, 0.71),
        (relabel("person"), reports(("person", 0.69, BOX)), False, 0.69),
        (relabel("person"), reports(("person", 0.99, shifted(30.0))), False, 0.0),
        (relabel("person"), reports(("bird", 0.99, BOX)), False, 0.0),
        (
            relabel("person"),
            reports(("car", 0.9, BOX), ("person", 0.8, BOX)),
            True,
            0.8,
        ),
        (
            relabel("person"),
            reports(("car", 0.9, shifted(200.0)), ("person", 0.8, BOX)),
            True,
            0.8,
        ),
        (relabel("person", confidence=0.9), reports(("person", 0.8, BOX)), False, 0.8),
        (
            Relabel(label="person", strict=True),
            reports(("car", 0.49, BOX), ("person", 0.8, BOX)),
            True,
            0.51,
        ),
        (
            Relabel(label="person", strict=True),
            reports(("car", 0.6, BOX), ("person", 0.8, BOX)),
            False,
            0.4,
        ),
        (hide(), reports(), True, 1.0),
        (hide(), reports(("bird", 0.9, shifted(200.0))), True, 1.0),
        (hide(), reports(("bird", 0.4, BOX)), False, 0.6),
        # overlap of a third: slid aside, not hidden
        (hide(), reports(("car", 0.8, shifted(20.0))), False, 0.2),
        (hide(confidence=0.5), reports(("car", 0.4, BOX)), True, 0.6),
        (untargeted(), reports(("bird", 0.9, BOX), ("car", 0.2, BOX)), True, 0.8),
        (untargeted(), reports(("car", 0.5, BOX)), False, 0.5),
    ],
)
def test_verdicts(
    objective: Objective, seen: Detections, success: bool, score: float
) -> None:
    verdict = objective.verdict(seen, TARGET)
    assert verdict.success is success
    assert verdict.score == pytest.approx(score)


@pytest.mark.parametrize(
    ("seen", "unambiguous"),
    [
        (reports(("person", 0.8, BOX)), True),
        (reports(("person", 0.8, BOX), ("car", 0.75, BOX)), True),
        (reports(("car", 0.9, BOX), ("person", 0.8, BOX)), False),
        (reports(("car", 0.9, shifted(200.0)), ("person", 0.8, BOX)), True),
        (reports(("person", 0.6, BOX)), False),
    ],
)
def test_a_relabelling_is_unambiguous_when_nothing_else_is_more_confident(
    seen: Detections, unambiguous: bool
) -> None:
    assert relabel("person").verdict(seen, TARGET).unambiguous is unambiguous


def test_untargeted_cannot_succeed_on_what_was_never_seen() -> None:
    unseen = Target(box=BOX, label=None, classes=CLASSES)
    assert not untargeted().verdict(reports(), unseen).success
    assert float(untargeted()(candidates(torch.zeros(2, 3)), unseen)) == 0.0
    assert hide().verdict(reports(), unseen).success


def test_a_class_that_the_detector_does_not_know_is_named() -> None:
    with pytest.raises(
        InvalidValueError, match="label: expected one of car, person, bird, got tram"
    ):
        relabel("tram")(candidates(torch.zeros(2, 3)), TARGET)


@given(
    st.lists(
        st.tuples(
            st.integers(0, 40),
            st.integers(0, 40),
            st.integers(1, 30),
            st.integers(1, 30),
        ),
        min_size=2,
    )
)
def test_overlap_is_the_intersection_over_union(
    corners: list[tuple[int, int, int, int]],
) -> None:
    """Boxes that lie apart along both axes have none, though both of their gaps are
    negative.
    """
    boxes = torch.tensor(
        [[x, y, x + width, y + height] for x, y, width, height in corners],
        dtype=torch.float32,
    )
    for box in boxes:
        torch.testing.assert_close(overlap(boxes, box), box_iou(boxes, box[None])[:, 0])
    far = torch.tensor([[100.0, 100.0, 110.0, 110.0]])
    assert not overlap(far, boxes[0]).any()


@pytest.mark.parametrize("drawn", [False, True])
def test_every_attacked_detector_has_to_be_deceived(drawn: bool) -> None:
    yes, no = (
        Verdict(success=success, score=float(success), unambiguous=success)
        for success in (True, False)
    )
    for rows, expected in (
        ([[yes, yes]], True),
        ([[yes, no]], False),
        ([[no, yes]], False),
    ):
        verdict = overall_verdict(rows * 3, 0.5, drawn=drawn)
        assert verdict.success is expected
        assert verdict.unambiguous is expected
