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


@pytest.mark.parametrize("plugin", ["gaussians", "splat_tile", "splat_ray"])
def test_plugins_say_which_variant_they_need(plugin: str) -> None:
    import mitsuba as mi

    import mi_splat.plugins  # noqa: F401

    before = variant.use()
    try:
        mi.set_variant("scalar_rgb")
        with pytest.raises(RuntimeError, match=r'call mi\.set_variant\("llvm_ad_rgb"\) first'):
            mi.load_dict({"type": plugin})
    finally:
        mi.set_variant(before)
    assert mi.load_dict({"type": "splat_ray"}) is not None
