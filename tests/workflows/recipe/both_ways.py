"""A recipe that a test loads is checked a second time, by the remembered answers of its nodes:
nothing may differ.
"""

from contextlib import suppress
from dataclasses import fields

import pytest

from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.recipe import loading, remembered_checks
from neusee.workflows.recipe.asked_nodes import AskedNodes
from neusee.workflows.recipe.node_families import all_nodes
from neusee.workflows.recipe.remembered_checks import Answers, RecordedNodes, RememberedNodes
from neusee.workflows.recipe.remembered_nodes import NotRemembered, signature_of

load_with = loading.load_with


def outcome(asked, *words):
    """The mistakes of a recipe, or all that its check has found."""
    try:
        recipe = load_with(asked, *words)
    except RecipeError as error:
        return str(error), [(p.mark, p.path, p.message, p.code) for p in error.diagnostics]
    recipe = remembered_checks.with_nodes(recipe)
    return {
        field.name: repr(getattr(recipe, field.name))
        for field in fields(recipe)
        if field.name not in ("uncertain", "safety")
    }


def signed():
    """The signatures of the nodes that this process has now, some of which are the test's."""
    answers = Answers("of the test")
    for name, node in all_nodes():
        family, _, attribute = name.partition(".")
        answers.signatures.setdefault(family, {})[attribute] = signature_of(node)
    return answers


def both_ways(asked, *words):
    """Load a recipe as ever, and compare its check with that by remembered answers."""
    if type(asked) is AskedNodes:
        answers = signed()
        found = outcome(RecordedNodes(answers), *words)
        # code of a user and files that are wrong are not remembered
        with suppress(NotRemembered):
            assert outcome(RememberedNodes(answers), *words) == found
    return load_with(asked, *words)


@pytest.fixture
def checked_both_ways(monkeypatch):
    """Check each recipe that the test loads in both ways."""
    for module in (loading, remembered_checks):
        monkeypatch.setattr(module, "load_with", both_ways)
