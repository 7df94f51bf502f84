"""The spot of a laser on the sensor: its heated diameter against the diffraction integral, and
the power of a frame.
"""

import math

import numpy as np
import pytest
import torch
from scipy.special import j0

from neusee.nodes.laser import (
    airy_diameter,
    beam,
    beam_radius,
    frame_power,
    heated_diameter,
    spot_in_pixels,
)


def heated(radius, diameter, wavelength, focal_length):
    """Return the 1/e2 diameter of the Gaussian spot with the same heat in its centre as a
    truncated Gaussian beam's.
    """
    rho = np.linspace(0, diameter / 2, 1001)
    weight = np.exp(-((rho / radius) ** 2)) * rho
    at = np.linspace(0, 50 * wavelength * focal_length / min(diameter, 2 * radius), 6001)
    field = np.trapezoid(
        weight * j0(2 * np.pi * at[:, None] * rho / (wavelength * focal_length)), rho, axis=1
    )
    return 2 * np.trapezoid((field / field[0]) ** 2, at) / math.sqrt(math.pi / 8)


@pytest.mark.parametrize("distance", [0.0, 2.0, 5.0, 12.0, 100.0])
def test_the_spot_heats_as_the_diffraction_pattern_of_the_beam(distance):
    laser = beam(532e-9, power=1.0, waist=1e-3, divergence=1.5e-3)
    found = heated_diameter(laser, distance, 8e-3, 50e-3)
    expected = heated(beam_radius(laser, distance), 8e-3, 532e-9, 50e-3)
    assert found == pytest.approx(expected, rel=0.045)


def test_a_wide_beam_has_the_spot_of_the_lens_and_tensors_serve_as_well():
    laser = beam(532e-9, power=1.0, divergence=1e-3)
    assert heated_diameter(laser, 1e5, 8e-3, 50e-3) == pytest.approx(
        airy_diameter(532e-9, 6.25), rel=1e-6
    )
    at = torch.tensor([1.0, 10.0, 1e3], dtype=torch.float64)
    one_by_one = [heated_diameter(laser, x, 8e-3, 50e-3) for x in at.tolist()]
    assert heated_diameter(laser, at, 8e-3, 50e-3).tolist() == pytest.approx(one_by_one)


def test_a_spot_is_counted_in_pixels():
    assert spot_in_pixels(550e-9, 50e-3, 10e-3, 2.75e-6) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("given", "exposure", "power"),
    [
        ({"power": 3.0}, 1e-3, 3.0),
        ({"pulse_energy": 1e-3, "pulse_duration": 1e-8}, 0.01, 0.1),
        ({"pulse_energy": 1e-3, "pulse_duration": 1e-8, "repetition_rate": 1000.0}, 0.01, 1.0),
        ({"pulse_energy": 1e-3, "pulse_duration": 1e-8, "repetition_rate": 10.0}, 0.01, 0.1),
    ],
    ids=["continuous", "single pulse", "train", "one pulse of a slow train"],
)
def test_a_frame_that_catches_a_pulse_counts(given, exposure, power):
    assert frame_power(beam(532e-9, divergence=1e-3, **given), exposure) == pytest.approx(power)
