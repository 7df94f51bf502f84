"""Ensembles in step: emcee's own walk to the last bit, whoever else walks beside it."""

import emcee
import numpy as np
import pytest

from neusee.workflows.calibration.emcee_sampler import Walk, walk_until

WALKERS, FREE = 16, 3
MOVES = {
    "de": emcee.moves.DEMove,
    "stretch": emcee.moves.StretchMove,
    "snooker": emcee.moves.DESnookerMove,  # four parts instead of two
}


def weigh(samples):
    """A bent law with an edge, weighed by walker: of each the same bits, whoever is beside it."""
    found = [-0.5 * (x[0] ** 2 + 4.0 * (x[1] - x[0] ** 2) ** 2 + abs(x[2])) for x in samples]
    return np.array(
        [log if x[2] > -1.0 else -np.inf for x, log in zip(samples, found, strict=True)]
    )


def start(seed):
    return np.random.default_rng(seed).normal(0.0, 0.3, (WALKERS, FREE))


def begun(seed, move):
    backend = emcee.backends.Backend()
    backend.reset(WALKERS, FREE)
    return Walk(backend, move, np.random.RandomState(seed), start(seed))


def by_emcee(seed, move, steps):
    sampler = emcee.EnsembleSampler(WALKERS, FREE, weigh, moves=move, vectorize=True)
    sampler.random_state = np.random.RandomState(seed).get_state()
    sampler.run_mcmc(start(seed), steps)
    return sampler.backend


def assert_same(found, expected):
    assert found.iteration == expected.iteration
    assert np.array_equal(found.get_chain(), expected.get_chain())
    assert np.array_equal(found.get_log_prob(), expected.get_log_prob())
    assert np.array_equal(found.accepted, expected.accepted)
    for one, other in zip(found.random_state, expected.random_state, strict=True):
        assert np.array_equal(one, other)


@pytest.mark.parametrize("name", MOVES)
def test_each_walks_as_emcee_walks_it_alone(name):
    walks = [begun(seed, MOVES[name]()) for seed in range(3)]
    walk_until(walks, 60, weigh)
    for seed, walk in enumerate(walks):
        assert_same(walk.backend, by_emcee(seed, MOVES[name](), 60))
        assert 0 < walk.backend.accepted.sum() < 60 * WALKERS


def test_all_are_weighed_in_one_call():
    counted = []

    def counting(samples):
        counted.append(len(samples))
        return weigh(samples)

    walk_until([begun(seed, emcee.moves.DEMove()) for seed in range(4)], 5, counting)
    assert counted == [WALKERS] * 4 + [4 * WALKERS // 2] * 10


def test_what_goes_on_is_what_never_stopped():
    walk = begun(0, emcee.moves.DEMove())
    for steps in (1, 20, 20, 10, 50):  # fewer than there are: nothing is walked
        walk_until([walk], steps, weigh)
    assert_same(walk.backend, by_emcee(0, emcee.moves.DEMove(), 50))


def test_those_behind_walk_first():
    walks = [begun(seed, emcee.moves.DEMove()) for seed in range(4)]
    walk_until(walks[1:2], 40, weigh)
    walk_until(walks[2:3], 90, weigh)
    walk_until(walks, 60, weigh)
    assert [walk.iteration for walk in walks] == [60, 60, 90, 60]
    for seed, walk in enumerate(walks):
        assert_same(walk.backend, by_emcee(seed, emcee.moves.DEMove(), walk.iteration))
