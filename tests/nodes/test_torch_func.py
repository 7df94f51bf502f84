"""The table of ``recipes/guide/torch_func.md``: every line is run, and what says no must not
pass.
"""

import re
from functools import partial
from pathlib import Path

import pytest
import torch

from tests.nodes import torch_func_probe
from tests.nodes.test_contract import NODES
from tests.nodes.torch_func_cases import NOTHING_TO_FOLLOW, cases
from tests.nodes.torch_func_probe import TRANSFORMS, Differs, followed, function_of

PAGE = Path(__file__).parents[2] / "recipes" / "guide" / "torch_func.md"
LINES = re.findall(r"^\| `(\S+)` \|(.*)\|$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
TABLE = {
    path: dict(zip(("of", *TRANSFORMS, "why"), map(str.strip, rest.split("|")), strict=True))
    for path, rest in LINES
}
BY_PATH = {node.path: node for node in NODES}
FOLLOWED = sorted(set(BY_PATH) - set(NOTHING_TO_FOLLOW))
# of fallbacks of vmap, and of what a half-known sensor warns of
pytestmark = pytest.mark.filterwarnings("ignore")


@pytest.fixture(scope="module")
def every_case(tmp_path_factory):
    return cases(tmp_path_factory.mktemp("weights"))


def test_the_table_has_a_line_for_every_node(every_case):
    assert [path for path, _ in LINES] == sorted(BY_PATH)
    assert sorted({*every_case, *NOTHING_TO_FOLLOW}) == sorted(BY_PATH)


def test_a_node_without_a_tensor_says_why():
    line = dict.fromkeys(TRANSFORMS, "–")
    # a stop only says where the samples lie; four nodes read files
    readers = ("restore.measured_psf", "scene.hyperspectral", "sensor.frame")
    for path, why in NOTHING_TO_FOLLOW.items():
        assert TABLE[path] == {"of": "", **line, "why": why}, path
        assert BY_PATH[path].inputs in ((), ("stop",)) or path in readers, path


def test_the_line_names_the_tensor_and_gives_a_reason_where_something_does_not_pass(every_case):
    for path in FOLLOWED:
        first, *rest = every_case[path].of.split(".")
        name = ".".join([BY_PATH[path].inputs[int(first)] if first.isdecimal() else first, *rest])
        line = TABLE[path]
        assert line["of"] == f"`{name}`", path
        assert bool(line["why"]) == any(line[each] != "yes" for each in TRANSFORMS), path


@pytest.mark.slow
@pytest.mark.parametrize("transform", TRANSFORMS)
def test_what_the_table_says_is_so(transform, every_case):
    wrong = []
    for path in FOLLOWED:
        try:
            hold_to_the_table(path, transform, every_case)
        except (Exception, pytest.fail.Exception) as error:
            wrong.append(f"{path}: {error!r}")
    assert not wrong, "\n".join(wrong)


def hold_to_the_table(path, transform, every_case):
    """Try a transform on a node, and fail where the table says something else."""
    function, x = function_of(BY_PATH[path], every_case[path])
    compare, said = getattr(torch_func_probe, transform), TABLE[path][transform]
    compare = partial(compare, to=every_case[path].to) if transform == "jvp" else compare
    if said == "yes":
        compare(function, x)
    elif said == "no":
        function(x)  # the case itself computes, so that what fails below is the transform
        with pytest.raises((Differs, RuntimeError, NotImplementedError, ValueError, TypeError)):
            compare(function, x)
    else:
        assert (said, transform == "vmap") == ("–", False)
        assert not _has_a_derivative(function, x)


def _has_a_derivative(function, x):
    try:
        return any(followed(function, x))
    except (TypeError, RuntimeError):  # it takes a number alone
        return False


def test_a_transform_that_gives_something_else_is_found():
    x = torch.rand(3, dtype=torch.float64)

    def straight_through(x):
        with torch.no_grad():
            rest = x.round() - x
        return (x + rest,)

    torch_func_probe.vjp(straight_through, x)
    with pytest.raises(Differs):
        torch_func_probe.jvp(straight_through, x)
    with pytest.raises(Differs):
        torch_func_probe._close(x, x + 1e-6)
