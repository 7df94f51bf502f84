"""Priors and coordinates: there and back, and the density with its Jacobian."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neusee.nodes.calibrate import NAMES, Coordinates, prior
from neusee.nodes.units import read_quantity

LAWS = {
    "gain": (0.37, 2.0),
    "offset": (390.0, 100.0),
    "read_noise": (10.5, 2.0),
    "dark_current": (0.002, 10.0),
    "full_well": (25500.0, 2.0),
    "quantum_efficiency": (0.56, 1.5),
    "spread": (1.0, 1.2),
}
NOMINAL = {name: law[0] for name, law in LAWS.items()}
UNITS = ["DN/e-", "e-/DN"]
some = st.sets(st.sampled_from(NAMES), min_size=1).map(sorted)


def coordinates(free, unit="DN/e-"):
    gain = read_quantity(f"0.37 {unit}", "DN/e-")
    laws = LAWS | {"gain": (gain, 2.0)}
    return Coordinates.of(prior(**{name: laws[name] for name in free}), NOMINAL | {"gain": gain})


@settings(max_examples=60, deadline=None)
@given(some, st.sampled_from(UNITS), st.integers(0, 1 << 30))
def test_there_and_back(free, unit, seed):
    c = coordinates(free, unit)
    drawn = c.draw(5, torch.Generator().manual_seed(seed))
    assert list(drawn) == [name for name in NAMES if name in free] == list(c.names)
    assert len(c.labels) == len(free)
    for way in (c.parameters(c.place(drawn)), c.from_whitened(c.whitened(drawn))):
        for name, value in drawn.items():
            torch.testing.assert_close(way[name], value, rtol=1e-11, atol=1e-9)


@settings(max_examples=40, deadline=None)
@given(some, st.sampled_from(UNITS), st.integers(0, 1 << 30))
def test_the_density_of_a_place_has_the_jacobian_of_its_parameters(free, unit, seed):
    """Between two places: the difference of log densities, by the derivative of the prior's own
    coordinates.
    """
    c = coordinates(free, unit)
    places = c.place(c.draw(2, torch.Generator().manual_seed(seed)))

    def exact(place):
        z = c.whitened(c.parameters(place))
        slopes = torch.autograd.functional.jacobian(lambda p: c.whitened(c.parameters(p)), place)
        return -0.5 * z.square().sum() + torch.linalg.slogdet(slopes).logabsdet

    found = c.log_prior(c.parameters(places))
    wanted = exact(places[0]) - exact(places[1])
    assert float(found[0] - found[1]) == pytest.approx(float(wanted), rel=1e-9, abs=1e-9)


def test_the_draws_have_the_prior():
    c = coordinates(NAMES)
    drawn = c.draw(20000, torch.Generator().manual_seed(3))
    for name, (middle, width) in LAWS.items():
        if name == "offset":
            assert float(drawn[name].mean()) == pytest.approx(
                middle, abs=4 * width / math.sqrt(20000)
            )
        else:
            assert float(drawn[name].median()) == pytest.approx(
                middle, rel=5 * math.log(width) / math.sqrt(20000)
            )
            assert float(drawn[name].log().std()) == pytest.approx(math.log(width), rel=0.03)


def test_what_frames_know_does_not_move_along_the_ridge_of_the_gain():
    """A gain 10 % larger with 10 % less of all that is counted in electrons: only the gain's own
    coordinate moves.
    """
    c = coordinates(["gain", "offset", "read_noise", "full_well", "quantum_efficiency"])
    more = {
        name: x * (1.1 if name == "gain" else 1 / 1.1)
        for name, x in NOMINAL.items()
        if name in c.names
    }
    moved = c.place(more) - c.place(NOMINAL)
    assert float(moved[0]) == pytest.approx(math.log(1.1))
    assert bool((moved[1:].abs() < 1e-12).all())


@pytest.mark.parametrize(
    ("laws", "said"),
    [
        ({}, "no parameter is free"),
        ({"offset": (390.0, 0.0)}, "offset"),
        ({"read_noise": (0.0, 2.0)}, "read_noise"),
    ],
)
def test_no_law_is_refused(laws, said):
    with pytest.raises(ValueError, match=said):
        prior(**laws)
