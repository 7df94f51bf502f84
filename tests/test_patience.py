"""No test fails because the machine is busy: examples have no deadline, and no limit of a test
is a short time.
"""

import re
from pathlib import Path

from hypothesis import HealthCheck, settings

TESTS = Path(__file__).parent
LEAST = 60.0  #: s that a test waits at least before it says that something hangs
WAITS = re.compile(
    r"(?:\.(?:wait|result|join|acquire|get)\(|timeout=|monotonic\(\) \+ )(\d+(?:\.\d+)?)\b(?!\w)"
)
PACES = {"workflows/engine/test_memory_watch.py"}  #: files whose short waits are pauses


def test_no_example_is_too_slow():
    assert settings.default.deadline is None
    assert HealthCheck.too_slow in settings.default.suppress_health_check


def test_what_may_take_long_is_waited_for():
    """A process that a busy machine starts late is no fault."""
    short = [
        f"{path.relative_to(TESTS)}: {found[0]}"
        for path in sorted(TESTS.rglob("test_*.py"))
        if path != Path(__file__) and path.relative_to(TESTS).as_posix() not in PACES
        for found in WAITS.finditer(path.read_text(encoding="utf-8"))
        if float(found[1]) < LEAST
    ]
    assert short == []


def test_no_default_test_compares_a_time_of_the_clock():
    """Time of the processor is another matter: it does not pass while others compute."""
    compared = re.compile(
        r"assert .*(?:perf_counter|monotonic|time\.time)\(\).*<\s*[\d.]+\s*(?:#.*)?$", re.MULTILINE
    )
    found = {
        path.name: compared.findall(path.read_text(encoding="utf-8"))
        for path in TESTS.rglob("test_*.py")
    }
    assert {name: lines for name, lines in found.items() if lines} == {}


def test_no_test_compares_a_duration_with_a_number_of_seconds():
    """A slower processor is no fault either: a test compares two durations of one run, or counts
    what is done.
    """
    duration = r"(?:process_time\(\)|\.seconds|\[\"seconds\"\])"
    compared = re.compile(rf"assert .*{duration}[^\n]*<=?\s*[\d.]+\s*(?:#.*)?$", re.MULTILINE)
    found = {
        path.name: compared.findall(path.read_text(encoding="utf-8"))
        for path in TESTS.rglob("test_*.py")
    }
    assert {name: lines for name, lines in found.items() if lines} == {}
