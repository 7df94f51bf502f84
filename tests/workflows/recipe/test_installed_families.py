"""Families of nodes that packages install by an entry point."""

import importlib

import pytest
from typer.testing import CliRunner

import neusee
from neusee.workflows import Store, load
from neusee.workflows.cli.app import app
from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.handbook import json_schema
from neusee.workflows.recipe import node_families

USES = """\
outputs: [b]
steps:
  a: {{node: scene.targets, with: {{kind: siemens, shape: [4, 4]}}}}
  b: {{node: {0}, from: a}}
"""


pytestmark = pytest.mark.usefixtures("forget")


def problems(*arguments):
    with pytest.raises(RecipeError) as caught:
        load(*arguments)
    return [f"{p.mark} | {p.path} | {p.message}" for p in caught.value.diagnostics]


@pytest.fixture
def install(write, tmp_path, monkeypatch):
    """Install a package with an entry point, as pip leaves it."""
    monkeypatch.syspath_prepend(str(tmp_path / "site-packages"))

    def install(name, family, code):
        write(
            f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n",
            f"site-packages/{name}-1.0.dist-info/METADATA",
        )
        write(
            f"[neusee.nodes]\n{family} = {name}\n",
            f"site-packages/{name}-1.0.dist-info/entry_points.txt",
        )
        write(code, f"site-packages/{name}.py")
        importlib.invalidate_caches()
        node_families._installed.cache_clear()

    return install


GOOD = '"""Gauge."""\nfrom torch import Tensor\nfrom neusee.nodes import node\n\n\n@node()\n'
GOOD += 'def double(x: Tensor) -> Tensor:\n    """Double."""\n    return 2 * x\n'


def test_an_installed_family_needs_no_entry_in_the_recipe(install, write, tmp_path):
    install("labkit", "gauge", GOOD)
    write(USES.format("gauge.double"))
    result = neusee.run(
        load("mine.yaml", (), tmp_path), store=Store(tmp_path / "cache"), outputs=["a", "b"]
    )
    assert (result["b"] == 2 * result["a"]).all()
    assert "gauge.double" in dict(node_families.all_nodes())


def test_a_broken_package_breaks_only_the_recipes_that_use_it(install, write, tmp_path):
    install("brokenkit", "gauge", "import none_such_at_all\n")
    write(USES.format("gauge.double"))
    [problem] = problems("mine.yaml", (), tmp_path)
    assert "gauge of the installed package brokenkit fails: brokenkit cannot be imported" in problem
    assert load("first_light").name == "first_light"
    out = CliRunner().invoke(app, ["nodes"]).output
    assert "optics.psf" in out
    assert "gauge of the installed package brokenkit fails" in out
    json_schema.schema()


def test_two_packages_with_one_family_are_named(install, write, tmp_path):
    install("kit_one", "gauge", GOOD)
    install("kit_two", "gauge", GOOD)
    write(USES.format("gauge.double"))
    [problem] = problems("mine.yaml", (), tmp_path)
    assert problem.endswith(
        "kit_one and kit_two both install a family of nodes gauge: uninstall one of the packages"
    )


@pytest.mark.slow
def test_check_takes_the_module_of_a_family_that_is_called_as_its_package(install, write):
    install("labpack", "labpack", GOOD)
    write(
        "[neusee.nodes]\nlabpack = labpack.nodes\n",
        "site-packages/labpack-1.0.dist-info/entry_points.txt",
    )
    (write("", "site-packages/labpack.py")).unlink()
    network = "from torch import nn\n\n\nclass Small(nn.Module):\n"
    network += '    """A network."""\n\n    def forward(self, x):\n        return x\n'
    write("", "site-packages/labpack/__init__.py")
    write(GOOD + network, "site-packages/labpack/nodes.py")
    for place in ("labpack.nodes", "labpack", "labpack.double"):
        found = CliRunner().invoke(app, ["check", place])
        assert found.exit_code == 3, found.output
        assert found.output.startswith("labpack.double\n")
        assert ("labpack.Small\n" in found.output) == (place != "labpack.double")
    unknown = CliRunner().invoke(app, ["check", "labpack.duoble"])
    assert unknown.exit_code == 2
    assert "did you mean labpack.double?" in unknown.output


def test_a_package_cannot_replace_a_family_of_neusee(install):
    install("optics_kit", "optics", GOOD)
    assert "double" not in node_families.nodes_of("optics")
