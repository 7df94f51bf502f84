"""A step that reached what its key does not cover, and all that follows from it, is used in its
run alone.
"""

import sys
import textwrap

import pytest

from neusee.nodes import own_modules
from neusee.workflows import load
from neusee.workflows.engine.runner import run
from neusee.workflows.keys import user_code as tainted_code
from neusee.workflows.keys.cache_key import is_private
from neusee.workflows.store.result_store import Store

READER = """
    import torch
    from torch import Tensor

    from neusee.nodes import node
    from neusee.nodes.units import Real


    @node()
    def even(*, size: Real) -> Tensor:
        return torch.full((3,), size)


    @node()
    def table(x: Tensor, *, name: str) -> Tensor:
        with open(f"{name}.txt") as file:
            return x * float(file.read())
"""
FOLLOWER = """
    from torch import Tensor

    from neusee.nodes import node


    @node()
    def twice(x: Tensor) -> Tensor:
        return 2 * x
"""


@pytest.fixture
def lab(tmp_path, request):
    """A folder with two files of nodes whose names no other test has, and the recipe that uses
    them.
    """
    names = {
        kind: f"{kind}_{abs(hash(request.node.nodeid)) % 10**9}"
        for kind in ("reader", "follower", "plain")
    }
    plain = READER[: READER.index("    @node()\n    def table")]
    texts = {"reader": READER, "follower": FOLLOWER, "plain": plain}
    for kind, name in names.items():
        (tmp_path / f"{name}.py").write_text(textwrap.dedent(texts[kind]))
    (tmp_path / "dark.txt").write_text("10")
    (tmp_path / "lab.yaml").write_text(
        f"""nodes: [{", ".join(f"./{name}.py" for name in names.values())}]
seed: 1
tolerance: 1e-3
outputs: [last]
steps:
  first: {{node: {names["plain"]}.even, with: {{size: 2}}}}
  read: {{node: {names["reader"]}.table, from: first, with: {{name: {tmp_path}/dark}}}}
  last: {{node: {names["follower"]}.twice, from: read}}
"""
    )
    files = dict(own_modules._files)
    yield tmp_path
    own_modules._files.clear()
    own_modules._files.update(files)
    for name in names.values():
        sys.modules.pop(name, None)
        tainted_code._taints.pop(name, None)
    sys.path.remove(str(tmp_path))


@pytest.mark.filterwarnings("ignore:.*which its cache key does not cover")
def test_a_tainted_step_and_all_that_follow_are_not_stored(lab):
    store = Store(lab / "cache")
    result = run(load("lab.yaml", [], lab), store)
    assert result["last"].tolist() == [40.0] * 3
    assert [is_private(result.keys[name]) for name in ("first", "read", "last")] == [
        False,
        True,
        True,
    ]
    (lab / "dark.txt").write_text("100")
    again = run(load("lab.yaml", [], lab), store)
    assert again["last"].tolist() == [400.0] * 3
    assert again.done["first"].state == "cached"
    assert {again.done[name].state for name in ("read", "last")} == {"run"}


def test_a_step_without_cache_is_computed_in_each_run(lab):
    store = Store(lab / "cache")
    keep = ["steps.read=null", "steps.last.from=first"]
    states = []
    for words in ([], [], ["steps.first.cache=false"], ["steps.first.cache=false"], []):
        result = run(load("lab.yaml", [*keep, *words], lab), store)
        assert result["last"].tolist() == [4.0] * 3
        states.append((result.done["first"].state, result.done["last"].state))
    both, none = ("run", "run"), ("not needed", "cached")
    assert states == [both, none, both, both, none]


def test_rerun_computes_a_step_and_all_that_follow_again(lab):
    store = Store(lab / "cache")
    recipe = load("lab.yaml", ["steps.read=null", "steps.last.from=first"], lab)
    run(recipe, store)
    again = run(recipe, store, anew=["first"])
    assert (again.done["first"].state, again.done["last"].state) == ("run", "run")
    assert run(recipe, store).done["last"].state == "cached"
    assert run(recipe, store, anew=["last"]).done["first"].state == "cached"
    with pytest.raises(ValueError, match="no step 'lost'"):
        run(recipe, store, anew=["lost"])


@pytest.mark.filterwarnings("ignore:.*when it is imported, which no cache key covers")
def test_what_a_module_reads_when_it_is_imported_taints_its_nodes(lab):
    (lab / "dark.ini").write_text("[camera]\ngain = 3\n")
    name = f"importer_{abs(hash(str(lab))) % 10**9}"
    code = """
        import configparser

        from torch import Tensor

        from neusee.nodes import node

        SETTINGS = configparser.ConfigParser()
        SETTINGS.read("{folder}/dark" + ".ini")
        GAIN = float(SETTINGS["camera"]["gain"])


        @node()
        def amplified(x: Tensor) -> Tensor:
            return GAIN * x
    """.replace("{folder}", str(lab))
    (lab / f"{name}.py").write_text(textwrap.dedent(code))
    recipe = (lab / "lab.yaml").read_text()
    plain = (
        next(line for line in recipe.splitlines() if line.startswith("  first:"))
        .partition("node: ")[2]
        .partition(".")[0]
    )
    (lab / "own.yaml").write_text(
        f"nodes: [./{plain}.py, ./{name}.py]\nseed: 1\ntolerance: 1e-3\noutputs: [last]\nsteps:\n "
        f" first: {{node: {plain}.even, with: {{size: 2}}}}\n  last: {{node: {name}.amplified,"
        " from: first}\n"
    )
    result = run(load("own.yaml", [], lab), Store(lab / "cache"))
    assert result["last"].tolist() == [6.0] * 3
    assert [is_private(result.keys[step]) for step in ("first", "last")] == [False, True]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_step_that_a_worker_taints_is_computed_by_the_caller(lab):
    """The worker sees what the step reads, keeps nothing of it, and the caller computes the
    rest.
    """
    pytest.importorskip("distributed")
    from neusee.workflows.engine.dask_cluster import cluster

    store = Store(lab / "cache")
    with cluster("dask:1", store) as executor:
        result = run(load("lab.yaml", [], lab), store, executor=executor)
    assert result["last"].tolist() == [40.0] * 3
    assert [is_private(result.keys[name]) for name in ("first", "read", "last")] == [
        False,
        True,
        True,
    ]
    assert {key for key, _ in store.entries()} == {result.keys["first"]}


LOG = """
    with open("{folder}/log.txt", "a") as file:
        file.write("read")
    with open(f"{{name}}.txt")"""


@pytest.mark.filterwarnings("ignore:.*which its cache key does not cover")
@pytest.mark.parametrize("declared", [True, False])
def test_a_step_that_adds_to_a_log_is_stored_if_it_states_that_its_result_does_not_depend_on_it(
    lab, declared
):
    (file,) = lab.glob("reader_*.py")
    free = (
        'depends=["dark.txt", "unaffected:log.txt"]'
        if declared
        else 'depends=["dark.txt", "unaffected:file"]'
    )
    text = file.read_text().replace('\n    with open(f"{name}.txt")', LOG.format(folder=lab))
    file.write_text(text.replace("@node()\ndef table", f"@node({free})\ndef table"))
    result = run(load("lab.yaml", [], lab), Store(lab / "cache"))
    assert result["last"].tolist() == [40.0] * 3
    assert (lab / "log.txt").read_text() == "read"
    assert is_private(result.keys["read"]) is not declared
    again = run(load("lab.yaml", [], lab), Store(lab / "cache"))
    assert (again.done["last"].state == "cached") is declared
