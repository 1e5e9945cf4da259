"""A graph model as a torch module: differentiable, channels first, its shapes and constants worked out once.

Making it ready walks the graph once with an input of zeros: what depends on constants alone is computed then, tensors
of pictures are put channels first, and what is left is a list of calls.
"""

import hashlib
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from attacks.detectors.catalogue import DetectorError
from attacks.detectors.graphs.files import MOST_ELEMENTS, GraphModel, Node
from attacks.detectors.graphs.operations import OPERATIONS
from attacks.detectors.graphs.values import Function, Step, Value, plain
from mi_splat.errors import InvalidValueError

_MISFITS = (RuntimeError, ValueError, TypeError, IndexError, KeyError, ArithmeticError)
"""What Python and torch raise where inputs and settings of an operation do not fit together."""


class GraphNetwork(nn.Module):
    """Some outputs of a graph as functions of its inputs.

    The tensors that go in and come out have the axes that the graph gives them. Sizes are those of the graph.

    Attributes:
        inputs: Names of the tensors that it takes, with their shapes.
        outputs: Names of the tensors that it gives.
        shapes: Shapes of these.
        digest: SHA-256 that stands for the nodes and the outputs.
    """

    def __init__(self, model: GraphModel, outputs: Sequence[str] | None = None) -> None:
        """Make a graph ready."""
        super().__init__()
        self.inputs = dict(model.inputs)
        self.outputs = tuple(model.outputs if outputs is None else outputs)
        self._calls: list[tuple[Function, tuple[str, ...], tuple[str, ...]]] = []
        self._constants: dict[int, str] = {}
        results = self._walk(model)
        self.shapes = [value.shape for value in results]
        self.digest = hashlib.sha256(" ".join((model.digest, *self.outputs)).encode()).hexdigest()
        self._last_use: dict[str, int] = {}
        self._results = [(self._kept(value), value.order) for value in results]
        for number, (_, taken, _) in enumerate(self._calls):
            self._last_use.update(dict.fromkeys(taken, number))
        for slot, _ in self._results:
            self._last_use[slot] = len(self._calls)

    def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        """The outputs for one tensor of each input, in the order of `inputs`."""
        at = dict(self.named_buffers())
        for (name, shape), tensor in zip(self.inputs.items(), tensors, strict=True):
            if tuple(tensor.shape) != shape:
                raise InvalidValueError.of(f"input {name}", shape, tuple(tensor.shape), "resize the picture")
            at[name] = tensor
        for number, (function, taken, given) in enumerate(self._calls):
            result = function(*(at[slot] for slot in taken))
            at.update(zip(given, result if isinstance(result, tuple) else (result,), strict=True))
            for slot in set(taken):
                if self._last_use[slot] == number:
                    del at[slot]
        return tuple(at[slot].permute(order) for slot, order in self._results)

    def _walk(self, model: GraphModel) -> list[Value]:
        """Make every node ready that the outputs need, and return the outputs."""
        ready: dict[str, tuple[Value, ...]] = {}
        waiting = [name.partition(":")[0] for name in self.outputs]
        while waiting:
            name = waiting[-1]
            if name not in model.nodes:
                raise DetectorError.of("output", "a node of the graph", name, "choose one of the graph's")
            node = model.nodes[name]
            needed = [taken.partition(":")[0] for taken in node.inputs]
            missing = [taken for taken in needed if taken not in ready]
            if name in ready or not missing:
                waiting.pop()
            if name in ready:
                continue
            if len(waiting) > 4 * len(model.nodes):
                raise DetectorError.of("graph", "no circle", f"one through {name}", "convert the model again")
            waiting += missing
            if not missing:
                ready[name] = self._made_ready(node, [_output(ready, taken) for taken in node.inputs], model)
        return [_output(ready, name) for name in self.outputs]

    def _made_ready(self, node: Node, inputs: list[Value], model: GraphModel) -> tuple[Value, ...]:
        if node.op == "Const":
            constant = model.constants[node.name]
            return (Value(constant, plain(constant.ndim)),)
        if node.op == "Placeholder":
            shape = model.inputs[node.name]
            if min(shape, default=1) < 1:
                do = "convert the model with sizes that are given"
                raise DetectorError.of(f"input {node.name}", "a shape that is known", shape, do)
            return (Value(torch.zeros(shape), plain(len(shape)), node.name),)
        if node.op not in OPERATIONS:
            expected = f"one of {', '.join(OPERATIONS)}"
            raise DetectorError.of(f"operation of node {node.name}", expected, node.op, "add it to OPERATIONS")
        try:
            return OPERATIONS[node.op](node, inputs, self._run)
        except _MISFITS as error:
            expected, got = "inputs and settings that fit together", " ".join(str(error).split())[:120]
            do = "convert the model again, or report the file"
            raise DetectorError.of(f"{node.op} {node.name}", expected, got or type(error).__name__, do) from error

    def _run(self, step: Step) -> tuple[Value, ...]:
        with torch.no_grad():
            plan = step.function(*(value.tensor.to("meta") for value in step.inputs))
            sizes = [tensor.numel() for tensor in (plan if isinstance(plan, tuple) else (plan,))]
            if max(sizes, default=0) > MOST_ELEMENTS:
                raise ValueError(f"a result of {max(sizes):,} numbers, more than {MOST_ELEMENTS:,}")
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


def _output(ready: Mapping[str, tuple[Value, ...]], name: str) -> Value:
    node, _, number = name.partition(":")
    values = ready[node]
    if number and (not number.isdecimal() or len(number) > 4 or int(number) >= len(values)):
        do = "convert the model again, or report the file"
        raise DetectorError.of(f"output of node {node}", f"one of {len(values)}", number[:40], do)
    return values[int(number or 0)]
