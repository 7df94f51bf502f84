"""Chance that a step draws without a seed, and chance that is seeded."""

import os
import pickle
import random
import secrets
import tempfile
import uuid
from pathlib import Path

import numpy as np
import pytest
import scipy.stats
import torch

DRAWS = {
    "torch": (lambda: torch.poisson(torch.ones(3)), "torch"),
    "torch dropout": (lambda: torch.nn.functional.dropout(torch.ones(3)), "torch"),
    "numpy": (lambda: np.random.normal(), "numpy.random"),
    "numpy seeded for all": (lambda: np.random.seed(1), "numpy.random"),
    "scipy": (lambda: scipy.stats.norm.rvs(size=2), "numpy.random"),
    "random": (random.random, "random"),
    "default_rng": (lambda: np.random.default_rng().normal(), "os.urandom"),
    "PCG64": (lambda: np.random.PCG64(), "os.urandom"),
    "RandomState": (lambda: np.random.RandomState().normal(), "numpy.random.RandomState without a seed"),
    "torch generator": (lambda: torch.Generator().seed(), "/dev/urandom"),
    "Random": (lambda: random.Random().random(), "random.Random without a seed"),
    "SystemRandom": (lambda: random.SystemRandom().random(), "os.urandom"),
    "secrets": (lambda: secrets.token_bytes(8), "os.urandom"),
    "uuid4": (uuid.uuid4, "os.urandom"),
    "urandom": (lambda: os.urandom(3), "os.urandom"),
    "device": (lambda: Path("/dev/urandom").open("rb", buffering=0).close(), "/dev/urandom"),
    "uuid of the kernel": (Path("/proc/sys/kernel/random/uuid").read_text, "/proc/sys/kernel/random/uuid"),
}


@pytest.mark.parametrize("draw", DRAWS)
def test_a_draw_without_a_seed_is_found(draw, taints, layer):
    draws, source = DRAWS[draw]
    if (draw, layer) == ("torch generator", "python"):
        pytest.skip("native code opens the device")
    assert taints(draws) == [("random", source)]


@pytest.mark.parametrize("size", [1, 64])
def test_chance_of_the_kernel_is_found_however_little_it_is(size, taints, watched):
    assert taints(lambda: os.getrandom(size)) == [("random", f"getrandom of {size} bytes")]


SEEDED = {
    "torch": lambda: torch.rand(3, generator=torch.Generator().manual_seed(3)),
    "numpy": lambda: np.random.default_rng(3).normal(),
    "legacy numpy": lambda: np.random.RandomState(3).normal(),
    "scipy": lambda: scipy.stats.norm.rvs(size=2, random_state=3),
    "random": lambda: random.Random(3).random(),
    "names of files": lambda: tempfile.mkdtemp(),
}


@pytest.mark.parametrize("draw", SEEDED)
def test_a_seeded_draw_is_none(draw, taints, layer):
    assert taints(SEEDED[draw]) == []


def test_a_legacy_generator_of_a_step_is_one_of_numpy(taints):
    made = []
    assert taints(lambda: made.append(np.random.RandomState(3))) == []
    assert made[0].normal() == np.random.RandomState(3).normal()
    again = pickle.loads(pickle.dumps(made[0]))
    assert type(again._bit_generator) is np.random.MT19937
    assert again.normal() == made[0].normal()
