"""What ships with neusee is not observed, and pays nothing."""

from ruamel.yaml import YAML

from neusee.workflows.keys import cache_key as module_owner
from neusee.workflows.recipe.node_families import all_nodes
from neusee.workflows.recipe.text.recipe_files import packaged


def test_no_node_that_ships_is_one_of_the_user(monkeypatch):
    monkeypatch.setattr(module_owner, "PROVEN", ("neusee.",))
    modules = {
        name: node.fn.__module__
        for name, node in all_nodes()
        if node.fn.__module__.startswith("neusee")
    }
    assert len(modules) > 100
    assert [name for name, module in modules.items() if module_owner.is_own(module)] == []
    assert module_owner.is_own("neusee_of_another")
    assert module_owner.is_own("bloom")


def test_no_recipe_that_ships_names_code():
    files = list(packaged().rglob("*.yaml"))
    assert len(files) > 50
    read = YAML(typ="safe", pure=True)
    assert [path.name for path in files if "nodes" in (read.load(path) or {})] == []
