"""A search that was interrupted goes on to the same bits; a checkpoint of another attack is refused."""

from pathlib import Path
from typing import Any

import pytest
import torch

from attacks.dagger.attack import attack_views
from attacks.dagger.config import DaggerConfig
from attacks.dagger.result import Result
from attacks.dagger.search import Checkpoint, CheckpointError
from attacks.objectives import relabel
from attacks.search import Step
from tests.dagger.toy import QUICK, toy_views
from tests.fakes import ColourDetector
from tests.io.noted import Change, changed


class KilledError(Exception):
    """The end of a process."""


def run(path: Path | None, *, killed_at: int | None = None, **settings: Any) -> Result:
    def kill(line: Step) -> None:
        if line.index == killed_at:
            raise KilledError

    return attack_views(
        toy_views(),
        ColourDetector(),
        relabel("person"),
        config=DaggerConfig.for_region(**{**QUICK, **settings}),
        checkpoint=None if path is None else Checkpoint(path=path, every=2),
        on_step=kill,
    )


@pytest.mark.parametrize(
    ("killed_at", "settings"),
    [
        (2, {}),
        (8, {"norm": "l2", "eps": (9.0,), "pool": 0, "optimiser": "apgd"}),
        (5, {"optimiser": "adam", "image_psnr": 35.0}),
    ],
    ids=str,
)
def test_an_interrupted_search_finds_the_same_bits(tmp_path: Path, killed_at: int, settings: dict[str, Any]) -> None:
    path = tmp_path / "search.checkpoint"
    whole = run(None, **settings)
    with pytest.raises(KilledError):
        run(path, killed_at=killed_at, **settings)
    assert path.exists()
    resumed = run(path, **settings)
    for before, after in zip(whole.scene.tensors(), resumed.scene.tensors(), strict=True):
        assert torch.equal(before, after)
    assert resumed.trace == whole.trace
    assert resumed.best == whole.best
    assert not path.exists()  # the search has ended


def test_a_checkpoint_of_another_attack_is_refused_and_stays(tmp_path: Path) -> None:
    path = tmp_path / "search.checkpoint"
    with pytest.raises(KilledError):
        run(path, killed_at=5)
    with pytest.raises(CheckpointError, match="one of this very attack"):
        run(path, eps=(1.0,))
    assert path.exists()
    # How it is judged is not part of the search.
    assert run(path, held_out=3).rate.total == 3


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda n, t: first(t, "point/").fill_(torch.nan), "finite numbers in point/"),
        (lambda n, t: first(t, "memory velocity/").fill_(torch.inf), "finite numbers in memory velocity/"),
        (lambda n, t: [t.update({k: t[k][:1]}) for k in list(t)], r"checkpoint, point, \w+: expected"),
        (lambda n, t: t.pop(next(k for k in t if k.startswith("best/"))), r"best, \w+: expected .*, got none"),
        (lambda n, t: t.update({"other/sh": first(t, "point/").clone()}), "got tensors other"),
        (lambda n, t: n.update(numbers={"length": "long"}), "numbers: length: expected a finite number"),
        (lambda n, t: n.update(index=-1), "index: expected a whole number from 0"),
        (lambda n, t: n.update(index=99), "index: expected at most 8 steps, got 99"),
        (lambda n, t: n["best_line"].update(score=None), "best_line, score: expected a number"),
        (lambda n, t: n["trace"][0].update(success="no"), r"trace\[0\], success: expected true or false"),
        (lambda n, t: n.update(trace=3), "trace: expected a list of objects"),
        (lambda n, t: n.update(seconds=float("nan")), "seconds: expected a finite number"),
    ],
)
def test_checkpoints_whose_parts_do_not_fit_are_refused(tmp_path: Path, change: Change, words: str) -> None:
    path = tmp_path / "search.checkpoint"
    with pytest.raises(KilledError):
        run(path, killed_at=5)
    changed(path, change)
    with pytest.raises(CheckpointError, match=words):
        run(path)


def first(tensors: dict[str, torch.Tensor], prefix: str) -> torch.Tensor:
    return next(value for name, value in tensors.items() if name.startswith(prefix))
