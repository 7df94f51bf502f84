import gc
import os

import pytest
from hypothesis import HealthCheck, settings

# Most of what is tested is over before a second thread is awake, and where others compute, threads that wait for each
# other take many times as long. Before torch is imported; processes that a test starts inherit it. Tests of several
# threads ask for them.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# The same cases at every run: what fails is the fault of what was changed. `pytest --hypothesis-profile=search` draws
# others.
#: no example fails because a busy machine takes its time to draw or to try it
PATIENT = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow]}
settings.register_profile("same", derandomize=True, **PATIENT)
settings.register_profile("search", derandomize=False, **PATIENT)
settings.load_profile("same")


def pytest_collection_finish() -> None:
    """Leave the modules and tests themselves to no collection of garbage: they stay, and each one walks them all."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True, scope="session")
def nodes_of_tests_are_not_observed():
    """Let nodes that stand in a test itself run as those of neusee do: side by side, in the thread of their lane."""
    from neusee.workflows.keys import own_code

    own_code.PROVEN = ("neusee.", "tests.")
