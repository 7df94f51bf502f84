"""Processes that learn together, forked from one that has everything at hand, so that a test can
afford many.

    python mesh_processes.py JOBS.json

A job: the number of ``processes``, ``words`` that change the recipe, a ``folder`` of its own, and what
to ``do``: ``step``, the gradients of one iteration; ``train``, a training; ``fail``, a training in
which one process raises. Beside each job's folder a list of exit codes is left, one a process.
"""

from __future__ import annotations

import json
import os
import socket
import sys
import time
import traceback
import warnings
from pathlib import Path
from typing import Any

import torch

from neusee.workflows import Store, load
from neusee.workflows.training.process_mesh import Mesh, joined
from neusee.workflows.training.resumable_loop import TrainingSession
from neusee.workflows.training.run_training import train, training_photographs
from neusee.workflows.training.training_iteration import Learner
from neusee.workflows.training.training_pictures import PictureSource, Shared, TrainingStream

LONGEST = 120.0  #: s, after which a process counts as hanging


def step(job: dict[str, Any], mesh: Mesh) -> None:
    """Gradients and losses of one iteration, as `Learner` leaves them."""
    recipe = load("train_small", job["words"])
    how = recipe.training
    learner = Learner(recipe, how, "cpu", mesh=mesh)
    learner.begin(how.stages[1], True)
    samples = TrainingStream(
        recipe,
        how,
        PictureSource(
            training_photographs(recipe, how, True), Store(Path(job["store"])), mesh=mesh
        ),
        None,
    )
    losses, _ = learner.iterate(samples, 1, 0)
    if mesh.first:
        parts = {n: getattr(learner, n).named_parameters() for n in ("mask", "net", "critics")}
        grads = {f"{n}.{k}": p.grad for n, named in parts.items() for k, p in named}
        torch.save({"grads": grads, "losses": losses}, Path(job["folder"], "step.pt"))


def pooled(job: dict[str, Any], mesh: Mesh) -> None:
    """Two rounds of a pool behind a fixed mask: the pictures of this process, and how often it
    drew values.
    """
    recipe = load("train_small", job["words"])
    how, store = recipe.training, Store(Path(job["store"]))
    samples = TrainingStream(
        recipe,
        how,
        PictureSource(training_photographs(recipe, how, True), store, mesh=mesh),
        recipe,
    )
    usual, drawn = samples._drawn, []
    samples._drawn = lambda *place: drawn.append(place) or usual(*place)  # type: ignore[method-assign, func-returns-value]
    found = [
        (i, sample.tensors)
        for first in (0, 2, 4, 6)
        for i, sample in samples.batch(Shared.of({}), 2, first, 2)
    ]
    torch.save(
        {"pictures": found, "drawn": len(drawn)},
        Path(job["folder"], f"pool_{mesh.rank}.pt"),
    )


def learn(job: dict[str, Any], mesh: Mesh) -> None:
    """A training as the command does it."""
    recipe = load("train_small", job["words"])
    train(
        recipe,
        TrainingSession(Store(Path(job["store"])), Path(job["runs"]), lambda line: None, mesh=mesh),
    )


def fail(job: dict[str, Any], mesh: Mesh) -> None:
    """A training whose last process raises in its second iteration."""
    usual = Learner.iterate

    def iterate(self: Learner, samples: TrainingStream, stage: int, iteration: int) -> Any:
        if (stage, iteration, mesh.rank) == (1, 1, mesh.size - 1):
            raise ValueError("this one cannot go on")
        return usual(self, samples, stage, iteration)

    Learner.iterate = iterate  # type: ignore[method-assign]
    learn(job, mesh)


DO = {"step": step, "pool": pooled, "train": learn, "fail": fail}


def work(job: dict[str, Any], rank: int, world: int, port: int) -> None:
    """One process, which ends here."""
    os.environ |= {"RANK": str(rank), "WORLD_SIZE": str(world), "LOCAL_RANK": str(rank)}
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    code = 1
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            with joined("cpu") as mesh:
                DO[job["do"]](job, mesh)
        code = 0
    except BaseException:
        Path(job["folder"], f"error_{rank}.txt").write_text(traceback.format_exc())
    os._exit(code)


def start(job: dict[str, Any]) -> None:
    """All processes of a job, until they have ended."""
    world = job["processes"]
    Path(job["folder"]).mkdir(parents=True)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    running, codes, end = {}, [-1] * world, time.monotonic() + LONGEST
    for rank in range(world):
        if (pid := os.fork()) == 0:
            work(job, rank, world, port)
        running[pid] = rank
    while running and time.monotonic() < end:
        pid, status = os.waitpid(-1, os.WNOHANG)
        if pid:
            codes[running.pop(pid)] = os.waitstatus_to_exitcode(status)
        else:
            time.sleep(0.005)
    for pid in running:
        os.kill(pid, 9)
        os.waitpid(pid, 0)
    Path(job["folder"], "codes.json").write_text(json.dumps(codes))


if __name__ == "__main__":
    import colour  # noqa: F401  # so that a child need not
    import kornia  # noqa: F401
    import torch._dynamo  # for the optimisers

    torch.set_num_threads(1)
    for each in json.loads(Path(sys.argv[1]).read_text()):
        start(each)
