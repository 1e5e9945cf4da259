"""What makes Dr.Jit record a stage again: new shapes do, values and the place of
borrowed memory do not.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from mi_splat.cameras.camera import Camera, orbit_pose
from mi_splat.cameras.lens import Lens
from mi_splat.render import variant
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.scene import GaussianScene
from tests.gaussians import varied_scene

variant.use()

import mitsuba as mi  # noqa: E402

from mi_splat.render.tile import stages  # noqa: E402
from mi_splat.render.tile.frozen import frozen  # noqa: E402

STAGES = (
    *(
        stages.project_gaussians,
        stages.allot_rows,
        stages.write_pairs,
        stages.find_lists,
    ),
    *(
        stages.blend_tiles,
        stages.rows_by_gaussian,
        stages.blend_backward,
        stages.project_backward,
    ),
)
VIEW = Camera(
    to_world=orbit_pose((0.0, 0.0, 0.0), azimuth=10.0, elevation=20.0, distance=3.0),
    lens=Lens(focal=40.0, size=(37, 29)),
)


def misaligned(values: Any, offset: int = 4) -> NDArray[np.float32]:
    """The same numbers in memory that starts `offset` bytes after a multiple of 64."""
    values = np.asarray(values, dtype=np.float32)
    room = np.zeros(values.nbytes + 128, dtype=np.uint8)
    start = -room.ctypes.data % 64 + offset
    view = room[start : start + values.nbytes].view(np.float32).reshape(values.shape)
    view[...] = values
    return view


def recordings() -> list[int]:
    return [frozen(mi.variant(), stage).n_recordings for stage in STAGES]  # type: ignore[attr-defined]


@pytest.fixture(autouse=True)
def _no_recordings() -> None:
    # which values Dr.Jit keeps out of a recording hangs on all calls before
    frozen.cache_clear()


def test_recordings_follow_shapes_never_values() -> None:
    render = Renderer()

    def step(seed: int) -> None:
        scene = varied_scene(50, degree=1, seed=seed)
        opacities = scene.opacities.clone().requires_grad_(True)
        render(scene.replace(opacities=opacities), VIEW).sum().backward()  # type: ignore[no-untyped-call]

    for seed in range(12):
        step(seed)
    assert recordings() == [1] * len(STAGES)


def check_offsets(
    step: Callable[[int], Sequence[Any]], equal: Callable[[Any, Any], bool]
) -> None:
    """Raise unless memory at any offset gives the same values, and no kernel is
    recorded again for it.
    """
    plain = step(0)
    before = recordings()
    assert before == [1] * len(STAGES)
    for offset in (4, 16, 32):
        assert all(equal(a, b) for a, b in zip(step(offset), plain, strict=True))
    assert recordings() == before


def test_torch_tensors_need_not_be_aligned() -> None:
    scene = varied_scene(50, degree=1, seed=0)
    render = Renderer(RenderSettings(alpha=True))
    weights = np.random.default_rng(0).normal(size=(29, 37, 4))

    def step(offset: int) -> tuple[torch.Tensor, ...]:
        tensors = [
            torch.from_numpy(misaligned(t.numpy(), offset)).requires_grad_(True)
            for t in scene.tensors()
        ]
        picture = render(GaussianScene(*tensors), VIEW)
        picture.backward(torch.from_numpy(misaligned(weights, offset)))  # type: ignore[no-untyped-call]
        return (picture.detach(), *(t.grad for t in tensors if t.grad is not None))

    check_offsets(step, torch.equal)
