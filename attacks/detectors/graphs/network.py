"""A graph model as a torch module: differentiable, channels first, its shapes and constants worked out once.

Making it ready walks the graph once with an input of zeros: what depends on constants alone is computed then, tensors
of pictures are put channels first, and what is left is a list of calls.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from attacks.detectors.graphs.graph import GraphModel, Node
from attacks.detectors.graphs.operations import OPERATIONS, Function, Step, Value, plain


class GraphNetwork(nn.Module):
    """Some outputs of a graph as functions of its inputs.

    The tensors that go in and come out have the axes that the graph gives them. Sizes are those of the graph.
    """

    def __init__(self, model: GraphModel, outputs: Sequence[str]) -> None:
        """Make a graph ready."""
        super().__init__()
        self._inputs = [name for name, node in model.nodes.items() if node.op == "Placeholder"]
        self._calls: list[tuple[Function, tuple[str, ...], tuple[str, ...]]] = []
        self._constants: dict[int, str] = {}
        self._results = [(self._kept(value), value.order) for value in self._walk(model, outputs)]
        self._last_use: dict[str, int] = {}
        for number, (_, taken, _) in enumerate(self._calls):
            self._last_use.update(dict.fromkeys(taken, number))
        for slot, _ in self._results:
            self._last_use[slot] = len(self._calls)

    def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        """The outputs for one tensor of each input, in the order of the graph."""
        at = {**dict(self.named_buffers()), **dict(zip(self._inputs, tensors, strict=True))}
        for number, (function, taken, given) in enumerate(self._calls):
            result = function(*(at[slot] for slot in taken))
            at.update(zip(given, result if isinstance(result, tuple) else (result,), strict=True))
            for slot in set(taken):
                if self._last_use[slot] == number:
                    del at[slot]
        return tuple(at[slot].permute(order) for slot, order in self._results)

    def _walk(self, model: GraphModel, outputs: Sequence[str]) -> list[Value]:
        """Make every node ready that the outputs need, and return the outputs."""
        ready: dict[str, tuple[Value, ...]] = {}

        def output(name: str) -> Value:
            node, _, number = name.partition(":")
            return ready[node][int(number or 0)]

        waiting = [name.partition(":")[0] for name in outputs]
        while waiting:
            name = waiting[-1]
            node = model.nodes[name]
            missing = [taken for taken in (of.partition(":")[0] for of in node.inputs) if taken not in ready]
            if name in ready or not missing:
                waiting.pop()
            if name in ready:
                continue
            waiting += missing
            if not missing:
                ready[name] = self._made_ready(name, node, [output(taken) for taken in node.inputs], model)
        return [output(name) for name in outputs]

    def _made_ready(self, name: str, node: Node, inputs: list[Value], model: GraphModel) -> tuple[Value, ...]:
        if node.op == "Const":
            constant = model.constants[name]
            return (Value(constant, plain(constant.ndim)),)
        if node.op == "Placeholder":
            shape = node.settings["shape"]
            return (Value(torch.zeros(shape), plain(len(shape)), name),)
        return OPERATIONS[node.op](node, inputs, self._run)

    def _run(self, step: Step) -> tuple[Value, ...]:
        with torch.no_grad():
            result = step.function(*(value.tensor for value in step.inputs))
        tensors = result if isinstance(result, tuple) else (result,)
        if all(value.constant for value in step.inputs):
            return tuple(Value(tensor, order) for tensor, order in zip(tensors, step.orders, strict=True))
        given = tuple(f"{len(self._calls)}.{number}" for number in range(len(tensors)))
        self._calls.append((step.function, tuple(self._kept(value) for value in step.inputs), given))
        return tuple(Value(*parts) for parts in zip(tensors, step.orders, given, strict=True))

    def _kept(self, value: Value) -> str:
        """Name under which a value is when the network runs; a constant becomes a buffer."""
        if value.slot is not None:
            return value.slot
        if id(value.tensor) not in self._constants:
            name = f"constant_{len(self._constants)}"
            self.register_buffer(name, value.tensor)
            self._constants[id(value.tensor)] = name
        return self._constants[id(value.tensor)]
