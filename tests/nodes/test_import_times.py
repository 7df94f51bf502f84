"""A moment stays before what follows it, however the clock is set."""

import time

from neusee.nodes import import_times
from neusee.nodes.import_times import Moment

HOUR = 3600 * 10**9


def test_a_moment_before_the_clock_is_set_back_is_before_what_follows(monkeypatch):
    real = time.time_ns
    monkeypatch.setattr(import_times.time, "time_ns", lambda: real() + HOUR)
    moment = Moment()
    assert moment.time() <= real() + HOUR
    monkeypatch.setattr(import_times.time, "time_ns", real)
    assert moment.time() <= real() < real() + HOUR


def test_a_steady_clock_and_one_that_is_set_forward_change_nothing(monkeypatch):
    real = time.time_ns
    before = real()
    moment = Moment()
    assert before <= moment.time() <= real()
    first = moment.time()
    monkeypatch.setattr(import_times.time, "time_ns", lambda: real() + HOUR)
    assert moment.time() == first
