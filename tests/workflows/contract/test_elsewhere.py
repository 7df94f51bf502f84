"""A node whose result depends on what is around the call is told on what, where, and what to
write.
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from neusee.workflows.contract import surroundings
from neusee.workflows.contract.node_contract import check_all
from neusee.workflows.contract.surroundings import elsewhere
from neusee.workflows.recipe.node_families import import_own, own_nodes

INSTALLED = surroundings.installed_locales
HEAD = '''"""Nodes of a test."""
import datetime
import locale
import os
import random
import time
import warnings
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from neusee.nodes import node
from neusee.nodes.units import DataFile

CALLED = []
HERE = os.getcwd()
HOME_AT_IMPORT = len(os.path.expanduser("~"))


def one():
    return {"x": torch.ones(3)}


def many():
    return {"x": torch.rand(1_000_003, generator=torch.Generator().manual_seed(1))}

'''
#: the body of a node of each kind, and what is said of it; no seed of ours is that of this process,
#: so the words of the set are many and the result holds several of them
KINDS = {
    "folder": ("x * len(os.getcwd())", "in another working folder the result differs by "),
    "file": (
        'x * len(Path("gain.txt").read_text())',
        "in another working folder it raises FileNotFoundError: ",
    ),
    "text": (
        'x * len(Path(HERE, "micro.txt").read_text())',
        "in the locale C it raises UnicodeDecodeError: ",
    ),
    "hashed": (
        "x * float(''.join({str(i) for i in range(40)})[:9])",
        "with another hash seed (PYTHONHASHSEED) the result ",
    ),
    "counted": (
        "x * torch.get_num_threads()",
        "with 3 threads in place of 1 the result differs by 2 of its largest",
    ),
    "zone": (
        "x * datetime.datetime.fromtimestamp(0).hour",
        "in another time zone (TZ) the result differs by ",
    ),
    "drawn": (
        "x * torch.rand(())",
        "with other states of the generators of torch, numpy and random the result ",
    ),
    "printed": (
        "x * len(str(np.array([1 / 3])))",
        "after other work in the process the result differs by ",
    ),
    "later": ("x * (1 + len(CALLED))", "after other work in the process the result differs by "),
    "divided": ("x * quotient()", "after another np.seterr the result differs by "),
    "home": ("x * len(os.path.expanduser('~'))", "with another HOME the result differs by "),
    "imported": ("x * HOME_AT_IMPORT", "with another HOME the result differs by "),
    "variable": (
        'x * float(os.environ.get("GAIN_OF_A_TEST", "1"))',
        (
            "without the variable GAIN_OF_A_TEST of the environment the result differs by 0.6 of"
            " its largest value: make the value a parameter, or write"
            ' depends=["env:GAIN_OF_A_TEST"]'
        ),
    ),
    "unset": ("x + torch.empty(10_000_000)[:3]", "where new memory has other bits the result "),
    "clock": (
        "x * (time.time_ns() % 1_000_003)",
        "two processes in the same surroundings differ, so draw from the argument rng",
    ),
    "unseeded": (
        "x * random.random()",
        "two processes in the same surroundings differ, so draw from the argument rng",
    ),
}
QUOTIENT = """

def quotient():
    try:
        with warnings.catch_warnings(action="ignore"):
            return float(np.divide(1.0, [0.0])[0] > 1)
    except FloatingPointError:
        return 3.0

"""
GOOD = {
    "plain": "x * 2",
    "many_threads": "x @ x",
    "declared": 'x * float(os.environ["DECLARED_OF_A_TEST"])',
}


def source_of(name, body, example="one", declared=""):
    first = "    CALLED.append(1)\n" if name == "printed" else ""
    return (
        f"\n@node({declared})\ndef {name}(x: Tensor) -> Tensor:\n    {first.strip()}\n    return"
        f" {body}\n\n\n@{name}.example\ndef _():\n    return {example}()\n\n"
    )


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder in which a check runs, alone with a locale of ASCII and two variables."""
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("elsewhere")
        patch.setattr(sys, "path", list(sys.path))
        patch.setattr(surroundings, "installed_locales", lambda environ: ["C", "C.utf8", "POSIX"])
        patch.setenv("LC_ALL", "C.UTF-8")
        patch.setenv("OMP_NUM_THREADS", "1")
        patch.setenv("GAIN_OF_A_TEST", "2.5")
        patch.setenv("DECLARED_OF_A_TEST", "2")
        patch.chdir(folder)
        yield folder


@pytest.fixture(scope="module")
def checked(place):
    """Check the nodes of a file: what the rule says of each, and all that is said of them."""

    def checked(name, text):
        (place / f"{name}.py").write_text(HEAD + text)
        nodes = own_nodes(name, import_own(f"{name}.py", place))
        with elsewhere() as process:
            found = check_all(nodes, {}, process)
        return {each.partition(".")[2] or each: findings for each, findings in found.items()}

    return checked


def said(findings):
    [one] = [each for each in findings if each.rule == "elsewhere"]
    return one


@pytest.fixture(scope="module")
def kinds(place, checked):
    (place / "gain.txt").write_text("abc")
    (place / "micro.txt").write_text("µ", encoding="utf-8")
    text = QUOTIENT + "".join(source_of(name, body) for name, (body, _) in KINDS.items())
    text += source_of("plain", GOOD["plain"]) + source_of(
        "many_threads", GOOD["many_threads"], "many"
    )
    text += source_of("declared", GOOD["declared"], declared='depends=["env:DECLARED_OF_A_TEST"]')
    return checked("kinds_of_elsewhere", text)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_of_dependence_is_named_with_its_place(kinds, kind):
    found = said(kinds[kind])
    assert found.ok is False
    assert re.match(r"kinds_of_elsewhere\.py:\d+: ", found.text)
    assert KINDS[kind][1] in found.text


@pytest.mark.slow
def test_what_was_seen_is_said_and_no_more(kinds):
    found = said(kinds["plain"])
    assert found.ok is True
    assert found.text.startswith(
        "the same bits in 11 changed surroundings: folder, locale (C), hash seed, 3 threads, "
    )
    assert found.text.endswith("unset memory; the clock was not changed")
    assert said(kinds["declared"]).ok is True


@pytest.mark.slow
def test_rounding_by_threads_is_no_fault_and_its_size_is_said(kinds):
    """A million products are summed in float32; how large the rounding is depends on how the BLAS of a machine sums."""
    found = said(kinds["many_threads"])
    assert found.ok is True
    assert found.text.startswith(
        "the same bits in 10 changed surroundings: folder, locale (C), hash seed, time zone, "
    )
    assert re.search(
        r"; equal to rounding with 3 threads \(\d(\.\d)?e-0[67] of the largest value\); the clock",
        found.text,
    )


ENDS = """
@node()
def ends(x: Tensor) -> Tensor:
    os._exit(0)


@ends.example
def _():
    return one()


@node()
def crashes(x: Tensor) -> Tensor:
    os.abort()


@crashes.example
def _():
    return one()


@node()
def crashes_elsewhere(x: Tensor) -> Tensor:
    if os.environ.get("TZ") == "NSC-13:45":
        os.abort()
    return x


@crashes_elsewhere.example
def _():
    return one()


"""


@pytest.fixture(scope="module")
def ended(place, checked):
    """What is said of nodes that end their process, and of one that reads the decimal point where a
    locale with another one can be made.
    """
    text = ENDS
    with pytest.MonkeyPatch.context() as patch:
        if shutil.which("localedef") and Path("/usr/share/i18n/locales/de_DE").exists():
            made = place / "locales" / "de_DE.utf8"
            made.parent.mkdir()
            words = ["localedef", "-i", "de_DE", "-f", "UTF-8", str(made)]
            subprocess.run(words, check=False, capture_output=True)
            patch.setenv("LOCPATH", str(made.parent))
            patch.setattr(surroundings, "installed_locales", INSTALLED)
            assert "de_DE.utf8" in INSTALLED(os.environ)
            text += source_of("comma", "x * ord(locale.str(1.5)[1])")
        return checked("ends_of_elsewhere", text)


@pytest.mark.slow
def test_a_call_that_ends_its_process_ends_no_check(ended):
    assert said(ended["ends"]).text.endswith(
        ": the call ends the process, with exit code 0; the rules on values were not tried"
    )
    assert said(ended["crashes"]).text.endswith(
        ": the call ends the process, with SIGABRT; the rules on values were not tried"
    )
    assert (
        ": in another time zone (TZ) it ends the process, with SIGABRT: "
        in said(ended["crashes_elsewhere"]).text
    )
    assert {one.rule for one in ended["ends"]} == {
        "docstring",
        "signature",
        "hooks",
        "key",
        "elsewhere",
    }
    assert "finite" in {one.rule for one in ended["crashes_elsewhere"]}


@pytest.mark.slow
def test_a_call_without_an_end_is_given_up(checked, monkeypatch):
    monkeypatch.setattr(surroundings, "LONGEST_CALL", 3)
    text = source_of("hangs", "time.sleep(1e6)") + source_of("plain", "x * 2")
    found = checked("hangs_elsewhere", text)
    assert said(found["hangs"]).text.endswith(
        ": the call does not end within 3 s; the rules on values were not tried"
    )


@pytest.mark.slow
def test_a_locale_with_a_decimal_comma_is_taken_where_there_is_one(ended):
    if "comma" not in ended:
        pytest.skip("no locale can be made here")
    found = said(ended["comma"])
    assert found.ok is False
    assert ": in the locale de_DE.utf8 the result differs by " in found.text


@pytest.mark.parametrize(
    ("now", "names", "other"),
    [
        (
            "en_GB.UTF-8",
            ["C", "C.utf8", "POSIX", "en_GB.utf8", "fr_FR.utf8", "tr_TR.utf8"],
            "tr_TR.utf8",
        ),
        ("tr_TR.UTF-8", ["C", "de_DE", "de_DE.utf8", "tr_TR.utf8"], "de_DE"),
        ("de_DE.UTF-8", ["C", "POSIX", "de_DE.utf8", "en_GB.utf8"], "en_GB.utf8"),
        ("C.UTF-8", ["C", "C.utf8", "POSIX"], "C"),
        ("C", ["C", "C.utf8", "POSIX"], "C"),  # Python takes UTF-8 there
        ("C.UTF-8", [], ""),
    ],
)
def test_the_other_locale_is_one_of_those_that_are_installed(now, names, other):
    assert surroundings.other_locale(now, names, {}) == other
    ascii_already = {"PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    assert surroundings.other_locale("C", ["C", "C.utf8", "POSIX"], ascii_already) == ""


def test_a_locale_that_cannot_be_changed_is_said(monkeypatch):
    monkeypatch.setattr(surroundings, "installed_locales", lambda environ: [])
    others = surroundings.other_surroundings({"PATH": "/bin", "OMP_NUM_THREADS": "4"})
    assert (
        others.described()
        == "folder, hash seed, 1 thread, time zone, random states, order of work, np.seterr, HOME,"
        " unset memory; locale not changed: no other is installed"
    )


def test_variables_that_find_libraries_stay_and_others_go():
    environ = {
        "PATH": "/bin",
        "LD_LIBRARY_PATH": "/lib",
        "NEUSEE_CACHE": "c",
        "GAIN": "2",
        "DECLARED": "3",
        "HOME": "/h",
    }
    others = surroundings.other_surroundings(environ)
    assert others.variables == ("DECLARED", "GAIN")
    settings = others.settings(frozenset(surroundings.ALL), Path("/empty"), {"DECLARED": "3"})
    assert {name: settings.variables[name] for name in ("GAIN", "HOME", "TZ")} == {
        "GAIN": None,
        "HOME": "/empty",
        "TZ": "NSC-13:45",
    }
    assert "DECLARED" not in settings.variables
    assert "PATH" not in settings.variables
