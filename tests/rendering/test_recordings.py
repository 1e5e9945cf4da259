"""What makes Dr.Jit record a stage again: new shapes do, values and the place of borrowed memory do not."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from mi_splat import variant
from mi_splat.cameras import Camera, orbit_pose
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene import GaussianScene
from tests import oracle

variant.use()

import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402

from mi_splat.rasterization import binning, pipeline, stages  # noqa: E402
from mi_splat.rasterization.frozen import aligned, buffer, frozen  # noqa: E402

STAGES = (
    *(stages.project_gaussians, stages.allot_rows, stages.write_pairs, stages.find_lists),
    *(stages.blend_tiles, stages.gradient_to_tiles, stages.rows_by_gaussian, stages.blend_backward),
    stages.project_backward,
)
VIEW = Camera(
    to_world=orbit_pose((0.0, 0.0, 0.0), azimuth=10.0, elevation=20.0, distance=3.0), focal=40.0, width=37, height=29
)
KEYS = ("data", "opacities", "sh_coeffs")


def misaligned(values: Any, offset: int = 4) -> NDArray[np.float32]:
    """The same numbers in memory that starts `offset` bytes after a multiple of 64."""
    values = np.asarray(values, dtype=np.float32)
    room = np.zeros(values.nbytes + 128, dtype=np.uint8)
    start = -room.ctypes.data % 64 + offset
    view = room[start : start + values.nbytes].view(np.float32).reshape(values.shape)
    view[...] = values
    return view


def address(array: Any) -> int:
    return int(np.from_dlpack(array).ctypes.data)


def recordings() -> list[int]:
    return [frozen(mi.variant(), stage).n_recordings for stage in STAGES]  # type: ignore[attr-defined]


@pytest.fixture(autouse=True)
def _no_recordings() -> None:
    frozen.cache_clear()  # which values Dr.Jit keeps out of a recording hangs on all calls before


def test_recordings_follow_shapes_never_values() -> None:
    render = Renderer()

    def step(seed: int) -> None:
        scene = oracle.random_scene(50, degree=1, seed=seed)
        opacities = scene.opacities.clone().requires_grad_(True)
        render(scene.replace(opacities=opacities), VIEW).sum().backward()  # type: ignore[no-untyped-call]

    for seed in range(12):
        step(seed)
    assert recordings() == [1] * len(STAGES)


def test_aligned_copies_only_what_is_not() -> None:
    values = np.arange(100, dtype=np.float32)
    for offset in range(4, 64, 4):
        copy = aligned(mi.Float(misaligned(values, offset)))
        assert address(copy) % 64 == 0
        assert np.array_equal(copy.numpy(), values)
    plain = mi.Float(misaligned(values, 0))
    assert address(plain) % 64 == 0
    assert aligned(plain).index == plain.index
    integers = aligned(mi.UInt32(misaligned(values, 8).view(np.uint32)))
    assert isinstance(integers, mi.UInt32)
    assert np.array_equal(integers.numpy(), values.view(np.uint32))
    assert len(aligned(mi.Float())) == 0
    assert address(aligned(dr.zeros(mi.Float, 5))) % 64 == 0


def check_offsets(step: Callable[[int], Sequence[Any]], equal: Callable[[Any, Any], bool]) -> None:
    """Raise unless memory at any offset gives the same values, and no kernel is recorded again for it."""
    plain, before = step(0), recordings()
    assert before == [1] * len(STAGES)
    for offset in (4, 16, 32):
        assert all(equal(a, b) for a, b in zip(step(offset), plain, strict=True))
    assert recordings() == before


def test_torch_tensors_need_not_be_aligned() -> None:
    scene, render = oracle.random_scene(50, degree=1, seed=0), Renderer(RenderSettings(alpha=True))
    weights = np.random.default_rng(0).normal(size=(29, 37, 4))

    def step(offset: int) -> tuple[torch.Tensor, ...]:
        tensors = [torch.from_numpy(misaligned(t.numpy(), offset)).requires_grad_(True) for t in scene.tensors()]
        picture = render(GaussianScene(*tensors), VIEW)
        picture.backward(torch.from_numpy(misaligned(weights, offset)))  # type: ignore[no-untyped-call]
        return (picture.detach(), *(t.grad for t in tensors if t.grad is not None))

    check_offsets(step, torch.equal)


def test_rows_that_stay_unused_have_no_part_in_the_gradient(monkeypatch: pytest.MonkeyPatch) -> None:
    """`count_tiles` may count a tile more than `emit_pairs` finds: they work with numbers that rounding may change."""
    scene = oracle.random_scene(400, degree=1, seed=3)

    def gradients() -> list[torch.Tensor]:
        frozen.cache_clear()
        leaves = GaussianScene(*(tensor.clone().requires_grad_(True) for tensor in scene.tensors()))
        (Renderer()(leaves, VIEW) ** 2).sum().backward()  # type: ignore[no-untyped-call]
        return [leaf.grad for leaf in leaves.tensors() if leaf.grad is not None]

    def not_a_number_where_unset(size: int, dtype: Any = None, value: float | None = None) -> Any:
        return buffer(size, dtype, math.nan if value is None and dtype is None else value)

    usual, count = gradients(), binning.count_tiles
    monkeypatch.setattr(binning, "count_tiles", lambda *given: dr.select(given[2], count(*given) + 3, 0))
    monkeypatch.setattr(pipeline, "buffer", not_a_number_where_unset)
    more = gradients()
    assert len(usual) == len(more) == 5
    assert all(torch.equal(one, other) for one, other in zip(usual, more, strict=True))
