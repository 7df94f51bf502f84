"""A tenth of the kinds of own nodes of the benchmark: none is served stale, and honest ones come
from the cache.
"""

import importlib
import os
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.workflows.program_forks import Programs

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "bench_unseen_kinds.py"
TENTH = [
    "draws.torch_poisson",
    "environment.bytes",
    "environment.which_program",
    "environment.path_of_python",
    "honest.astropy_table",
    "honest.linear_of_module",
    "honest.xarray_interpolation",
    "honest.threads_in_node",
    "honest.weights_normalised",
    "honest.hdf_parameter",
    "honest.stem_parameter",
    "indirect.yaml_with_include",
    "indirect.url_of_file",
    "installed.optional_package",
    "installed.typing_stub_beside",
    "left_behind.context_variable",
    "left_behind.generator",
    "left_behind.print_options",
    "left_behind.astropy_configuration",
    "left_behind.memory_file",
    "left_behind.table_of_library",
    "left_behind.deterministic_switch",
    "machine.clock_of_astropy",
    "machine.hash_of_object",
    "machine.open_files",
    "machine.rights_of_parameter",
    "paths.dictionary_of_paths",
    "paths.text_parameter",
    "readers.shelve_of_lab",
    "readers.pandas_table",
    "settings.mpmath_digits",
    "settings.default_dtype",
    "settings.threshold_of_gc",
    "siblings.hook_of_json",
]
GOOD = {"right", "told", "unreached", "kept", "skipped"}
KNOWN = {
    "honest.linear_of_module": (
        "the first weights of a layer of the module are drawn, though they are set afterwards"
    ),
}


#: variables that Python reads when it starts, so that only a new process has them
OF_PYTHON = ("PYTHON", "LC_", "LANG")
#: cases on what differs between two new processes, but not between two forks of one
OF_NEW_PROCESSES = {"machine.hash_of_object"}


@pytest.fixture(scope="module")
def benchmark_module():
    """The module of the benchmark."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(BENCHMARK.parent))
        yield importlib.import_module(BENCHMARK.stem)


@pytest.fixture(scope="module")
def every_case(benchmark_module):
    return dict(benchmark_module.cases())


@pytest.fixture(scope="module")
def programs():
    server = Programs()
    yield server
    server.close()


@pytest.fixture
def forked(benchmark_module, programs, monkeypatch):
    """Let runs of the benchmark be forks of a process that has torch at hand, where this is the
    same.
    """
    known = benchmark_module.subprocess
    start = [sys.executable, "-P", "-m", "neusee"]
    usual = f"{BENCHMARK.parents[2] / '.src'}"

    def run(command, env, cwd, input, **more):
        of_python = {name: text for name, text in env.items() if name.startswith(OF_PYTHON)}
        here = {name: os.environ[name] for name in of_python if name in os.environ}
        if command[:4] != start or input or of_python != {**here, "PYTHONPATH": usual}:
            return known.run(command, env=env, cwd=cwd, input=input, **more)
        return programs.run(command[4:], cwd, env)

    stand_in = SimpleNamespace(run=run, TimeoutExpired=known.TimeoutExpired)
    monkeypatch.setattr(benchmark_module, "subprocess", stand_in)


def _case(name: str) -> object:
    marks = [pytest.mark.xfail(strict=True, reason=KNOWN[name])] if name in KNOWN else []
    return pytest.param(name, marks=marks)


@pytest.mark.slow
def test_the_tenth_is_every_tenth_case(every_case):
    assert [*every_case][::10] == TENTH


@pytest.mark.slow
@pytest.mark.parametrize("name", [_case(name) for name in TENTH])
def test_case_is_not_served_stale_and_an_honest_one_is_kept(
    name, benchmark_module, every_case, request
):
    if name not in OF_NEW_PROCESSES:
        request.getfixturevalue("forked")
    with tempfile.TemporaryDirectory(prefix="unseen_kinds_", dir=Path.home()) as scratch:
        found = benchmark_module.tried(name, every_case[name], BENCHMARK.parents[2], Path(scratch))
    if found["verdict"] == "no case":
        pytest.skip("what this case changes changes no result here")
    assert found["verdict"] in GOOD, found
