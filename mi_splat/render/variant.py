"""Sets the Mitsuba variant, with this project's plugins registered in it."""

from mi_splat.errors import MiSplatError
from mi_splat.render.plugins import SUPPORTED_VARIANTS
from mi_splat.render.setup import prepare_llvm, set_up_mitsuba

DEFAULT_VARIANT = "llvm_ad_rgb"


class VariantError(MiSplatError):
    """No Mitsuba variant of this machine can render splats; the message says what to
    install.
    """


def use(variant: str = "") -> str:
    """Make a Mitsuba variant that can render splats the current one."""
    import mitsuba as mi

    if not variant:
        current = mi.variant()
        variant = current if current in SUPPORTED_VARIANTS else DEFAULT_VARIANT
    if variant not in SUPPORTED_VARIANTS or variant not in mi.variants():
        raise VariantError.of(
            "variant",
            f"one of {SUPPORTED_VARIANTS}",
            repr(variant),
            "choose a *_ad_rgb variant",
        )
    if variant.startswith("llvm"):
        prepare_llvm()
    elif not has_cuda():
        do = f"use {DEFAULT_VARIANT}, or install the GPU's driver"
        raise VariantError.of(
            f"variant {variant}", "an NVIDIA GPU that Dr.Jit can use", "none", do
        )
    set_up_mitsuba()
    if mi.variant() != variant:
        mi.set_variant(variant)
    return variant


def device_of(variant: str) -> str:
    """Where a variant has its tensors, by torch's name: "cpu" or "cuda"."""
    if variant.startswith("cuda"):
        return "cuda"
    return "cpu"


def check_device(device: str) -> None:
    """Refuse the device "cuda" where Dr.Jit or torch has none."""
    import torch

    if device == "cuda" and not (has_cuda() and torch.cuda.is_available()):
        raise VariantError.of(
            "--device cuda",
            "an NVIDIA GPU that Dr.Jit and torch can use",
            "none",
            "leave it out",
        )


def has_cuda() -> bool:
    """Whether Dr.Jit finds a GPU and its driver."""
    import drjit as dr

    return bool(dr.has_backend(dr.JitBackend.CUDA))
