"""The same bits on a cluster: keys travel, tensors never, and a worker that dies loses nothing."""

import os
import pickle
import signal
import threading
import time

import pytest
import torch

from neusee.workflows import load
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.errors import RunError
from neusee.workflows.store.result_store import Store

distributed = pytest.importorskip("distributed")
pytestmark = pytest.mark.filterwarnings("ignore")  # of dask and tornado

SMALL = [
    "restore=null",
    "steps.restored_quality=null",
    "optics.samples=128",
    "optics.pitch=60 um",
    "optics.window=[64, 64]",
    "optics.bands=5",
    "sensor.shape=[48, 48]",
    "scene.shape=[64, 64]",
    "outputs=[raw, lsr, developed_quality]",
]


@pytest.fixture(scope="module")
def small():
    return load("first_light", SMALL)


@pytest.fixture(scope="module")
def local(small, tmp_path_factory):
    """What this process makes of the recipe."""
    return run(small, Store(tmp_path_factory.mktemp("local")))


def same(a, b):
    if isinstance(a, torch.Tensor):
        return torch.equal(a, b)
    return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))


def agree(one, other):
    assert one.keys == other.keys
    assert one.values.keys() == other.values.keys()
    assert all(same(one.values[name], other.values[name]) for name in one.values)


def test_work_travels_without_tensors(small):
    from neusee.workflows.engine.step_job import StepJob

    for step in small.steps.values():
        work = StepJob(step, "k" * 32, {}, (), 1, "r", "cpu", "l")
        data = pickle.dumps(work)
        assert len(data) < 4000
        assert pickle.loads(data).step.node is step.node


def test_an_error_comes_back_as_what_it_was(small):
    step = small.steps["bands"]
    error = pickle.loads(pickle.dumps(RunError(step, [torch.zeros(3)], ValueError("no light"))))
    assert isinstance(error, RunError)
    assert "no light" in str(error)
    assert error.step == "bands"


def test_in_one_process(small, local, tmp_path):
    from neusee.workflows.engine.dask_cluster import cluster

    store = Store(tmp_path)
    with cluster("dask:here", store) as executor:
        there = run(small, store, executor=executor)
        agree(there, local)
        assert {d.state for d in run(small, Store(tmp_path), executor=executor).done.values()} <= {
            "cached",
            "not needed",
            "left out",
        }


@pytest.mark.slow
def test_on_a_cluster_of_two_workers_and_after_one_was_killed(small, local, tmp_path):
    from distributed import Client

    from neusee.workflows.engine.dask_cluster import cluster

    store = Store(tmp_path / "a")
    with cluster("dask:2", store) as executor:
        agree(run(small, store, executor=executor), local)
        address = executor.client.scheduler.address
        other = Store(tmp_path / "b")
        seen, killed = [], []

        def watch(event):
            if event.done is not None and event.done.state == "run":
                seen.append(event.step)
            if len(seen) == 12 and not killed:
                killed.append(executor.client.run(os.getpid))
                os.kill(next(iter(killed[0].values())), signal.SIGKILL)

        with cluster(address, other) as second:
            assert isinstance(second.client, Client)
            result = run(small, other, executor=second, watch=watch)
        assert killed
        agree(result, local)
        first = {d.step: d.key for d in result.done.values() if d.state == "run"}
        assert all(other.about(key) for key in first.values())


@pytest.mark.slow
def test_a_worker_with_other_code_is_refused(small, tmp_path, monkeypatch):
    from neusee.workflows.engine.dask_cluster import cluster
    from neusee.workflows.keys import code_digest

    store = Store(tmp_path)
    with cluster("dask:1", store) as executor:
        assert threading.active_count() < 200
        time.sleep(0.1)
        with monkeypatch.context() as other:
            other.setattr(code_digest.Code, "digest", lambda self, module: "0" * 32)
            with pytest.raises(RunError, match=r"code of .* differs on a worker"):
                run(small, store, executor=executor)
