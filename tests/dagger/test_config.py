"""DAGGER's configuration: what the paper fixes, and what is refused."""

from __future__ import annotations

from typing import Any

import pytest

from attacks.dagger.config import DaggerConfig
from mi_splat.errors import InvalidValueError


def test_the_defaults_are_the_paper_s() -> None:
    """Eleven steps of length 2 eps / steps in one l2 ball of radius 5 over the SH coefficients of degree 3."""
    config = DaggerConfig()
    assert config.steps == 11
    assert config.attributes == ("sh",)
    assert config.sh_degree == 3
    assert (config.budget.radius, config.budget.norm) == ({"sh": 5.0}, "l2")
    assert config.step == {"sh": 2 * 5.0 / 11}
    assert (config.restarts, config.random_start) == (1, False)


def test_one_radius_stands_for_every_attribute_and_steps_follow_it() -> None:
    assert DaggerConfig(attributes=("sh", "means"), eps=(3.0,)).radius == {"sh": 3.0, "means": 3.0}
    config = DaggerConfig(attributes=("sh", "means"), eps=(3.0, 0.5), steps=4, step_factor=1.0, norm="linf")
    assert config.budget.radius == {"sh": 3.0, "means": 0.5}
    assert config.budget.norm == "linf"
    assert config.step == {"sh": 0.75, "means": 0.125}


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({"eps": (1.0, 2.0)}, "eps: expected one number for all of sh, or one for each"),
        ({"attributes": ("sh", "means"), "eps": ()}, "eps: expected one number for all of sh, means, or one for each"),
        ({"attributes": ("sh", "sh"), "eps": (1.0, 1.0)}, "eps: expected one number for all"),
        ({"attributes": ()}, "attributes: expected at least one"),
        ({"eps": (-1.0,)}, "eps: expected a number >= 0"),
        ({"attributes": ("colour",)}, "attributes: expected one of means"),
        ({"norm": "l7"}, "norm: expected one of linf"),
        ({"steps": 0}, "steps: expected a number >= 1"),
        ({"restarts": 0}, "restarts: expected a number >= 1"),
        ({"noise_draws": -1}, "noise_draws: expected a number >= 0"),
        ({"sh_degree": 4}, r"sh_degree: expected a number in \[0, 3\], got 4"),
        ({"required_views": 0.0}, r"required_views: expected a number in \(0, 1\], got 0"),
        ({"required_views": 1.01}, r"required_views: expected a number in \(0, 1\], got 1.01"),
        ({"step_factor": 0.0}, "step_factor: expected a number > 0"),
        ({"step_factor": float("nan")}, "step_factor: expected a finite number"),
    ],
)
def test_a_wrong_configuration_says_what_is_wrong(settings: dict[str, Any], complaint: str) -> None:
    with pytest.raises(InvalidValueError, match=complaint):
        DaggerConfig(**settings)
