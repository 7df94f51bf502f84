"""The error that a run raises for a failed step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from neusee.workflows.graph.recipe_graph import Step


class RunError(RuntimeError):
    """Error of a failed step, with the step, its node, its location in the recipe, its inputs
    and the cause.
    """

    def __init__(self, step: Step, inputs: Sequence[Any], cause: BaseException) -> None:
        self.step, self.cause = step.name, cause
        shapes = ", ".join(
            f"{name} {_shape(value)}" for name, value in zip(step.node.inputs, inputs, strict=False)
        )
        super().__init__(
            f"{step.mark}   {step.name} ({step.node.path}): {type(cause).__name__}: {cause}"
            + (f"\n  inputs: {shapes}" if shapes else "")
        )

    def __reduce__(self) -> tuple[Any, ...]:
        # another process can make such an error from its texts
        can_be_sent = type(self.cause).__module__ == "builtins" and all(
            isinstance(argument, str) for argument in self.cause.args
        )
        return _unpickled, (self.step, str(self), self.cause if can_be_sent else repr(self.cause))


def _unpickled(step: str, text: str, cause: BaseException | str) -> RunError:
    """Return the `RunError` of another process, which keeps its text but not the traceback of
    its cause.
    """
    error = RunError.__new__(RunError, text)
    RuntimeError.__init__(error, text)
    error.step, error.cause = (
        step,
        cause if isinstance(cause, BaseException) else RuntimeError(cause),
    )
    return error


def _shape(value: Any) -> str:
    """Return the shape and type of an input as text."""
    if isinstance(value, Tensor):
        return f"{tuple(value.shape)} {str(value.dtype).removeprefix('torch.')}"
    if isinstance(value, list | tuple):
        return f"{type(value).__name__}[{', '.join(_shape(item) for item in value)}]"
    return "absent" if value is None else type(value).__name__
