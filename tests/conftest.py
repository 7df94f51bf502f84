import gc
import os
import threading

import pytest
from hypothesis import HealthCheck, settings

from tests import grouped_rows

# Most of what is tested is over before a second thread is awake, and where others compute, threads
# that wait for each other take many times as long. Before torch is imported; processes that a test
# starts inherit it. Tests of several threads ask for them.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# The same cases at every run: what fails is the fault of what was changed. `pytest
# --hypothesis-profile=search` draws others.
#: no example fails because a busy machine takes its time to draw or to try it
PATIENT = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow]}
settings.register_profile("same", derandomize=True, **PATIENT)
settings.register_profile("search", derandomize=False, **PATIENT)
settings.load_profile("same")


#: files of minutes, which come first: at the end no worker waits for the other
LONG_FILES = (
    "tests/test_guide_commands.py",
    "tests/workflows/studies/test_calibration_study.py",
    "tests/workflows/calibration/test_real_cameras.py",
    "tests/workflows/cli/test_cache_faults.py",
    "tests/workflows/contract/test_node_contract.py",
    "tests/workflows/tolerance/test_stated_errors.py",
    "tests/workflows/safety/test_over_distance.py",
    "tests/workflows/calibration/test_scatter_calibration.py",
    "tests/workflows/cli/test_interrupts.py",
)


@pytest.hookimpl(trylast=True)  # after what was asked for by words and marks
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Put the tests of long files first, leave the others in their order, and make one test of
    the rows of each table.
    """
    assert all((config.rootpath / name).is_file() for name in LONG_FILES), (
        "name the long files as they are"
    )
    order = {name: place for place, name in enumerate(LONG_FILES)}
    items.sort(key=lambda item: order.get(item.nodeid.partition("::")[0], len(order)))
    if not config.getoption("each_row"):
        items[:] = grouped_rows.grouped(items)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Offer `--each-row`."""
    parser.addoption("--each-row", action="store_true", help="report each row of a table apart")


def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
    """Run a table row by row; leave all other tests to pytest."""
    if not isinstance(item, grouped_rows.Rows):
        return None
    grouped_rows.run(item, nextitem)
    return True


def pytest_collection_finish() -> None:
    """Leave the modules and tests themselves to no collection of garbage: they stay, and each
    one walks them all.
    """
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True, scope="session")
def nodes_of_tests_are_not_observed():
    """Let nodes that stand in a test itself run as those of neusee do: side by side, in the
    thread of their lane.
    """
    from neusee.workflows.keys import cache_key as module_owner

    module_owner.PROVEN = ("neusee.", "tests.", "engine_toys.")


@pytest.fixture(autouse=True, scope="session")
def a_thread_of_others():
    """Let own steps compute in the process of the test, as in a notebook, with one worker of
    xdist or without any.
    """
    end = threading.Event()
    other = threading.Thread(target=end.wait, name="a thread of others", daemon=True)
    other.start()
    yield
    end.set()
    other.join()


@pytest.fixture(autouse=True)
def own_modules_of_a_test_are_forgotten():
    """Let no own module of a test join the keys of the nodes of the next one, as in a process it
    would.
    """
    from neusee.nodes import own_modules

    known = dict(own_modules._files)
    yield
    own_modules._files.clear()
    own_modules._files.update(known)
