"""The rules of a network class: the start keeps them, and each planted fault breaks one."""

import sys
from importlib.resources import files

import pytest
from typer.testing import CliRunner

from neusee.workflows.cli.app import app
from neusee.workflows.contract.node_contract import check_network, whole_networks
from neusee.workflows.recipe.node_families import import_own

START = (files("neusee.workflows.cli") / "starts" / "network.py.txt").read_text()


@pytest.fixture
def made(tmp_path, monkeypatch):
    """Write the start of a network with changes, and give what each rule found."""
    monkeypatch.setattr(sys, "path", list(sys.path))

    def made(name, *changes):
        text = START
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        (tmp_path / f"{name}.py").write_text(text)
        networks = whole_networks(import_own(f"{name}.py", tmp_path))
        return {one.rule: one for one in check_network(f"{name}.UNet", networks["UNet"])}

    return made


def test_the_start_keeps_every_rule(made):
    found = made("network_a")
    assert [*found] == ["docstring", "key", "arguments", "picture", "double", "weights", "gradient"]
    assert all(one.ok for one in found.values()), found


LAST = "        return picture + "
INIT = "        nn.init.zeros_(self.last.bias)\n"
FAULTS = {
    "docstring": [
        ("A UNet of three levels, which computes the change of a picture (n, 3, y, x).", "unet")
    ],
    "key": [
        (
            LAST,
            (
                "        if picture.ndim == 9:\n            open('gain.txt')\n        return"
                " picture + "
            ),
        )
    ],
    "arguments": [("width: int = 16", "width: int")],
    "picture": [("multiple = 4", "multiple = 1")],
    "double": [(LAST, "        return picture.float() + "), ("fine], 1)))", "fine], 1))).float()")],
    "weights": [
        (INIT, INIT + "        self.drawn = torch.rand(())\n"),
        (LAST, LAST.replace("pic", "self.drawn * pic")),
    ],
    "gradient": [(INIT, INIT + "        self.unused = nn.Parameter(torch.ones(1))\n")],
}
SAID = {
    "key": "'gain.txt': a file is read",
    "arguments": "give each argument a default",
    "picture": "write multiple = 8 in the class (now 1)",
    "weights": "two networks with the same weights differ",
    "gradient": "unused has no gradient",
}


@pytest.mark.parametrize("rule", FAULTS)
def test_a_planted_fault_breaks_its_rule_and_no_other(made, rule):
    found = made(f"network_{rule}", *FAULTS[rule])
    broken = [one.rule for one in found.values() if one.ok is False]
    assert broken[: 1 if rule == "picture" else None] == [rule], found
    assert SAID.get(rule, "") in found[rule].text


@pytest.mark.slow
def test_the_command_checks_nodes_and_networks_and_leaves_their_layers_out(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.chdir(tmp_path)
    layer = "\n\nclass Layer(nn.Conv2d):\n    pass\n"
    text = START.replace("\n\nclass UNet", f"{layer}\n\nclass UNet").replace(
        "= nn.Conv2d(w", "= Layer(w"
    )
    (tmp_path / "network_c.py").write_text(text)
    good = CliRunner().invoke(app, ["check", "network_c.py"])
    assert good.exit_code == 0, good.output
    assert good.output.startswith("network_c.UNet\n  ok    docstring")
    assert good.output.endswith("\n1 network: every rule holds\n")
    (tmp_path / "network_d.py").write_text(text.replace("multiple = 4", "multiple = 2"))
    bad = CliRunner().invoke(app, ["check", "network_d.py"])
    assert bad.exit_code == 3
    assert bad.output.endswith("\n1 network: 4 rules fail\n")
