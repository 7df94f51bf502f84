"""Order in which the results of a run are made: those that need only short steps before those that need a long one.

Pictures and files of the short steps are then made beside the long ones, and values that only short steps read are no
longer in memory.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping

from neusee.workflows.graph.recipe_graph import Recipe


def shortest_first(
    recipe: Recipe, order: Iterable[str], first: Collection[str], others: Iterable[str], seconds: Mapping[str, float]
) -> list[str]:
    """Return the steps ``first``, and ``others`` that need only shorter steps, by the longest step that each needs.

    Args: order: all steps, each after its inputs. first: steps whose results are needed before all others are made.
    seconds: of each step that must run, as predicted. A step of ``others`` that needs a step as long as the longest
    that ``first`` need is left out.
    """
    longest: dict[str, float] = {}
    for name in order:
        below = (longest[source] for source in recipe.steps[name].sources)
        longest[name] = max(seconds.get(name, 0.0), max(below, default=0.0))
    most = max((longest[name] for name in first), default=0.0)
    found = dict.fromkeys([*first, *(name for name in others if longest[name] < most)])
    return sorted(found, key=longest.__getitem__)
