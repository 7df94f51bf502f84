"""The file of draws in a cache that somebody else changed: the same draws come out, and the file
is written anew.
"""

from types import SimpleNamespace

import emcee
import numpy as np
import pytest

from neusee.workflows.calibration import emcee_sampler
from neusee.workflows.keys.sealed_files import seal_file

h5py = pytest.importorskip("h5py")
WALKERS = 8


def log_posterior(theta):
    return -0.5 * (theta**2).sum(-1)


def draw(count, rng):
    return rng.normal(size=(count, 2))


PROBLEM = SimpleNamespace(names=("a", "b"), log_posterior=log_posterior)
MODE = SimpleNamespace(theta=np.zeros(2), log=0.0, draw=draw)


@pytest.fixture
def sampled(monkeypatch):
    """Returns the draws of a Gaussian, and how often the density was evaluated."""
    for name in ("_FIRST_STEPS", "_MOST_STEPS"):
        monkeypatch.setattr(emcee_sampler, name, 20)
    monkeypatch.delenv("NEUSEE_CACHE_SECRET", raising=False)

    def sampled(file):
        calls = []
        weigh = SimpleNamespace(
            names=PROBLEM.names, log_posterior=lambda x: calls.append(0) or log_posterior(x)
        )
        return emcee_sampler.sample(
            weigh, MODE, file, emcee_sampler.Sampling(3, WALKERS)
        ).draws, len(calls)

    return sampled


def forged(change):
    """A file with a right checksum whose content somebody changed."""

    def forge(path):
        with h5py.File(path, "a") as file:
            change(file["ensemble0"])
        content = path.read_bytes()[512:]
        path.write_bytes(seal_file("draws", path.stem, content).ljust(512, b"\0") + content)

    return forge


def nan(group):
    group["chain"][3, 2, 1] = np.nan


def none(group):
    group.attrs["iteration"] = 0


def negative(group):
    group.attrs["iteration"] = -1


def text(group):
    group.attrs["random_state_0"] = "os.system"


def no_state(group):
    del group.attrs["random_state_1"]


def wrong_state(group):
    group.attrs["random_state_1"] = np.zeros(3, np.uint32)


def no_densities(group):
    del group["log_prob"]


def flipped(path):
    raw = bytearray(path.read_bytes())
    raw[len(raw) // 2] ^= 1
    path.write_bytes(raw)


FORGERIES = {
    **{
        change.__name__: forged(change)
        for change in (nan, none, negative, text, no_state, wrong_state, no_densities)
    },
    "one bit": flipped,
    "no seal": lambda path: path.write_bytes(bytes(512) + path.read_bytes()[512:]),
    "another file": lambda path: path.write_bytes(
        path.read_bytes().replace(b'"key":"draws"', b'"key":"other"')
    ),
    "empty": lambda path: path.write_bytes(b""),
    "text": lambda path: path.write_text("no draws"),
}


@pytest.mark.slow
@pytest.mark.parametrize("how", FORGERIES)
def test_changed_draws_are_drawn_anew_and_written_anew(tmp_path, sampled, how):
    path = tmp_path / "draws.h5"
    right, calls = sampled(path)
    assert calls > 0
    assert sampled(path)[1] == 0
    FORGERIES[how](path)
    again, calls = sampled(path)
    assert np.array_equal(again, right)
    assert calls > 0
    assert sampled(path)[1] == 0


def test_draws_are_read_with_the_right_secret_alone(tmp_path, sampled, monkeypatch):
    path = tmp_path / "draws.h5"
    sampled(path)
    for secret, is_read in (
        ("ours", False),
        ("ours", True),
        ("new, ours", True),
        ("other", False),
        ("other", True),
    ):
        monkeypatch.setenv("NEUSEE_CACHE_SECRET", secret)
        assert (sampled(path)[1] == 0) == is_read


def test_a_sealed_file_of_draws_is_a_file_of_emcee(tmp_path, sampled):
    sampled(tmp_path / "draws.h5")
    kept = emcee.backends.HDFBackend(str(tmp_path / "draws.h5"), name="ensemble3", read_only=True)
    assert kept.get_chain().shape == (20, WALKERS, 2)


def test_signed_draws_of_another_key_or_kind_of_file_are_not_read(tmp_path, sampled, monkeypatch):
    monkeypatch.setenv("NEUSEE_CACHE_SECRET", "ours")
    path, other = tmp_path / "draws.h5", tmp_path / "other.h5"
    sampled(path)
    other.write_bytes(path.read_bytes())
    assert sampled(other)[1] > 0, "signed for another key"
    content = path.read_bytes()[512:]
    path.write_bytes(seal_file("answer", path.stem, content).ljust(512, b"\0") + content)
    assert sampled(path)[1] > 0, "signed as another kind of file"


def test_draws_that_are_exchanged_after_their_check_are_not_read(tmp_path, sampled, monkeypatch):
    path, other = tmp_path / "draws.h5", tmp_path / "other.h5"
    right, _ = sampled(path)
    sampled(other)
    forged(lambda group: group["chain"].write_direct(np.ones(group["chain"].shape)))(other)
    whole, check = other.read_bytes(), emcee_sampler.unseal_file

    def exchanged(*words):
        check(*words)
        path.write_bytes(whole)

    monkeypatch.setattr(emcee_sampler, "unseal_file", exchanged)
    assert np.array_equal(sampled(path)[0], right)
