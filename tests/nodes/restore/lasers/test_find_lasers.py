"""Lasers found in frames of a camera in NumPy that shares no line with the nodes, and frames
without any.
"""

import numpy as np
import pytest
import torch
from scipy.stats import norm

from neusee.nodes import restore
from neusee.nodes.restore.lasers import (
    Lens,
    censored,
    filled,
    filter_of,
    grid_patterns,
    index_at,
    line_moves,
    line_pattern,
)
from tests.nodes.restore.lasers import own_camera as own
from tests.nodes.restore.lasers.as_inputs import BANDS, LENS, found_in, inputs, pupil_of, tensor

PIXEL = own.PITCH / own.FOCAL
SIDE = 64


def frame_of(lasers, mask="half_ring", kind="noise", seed=3, lamps=0, side=SIDE):
    return own.frame(mask, kind, side, lasers, np.random.default_rng(seed), lamps)


def number(x):
    return torch.tensor(x, dtype=torch.float64)


@pytest.mark.parametrize("mask", ["plain", "half_ring", "cubic"])
def test_the_pattern_of_a_line_is_that_of_direct_sums(mask):
    expected = own.pattern(mask, 533e-9, (3.3, -8.2), (48, 40))
    lens = Lens(own.FOCAL, own.PITCH, (48, 40))
    found = line_pattern(
        pupil_of(mask, torch.float64),
        number([3.3, -8.2]) * PIXEL,
        number(533e-9),
        lens,
        number(0.0),
    )
    assert np.abs(found.numpy() - expected).max() < 1e-6 * expected.max()


def test_the_index_between_bands_is_that_of_the_glass_and_other_numbers_of_bands_have_one():
    pupil = pupil_of("plain")
    for nm in (401.0, 533.0, 699.0):
        assert float(index_at(number(nm * 1e-9), pupil)) == pytest.approx(
            own.silica(nm * 1e-9), abs=3e-8
        )
    for count in (1, 2, 3):
        few = pupil._replace(index=pupil.index[:count], wavelengths=pupil.wavelengths[:count])
        for n in range(count):
            assert float(index_at(few.wavelengths[n], few)) == pytest.approx(
                float(few.index[n]), abs=1e-12
            )


def test_a_pixel_between_two_points_of_it_sees_their_mean():
    """The mean over a pixel by SciPy's direct sums at 9 x 9 places in that pixel."""
    lens = Lens(own.FOCAL, own.PITCH, (9, 9), "integrated")
    found = line_pattern(
        pupil_of("plain", torch.float64), number([0.0, 0.0]), number(550e-9), lens, number(0.0)
    ).numpy()
    at = (np.arange(9) + 0.5) / 9 - 0.5
    expected = np.mean([own.pattern("plain", 550e-9, (-y, -x), (9, 9)) for y in at for x in at], 0)
    assert np.abs(found - expected).max() < 6e-3 * expected.max()


@pytest.mark.slow
@pytest.mark.parametrize("fwhm", [1e-9, 5e-9])
def test_the_slopes_of_a_line_are_differences_of_direct_sums(fwhm):
    """Differences of a line summed by the rule of the trapezium over ten deviations, over the
    largest of each kind.
    """
    at = np.linspace(-5, 5, 31)

    def line(down=0.0, right=0.0, wave=0.0, variance=0.0):
        spread = np.sqrt((fwhm / 2.3548200450309493) ** 2 + variance)
        parts = [
            own.pattern(
                "half_ring", 533e-9 + wave + x * spread, (3.3 + down, -8.2 + right), (24, 20)
            )
            for x in at
        ]
        return np.average(parts, 0, np.exp(-0.5 * at**2))

    def slope(step, **move):
        (name,) = move
        return (line(**{name: step}) - line(**{name: -step})) / (2 * step)

    lens = Lens(own.FOCAL, own.PITCH, (24, 20))
    moves = line_moves(
        pupil_of("half_ring", torch.float64),
        number([3.3, -8.2]),
        number(533e-9),
        lens,
        number(fwhm),
    )
    wanted = (
        line(),
        slope(0.01, down=0),
        slope(0.01, right=0),
        slope(1e-11, wave=0),
        slope(fwhm**2 / 200, variance=0),
    )
    for found, expected, bound in zip(moves, wanted, (1e-4, 1e-3, 1e-3, 2e-3, 2e-2), strict=True):
        assert np.abs(found.numpy() - expected).max() < bound * np.abs(expected).max()


def test_patterns_at_several_places_are_those_of_direct_sums():
    lens = Lens(own.FOCAL, own.PITCH, (24, 30))
    found = grid_patterns(
        pupil_of("cubic", torch.float64), number([1.0, -2.3]), number([0.4]), number(533e-9), lens
    )
    for n, y in enumerate((1.0, -2.3)):
        expected = own.pattern("cubic", 533e-9, (y, 0.4), (24, 30))
        assert np.abs(found[n, 0].numpy() - expected).max() < 1e-6 * expected.max()


def test_a_clipped_pixel_counts_as_at_least_full():
    """The misfit of a clipped pixel is minus the logarithm of the probability in closed form, by
    SciPy.
    """
    electrons = torch.full((3, 16, 16), 100.0, dtype=torch.float64)
    seen = torch.ones_like(electrons)
    seen[0, 8, 8] = 0
    electrons[0, 8, 8] = 20000.0
    clipped = censored(electrons, seen, electrons, read_noise=5.0)
    assert censored(electrons, torch.ones_like(seen), electrons, 5.0) is None
    # the scene around is even, so nothing but photons and read noise is not known
    sigma = np.sqrt(20000 + 25)
    spot = torch.zeros_like(electrons)
    spot[0, 8, 8] = 1.0
    for over in (-3.0, -0.5, 0.0, 1.5, 3.0):

        def cost(shift, over=over):
            light = 20000 - 100 + (over + shift) * sigma
            return 0.5 * float(clipped.misfits(electrons - light * spot).square().sum())

        wanted = -np.log(0.01 + 0.99 * norm.cdf(over)) / 9
        assert cost(0.0) == pytest.approx(wanted, rel=1e-9)
        rest = electrons - (19900 + over * sigma) * spot
        slope = clipped.slopes(rest, clipped.of(clipped.lit(spot))[None])
        fall = float((slope[0] * clipped.misfits(rest)).sum()) * sigma
        assert fall == pytest.approx((cost(-1e-4) - cost(1e-4)) / 2e-4, rel=1e-5)


@pytest.mark.slow
def test_the_strength_of_a_wider_line_lies_in_its_interval():
    """A line of 3 nm, of which no width is tried: its rings fade, which must not count as a
    weaker laser.
    """
    laser = own.Laser((4.3, -7.8), 560e-9, 1e4, 3e-9)
    found = found_in(frame_of([laser], "plain"), "plain", lamps=0, most=1)
    ends = found.strength_interval[0].numpy()
    assert ((ends[:, 0] < laser.channels) & (laser.channels < ends[:, 1])).all()
    assert (ends[:2, 1] - ends[:2, 0] < 0.05 * laser.channels[:2]).all()
    assert float(found.fwhm[0]) == pytest.approx(3e-9, rel=0.15)


@pytest.mark.slow
def test_a_strong_laser_behind_a_mask_is_found_among_its_clipped_pixels():
    laser = own.Laser((-9.0, 0.8), 634e-9, 1e4)
    found = found_in(frame_of([laser], "cubic", "leaves", seed=2), "cubic", lamps=0, most=1)
    assert (found.direction[0] / PIXEL).tolist() == pytest.approx(laser.spot, abs=0.1)
    assert float(found.wavelength[0]) == pytest.approx(laser.wavelength, abs=1e-9)


@pytest.fixture(scope="module")
def strong():
    """A strong laser, a frame with it, and what is found there."""
    laser = own.Laser((4.3, -7.8), 533e-9, 1e3)
    frame = frame_of([laser])
    return laser, frame, found_in(frame, "half_ring", lamps=1)


def test_a_strong_laser_is_found_where_it_is(strong):
    laser, _, found = strong
    assert int(found.number) == 1
    assert (found.direction[0] / PIXEL).tolist() == pytest.approx(laser.spot, abs=0.2)
    assert float(found.wavelength[0]) == pytest.approx(laser.wavelength, abs=5e-9)
    assert found.strength[0].tolist() == pytest.approx(laser.channels.tolist(), rel=0.1)
    assert found.identifiable[0].all()
    low, high = found.wavelength_interval[0].tolist()
    assert low < float(found.wavelength[0]) < high
    assert not found.identifiable[1:].any()
    assert not found.strength[1:].any()


def test_no_laser_is_found_where_there_is_none():
    found = found_in(frame_of([], seed=5), "half_ring", lamps=1)
    assert int(found.number) == 0
    assert not any(bool(x.any()) for x in found)


def test_the_glare_found_is_the_light_of_the_laser(strong):
    laser, frame, found = strong
    picture = tensor(frame.electrons).float()
    glare = restore.found_glare(found, pupil_of("half_ring"), picture, rank=1, **LENS).numpy()
    expected = laser.electrons("half_ring", (SIDE, SIDE))
    assert np.abs(glare - expected).max() < 0.03 * expected.max()
    none = restore.found_glare(found, pupil_of("half_ring"), picture, rank=2, **LENS)
    assert not none.any()
    rng = torch.Generator().manual_seed(1)
    nearby = restore.found_nearby(
        found, pupil_of("half_ring"), picture, rank=1, patterns=8, rng=rng, **LENS
    )
    spread = (nearby - torch.tensor(glare)).square().mean().sqrt()
    assert 0 < float(spread) < 0.2 * float(np.sqrt((glare**2).mean()))
    assert not restore.found_nearby(
        found, pupil_of("half_ring"), picture, rank=3, rng=rng, **LENS
    ).any()


def test_what_is_filled_comes_from_what_is_seen_and_a_smooth_picture_is_removed():
    y, x = torch.meshgrid(torch.arange(40.0), torch.arange(40.0), indexing="ij")
    slope = (3 * y + x)[None].double().repeat(3, 1, 1) + 100
    seen = torch.ones_like(slope)
    seen[:, 10:18, 12:19] = 0
    again = filled(torch.where(seen > 0, slope, torch.nan).nan_to_num(1e9), seen)
    assert float((again - slope).abs().max()) < 12
    use = filter_of(
        slope + torch.randn(slope.shape, generator=torch.Generator().manual_seed(0)),
        0 * slope + 1,
        seen,
    )
    assert float(use(torch.ones_like(slope)).abs().max()) < 1e-9


def test_other_frames_are_refused():
    given = inputs(frame_of([]), "half_ring")
    with pytest.raises(ValueError, match="3 colour channels"):
        restore.find_lasers(given[0][:2], given[1][:2], *given[2:], read_noise=own.READ, **LENS)
    with pytest.raises(ValueError, match="same channels"):
        restore.find_lasers(given[0][:1], given[1][:1], *given[2:], read_noise=own.READ, **LENS)
    with pytest.raises(ValueError, match="at least 20 a side"):
        restore.find_lasers(
            given[0][:, :19], given[1][:, :19], *given[2:], read_noise=own.READ, **LENS
        )
    other = given[3]._replace(wavelengths=BANDS.centres[:5], index=given[3].index[:5])
    with pytest.raises(ValueError, match="compute both from one `bands` step"):
        restore.find_lasers(*given[:3], other, *given[4:], read_noise=own.READ, **LENS)
    empty = found_in(frame_of([], side=32), "half_ring", lamps=0)
    with pytest.raises(ValueError, match="do not fit"):
        restore.found_glare(empty, given[3], given[0][:1], **LENS)


def grey(wavelength):
    """The response of a camera of one channel."""
    return (0.25 + 0.75 * np.exp(-0.5 * ((np.asarray(wavelength) - 550e-9) / 90e-9) ** 2))[None]


@pytest.mark.slow
def test_one_channel_tells_a_wavelength_by_the_scale_of_the_pattern_and_the_laser_is_removed(
    monkeypatch,
):
    monkeypatch.setattr(own, "response", grey)
    laser = own.Laser((4.3, -7.8), 533e-9, 1e3)
    given = inputs(frame_of([laser]), "half_ring")
    settings = {"read_noise": own.READ, **LENS}
    found = restore.find_lasers(*given, most=1, lamps=0, **settings)
    assert (found.direction[0] / PIXEL).tolist() == pytest.approx(laser.spot, abs=0.2)
    assert float(found.wavelength[0]) == pytest.approx(laser.wavelength, abs=5e-9)
    assert found.strength[0].tolist() == pytest.approx(laser.channels.tolist(), rel=0.1)
    text = restore.find_lasers.hooks.check(found, *given, **LENS)[0].text
    assert text.startswith("1 laser found: +4.")
    assert text.endswith("with one channel, wavelengths come from the scale of the patterns alone")
    electrons, clipped, psf, pupil, illuminant, responses, bands = given
    told = (psf, illuminant, responses, bands, clipped)
    glare = restore.found_glare(found, pupil, electrons, rank=1, **LENS)
    clean = inputs(frame_of([]), "half_ring")
    truth = restore.wiener(clean[0], *told[:-1], clean[1], read_noise=own.READ)
    blind = restore.wiener(electrons, *told, read_noise=own.READ)
    searched = restore.wiener(electrons, *told, [glare], read_noise=own.READ)
    far, near = (float((x - truth)[~clipped].square().mean()) for x in (blind, searched))
    assert near < 0.1 * far


@pytest.mark.slow
def test_one_channel_takes_no_lamp_for_a_laser(monkeypatch):
    monkeypatch.setattr(own, "response", grey)
    for mask in ("plain", "half_ring"):
        assert int(found_in(frame_of([], mask, "leaves", seed=21, lamps=2), mask).number) == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mask", "strength"),
    [("plain", 1e5), ("cubic", 1e3), ("half_ring", 1e2)],
)
def test_lasers_of_any_strength_are_found(mask, strength):
    laser = own.Laser((-11.6, 8.4), 588e-9, strength)
    found = found_in(frame_of([laser], mask, "leaves", seed=11), mask)
    assert int(found.number) == 1
    assert (found.direction[0] / PIXEL).tolist() == pytest.approx(laser.spot, abs=0.2)
    assert float(found.wavelength[0]) == pytest.approx(laser.wavelength, abs=5e-9)


@pytest.mark.slow
def test_two_lasers_are_two():
    lasers = [own.Laser((-20.6, 8.4), 588e-9, 1e3), own.Laser((15.2, -12.1), 470e-9, 2e3)]
    found = found_in(frame_of(lasers, seed=12), "half_ring")
    assert int(found.number) == 2
    assert sorted((found.wavelength[:2] * 1e9).tolist()) == pytest.approx([470, 588], abs=5)


@pytest.mark.slow
@pytest.mark.parametrize("mask", ["plain", "half_ring"])
def test_lamps_are_no_lasers(mask):
    assert int(found_in(frame_of([], mask, "leaves", seed=21, lamps=2), mask).number) == 0
