"""What the check of a recipe asks the nodes: which there are, their own checks, and the known
forms of their results.
"""

from __future__ import annotations

import functools
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from neusee.nodes import Node
from neusee.workflows.graph.recipe_graph import Step
from neusee.workflows.graph.step_shapes import Form, form_of
from neusee.workflows.keys.cache_key import is_own
from neusee.workflows.recipe import lazy_imports as lazy
from neusee.workflows.recipe.node_families import Own, find_node

if TYPE_CHECKING:
    from neusee.workflows.recipe.step_checks import CheckedStep


class AskedNodes:
    """The nodes themselves, each imported where a recipe names it.

    `remembered_checks` has other answers: those that an earlier process wrote down.
    """

    reuses_checks = True  #: whether steps that this process has checked are not asked again
    are_imported = True  #: whether later checks of this process may use the nodes that are found

    def refuse_code_of(self, keys: Collection[str | int]) -> None:
        """Take note of the keys of a recipe whose blocks import code to be read."""

    def find(self, name: str, own: Own) -> Node:
        """Return the node with a name such as ``sensor.digitize``, as `find_node` does."""
        return find_node(name, own)

    def note_values(self, node: Node, given: Mapping[str, Any], read: Mapping[str, Any]) -> None:
        """Take note of the parameters ``given`` in a recipe and of their values as ``read``."""

    def notes(self, step: Step, forms: Mapping[str, Form]) -> Sequence[str]:
        """Return the notes of a node's own check of a step, which raises for a mistake.

        ``forms`` has the known form of each input that the check takes. The check of a user's node
        is observed.
        """
        hook = step.node.hooks.preflight
        if hook is None:
            return ()
        call = functools.partial(hook, **step.params, **forms)
        if not is_own(step.node.fn.__module__):
            return call()
        return lazy.observed_call.call_hook(step.node, call, step.params)

    def form(self, step: Step, inputs: Sequence[Form]) -> Form:
        """Return the known form of the result of a step; a step with `before_run` is computed, and
        raises for its own mistakes.
        """
        if step.node.before_run:
            return step.node(**step.params)
        return form_of(step.node, inputs, step.params)

    def learn(self, checked: Iterable[CheckedStep]) -> None:
        """Take note of the steps of a recipe without mistakes."""


THEMSELVES = AskedNodes()
