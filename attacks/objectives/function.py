"""An objective of one's own, of two functions."""

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from attacks.detectors.base import Candidates, Detections
from attacks.objectives.base import Objective, Target
from attacks.search.loop import Verdict
from mi_splat.errors import InvalidValueError


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class FunctionObjective:
    """An aim of two functions; see `objective`.

    Attributes:
        loss: Scalar that falls as the attacker gets nearer.
        success: Whether the aim is reached, how near it is, or a `Verdict`.
        name: Short name for reports.
        label: Class that the object should become; None if no particular one.
    """

    loss: Callable[[Candidates, Target], Tensor]
    success: Callable[[Detections, Target], bool | float | Verdict]
    name: str
    label: str | None

    def __repr__(self) -> str:
        """Text that is the same in every process, so that a search can be taken up
        again.
        """
        loss, success = (
            f"{function.__module__}.{function.__qualname__}"
            for function in (self.loss, self.success)
        )
        return f"objective({loss}, {success}, name={self.name!r}, label={self.label!r})"

    def __call__(self, candidates: Candidates, target: Target) -> Tensor:
        """Scalar loss, lower is better for the attacker."""
        value = self.loss(candidates, target)
        if not isinstance(value, Tensor) or value.ndim:
            if isinstance(value, Tensor):
                got = f"a tensor of shape {tuple(value.shape)}"
            else:
                got = type(value).__name__
            do = "end the loss with .sum() or .mean()"
            raise InvalidValueError.of(
                f"loss of {self.name}", "a tensor without axes", got, do
            )
        return value

    def verdict(self, detections: Detections, target: Target) -> Verdict:
        """What `success` says; a number is how near the aim is, and 1 is success."""
        answer = self.success(detections, target)
        if isinstance(answer, Verdict):
            return answer
        score = float(answer)
        if not 0 <= score <= 1:
            do = "give True or False, or how near the aim is"
            raise InvalidValueError.of(
                f"success of {self.name}", "a number in [0, 1]", score, do
            )
        return Verdict(success=score == 1, score=score, unambiguous=score == 1)


def objective(
    loss: Callable[[Candidates, Target], Tensor],
    success: Callable[[Detections, Target], bool | float | Verdict],
    *,
    name: str = "",
    label: str | None = None,
) -> Objective:
    """An aim of your own from two functions: what the search follows, and what counts.

    Args:
        loss: From everything that a detector considers in a view, and the object there,
            to a scalar that falls as the attacker gets nearer. It has to be
            differentiable in `Candidates.scores` or `Candidates.boxes`.
        success: From what the detector reports, and the object there, to whether the
            aim is reached; or to how near it is, in [0, 1], where 1 is success; or to a
            whole `attacks.search.loop.Verdict`. `attacks.objectives.base.confidence` is
            the score with which classes are reported on the object.
        name: Short name for reports; that of `success` if empty.
        label: Class that the object should become, which `Target.label` then is; None
            if no particular one.

    Returns:
        The aim, as `attack` takes it.

    Raises:
        InvalidValueError: One of them is no function.
    """
    for what, value in (("loss", loss), ("success", success)):
        if not callable(value):
            raise InvalidValueError.of(
                what,
                "a function",
                type(value).__name__,
                "pass a function of two arguments",
            )
    name = name or getattr(success, "__name__", "own").strip("<>")
    return FunctionObjective(loss=loss, success=success, name=name, label=label)
