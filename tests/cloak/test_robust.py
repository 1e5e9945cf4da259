"""A victim who audits the images trains without those that are named."""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import cast

import pytest
import torch

from attacks.cloak.config import LayersConfig, StudyConfig
from attacks.cloak.kinds import robust
from attacks.cloak.kinds.robust import AUDIT, RobustConfig
from attacks.cloak.kinds.trained import TrainedConfig
from attacks.cloak.setup import SET
from attacks.cloak.steps import StudySteps
from mi_splat.audit.image_splits import Split
from mi_splat.audit.images import ImageAudit
from mi_splat.datasets import Dataset
from mi_splat.errors import InvalidValueError
from mi_splat.ledger import Out
from tests.cloak.tiny_study import STUDY
from tests.datasets.sets import VIEWS, write_transforms


def audited(count: int, named: int) -> ImageAudit:
    """An audit that names the first images."""
    smaller = torch.arange(count) < named
    split = Split(
        smaller=smaller,
        decided=torch.ones_like(smaller),
        scores=smaller.float(),
        step=1.0,
        spread=0.0,
        gain=1.0,
        edge=3.0,
        difference=0.1,
        pair=None,
    )
    return ImageAudit(count=count, points=1, split=split)


def test_only_the_attacked_splat_of_a_robust_study_is_trained_on_fewer_images() -> None:
    for study, kind in ((STUDY, "trained"), (replace(STUDY, robust=True), "robust")):
        steps = StudySteps(study=study)
        assert steps.splat("clean", 0).kind == "attacks.cloak.kinds.trained"
        assert steps.splat("cloaked", 0).kind == f"attacks.cloak.kinds.{kind}"


def test_named_images_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_transforms(tmp_path / SET, VIEWS)
    used = list[str]()

    def train_on(
        views: Dataset, config: TrainedConfig, inputs: Mapping[str, Path], out: Out
    ) -> None:
        used.extend(path.name for path in views.paths)

    monkeypatch.setattr(robust, "train_on", train_on)
    monkeypatch.setattr(robust, "audit_images", lambda views: audited(len(views), 1))
    config = RobustConfig(training=STUDY.training, background=(0.0, 0.0, 0.0), near=0.1)
    robust.run(config, {"pictures": tmp_path}, cast("Out", tmp_path))
    record = json.loads((tmp_path / AUDIT).read_text())
    (named,) = record["groups"]["B"]
    assert len(used) == len(VIEWS) - 1
    assert named not in used


def test_no_group_is_left_out_where_both_are_as_large(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_transforms(tmp_path / SET, VIEWS)
    half = len(VIEWS) // 2
    monkeypatch.setattr(robust, "audit_images", lambda views: audited(2 * half, half))
    config = RobustConfig(training=STUDY.training, background=(0.0, 0.0, 0.0), near=0.1)
    with pytest.raises(InvalidValueError, match="equal groups"):
        robust.run(config, {"pictures": tmp_path}, cast("Out", tmp_path))


def test_a_file_that_is_changed_has_no_robust_training() -> None:
    with pytest.raises(InvalidValueError, match="layers"):
        StudyConfig(
            name="both",
            attack=STUDY.attack,
            layers=LayersConfig(attacks=("overhead",)),
            robust=True,
        )
