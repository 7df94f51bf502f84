"""The contract of a node finds what is wrong with a node of a user, and the nodes of neusee keep
it.
"""

import json
import re
import sys
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import pytest
import torch
from torch import Tensor
from typer.testing import CliRunner

from neusee.nodes import node, own_modules
from neusee.workflows.cli.app import app
from neusee.workflows.contract import node_contract
from neusee.workflows.contract.node_contract import check_node, check_values
from neusee.workflows.contract.node_rules import Call
from neusee.workflows.recipe import node_families
from neusee.workflows.recipe.node_families import all_nodes, import_own, own_nodes

START = (
    (files("neusee.workflows.cli") / "starts" / "node.py.txt")
    .read_text(encoding="utf-8")
    .replace("NAME", "bloom")
)


@pytest.fixture
def made(tmp_path):
    """Write a node to a file of its own name, import it, and give what the contract finds, by
    rule.
    """
    names = []

    def made(name, *changes):
        text = START
        for old, new in changes:
            assert text.count(old) >= 1, old
            text = text.replace(old, new)
        (tmp_path / f"{name}.py").write_text(text)
        names.append(name)
        bloom = own_nodes(name, import_own(f"{name}.py", tmp_path))["bloom"]
        return {finding.rule: finding for finding in check_node(bloom)}

    path = list(sys.path)
    yield made
    sys.path[:] = path
    for name in names:
        sys.modules.pop(name, None)
        own_modules._files.pop(name, None)
        node_families._family_of.pop(name, None)


def test_the_start_keeps_every_rule(made):
    found = made("contract_a")
    assert [rule for rule, finding in found.items() if finding.ok is not True] == []
    assert {"reference", "gradient", "skip bound", "key", "docstring", "same twice"} <= set(found)


STRAIGHT = """
class Wrong(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x):
        return x * 1.0

    @staticmethod
    def backward(ctx, slope):
        return 2 * slope


@node("""
FAULTS = {
    "reference": [("(over[i - 1] + over[(i + 1) % count]) / 2", "over[i - 1]")],
    "gradient": [
        ("\n@node(", STRAIGHT),
        ("return charge - excess", "return Wrong.apply(charge) - excess"),
    ],
    "inputs": [
        ("    return charge - excess", "    charge.mul_(1.001)\n    return charge - excess")
    ],
    "docstring": [("    Units:  electrons.\n", "")],
    "skip bound": [("2 * spill * max", "0.1 * spill * max")],
    "same twice": [
        ("return charge - excess", "return charge * (1 + 1e-3 * torch.rand(())) - excess")
    ],
    "type": [
        ("return charge - excess + 0.5 *", "return 1.0 if spill else charge - excess + 0.5 *")
    ],
    "finite": [("return charge - excess", "return charge / 0 - excess")],
    "hooks": [
        ("def _(charge: Any, *, full_well: float,", "def _(charge: Any, *, full_wel: float,")
    ],
    "signature": [('spill: float = 0.5) -> Tensor:\n    "', 'spill: float = 0.5):\n    "')],
    "key": [
        (
            "    excess = ",
            "    full_well = full_well + len(open('gain.txt').read()) * 0\n    excess = ",
        )
    ],
    "example": [('"full_well": "25500 e-"', '"full_well": 25500.0')],
}


@pytest.mark.parametrize("rule", FAULTS)
def test_a_planted_fault_breaks_its_rule(made, rule):
    found = made(f"fault_{rule.replace(' ', '_')}", *FAULTS[rule])
    assert found[rule].ok is False, found[rule].text


LOGARITHM = (
    "    excess = torch.where(charge > full_well, torch.log(charge - full_well).exp(), 0) * spill\n"
    "    return charge"
)
TEXTS = {
    "gradient": ("    return charge", LOGARITHM, "with respect to charge: NaN or infinite for "),
    "reference": (
        "    return charge - excess",
        "    excess = excess[:, 1:]\n    return charge[:, 1:] - excess",
        "the result is 3 x 15 x 16, the reference 3 x 16 x 16",
    ),
    "example": (
        '"full_well": "25500 e-"',
        '"full_well": "25500 um"',
        "full_well: has the wrong unit 'um': write one of",
    ),
    "signature": ("spill: float = 0.5) ->", "spill=0.5) ->", "without an annotation: spill"),
}


@pytest.mark.parametrize("rule", TEXTS)
def test_a_fault_is_said_in_words_of_its_own(made, rule):
    old, new, text = TEXTS[rule]
    found = made(f"text_{rule}", (old, new))[rule]
    assert found.ok is False
    assert found.text.startswith(text)


def test_a_wrong_slope_is_said_with_both_numbers(made):
    found = made("text_slope", *FAULTS["gradient"])["gradient"].text
    assert re.fullmatch(
        r"with respect to charge: along a drawn direction the slope is [-\d.e+]+, but by finite"
        r" differences [-\d.e+]+",
        found,
    )


class Split(NamedTuple):
    count: Tensor
    squares: Tensor
    threefold: Tensor


class Twice(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x):
        return x * 1.0

    @staticmethod
    def backward(ctx, slope):
        return 2 * slope


@node()
def split(charge: Tensor, *, wrong: bool = False) -> Split:
    """Give a result without a slope before two with one."""
    return Split(
        torch.tensor([3.0, 4.0]), charge**2, 3 * (Twice.apply(charge) if wrong else charge)
    )


@split.shape
def _(charge: Tensor, *, wrong: bool) -> Split:
    column = torch.empty(5, dtype=torch.float64, device="meta")
    return Split(torch.empty(4 if wrong else 2, device="meta"), column, column)


@pytest.mark.parametrize("wrong", [False, True])
def test_results_without_a_slope_and_shapes_that_are_told_once_for_two_results_are_no_fault(wrong):
    """Fast differences of gradcheck pair the results wrongly where one has no slope; shapes may
    share one tensor.
    """
    call = Call(split, [torch.linspace(1, 2, 5, dtype=torch.float64)], {"wrong": wrong})
    found = {finding.rule: finding.ok for finding in check_values(call)}
    assert (found["gradient"], found["shape"]) == (not wrong, not wrong)


def test_a_reference_that_returns_nothing_agrees_with_no_result(made):
    found = made("text_nothing", ("    return torch.stack(each, -2)", "    torch.stack(each, -2)"))[
        "reference"
    ]
    assert found.ok is False
    assert found.text.endswith("the reference no tensor")


def test_a_node_without_a_reference_or_an_example_is_told_how_to_attach_one(made):
    found = made("contract_b", ("@bloom.reference", "@staticmethod"))
    assert found["reference"].ok is None
    assert "@bloom.reference" in found["reference"].text
    found = made("contract_c", ("@bloom.example", "@staticmethod"))
    assert found["example"].ok is False
    assert "@bloom.example" in found["example"].text
    assert "gradient" not in found


@pytest.mark.slow
def test_the_command_says_each_rule_and_ends_with_three_where_one_is_broken(
    tmp_path, monkeypatch, made
):
    made("contract_d")
    monkeypatch.chdir(tmp_path)
    good = CliRunner().invoke(app, ["check", "contract_d.py"])
    assert good.exit_code == 0
    assert "contract_d.bloom\n  ok    docstring" in good.output
    assert good.output.endswith("1 node: every rule holds\n")
    bad = CliRunner().invoke(app, ["check", "sensor.digitize", "--json"])
    assert bad.exit_code == 3
    assert {
        key: value
        for key, value in json.loads(bad.output)["sensor.digitize"][-1].items()
        if key != "text"
    } == {
        "rule": "example",
        "ok": False,
    }


# --- the nodes of neusee --------------------------------------------------------------------------

#: rules that a node of neusee breaks on its case; a rule that comes to hold must leave the table
EXCEPTIONS = {
    # a changed count of light or of exposures leaves no dark frames, and frames without spread have
    # no statistics
    "calibrate.camera": ["gradient"],
    "calibrate.least_squares": ["finite", "gradient"],
    # rounding passes slopes on as if there were none, on purpose
    "doe.fabricate": ["gradient"],
    "sensor.digitize": ["gradient"],
    # paths of 0 have no scale but a metre, thousands of waves: tests of their own compare these
    # slopes
    "optics.psf": ["gradient"],
    "restore.nearby_glare": ["gradient"],  # two such PSFs
    "metrics.spectral_error": ["gradient"],
    # a wavelength passes through tables; metamers have no slope where a spectrum reaches 0
    "restore.colour_matrix": ["gradient"],
    "spectra.metamers": ["gradient"],
    # an unknown bound of the largest value is infinite
    "optics.image_channels": ["finite"],
    # factors of a cube: the reference gives other factors of the same cube
    "spectra.compress": ["reference"],
    "spectra.lift_lmmse_mixture": ["reference"],
    "spectra.lift_mallett_mixture": ["reference"],
}


#: nodes whose slopes take most of the time and go through the solver of `restore.wiener`, or through
#: `optics.psf`, whose own slopes are always compared: theirs are by the long test
DEAR = (
    "restore.filter_facts",
    "restore.nearby_glare",
    "restore.spread_by_field",
    "restore.wiener_by_field",
    "restore.wiener_problem",
    "restore.wiener_spread",
)


@pytest.fixture
def broken(monkeypatch):
    """The rules on values that nodes of neusee break on their cases, by node."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "nodes"))
    from torch_func_cases import CASES

    def broken(chosen, without=()):
        rules = tuple(rule for rule in node_contract._OF_VALUES if rule not in without)
        monkeypatch.setattr(node_contract, "_OF_VALUES", rules)
        found = {}
        for name, each in all_nodes():
            if name in CASES and chosen(name):
                case = CASES[name]
                inputs = [*case.inputs, *[None] * (len(each.inputs) - len(case.inputs))]
                own = {p.name: p.default for p in each._keyword_only if p.default is not p.empty}
                findings = check_values(Call(each, inputs, {**own, **case.params}))
                if failed := sorted(finding.rule for finding in findings if finding.ok is False):
                    found[name] = failed
        return found

    return broken


@pytest.mark.slow
def test_the_nodes_of_neusee_keep_the_rules_on_values(broken):
    assert {*DEAR} <= {name for name, _ in all_nodes()}
    found = broken(lambda name: name not in DEAR)
    found |= broken(lambda name: name in DEAR, without=[node_contract.check_gradient])
    expected = {
        name: [rule for rule in rules if name not in DEAR or rule != "gradient"]
        for name, rules in EXCEPTIONS.items()
    }
    assert found == {name: rules for name, rules in expected.items() if rules}


@pytest.mark.long
def test_the_dear_nodes_of_neusee_keep_the_rules_on_values(broken):
    found = broken(lambda name: name in DEAR)
    assert found == {name: rules for name, rules in EXCEPTIONS.items() if name in DEAR}
