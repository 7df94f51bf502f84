"""Chance that a step draws without a seed, and chance that is seeded."""

import importlib
import os
import pickle
import random
import secrets
import sys
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


#: a package that keeps a generator, and how a function of it draws
KEEPING = {
    "legacy numpy": ("import numpy as np\nKEPT = np.random.RandomState()", "KEPT.normal()"),
    "legacy numpy in a default": (
        "import numpy as np\n\n\ndef shared(rng=np.random.RandomState(3)):\n    return rng.rand()",
        "shared()",
    ),
    "numpy": ("import numpy as np\nKEPT = np.random.default_rng()", "KEPT.normal()"),
    "python": ("import random\nKEPT = random.Random()", "KEPT.random()"),
}  # fmt: skip


@pytest.fixture
def keeping(tmp_path, monkeypatch):
    """What installs a package that keeps a generator, and returns what imports it and what draws from it."""

    def install(kind):
        name = f"keeping_{kind.replace(' ', '_')}"
        made, draw = KEEPING[kind]
        site = tmp_path / "site-packages"
        (site / f"{name}-1.0.dist-info").mkdir(parents=True)
        (site / f"{name}.py").write_text(f"{made}\n\n\ndef draw():\n    return {draw}\n")
        monkeypatch.syspath_prepend(site)
        return lambda: importlib.import_module(name)

    yield install
    for name in [each for each in sys.modules if each.startswith("keeping_")]:
        del sys.modules[name]


@pytest.mark.parametrize("kind", KEEPING)
def test_a_generator_that_a_package_makes_at_its_import_is_none_until_a_step_draws(kind, keeping, taints, layer):
    load = keeping(kind)
    assert taints(load) == []
    assert taints(load) == []
    assert taints(lambda: load().draw()) == [("random", f"a generator that {load().__name__} keeps")]
    assert taints(load) == []


@pytest.mark.parametrize("kind", KEEPING)
def test_a_step_that_imports_a_package_and_draws_from_its_generator_is_found(kind, keeping, taints, layer):
    load = keeping(kind)
    assert taints(lambda: load().draw()) == [("random", f"a generator that {load().__name__} keeps")]


def test_an_own_module_may_import_a_package_that_makes_a_generator(tmp_path, monkeypatch, keeping, taints, layer):
    keeping("legacy numpy")
    (tmp_path / "keeping_own.py").write_text("import keeping_legacy_numpy\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert taints(lambda: importlib.import_module("keeping_own")) == []


def test_a_package_that_draws_without_a_seed_when_it_is_imported_is_found(keeping, taints, layer, monkeypatch):
    monkeypatch.setitem(
        KEEPING, "drawn numbers", ("import numpy as np\nKEPT = np.random.RandomState().rand(3)", "KEPT")
    )
    load = keeping("drawn numbers")
    assert taints(load) == [("random", "a generator that keeping_drawn_numbers keeps")]


def test_names_of_tasks_that_dask_draws_are_none(taints, layer):
    array = pytest.importorskip("dask.array")
    delayed = pytest.importorskip("dask").delayed

    def step():
        numbers = array.from_array(np.arange(16.0).reshape(4, 4), chunks=2)
        scaled = numbers.map_blocks(lambda block: 2 * block) @ numbers.T
        return float(scaled.sum().compute(scheduler="threads")) + delayed(abs)(object.__sizeof__(3) - 100).compute()

    assert taints(step) == []


def test_names_of_files_that_xarray_draws_are_none(tmp_path, taints, layer):
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")

    def step():
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "table.nc"
            xarray.Dataset({"gain": ("x", np.ones(3))}).to_netcdf(path, engine="h5netcdf")
            with xarray.open_dataset(path, engine="h5netcdf") as table:
                return float(table.gain.sum())

    assert taints(step) == []


def test_chance_that_dask_draws_and_a_name_that_a_step_draws_are_found(taints, layer):
    random = pytest.importorskip("dask.array").random
    assert [kind for kind, _ in taints(lambda: random.default_rng().normal(size=3).compute())] == ["random"]
    assert taints(lambda: [uuid.uuid4() for _ in range(2)]) == [("random", "os.urandom")]
