"""Steps whose results a run must return, and the values that it must compute for them.

A run returns its outputs, the numbers that the recipe expects, the spectral errors, the rival of a
mask, and the inputs of the result table. Only this module and ``report/contents.toml`` contain the
names of the steps of the camera graph.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence

from neusee.workflows.graph.recipe_graph import Expectation, Recipe, in_order, needed
from neusee.workflows.keys.cache_key import Key
from neusee.workflows.tolerance.cheaper_steps import with_substitutions

# --- wanted steps ---------------------------------------------------------------------------------


def _row(arm: str) -> dict[str, str]:
    """Return the step whose result each column of the result table shows, for the ``plain`` lens
    or the ``mask``.
    """
    steps = {
        "peak/I_sat": "peak",
        "LSR": "lsr",
        "BSR": "bsr",
        "outside": "outside",
        "quality": "developed_quality",
        "saturated": "saturated",
    }
    return {column: f"{step}[{arm}]" for column, step in steps.items()}


#: Rows of the result table: the step that each column reads. `LSR` is taken at the wavelength of
#: the first laser.
TABLE: Mapping[str, Mapping[str, str]] = {
    "plain lens": _row("plain"),
    "with mask": _row("mask"),
    "restored": {"quality": "restored_quality"},
    "grey filter, restored": {"quality": "rival_quality", "saturated": "rival_saturated"},
}
RIVAL = "grey filter, restored"

#: Steps that estimate the error from the number of bands, each with the quantity that has the
#: error.
SPECTRAL: Mapping[str, str] = {
    "spectral": "of the PSF of a white point",
    "laser_spectral": "of a laser spot",
}

BANDS = "bands"
LINES = "line[*]"


def wanted(recipe: Recipe) -> tuple[str, ...]:
    """Return the steps that a run must return: outputs, steps of expected numbers, spectral errors,
    and the rival of a mask.

    An expected number counts if an output needs its step, and a spectral error if the outputs need
    all its inputs. The rival of a mask counts if the outputs tell how the mask protects and how the
    restored picture looks.
    """
    needed_steps = _asked(recipe)
    errors = (
        name
        for name in spectral_steps(recipe)
        if needed_steps.issuperset(recipe.steps[name].sources)
    )
    numbers = (e.step for e in compared(recipe)[0])
    return tuple(dict.fromkeys([*recipe.outputs, *numbers, *errors, *_rival(recipe, needed_steps)]))


def _rival(recipe: Recipe, asked: set[str]) -> Iterable[str]:
    """Return the steps of the grey filter that is the rival of a mask; none if the recipe itself
    has a filter.
    """
    steps = TABLE[RIVAL].values()
    has_mask = asked.issuperset((TABLE["with mask"]["LSR"], *TABLE["restored"].values()))
    return steps if has_mask and not shade_of(recipe) and recipe.steps.keys() >= set(steps) else ()


def shade_of(recipe: Recipe) -> str | None:
    """Return the step of the grey filter, stop or notch in the arm of the mask, or None."""
    pupil_step = recipe.steps.get("pupil[mask]")
    source_step = pupil_step.wires.get("shade") if pupil_step else None
    return source_step if isinstance(source_step, str) else None


def compared(recipe: Recipe) -> tuple[list[Expectation], list[Expectation]]:
    """Return the expected numbers that a run compares, and those whose steps no output of the
    recipe needs.
    """
    needed_steps = _asked(recipe)
    numbers: tuple[list[Expectation], list[Expectation]] = ([], [])
    for number in recipe.expect:
        # False is index 0, the compared numbers; True is index 1, the others
        numbers[number.step not in needed_steps].append(number)
    return numbers


def _asked(recipe: Recipe) -> set[str]:
    return set(needed(recipe.unsubstituted or recipe, recipe.outputs))


def spectral_steps(recipe: Recipe) -> list[str]:
    """Return the steps of the recipe that estimate the error by the number of spectral bands."""
    return [name for name in recipe.steps if name.partition("[")[0] in SPECTRAL]


def steps_of(recipe: Recipe) -> list[str]:
    """Return every step that a run of ``recipe`` computes or loads from the cache, in running
    order.
    """
    return needed(with_substitutions(recipe, wanted(recipe)), wanted(recipe))


# --- missing values -------------------------------------------------------------------------------

# The values that a run must compute, because the store has no copy of them. A stored value that is
# requested is loaded. The inputs of a missing value are loaded if they are stored, and otherwise
# computed in the same way.


class Upstream(dict[Key, list[Key]]):
    """Dictionary from the key of a value to the keys of its inputs; the list is empty if the
    value is known.
    """

    def __init__(
        self, is_known: Callable[[Key], bool], sources: Callable[[Key], list[Key]]
    ) -> None:
        self._known, self._sources = is_known, sources
        self.missing = set[Key]()

    def __missing__(self, key: Key) -> list[Key]:
        if self._known(key):
            self[key] = []
        else:
            self.missing.add(key)
            self[key] = self._sources(key)
        return self[key]

    def knows(self, key: Key) -> bool:
        """Return True if a value is known; each value is checked only once."""
        return key not in self.missing if key in self else self._known(key)


def uses_of(
    plan: Iterable[Key],
    targets: Sequence[Key],
    is_known: Callable[[Key], bool],
    sources: Callable[[Key], list[Key]],
) -> Counter[Key]:
    """Return how often each value is read while the values with the keys ``plan`` and
    ``targets`` are computed.
    """
    upstream, uses = Upstream(is_known, sources), Counter(targets)
    # the walk notes the missing values
    in_order(upstream, targets)
    for key in upstream.missing.union(plan):
        uses.update(sources(key))
    return uses
