"""The version of a package, also where its description is not there."""

import importlib.metadata

import pytest

from neusee.workflows.engine import provenance


def test_a_package_has_the_version_that_is_installed():
    assert provenance.version_of("torch") == importlib.metadata.version("torch")
    assert provenance.version_of("no-such-package") == ""


def test_a_package_without_its_description_has_no_version(tmp_path, monkeypatch):
    (tmp_path / "halfgone-1.0.dist-info").mkdir()
    monkeypatch.syspath_prepend(str(tmp_path))
    assert provenance.version_of("halfgone") == ""


@pytest.mark.parametrize("error", [FileNotFoundError("No package metadata was found."), None])
def test_what_the_finder_of_importlib_metadata_says_is_no_error(monkeypatch, error):
    def version(package):
        if error:
            raise error

    monkeypatch.setattr(provenance, "version", version)
    assert provenance.version_of("torch") == ""
