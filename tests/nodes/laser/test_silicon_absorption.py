"""Absorption of silicon: shares that a text book gives, and the bracket of a threshold at
another wavelength.
"""

import math

import numpy as np
import pytest

from neusee.nodes.laser import absorbed_share, absorption_bracket, silicon_absorption

#: extinction k of another measurement, at 295 K: Schinke et al., AIP Advances 5, 067168 (2015)
SCHINKE = {500: 4.8542e-2, 530: 3.4804e-2, 600: 1.8521e-2, 650: 1.4447e-2, 700: 1.0623e-2}


@pytest.mark.parametrize(("nm", "share"), [(532, 0.90), (905, 0.09), (1064, 0.003)])
def test_three_micrometres_absorb_the_share_that_is_known(nm, share):
    assert absorbed_share(nm * 1e-9) == pytest.approx(share, rel=0.1)


@pytest.mark.parametrize("nm", SCHINKE)
def test_the_table_agrees_with_another_measurement_within_its_uncertainty(nm):
    """Schinke et al. state 11 % at 600 nm."""
    assert silicon_absorption(nm * 1e-9) == pytest.approx(
        4 * math.pi * SCHINKE[nm] / (nm * 1e-9), rel=0.12
    )


def test_absorption_falls_with_the_wavelength_and_has_ends():
    values = [silicon_absorption(nm * 1e-9) for nm in np.arange(400, 1100.5, 0.5)]
    assert (np.diff(values) < 0).all()
    for nm in (399.9, 1100.1, 1550):
        with pytest.raises(ValueError, match="no absorption of silicon"):
            silicon_absorption(nm * 1e-9)


def test_no_entry_of_the_table_stands_out():
    """A mistyped digit is a kink: what a parabola through the neighbours of an entry says of the
    logarithm of k.
    """
    logs = np.log([silicon_absorption(nm * 1e-9) * nm for nm in range(400, 1101, 10)])
    for index in range(2, len(logs) - 2):
        around = logs[[index - 2, index - 1, index + 1, index + 2]]
        assert around @ [-1 / 6, 4 / 6, 4 / 6, -1 / 6] == pytest.approx(logs[index], abs=0.03), (
            400 + 10 * index
        )


def test_between_two_entries_the_logarithm_is_a_straight_line():
    """At 535 nm k is the geometric mean of its neighbours, and at 532 nm it is nearer to that of
    530 nm.
    """
    k = {nm: silicon_absorption(nm * 1e-9) * nm for nm in (530, 532, 535, 540)}
    assert k[535] == pytest.approx(math.sqrt(k[530] * k[540]), rel=1e-9)
    assert k[532] == pytest.approx(k[530] ** 0.8 * k[540] ** 0.2, rel=1e-9)


@pytest.mark.parametrize(("nm", "least", "largest"), [
    (532, 1.0, 1.0),
    (405, 0.90, 1.0),
    (905, 1.0, 0.90 / 0.0824),
    (1064, 1.0, 0.90 / 0.0029),
])  # fmt: skip
def test_a_threshold_lies_between_equal_absorption_and_silicon_alone(nm, least, largest):
    assert absorption_bracket(nm * 1e-9, 532e-9) == pytest.approx((least, largest), rel=0.02)
