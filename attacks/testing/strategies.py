"""The contract of a strategy of densification
(`mi_splat.training.strategies.Strategy`).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from attacks.testing.promises import Contract, cloud, expect, expect_same
from mi_splat.io.parameters import to_raw_parameters
from mi_splat.scene import GaussianScene
from mi_splat.training.strategies import Edit, Step, StrategyConfig

_COUNT = 40
_EXTENT = 1.0
_STEPS = (1, 100, 500, 600, 3000)
"""Steps of the training after which a strategy is asked for a change."""
_ITERATIONS = 30_000


class _Statistics:
    """Screen-space gradients of a step in which half of the Gaussians were visible, and
    far from at rest.
    """

    def __init__(self, count: int) -> None:
        self.lengths = torch.linspace(0, 1e-2, count)
        self.visible = (torch.arange(count) % 2).float()


def check_strategy(config: Any) -> None:
    """Raise unless a strategy keeps its contract.

    It is asked for its changes at several steps of a training. A change names a source
    for each new row, has tensors of the right shapes, and leaves the tensors that it
    was given as they are; the state keeps its names; and two runs with the same random
    numbers make the same bits.

    Args:
        config: The options of the strategy, a `StrategyConfig`.

    Raises:
        ContractError: It does not; the message lists all that is wrong.
    """
    contract = Contract(f"strategy {type(config).__name__}")
    with contract.promise("options"):
        expect(
            isinstance(config, StrategyConfig),
            "a StrategyConfig",
            type(config).__name__,
            "derive from it",
        )
        for hook in ("initial_state", "before_backward", "after_step"):
            expect(
                callable(getattr(config.build(), hook, None)),
                f"a hook {hook}",
                "none",
                "derive from Strategy",
            )
    contract.settle()
    with contract.promise("loss"):
        _loss(config)
    with contract.promise("changes"):
        for iteration in _STEPS:
            _change(config, iteration)
    with contract.promise("state"):
        _state(config)
    with contract.promise("determinism"):
        first, second = (_run(config) for _ in range(2))
        do = "draw from step.generator, in a fixed order"
        expect_same(
            first,
            second,
            atol=0,
            expected="the same tensors from the same random numbers",
            do=do,
        )
    contract.settle()


def _scene() -> GaussianScene:
    return cloud(_COUNT, degree=1)


def _parameters() -> dict[str, Tensor]:
    raw = to_raw_parameters(_scene())
    sh = raw.pop("sh")
    return {**raw, "sh0": sh[:, :1].clone(), "shN": sh[:, 1:].clone()}


def _step(parameters: dict[str, Tensor], iteration: int) -> Step:
    return Step(
        parameters=parameters,
        iteration=iteration,
        iterations=_ITERATIONS,
        scene_extent=_EXTENT,
        lr_means=1.6e-4,
        generator=torch.Generator().manual_seed(iteration),
        screen_gradients=_Statistics(len(parameters["means"])),
    )


def _loss(config: StrategyConfig) -> None:
    leaf = torch.tensor(2.0, requires_grad=True)
    loss = config.build().before_backward(leaf, _scene())
    is_scalar = (
        isinstance(loss, Tensor) and loss.ndim == 0 and bool(torch.isfinite(loss))
    )
    expect(
        is_scalar,
        "a finite scalar loss",
        repr(loss)[:60],
        "add numbers to the loss that is given",
    )
    expect(
        loss.requires_grad,
        "a loss that depends on the one that is given",
        "none",
        "add to it",
    )


def _change(config: StrategyConfig, iteration: int) -> None:
    strategy = config.build()
    parameters = _parameters()
    state = strategy.initial_state(_COUNT)
    kept = {name: value.clone() for name, value in parameters.items()}
    edit = strategy.after_step(_step(parameters, iteration), state)
    stayed = all(torch.equal(parameters[name], value) for name, value in kept.items())
    expect(
        stayed, "tensors that stay as they are", "others", "return new ones in an Edit"
    )
    if edit is None:
        return
    expect(isinstance(edit, Edit), "an Edit or None", type(edit).__name__, "return one")
    count = _COUNT if edit.source is None else len(edit.source)
    if edit.source is not None:
        within = bool(((edit.source >= 0) & (edit.source < _COUNT)).all())
        expect(
            within,
            f"sources among {_COUNT} rows",
            "others",
            "name an old row for each new one",
        )
    if edit.fresh is not None:
        shape = tuple(edit.fresh.shape)
        expect(
            shape == (count,),
            f"fresh of shape ({count},)",
            shape,
            "say it of each new row",
        )
    unknown = sorted({*edit.parameters} - {*parameters})
    expect(not unknown, "names of parameters", ", ".join(unknown), "leave others out")
    for name, value in edit.parameters.items():
        wanted = (count, *kept[name].shape[1:])
        expect(
            tuple(value.shape) == wanted,
            f"{name} of shape {wanted}",
            tuple(value.shape),
            "give each row a value",
        )
        finite = bool(torch.isfinite(value).all())
        expect(
            finite,
            f"finite {name}",
            "NaN or infinity",
            "look at logarithms and divisions",
        )


def _state(config: StrategyConfig) -> None:
    """A checkpoint holds the state by its names, of a number of rows that follows the
    Gaussians.
    """
    strategy = config.build()
    state = strategy.initial_state(_COUNT)
    kinds = {name: (value.dtype, value.shape[1:]) for name, value in state.items()}
    for iteration in _STEPS:
        strategy.after_step(_step(_parameters(), iteration), state)
        now = {name: (value.dtype, value.shape[1:]) for name, value in state.items()}
        expect(
            now == kinds,
            f"a state of {sorted(kinds)}",
            sorted(now),
            "keep names, shapes and kinds of numbers",
        )
        state = strategy.initial_state(_COUNT)


def _run(config: StrategyConfig) -> list[Tensor]:
    """What a strategy changes at each of some steps."""
    strategy = config.build()
    changed = list[Tensor]()
    for iteration in _STEPS:
        edit = strategy.after_step(
            _step(_parameters(), iteration), strategy.initial_state(_COUNT)
        )
        if edit is not None:
            changed += [edit.parameters[name] for name in sorted(edit.parameters)]
    return changed
