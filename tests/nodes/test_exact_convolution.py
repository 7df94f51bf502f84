"""Convolutions in full float32 leave the settings of the process as they found them, from any
number of threads.
"""

from concurrent.futures import ThreadPoolExecutor
from threading import Event, Thread
from types import SimpleNamespace

import pytest
import torch
from torch.backends import cudnn

from neusee.nodes.metrics import quality
from neusee.nodes.precision import exact_convolutions, tf32_setting
from neusee.workflows.keys.loaded_state import settings

ON_CUDA = SimpleNamespace(is_cuda=True)


def test_no_thread_on_the_cpu_changes_a_setting():
    """Each of two threads restored what the other had set, so that TF32 stayed off and every
    later key was another.
    """
    a, b = torch.rand(2, 3, 40, 40)
    seen = []

    def compare(_):
        quality.fn(a, b)
        seen.append(cudnn.allow_tf32)

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(compare, range(200)))
    assert all(seen)
    assert settings() == {}


def test_one_thread_at_a_time_changes_the_settings_of_cudnn():
    inside, ready, order = Event(), Event(), []

    def first():
        with exact_convolutions(ON_CUDA, deterministic=True):
            order.append(("first", cudnn.allow_tf32, cudnn.deterministic))
            inside.set()
            ready.wait(300)
        order.append(("first left",))

    def second():
        inside.wait(300)
        ready.set()
        with exact_convolutions(ON_CUDA):
            order.append(("second", cudnn.allow_tf32, cudnn.deterministic))

    threads = [Thread(target=work) for work in (first, second)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert order[0] == ("first", False, True)
    assert ("second", False, False) in order
    assert cudnn.allow_tf32
    assert not cudnn.deterministic


def test_the_key_reads_the_setting_outside_of_a_convolution():
    inside, leave = Event(), Event()

    def convolve():
        with exact_convolutions(ON_CUDA):
            inside.set()
            leave.wait(300)

    with ThreadPoolExecutor(2) as pool:
        pool.submit(convolve)
        inside.wait(300)
        read = pool.submit(tf32_setting)
        leave.set()
        assert read.result() is True


def test_a_nested_block_and_an_error_restore_the_settings():
    def fails():
        with exact_convolutions(ON_CUDA), exact_convolutions(ON_CUDA, deterministic=True):
            raise ArithmeticError

    with pytest.raises(ArithmeticError):
        fails()
    assert cudnn.allow_tf32
    assert not cudnn.deterministic
