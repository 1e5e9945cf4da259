"""The pictures of an attack keep the PSNR that was asked for, and the price of their error follows it."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from attacks.budgets import Budget
from attacks.dagger.config import EotConfig
from attacks.dagger.image_budget import ImagePrice, fitted, stretched
from mi_splat.errors import InvalidValueError
from tests.dagger.toy import quick


def test_the_price_begins_where_an_error_at_the_limit_costs_one() -> None:
    price = ImagePrice.of(20.0, steps=100)
    assert price.limit == pytest.approx(0.01)
    assert price.weight * price.limit == pytest.approx(1.0)


def test_the_price_rises_while_pictures_are_too_bad_and_falls_while_they_are_good() -> None:
    price = ImagePrice.of(20.0, steps=100)
    assert price.after(0.02).weight > price.weight > price.after(0.005).weight
    assert price.after(0.01).weight == pytest.approx(price.weight)


def test_an_error_above_the_limit_costs_more_at_once() -> None:
    price = ImagePrice.of(20.0, steps=100)
    assert price.now == price.weight
    worse = price.after(0.03)
    assert worse.now == pytest.approx(3 * worse.weight)
    better = price.after(0.003)
    assert better.now == better.weight


def test_the_price_stays_within_its_bounds() -> None:
    for error, bound in ((1.0, 100.0), (0.0, 0.02)):
        price = ImagePrice.of(20.0, steps=100)
        for _ in range(400):
            price = price.after(error)
        assert price.weight * price.limit == pytest.approx(bound)


def test_a_point_is_pulled_back_to_the_limit_along_a_line() -> None:
    reference, point = {"sh": torch.ones(3)}, {"sh": torch.tensor([2.0, 3.0, 5.0])}

    def error(one: dict[str, torch.Tensor]) -> float:
        return float((one["sh"] - reference["sh"]).square().sum())

    found = fitted(point, reference, 21 / 4, error)
    assert 0.97 * 21 / 4 <= error(found) <= 21 / 4
    way = (found["sh"] - 1) / (point["sh"] - 1)
    assert torch.allclose(way, way[0].expand(3))
    assert fitted(point, reference, 21.5, error) is point
    assert fitted(point, reference, 0.0, error) is reference


def test_a_point_is_stretched_to_the_limit_and_not_out_of_its_ball() -> None:
    reference, point = {"sh": torch.zeros(2)}, {"sh": torch.tensor([1.0, 2.0])}

    def error(one: dict[str, torch.Tensor]) -> float:
        return float(one["sh"].square().sum())

    wide, narrow = (Budget(radius={"sh": radius}, norm="linf") for radius in (10.0, 2.2))
    found = stretched(point, reference, wide, 7.2, error)["sh"]
    assert float(found[1] / found[0]) == pytest.approx(2.0)
    assert 6.9 < float(found.square().sum()) <= 7.2
    assert float(stretched(point, reference, narrow, 7.2, error)["sh"].abs().max()) == pytest.approx(2.2)
    assert torch.allclose(stretched(point, reference, wide, 100.0, error)["sh"], 1.5 * point["sh"])


def test_an_attack_keeps_the_psnr_that_an_attack_without_a_limit_does_not() -> None:
    free, limited = quick(), quick(image_psnr=35.0)
    assert free.judgement.image.psnr is not None
    assert limited.judgement.image.psnr is not None
    assert free.judgement.image.psnr < 30
    # Held-out views are others than those that the limit is held on.
    assert limited.judgement.image.psnr > 34
    assert max(limited.used.values()) > 0


def test_a_result_that_is_below_its_budget_warns() -> None:
    found = quick(image_psnr=35.0)
    assert not any("dB of the validation views" in warning for warning in found.warnings)
    assert isinstance(found.config, EotConfig)
    asked_for_more = dataclasses.replace(found, config=dataclasses.replace(found.config, image_psnr=45.0))
    assert any("less than the 45 dB of the validation views" in one for one in asked_for_more.warnings)


def test_an_impossible_limit_is_refused() -> None:
    for psnr in (0.0, -3.0, float("inf"), float("nan")):
        with pytest.raises(InvalidValueError, match="image_psnr"):
            EotConfig(image_psnr=psnr)
