"""Finding a libLLVM that works, and saying what to do where there is none."""

from pathlib import Path

import pytest

from mi_splat.render import setup as mitsuba_setup
from mi_splat.render import variant
from mi_splat.render.setup import LLVMError, find_llvm, llvm_version, prepare_llvm
from mi_splat.render.variant import VariantError


@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("libLLVM.so.22.1", 22),
        ("libLLVM-19.so.1", 19),
        ("libLLVM-14.0.6.so.1", 14),
        ("libLLVM-17.so", 17),
        ("llvm-20/lib/libLLVM.so", 20),
        ("llvm@18/lib/libLLVM.dylib", 18),
        ("libLLVM.so", None),
    ],
)
def test_version_from_name(tmp_path: Path, name: str, version: int | None) -> None:
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    assert llvm_version(path) == version


def test_a_link_has_the_version_of_its_target(tmp_path: Path) -> None:
    (tmp_path / "libLLVM.so.21.1").touch()
    (tmp_path / "libLLVM.so").symlink_to("libLLVM.so.21.1")
    assert llvm_version(tmp_path / "libLLVM.so") == 21


def test_the_newest_usable_one_is_taken(tmp_path: Path) -> None:
    for name in (
        "libLLVM-14.so.1",
        "libLLVM-17.so.1",
        "libLLVM.so.19.1",
        "libLLVMCore.a",
    ):
        (tmp_path / name).touch()
    assert find_llvm([tmp_path]) == tmp_path / "libLLVM.so.19.1"


def test_the_users_choice_is_checked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "libLLVM-15.so.1"))
    with pytest.raises(LLVMError, match="missing"):
        prepare_llvm()
    (tmp_path / "libLLVM-15.so.1").touch()
    with pytest.raises(LLVMError, match="LLVM 15"):
        prepare_llvm()
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "libLLVM.so.22.1"))
    (tmp_path / "libLLVM.so.22.1").touch()
    assert prepare_llvm() == tmp_path / "libLLVM.so.22.1"


def test_none_at_all_gets_a_hint(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    monkeypatch.setattr(mitsuba_setup, "find_llvm", lambda: None)
    monkeypatch.setattr("platform.system", lambda: "Linux")
    with pytest.raises(LLVMError, match="apt install"):
        prepare_llvm()


# Which Mitsuba variant renders


def test_a_variant_without_derivatives_is_refused() -> None:
    with pytest.raises(VariantError, match="llvm_ad_rgb"):
        variant.use("scalar_rgb")


@pytest.mark.parametrize("plugin", ["gaussians", "splat_tile", "splat_ray"])
def test_plugins_say_which_variant_they_need(plugin: str) -> None:
    import mitsuba as mi

    import mi_splat.render.plugins  # noqa: F401

    before = variant.use()
    try:
        mi.set_variant("scalar_rgb")
        with pytest.raises(
            RuntimeError, match=r'call mi\.set_variant\("llvm_ad_rgb"\) first'
        ):
            mi.load_dict({"type": plugin})
    finally:
        mi.set_variant(before)
    assert mi.load_dict({"type": "splat_ray"}) is not None
