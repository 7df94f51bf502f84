"""The draws of a study whose values the recipe allows together; other draws are left out, and their number is stated.

A value alone may be allowed, and two values may exclude each other, such as a full well below the offset.
"""

from __future__ import annotations

from neusee.workflows.graph.diagnostics import Diagnostic, RecipeError
from neusee.workflows.recipe.distributions.shapes import FloatArray
from neusee.workflows.recipe.distributions.uncertain_inputs import InputDraws, Inputs


class AllowedDraws:
    """The allowed draws of the inputs, in order, of which a study takes more and more."""

    def __init__(self, inputs: Inputs, draws: InputDraws, sequences: int) -> None:
        self._inputs, self._draws = inputs, draws
        self._block = max(1, sequences)  #: draws that are left out together, so that Sobol sequences stay equally long
        self._allowed: list[int] = []
        self.tried = 0
        self.left_out = 0
        self.reason = ""  #: why the last draw was left out

    @property
    def available(self) -> int:
        """Return the largest number of draws that can be tried."""
        return len(self._draws.z)

    @property
    def statement(self) -> str:
        """Return how many draws were left out and why, or an empty text."""
        return f"{self.left_out} of {self.tried} draws ({self.reason})" if self.left_out else ""

    @property
    def z(self) -> FloatArray:
        """Return the standard normal numbers (draw, input) of the allowed draws so far."""
        return self._draws.z[self._allowed]

    @property
    def values(self) -> FloatArray:
        """Return the values (draw, input) of the allowed draws so far, in SI."""
        return self._draws.values[self._allowed]

    def extend(self, count: int) -> None:
        """Try draws until ``count`` draws have been tried."""
        while self.tried < min(count, self.available):
            block = range(self.tried, min(self.tried + self._block, self.available))
            problems = [self._inputs.problem(self._draws.values[i]) for i in block]
            wrong = [problem for problem in problems if problem is not None]
            if wrong:
                self.left_out += len(block)
                self.reason = _text(wrong[-1])
            else:
                self._allowed += block
            self.tried = block.stop


def refuse_combinations(inputs: Inputs, ends: FloatArray, draws: AllowedDraws) -> None:
    """Raise `RecipeError` if values of ``ends`` (run, input), or of a draw, are not allowed together.

    The draws are those that have been tried before anything runs.
    """
    problems = [problem for problem in map(inputs.problem, ends) if problem is not None]
    if problems:
        raise RecipeError(problems)
    if draws.left_out:
        what = f"{draws.left_out} of the first {draws.tried} draws have values that are not allowed together"
        value = inputs.uncertain.composed.root.below(inputs.names[0].split("."))
        assert value is not None
        advice = "give narrower or truncated distributions"
        raise RecipeError([Diagnostic(value.mark, ", ".join(inputs.names), f"{what} ({draws.reason}): {advice}")])


def _text(problem: Diagnostic) -> str:
    return f"{problem.path}: {problem.message}" if problem.path else problem.message
