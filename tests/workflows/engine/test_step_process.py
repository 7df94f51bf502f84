"""A call in a process of its own: its value comes back, and nothing else does."""

import ctypes
import faulthandler
import os
import signal
import sys
import threading
import time
import warnings
from decimal import getcontext
from typing import NamedTuple

import numpy as np
import pytest
import torch

from neusee.workflows.engine.machine_resources import MemoryLimit, limited, process_memory
from neusee.workflows.engine.step_process import ProcessEnded, call_in_fork
from neusee.workflows.keys.user_code import OwnCode
from neusee.workflows.observation import kernel_layer
from neusee.workflows.observation.observed_call import call_observed

NONE = frozenset()
OWN = OwnCode(frozenset({__name__}), frozenset({__name__}), frozenset(), frozenset())


class Pair(NamedTuple):
    picture: torch.Tensor
    words: dict


def value_of(function, variables=NONE):
    """What a step of own code gives: it computes in a thread of its own."""
    returned = call_in_fork(lambda: call_observed(function, OWN), variables)
    assert returned is not None
    return returned.value[0]


def test_value_comes_back_bit_for_bit():
    shared = torch.randn(5, 7)
    sent = Pair(
        shared,
        {
            "half": shared.half(),
            "same": shared,
            "c": shared + 1j,
            "empty": torch.empty(0, 3),
            "n": 1.5,
        },
    )
    found = value_of(lambda: sent)
    assert type(found) is Pair
    assert found.words["n"] == 1.5
    assert torch.equal(found.picture, shared)
    assert found.words["same"] is found.picture
    assert torch.equal(found.words["half"], shared.half())
    assert found.words["half"].dtype == torch.float16
    assert torch.equal(found.words["c"], shared + 1j)
    assert found.words["empty"].shape == (0, 3)


def test_all_threads_of_torch_compute_as_here():
    x = torch.randn(300, 300)
    here = (x @ x).sin().sum()
    assert torch.equal(value_of(lambda: (x @ x).sin().sum()), here)


KEPT = []


def test_nothing_that_the_call_changes_stays():
    def change():
        KEPT.append(1)
        os.chdir("/")
        os.environ["NEUSEE_TEST_LEFT"] = "1"
        sys.setrecursionlimit(5000)
        getcontext().prec = 3
        np.set_printoptions(precision=1)
        torch.use_deterministic_algorithms(True)
        torch.add = None
        sys.path.append("/nowhere")
        return len(KEPT)

    before = (
        os.getcwd(),
        sys.getrecursionlimit(),
        getcontext().prec,
        np.get_printoptions(),
        torch.add,
        [*sys.path],
    )
    assert value_of(change) == 1
    now = (
        os.getcwd(),
        sys.getrecursionlimit(),
        getcontext().prec,
        np.get_printoptions(),
        torch.add,
        [*sys.path],
    )
    assert now == before
    assert KEPT == []
    assert "NEUSEE_TEST_LEFT" not in os.environ
    assert not torch.are_deterministic_algorithms_enabled()


def test_error_has_its_kind_and_its_words():
    def fail():
        raise ValueError("no such gain")

    with pytest.raises(ValueError, match="no such gain"):
        value_of(fail)


@pytest.mark.parametrize(
    ("number", "words"), [(signal.SIGKILL, "SIGKILL: killed"), (signal.SIGSEGV, "crashed")]
)
def test_process_that_dies_is_an_error_with_its_reason(number, words):
    with pytest.raises(ProcessEnded, match=words):
        value_of(lambda: [faulthandler.disable(), os.kill(os.getpid(), number)])
    assert value_of(lambda: 2) == 2


def test_process_that_exits_is_an_error():
    with pytest.raises(ProcessEnded, match="exit code 7"):
        value_of(lambda: os._exit(7))


def test_warning_is_given_here():
    with pytest.warns(UserWarning, match="said in the fork"):
        value_of(lambda: warnings.warn("said in the fork", stacklevel=2))


def test_value_that_cannot_be_sent_is_left_to_the_caller():
    assert call_in_fork(lambda: lambda: 1, NONE) is None


def test_without_another_process_the_caller_computes(monkeypatch):
    def refuse():
        raise BlockingIOError("no more processes")

    monkeypatch.setattr(os, "fork", refuse)
    assert call_in_fork(lambda: 1, NONE) is None


def test_exception_in_the_waiting_thread_ends_the_process(tmp_path):
    told, here = tmp_path / "pid", threading.get_ident()

    def wait():
        told.write_text(str(os.getpid()))
        time.sleep(600)

    def interrupt():
        while not (told.exists() and told.read_text()):
            time.sleep(0.01)
        ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(here), ctypes.py_object(KeyError))

    threading.Thread(target=interrupt).start()
    with pytest.raises(KeyError):
        value_of(wait)
    with pytest.raises(ProcessLookupError):
        os.kill(int(told.read_text()), 0)


def test_memory_limit_holds_in_the_fork():
    def take():
        return len([torch.ones(1 << 22) for _ in range(400)])  # 6.7 GB, piece by piece

    with limited(process_memory() + 200e6), pytest.raises(MemoryLimit, match="the limit is"):
        value_of(take)


def test_peak_memory_is_that_of_the_fork():
    returned = call_in_fork(
        lambda: call_observed(lambda: float(torch.ones(1 << 25).sum()), OWN), NONE
    )
    assert returned.peak is None or returned.peak > 100e6


# --- observed -------------------------------------------------------------------------------------


@pytest.mark.skipif(bool(kernel_layer.missing()), reason="the kernel watches nothing here")
def test_file_is_seen_in_the_fork_and_here_afterwards(tmp_path):
    file = tmp_path / "table.txt"
    file.write_text("3")
    for _ in range(2):
        value, found = call_in_fork(lambda: call_observed(file.read_text, OWN), NONE).value
        assert value == "3"
        assert [(each.kind, each.what) for each in found] == [("file", str(file))]
        value, found = call_observed(file.read_text, OWN)
        assert value == "3"
        assert [(each.kind, each.what) for each in found] == [("file", str(file))]


@pytest.mark.skipif(bool(kernel_layer.missing()), reason="the kernel watches nothing here")
def test_fork_that_died_leaves_no_half_answer(tmp_path):
    with pytest.raises(ProcessEnded):
        value_of(lambda: os.kill(os.getpid(), signal.SIGKILL))
    value, found = call_in_fork(lambda: call_observed(lambda: 1, OWN), NONE).value
    assert value == 1
    assert found == []


# --- variables of the environment -----------------------------------------------------------------


@pytest.fixture
def library(tmp_path, monkeypatch):
    """An installed library that reads variables, in Python and in C."""
    folder = tmp_path / "site"
    (folder / "asking-1.0.dist-info").mkdir(parents=True)
    (folder / "asking_library.py").write_text(
        "import ctypes, os\n"
        "def of_python(name): return os.environ.get(name)\n"
        "def of_c(name):\n"
        "    get = ctypes.CDLL(None).getenv\n"
        "    get.restype = ctypes.c_char_p\n"
        "    return get(name.encode())\n"
        "def all_names(): return [*os.environ]\n"
    )
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv("ASKED_FOR", "5")
    import asking_library

    yield asking_library
    del sys.modules["asking_library"]


def test_library_does_not_find_a_variable_that_no_key_has(library):
    returned = call_in_fork(
        lambda: [library.of_python("ASKED_FOR"), library.of_c("ASKED_FOR")], NONE
    )
    assert returned.value == [None, None]
    assert [*returned.asked.of_libraries] == ["ASKED_FOR"]
    assert "ASKED_FOR" not in value_of(library.all_names)
    assert library.of_python("ASKED_FOR") == "5"
    assert library.of_c("ASKED_FOR") == b"5"


def test_library_finds_a_declared_variable_and_those_that_decide_nothing(library):
    def asked():
        return [
            library.of_python("ASKED_FOR"),
            library.of_c("ASKED_FOR"),
            library.of_python("HOME"),
        ]

    assert value_of(asked, frozenset({"ASKED_FOR"})) == ["5", b"5", os.environ.get("HOME")]


def test_own_code_finds_each_variable_and_is_noted(monkeypatch):
    monkeypatch.setenv("ASKED_FOR", "5")
    returned = call_in_fork(
        lambda: (os.environ["ASKED_FOR"], os.getenv("NEVER_SET"), os.getenv("HOME")), NONE
    )
    assert returned.value[:2] == ("5", None)
    assert [*returned.asked.of_own_code] == ["ASKED_FOR", "NEVER_SET"]


def test_own_code_that_asks_for_all_variables_finds_them_and_is_noted_once(monkeypatch):
    monkeypatch.setenv("ASKED_FOR", "5")
    returned = call_in_fork(lambda: {**os.environ}["ASKED_FOR"] + str(len(os.environ.copy())), NONE)
    assert returned.value == "5" + str(len(os.environ))
    assert [*returned.asked.of_own_code] == ["(all of them)"]
