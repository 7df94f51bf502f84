"""What is public is exported, documented and typed, and the page of exceptions names every one
of them.
"""

import importlib
import inspect
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest

import neusee
import neusee.nodes
import neusee.workflows

GUIDE = Path(neusee.__file__).parent / "recipes" / "guide"
PUBLIC = [
    (module, name)
    for module in (neusee, neusee.workflows)
    for name in module.__all__
    if name != "__version__"
]
every_name = pytest.mark.parametrize(
    ("module", "name"), PUBLIC, ids=lambda x: x if isinstance(x, str) else x.__name__
)


def exceptions():
    """Every public class of exceptions, by its full name."""
    found = {}
    for package in (neusee.nodes, neusee.workflows):
        for info in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if info.name.endswith("__main__"):
                continue
            try:
                module = importlib.import_module(info.name)
            except ModuleNotFoundError as error:
                if str(error.name).startswith("neusee"):
                    raise
                continue  # of an extra that is not installed
            for name, value in vars(module).items():
                if (
                    isinstance(value, type)
                    and issubclass(value, BaseException)
                    and value.__module__ == module.__name__
                ):
                    found[f"{value.__module__}.{name}"] = value
    return {name: value for name, value in found.items() if not value.__name__.startswith("_")}


EXCEPTIONS = exceptions()


@every_name
def test_a_public_name_is_there_and_listed(module, name):
    assert getattr(module, name).__name__ == name
    assert name in dir(module)


def _sentence(thing):
    return " ".join((inspect.getdoc(thing) or "").split("\n\n")[0].split())


@every_name
def test_a_public_name_is_documented_by_a_sentence(module, name):
    first = _sentence(getattr(module, name))
    assert first[:1].isupper() or first.startswith("`"), first
    assert first.endswith((".", ":")), first
    assert "\n" not in first
    assert len(first) > 15


def test_the_packages_are_documented_by_a_sentence():
    for module in (neusee, neusee.workflows):
        assert re.match(r"[A-Z][^.]+[.]$", _sentence(module))


def _functions(thing):
    if inspect.isfunction(thing):
        return [thing]
    members = vars(thing).items() if isinstance(thing, type) else ()
    plain = (
        getattr(m, "fget", None) or getattr(m, "__func__", m)
        for name, m in members
        if not name.startswith("_")
    )
    return [m for m in plain if inspect.isfunction(m)]


@every_name
def test_a_public_function_is_typed_in_full(module, name):
    for function in _functions(getattr(module, name)):
        signature = inspect.signature(function)
        bare = [
            p.name
            for p in signature.parameters.values()
            if p.annotation is p.empty and p.name not in ("self", "cls")
        ]
        assert bare == [], function
        assert signature.return_annotation is not inspect.Signature.empty, function


def test_what_users_need_is_public():
    assert {"load", "run", "sweep", "train", "evaluate", "calibrate", "study"} <= set(
        neusee.__all__
    )
    assert {"Recipe", "Result", "Store", "RecipeError", "RunError"} <= set(neusee.__all__)
    assert (Path(neusee.__file__).parent / "py.typed").is_file()


def test_the_version_is_that_of_the_project():
    assert re.fullmatch(r"\d+\.\d+\.\d+([a-z]+\d+)?", neusee.__version__)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'neusee' has no attribute 'swep'"):
        _ = neusee.swep


def test_importing_it_loads_neither_torch_nor_pydantic():
    code = (
        "import sys, neusee; neusee.__version__; print(sorted({'torch', 'pydantic', 'typing'} &"
        " set(sys.modules)))"
    )
    # -S keeps away what the environment imports at its start
    path = str(Path(neusee.__file__).parents[1])
    done = subprocess.run(
        [sys.executable, "-S", "-c", code],
        env={"PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == "[]\n"


@pytest.mark.slow
def test_the_example_of_the_docstring_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    lines = [line[4:] for line in (neusee.__doc__ or "").splitlines() if line.startswith("    ")]
    assert 4 <= len(lines) <= 6
    exec("\n".join(lines), {})


@pytest.mark.parametrize("name", EXCEPTIONS)
def test_the_page_of_exceptions_names_it_and_who_raises_it(name):
    page = (GUIDE / "exceptions.md").read_text(encoding="utf-8")
    assert [
        line
        for line in page.splitlines()
        if line.startswith(f"| `{name}` |") and line.count("|") == 5
    ], name


def test_the_page_of_exceptions_names_no_other():
    page = (GUIDE / "exceptions.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r"^\| `(neusee\.\S+)` \|", page, re.MULTILINE)) == sorted(EXCEPTIONS)
    short = [
        word
        for word in re.findall(r"`(\w+Error)`", neusee.__doc__ or "")
        if word not in neusee.__all__
    ]
    assert short == []
