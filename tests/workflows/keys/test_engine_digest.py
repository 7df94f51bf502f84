"""The digest of the program: it follows the code of all that is imported, and raises where it
cannot.
"""

from pathlib import Path

import pytest

from neusee.workflows.keys import code_digest as engine_digest

ROOT = Path(engine_digest.__file__).parents[1]
TEXTS = {
    "engine.runner": "from neusee.workflows.room.deep import x\n",
    "room.deep": "x = 1\n",
    "room.__init__": "",
    "room.aside": "y = 1\n",
}
MODULES = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts) for path in ROOT.rglob("*.py")
)


@pytest.fixture
def digest_with(tmp_path, monkeypatch):
    """Return the digest of a small program, some of whose modules have another text."""
    monkeypatch.setattr(engine_digest, "_HERE", tmp_path)

    def digest_with(texts=()):
        for name, text in {**TEXTS, **dict(texts)}.items():
            path = tmp_path / f"{name.replace('.', '/')}.py"
            path.parent.mkdir(exist_ok=True)
            path.write_text(text)
        return engine_digest.engine.__wrapped__()

    return digest_with


def test_the_digest_follows_the_code_of_what_is_imported_and_nothing_else(digest_with):
    first = digest_with()
    assert digest_with({"room.aside": "y = 2\n"}) == first
    assert digest_with({"room.deep": '"""Words."""\nx = 1  # more\n'}) == first
    assert digest_with({"room.deep": "x = 2\n"}) != first


@pytest.mark.parametrize(
    "line", ["import neusee.workflows.room.deep", "from neusee.workflows.room import deep"]
)
def test_every_way_to_import_a_module_counts(digest_with, line):
    first = digest_with({"engine.runner": f"{line}\n"})
    assert digest_with({"engine.runner": f"{line}\n", "room.deep": "x = 3\n"}) != first


@pytest.mark.parametrize(
    "line", ["from neusee.workflows.gone import x", "import neusee.workflows.room.gone"]
)
def test_a_module_without_a_file_is_an_error(digest_with, line):
    with pytest.raises(LookupError, match=r"gone has no source file"):
        digest_with({"engine.runner": f"{line}\n"})


@pytest.mark.slow
def test_every_module_of_the_program_has_a_digest():
    """None imports, at its top, what the digest cannot find."""
    wrong = {}
    for module in MODULES:
        try:
            found = engine_digest.engine(module.removesuffix(".__init__"))
        except LookupError as error:
            wrong[module] = str(error)
        else:
            if len(found) != 32:
                wrong[module] = found
    assert len(MODULES) > 100
    assert wrong == {}
