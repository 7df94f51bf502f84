"""Where a laser stands: given or drawn, on the sensor, and never by the printed rule."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neusee.nodes import ParameterError, doe, optics, spectra

PAPER = {"focal_length": 0.11, "pixel_pitch": 2.9e-6, "shape": (2048, 2048)}
RULE = {"share": 0.36, "rule": "width_over_focal_length"}


def drawn(seed, **params):
    return optics.direction(rng=torch.Generator().manual_seed(seed), **PAPER | params)


def test_a_given_angle_is_taken():
    assert drawn(0, angle=(1e-3, -2e-3)).tolist() == [1e-3, -2e-3]


def test_the_spread_is_that_of_the_paper_read_with_a_sense():
    places = torch.stack([drawn(seed) for seed in range(4000)])
    assert places.std(0) * 3 == pytest.approx(0.01944, rel=0.05)  # 0.36 W / f
    assert float(places.std() * 0.11 / 2.9e-6) == pytest.approx(245.8, rel=0.05)  # pixels
    assert places.mean(0).abs().max() < 3 * 0.01944 / 3 / 4000**0.5 * 1.5


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**31), share=st.floats(0, 1), y=st.integers(1, 64), x=st.integers(1, 64)
)
def test_a_drawn_spot_falls_on_the_sensor(seed, share, y, x):
    place = drawn(seed, share=share, shape=(y, x)) * 0.11 / 2.9e-6
    assert abs(float(place[0])) <= y / 2 + 1e-9
    assert abs(float(place[1])) <= x / 2 + 1e-9
    assert torch.equal(place, drawn(seed, share=share, shape=(y, x)) * 0.11 / 2.9e-6)


def test_the_printed_rule_is_refused_with_its_shift():
    with pytest.raises(
        ParameterError, match=r"6\.67 rad would put the spot 0\.73 m off the axis"
    ) as caught:
        optics.direction.hooks.preflight(
            angle=None, **PAPER, **RULE | {"rule": "focal_length_over_width"}
        )
    assert caught.value.parameter == "rule"
    assert (
        optics.direction.hooks.preflight(
            angle=(0.0, 0.0), **PAPER, **RULE | {"rule": "focal_length_over_width"}
        )
        == []
    )


def test_the_check_says_where_the_spot_is():
    (line,) = optics.direction.hooks.check(torch.tensor([1e-3, 0.0]), **PAPER)
    assert "+37.9, +0.0 px" in line.text


def test_an_angle_beyond_the_sensor_is_told_before_the_run():
    (note,) = optics.direction.hooks.preflight(angle=(0.1, 0.0), **PAPER, **RULE)
    assert "+3793.1, +0.0 px" in note
    assert "beyond the sensor of 2048 x 2048 px" in note
    assert optics.direction.hooks.preflight(angle=(1e-3, 0.0), **PAPER, **RULE) == []


def test_a_wired_direction_moves_the_spot_like_an_angle():
    band = spectra.bands(start=550e-9, stop=560e-9, count=2)
    stop = optics.stop(samples=32, pitch=1e-4, diameter=3.2e-3)
    height = doe.flat(stop)
    glass = doe.material(band, material="fused silica")
    pupil = optics.pupil(height, glass, band, stop)
    camera = {"focal_length": 0.11, "pixel_pitch": 2.9e-6, "shape": (24, 24)}
    towards = torch.tensor([1.3e-4, -0.7e-4], dtype=torch.float64)
    wired = optics.psf(pupil, towards, **camera)
    assert torch.equal(
        wired.intensity, optics.psf(pupil, angle=(1.3e-4, -0.7e-4), **camera).intensity
    )
    assert not torch.equal(wired.intensity, optics.psf(pupil, **camera).intensity)
