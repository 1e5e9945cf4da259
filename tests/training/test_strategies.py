"""What one call of each strategy does to the tensors."""

import time

import pytest
import torch
from torch import Tensor

from mi_splat.training.strategies import ClassicConfig, Edit, MCMCConfig
from mi_splat.training.strategies.classic import densify_and_prune
from mi_splat.training.strategies.mcmc import _shared as shared
from mi_splat.training.strategies.mcmc import relocate


def rows(edit: Edit) -> Tensor:
    assert edit.source is not None
    return edit.source


def fresh(edit: Edit) -> Tensor:
    assert edit.fresh is not None
    return edit.fresh


def values(count: int, seed: int = 0) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return {
        "means": torch.randn(count, 3, generator=generator),
        "scales": torch.randn(count, 3, generator=generator) * 0.5 - 3,
        "rotations": torch.randn(count, 4, generator=generator),
        "opacities": torch.randn(count, generator=generator) + 1,
        "sh0": torch.randn(count, 1, 3, generator=generator),
        "shN": torch.randn(count, 3, 3, generator=generator),
    }


def test_classic_round_keeps_clones_and_splits() -> None:
    before = values(6)
    before["scales"][:3] = -1.0  # 0.37, large
    before["scales"][3:] = -6.0
    before["opacities"][5] = -9.0  # dead
    gradient = torch.tensor([1.0, 0.0, 1.0, 1.0, 0.0, 0.0])
    edit = densify_and_prune(
        before,
        gradient,
        scene_extent=1.0,
        config=ClassicConfig(densify_grad_threshold=0.5, percent_dense=0.1),
        prune_large=False,
        generator=torch.Generator().manual_seed(0),
    )
    # 5 is pruned, 0 and 2 are split, 3 is cloned
    assert rows(edit).tolist() == [1, 3, 4, 3, 0, 0, 2, 2]
    assert fresh(edit).tolist() == [False] * 3 + [True] * 5
    after = edit.parameters
    for name, tensor in after.items():
        assert torch.equal(tensor[:4], before[name][[1, 3, 4, 3]])
    assert torch.allclose(
        after["scales"][4:],
        before["scales"][[0, 0, 2, 2]] - torch.tensor(1.6).log(),
        atol=1e-6,
    )
    assert (after["means"][4] - after["means"][5]).norm() > 0
    assert (
        (after["means"][4:] - before["means"][[0, 0, 2, 2]]).norm(dim=1) < 4 * 0.37
    ).all()


def test_relocated_gaussians_look_like_the_one_they_came_from() -> None:
    """The line integral of opacity through n coinciding Gaussians is that of the one
    they replace.
    """
    before = values(5, seed=4)
    before["opacities"][:] = 2.0
    before["opacities"][4] = -9.0
    edit = relocate(
        before,
        config=MCMCConfig(growth=0.0),
        generator=torch.Generator().manual_seed(1),
    )
    assert len(rows(edit)) == 5
    (parent,) = set(rows(edit).tolist()) & {int(rows(edit)[4])}
    assert fresh(edit).nonzero().flatten().tolist() == sorted({parent, 4})
    after = edit.parameters
    assert torch.equal(after["means"][4], before["means"][parent])
    x = torch.linspace(-6, 6, 4001, dtype=torch.float64)

    def line(logit: Tensor, log_scale: Tensor, count: int) -> float:
        alpha = logit.double().sigmoid() * torch.exp(
            -0.5 * (x / log_scale.double().exp()) ** 2
        )
        return float(torch.trapezoid(1 - (1 - alpha) ** count, x))

    old = line(before["opacities"][parent], before["scales"][parent, 0] * 0, 1)
    relative = after["scales"][4, 0] - before["scales"][parent, 0]
    assert line(after["opacities"][4], relative, 2) == pytest.approx(old, rel=1e-3)
    untouched = [i for i in range(4) if i != parent]
    for name, tensor in after.items():
        assert torch.equal(tensor[untouched], before[name][untouched])


def test_only_gaussians_in_one_place_are_worked_on() -> None:
    before = values(100_000)
    shares = torch.ones(100_000, dtype=torch.int64)
    shares[[7, 9]] = torch.tensor([60, 3])
    begun = time.process_time()
    opacities, scales = shared(before["opacities"], before["scales"], shares)
    assert time.process_time() - begun < 1  # on all rows: 3 s
    some = torch.arange(5, 12)
    alone = shared(before["opacities"][some], before["scales"][some], shares[some])
    assert torch.equal(opacities[some], alone[0])
    assert torch.equal(scales[some], alone[1])
    kept = shares == 1
    assert torch.equal(opacities[kept], before["opacities"][kept])
    assert torch.equal(scales[kept], before["scales"][kept])
    assert (scales[~kept] != before["scales"][~kept]).all()
