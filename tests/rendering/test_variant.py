"""Which Mitsuba variant renders."""

from __future__ import annotations

import pytest

from mi_splat import variant
from mi_splat.variant import VariantError


def test_a_variant_without_derivatives_is_refused() -> None:
    with pytest.raises(VariantError, match="llvm_ad_rgb"):
        variant.use("scalar_rgb")


def test_the_current_variant_is_kept() -> None:
    assert variant.use("llvm_ad_rgb") == variant.use() == "llvm_ad_rgb"
