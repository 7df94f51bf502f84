"""Chance that a step draws without a seed, and chance that is seeded."""

import importlib
import os
import pickle
import random
import secrets
import sys
import tempfile
import threading
import uuid
from pathlib import Path

import numpy as np
import pytest
import scipy.stats
import torch

from neusee.workflows.observation.observed_call import observed
from neusee.workflows.observation.taints import Covered


def seeded(size=3):
    torch.manual_seed(3)
    return torch.rand(size)


def forked(draw):
    with torch.random.fork_rng(devices=[]):
        return draw(3)


def put_back(*draws):
    before = np.random.get_state()
    for draw in draws:
        draw()
    np.random.set_state(before)
    return np.random.normal() if len(draws) > 1 else None


DRAWS = {
    "torch": (lambda: torch.poisson(torch.ones(3)), "torch"),
    "torch dropout": (lambda: torch.nn.functional.dropout(torch.ones(3)), "torch"),
    "numpy": (lambda: np.random.normal(), "numpy.random"),
    "numpy, then seeded": (lambda: [np.random.normal(), np.random.seed(3)], "numpy.random"),
    "numpy, put back": (lambda: put_back(np.random.normal), "numpy.random"),
    "numpy, seeded and put back": (
        lambda: put_back(lambda: np.random.seed(3), np.random.normal),
        "numpy.random",
    ),
    "weights of torch": (lambda: torch.nn.Linear(3, 2), "torch"),
    "torch, then seeded": (lambda: [torch.rand(3), torch.manual_seed(3)], "torch"),
    "torch in a fork": (lambda: forked(torch.rand), "torch"),
    "torch after a fork": (lambda: [forked(seeded), torch.rand(3)], "torch"),
    "torch seeded by itself": (lambda: torch.manual_seed(int(torch.randint(9, ()))), "torch"),
    "scipy": (lambda: scipy.stats.norm.rvs(size=2), "numpy.random"),
    "random": (random.random, "random"),
    "default_rng": (lambda: np.random.default_rng().normal(), "os.urandom"),
    "PCG64": (lambda: np.random.PCG64(), "os.urandom"),
    "RandomState": (
        lambda: np.random.RandomState().normal(),
        "numpy.random.RandomState without a seed",
    ),
    "torch generator": (lambda: torch.Generator().seed(), "/dev/urandom"),
    "Random": (lambda: random.Random().random(), "random.Random without a seed"),
    "SystemRandom": (lambda: random.SystemRandom().random(), "os.urandom"),
    "secrets": (lambda: secrets.token_bytes(8), "os.urandom"),
    "uuid4": (uuid.uuid4, "os.urandom"),
    "urandom": (lambda: os.urandom(3), "os.urandom"),
    "device": (lambda: Path("/dev/urandom").open("rb", buffering=0).close(), "/dev/urandom"),
    "uuid of the kernel": (
        Path("/proc/sys/kernel/random/uuid").read_text,
        "/proc/sys/kernel/random/uuid",
    ),
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
    "torch for all": lambda: [
        seeded(),
        torch.nn.Conv2d(1, 1, 3),
        torch.nn.functional.dropout(torch.ones(3)),
    ],
    "torch for all, in a fork": lambda: forked(seeded),
    "torch for all, a fork in it": lambda: [seeded(), forked(torch.rand), torch.rand(3)],
    "layer without weights": lambda: torch.nn.utils.skip_init(torch.nn.Linear, 3, 2),
    "numpy for all": lambda: [np.random.seed(3), scipy.stats.norm.rvs(size=2)],
    "numpy for all, put back": lambda: [
        np.random.seed(3),
        put_back(np.random.normal),
        np.random.normal(),
    ],
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
    """What installs a package that keeps a generator, and returns what imports it and what draws
    from it.
    """

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
def test_a_generator_that_a_package_makes_at_its_import_is_none_until_a_step_draws(
    kind, keeping, taints, layer
):
    load = keeping(kind)
    assert taints(load) == []
    assert taints(load) == []
    assert taints(lambda: load().draw()) == [
        ("random", f"a generator that {load().__name__} keeps")
    ]
    assert taints(load) == []


@pytest.mark.parametrize("kind", KEEPING)
def test_a_step_that_imports_a_package_and_draws_from_its_generator_is_found(
    kind, keeping, taints, layer
):
    load = keeping(kind)
    assert taints(lambda: load().draw()) == [
        ("random", f"a generator that {load().__name__} keeps")
    ]


def test_an_own_module_may_import_a_package_that_makes_a_generator(
    tmp_path, monkeypatch, keeping, taints, layer
):
    keeping("legacy numpy")
    (tmp_path / "keeping_own.py").write_text("import keeping_legacy_numpy\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert taints(lambda: importlib.import_module("keeping_own")) == []


def test_a_package_that_draws_without_a_seed_when_it_is_imported_is_found(
    keeping, taints, layer, monkeypatch
):
    monkeypatch.setitem(
        KEEPING,
        "drawn numbers",
        ("import numpy as np\nKEPT = np.random.RandomState().rand(3)", "KEPT"),
    )
    load = keeping("drawn numbers")
    assert taints(load) == [("random", "a generator that keeping_drawn_numbers keeps")]


def test_names_of_tasks_that_dask_draws_are_none(taints, layer):
    array = pytest.importorskip("dask.array")
    delayed = pytest.importorskip("dask").delayed

    def step():
        numbers = array.from_array(np.arange(16.0).reshape(4, 4), chunks=2)
        scaled = numbers.map_blocks(lambda block: 2 * block) @ numbers.T
        return (
            float(scaled.sum().compute(scheduler="threads"))
            + delayed(abs)(object.__sizeof__(3) - 100).compute()
        )

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
    assert [kind for kind, _ in taints(lambda: random.default_rng().normal(size=3).compute())] == [
        "random"
    ]
    assert taints(lambda: [uuid.uuid4() for _ in range(2)]) == [("random", "os.urandom")]


@pytest.mark.parametrize(
    ("seed", "source"), [(np.random.seed, "numpy.random"), (torch.seed, "torch")]
)
def test_a_seed_that_the_system_gives_is_none(seed, source, taints, layer):
    assert ("random", source) in taints(seed)


def test_a_seed_that_the_process_has_already_is_one(taints):
    torch.manual_seed(3)
    np.random.seed(3)
    assert taints(lambda: [seeded(), np.random.seed(3), np.random.normal()]) == []


def test_a_state_that_the_process_has_already_is_none(taints):
    before = torch.get_rng_state()
    assert taints(lambda: [torch.set_rng_state(before), torch.rand(3)]) == [("random", "torch")]


def test_a_seed_that_another_thread_sets_is_none_of_the_step(taints):
    started, ended = threading.Event(), threading.Event()

    def disturb():
        started.wait(60)
        torch.manual_seed(5)
        ended.set()

    other = threading.Thread(target=disturb)
    other.start()
    assert taints(lambda: [seeded(), started.set(), ended.wait(60), torch.rand(3)]) == [
        ("random", "torch")
    ]
    other.join()


def test_the_functions_of_torch_and_numpy_are_what_they_were(taints):
    def functions():
        return [
            torch.random.default_generator,
            np.random.seed,
            np.random.mtrand.set_state,
            torch.cuda.manual_seed_all,
        ]

    before = functions()
    taints(lambda: torch.manual_seed(3))
    assert functions() == before
    assert torch.manual_seed(4) is torch.default_generator


def test_a_draw_says_what_to_write_and_the_advice_works(taints):
    found = observed(lambda: torch.nn.Linear(3, 2), Covered(frozenset(), lambda name: True))[1]
    for word in (
        "torch.manual_seed(seed)",
        "torch.nn.utils.skip_init(torch.nn.Linear, 3, 2)",
        "rng",
        "cache: false",
    ):
        assert word in found[0].fix
    numpy = observed(np.random.normal, Covered(frozenset(), lambda name: True))[1]
    assert "np.random.seed(seed)" in numpy[0].fix

    def advised(seed=3):
        layer = torch.nn.utils.skip_init(torch.nn.Linear, 3, 2)
        torch.nn.init.zeros_(layer.weight)
        torch.manual_seed(seed)
        return torch.nn.Linear(3, 2)(torch.ones(3)), layer

    assert taints(advised) == []
