"""What is said to be counted along the axis, and what not: its values and its conditions."""

import math

import numpy as np
import pytest
import torch

from neusee.nodes.laser import BrightPixels
from neusee.workflows.recipe.blocks.safety_block import Laser, Safety, SafetySettings
from neusee.workflows.safety.laser_spots import Peaks, Ranked, Veil
from neusee.workflows.safety.safety_estimate import (
    counted,
    focus_text,
    ladder_text,
    near_text,
    scatter_text,
)

PIXELS = BrightPixels(*[torch.ones(1)] * 4, torch.ones(3))


def case(focus="infinity", beam=(), **laser):
    light = {
        "wavelength": "532 nm",
        "power": "5 mW",
        "divergence": "1 mrad",
        "distance": "100 m",
        **laser,
    }
    lens = {"focal_length": "50 mm", "diameter": "12 mm", "focus": focus}
    settings = {
        "lens": lens,
        "sensor": {"pixel_pitch": "3.45 um", "shape": [101, 101]},
        "beam": dict(beam),
    }
    return Safety(
        Laser.model_validate(light), SafetySettings.model_validate(settings), "laser", {}, ()
    )


def ranked(error=0.013):
    return Ranked("mask", (2.0, 20.0, 200.0), (PIXELS,) * 3, error)


def test_hot_spots_and_turbulence_are_counted_with_their_value_or_said_not_to_be():
    even = list(counted(case()))
    assert even[0] == "Hot spots of the beam: not included (safety.beam.hot_spots is 1)."
    assert "not included (safety.beam.cn2 is not set)" in even[1]
    assert even[2].startswith("M2 is 1")
    uneven = list(
        counted(
            case(beam={"hot_spots": 2.5, "cn2": 1e-14, "worst": 0.95}, waist="1 mm", m_squared=None)
        )
    )
    assert "included, factor 2.5" in uneven[0]
    assert "Cn2 1e-14" in uneven[1]
    assert "for 5 % of the time" in uneven[1]
    quality = 1e-3 * 1e-3 * math.pi / (2 * 532e-9)
    assert uneven[2].startswith(f"M2 of {quality:.3g}: included in the width")


def test_the_veil_is_said_with_its_share_in_per_cent_and_where_it_comes_from():
    assert "scatters no light" in scatter_text(None)
    assumed = scatter_text(Veil(np.array([0.005]), True, np.zeros_like))
    assert assumed.startswith("Lens scatter 0.5 %, assumed, within a factor of 1.5")
    assert scatter_text(Veil(np.array([0.012]), False, np.zeros_like)).startswith(
        "Lens scatter 1.2 %, as given in the recipe"
    )


@pytest.mark.parametrize(("focus", "text"), [("infinity", "focused at infinity"), ("7 m", "focused at 7 m"),
                                             ("laser", "at every distance, which gives the highest peak")])  # fmt: skip
def test_the_focus_is_said(focus, text):
    assert text in focus_text(case(focus))


def test_the_number_of_distances_and_the_error_between_them_are_said():
    text = ladder_text((ranked(),), Peaks(0.1, ((2.0, 0.4), (20.0, 0.02)), 0.03))
    assert "mask: 3 distances, interpolated within 1.3 %" in text
    assert "peak behind the mask: 2 distances, interpolated within 3 %" in text
    assert "(D / 2w)^2 = 0.02 with 0.03 waves" in text
    assert "distances, interpolated" not in ladder_text(
        (ranked(math.inf),), Peaks(0.1, ((2.0, 0.4),), 0.0)
    )


def test_a_bound_is_said_only_where_nearer_distances_are_asked_for():
    peaks = Peaks(0.1, ((3.0, 0.4), (20.0, 0.02)), 0.03)
    both = list(near_text(1.0, (ranked(),), peaks))
    assert both[0].startswith("At less than 3 m the beam in front of the mask is not computed")
    assert both[1].startswith("At less than 2 m the pixels behind the mask are not computed")
    assert len(list(near_text(2.0, (ranked(),), peaks))) == 1
    assert list(near_text(3.0, (ranked(),), peaks)) == []
    assert list(near_text(1.0, (ranked(math.inf),), None)) == []


def test_light_outside_the_window_that_counts_as_the_peak_is_said_with_its_share_and_distances():
    peaks = Peaks(
        0.1, ((1.0, 0.4), (3.0, 0.25), (20.0, 0.02)), 0.03, outside=((1.0, 0.4), (3.0, 0.25))
    )
    (text,) = near_text(1.0, (), peaks)
    assert text.startswith(
        "At 2 of 3 distances, the farthest 3 m, the window of the spot behind the mask lacks light"
    )
    assert "(up to 40 %)" in text
