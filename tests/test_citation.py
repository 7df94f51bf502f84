"""The metadata that others read: CITATION.cff and pyproject.toml say the same, and no more than
is tested.
"""

import re
import sys
import tomllib
from pathlib import Path

import pytest
from ruamel.yaml import YAML

import neusee

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


@pytest.fixture
def citation():
    return YAML(typ="safe").load((ROOT / "CITATION.cff").read_text())


def test_the_citation_has_what_the_format_requires(citation):
    """The required keys, and the types of Citation File Format 1.2.0."""
    assert citation["cff-version"] == "1.2.0"
    assert citation["type"] == "software"
    assert {"message", "title", "authors"} <= citation.keys()
    for work in (citation, *citation["references"]):
        assert work["title"]
        assert work["authors"]
        for author in work["authors"]:
            assert author.keys() in ({"name"}, {"family-names", "given-names"})
    assert all(isinstance(work["year"], int) for work in citation["references"])
    assert {work["type"] for work in citation["references"]} == {"conference-paper"}


def test_citation_and_package_say_the_same(citation):
    assert citation["version"] == neusee.__version__
    assert citation["title"] == PROJECT["name"]
    assert citation["license"] == PROJECT["license"]
    assert [author["name"] for author in citation["authors"]] == [
        author["name"] for author in PROJECT["authors"]
    ]
    assert set(citation["keywords"]) <= set(PROJECT["keywords"])


def test_every_version_of_python_that_is_allowed_is_named_as_tested():
    named = [
        c.rpartition(" ")[2] for c in PROJECT["classifiers"] if re.fullmatch(r".* :: 3\.\d+", c)
    ]
    low, high = (
        tuple(map(int, part.split(".")))
        for part in re.findall(r"\d+\.\d+", PROJECT["requires-python"])
    )
    allowed = [f"3.{minor}" for minor in range(low[1], high[1])]
    readme = " ".join((ROOT / "README.md").read_text().split())
    (tested,) = re.search(r"Tested with Python ([\d., and]*?), and torch", readme).groups()
    assert named == allowed
    assert re.findall(r"3\.\d+", tested) == named
    table = (ROOT / "CONTRIBUTING.md").read_text().partition("## Versions")[2]
    assert all(f"| {version} |" in table for version in named)
    assert low <= sys.version_info[:2] < high
