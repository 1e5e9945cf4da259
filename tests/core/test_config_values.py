"""Numbers and tuples in configurations: what is meant is taken, the wrong kind is refused before anything runs."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest

from attacks.cloak.layer_config import LayerConfig, LayersConfig
from attacks.dagger.config import DaggerConfig
from mi_splat.errors import InvalidValueError
from mi_splat.selection.config import Selection
from mi_splat.training.config import FitConfig
from mi_splat.training.strategies import ClassicConfig, FixedConfig, MCMCConfig

REFUSED: list[tuple[Callable[..., object], dict[str, Any], str]] = [
    (FitConfig, {"iterations": 2.5}, r"iterations: expected a whole number >= 1 \(steps\), got 2.5"),
    (FitConfig, {"iterations": "3"}, r"iterations: expected a whole number >= 1 \(steps\), got '3'"),
    (FitConfig, {"iterations": True}, "iterations: expected a whole number"),
    (FitConfig, {"iterations": 0}, r"iterations: expected a number >= 1 \(steps\), got 0"),
    (FitConfig, {"eval_interval": -1}, "eval_interval: expected a number >= 0"),
    (FitConfig, {"lr_means": "a"}, "lr_means: expected a number > 0, got 'a'"),
    (FitConfig, {"lr_sh": float("nan")}, "lr_sh: expected a finite number >= 0, got nan"),
    (FitConfig, {"lr_sh": -1.0}, "lr_sh: expected a number >= 0"),
    (FitConfig, {"lr_sh_final": 0.0}, "lr_sh_final: expected a number > 0, got 0.0"),
    (FitConfig, {"lr_sh": 0, "lr_sh_final": 0.1}, "lr_sh: expected a number > 0"),
    (FitConfig, {"lr_means": 0.0}, "lr_means: expected a number > 0"),
    (FitConfig, {"lr_means_final": 0.0}, "lr_means_final: expected a number > 0"),
    (FitConfig, {"lambda_dssim": None}, r"lambda_dssim: expected a number in \[0, 1\]"),
    (FitConfig, {"trainable": "texture"}, "trainable: expected one of means"),
    (FitConfig, {"trainable": 3}, "trainable: expected one of means"),
    (FitConfig, {"strategy": "mcmc"}, "strategy: expected the options of a strategy"),
    (LayersConfig, {"attacks": ("rear",), "lr_sh": 0.0}, "lr_sh: expected a number > 0"),
    (LayersConfig, {"attacks": ("rear",), "lr_sh_final": 0.0}, "lr_sh_final: expected a number > 0"),
    (
        LayersConfig,
        {"attacks": ("rear",), "making": LayerConfig(gap=(3.0, 4.0))},
        "gap: expected one number for all, or 1, one for each trigger, got 2 numbers",
    ),
    (ClassicConfig, {"densify_from": 1.5}, "densify_from: expected a whole number"),
    (ClassicConfig, {"max_gaussians": "many"}, "max_gaussians: expected a whole number"),
    (MCMCConfig, {"noise_lr": float("inf")}, "noise_lr: expected a finite number"),
    (DaggerConfig, {"steps": 2.5}, r"steps: expected a whole number >= 1 \(steps\), got 2.5"),
    (DaggerConfig, {"steps": "3"}, r"steps: expected a whole number >= 1 \(steps\), got '3'"),
    (DaggerConfig, {"eps": "5"}, "eps: expected a number"),
    (DaggerConfig, {"required_views": "all"}, r"required_views: expected a number in \(0, 1\]"),
    (Selection, {"cluster": 1.5}, "cluster: expected a whole number"),
    (Selection, {"planes": None}, "planes: expected a whole number"),
    (Selection, {"link_distance": "far"}, "link_distance: expected a number > 0"),
]


@pytest.mark.parametrize(("kind", "values", "words"), REFUSED, ids=lambda value: str(value)[:40])
def test_the_wrong_kind_is_refused_in_words(kind: Callable[..., object], values: dict[str, Any], words: str) -> None:
    with pytest.raises(InvalidValueError, match=words):
        kind(**values)


def test_a_rate_that_stays_as_it_is_may_be_nothing() -> None:
    assert FitConfig(lr_sh=0.0).lr_sh == 0


def test_one_value_stands_for_a_tuple_of_one() -> None:
    config = DaggerConfig(attributes="sh", eps=5.0)  # type: ignore[arg-type]
    assert config == DaggerConfig()
    assert DaggerConfig(eps=np.array([2.0])).eps == (2.0,)  # type: ignore[arg-type]
    assert FitConfig(trainable="sh", strategy=FixedConfig()).trainable == ("sh",)  # type: ignore[arg-type]


def test_numbers_of_numpy_become_python_s_so_that_snapshots_are_json() -> None:
    numbers: dict[str, Any] = {"iterations": np.int64(5), "lr_means": np.float32(0.5)}
    most: Any = np.int32(9)
    config = FitConfig(**numbers, strategy=ClassicConfig(max_gaussians=most))
    assert json.loads(json.dumps(asdict(config)))["strategy"]["max_gaussians"] == 9
    assert (type(config.iterations), type(config.lr_means)) == (int, float)
