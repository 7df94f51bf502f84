"""The sheet of EMVA 1288: published numbers, a camera of known truth in NumPy, and what frames
do not tell.
"""

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from neusee.nodes.calibrate import (
    Nonuniformity,
    defects,
    emva_sheet,
    general_model,
    profiles,
    reduce,
    saturation_point,
    spatial_series,
    spatial_variances,
    spectrogram,
    table,
    without_trend,
)
from neusee.nodes.calibrate import levels as joined
from neusee.nodes.values import Levels

DATA = Path(
    os.environ.get("NEUSEE_EMVA1288", Path(__file__).parents[3] / "../shared/data/emva1288")
)
#: doc/datasets/datasets_results.rst of the reference implementation of the working group (set 001,
#: release 3.0)
PUBLISHED = {
    "inverse_K": 3.56164319936, "K": 0.280769280926, "eta": 45.1356082834, "R": 0.126726922819,
    "sigma_y_dark": 3.07341849276, "sigma_d": 10.8980275235, "mu_p_min": 25.3600660517, "mu_p_sat": 30957.0,
    "mu_e_sat": 13972.6302563, "SNR_max": 118.205880802, "SNR_max_bit": 6.88515800189, "DR": 1220.69871336,
    "DR_bit": 10.2534914503, "LE_min": -0.615797581149, "LE_max": 0.480448332752, "mu_I_mean": 28.4074312749,
}  # fmt: skip
GAIN, EFFICIENCY, NOISE, OFFSET, CURRENT = 0.4, 0.55, 12.0, 60.0, 900.0
# DN and %
DSNU, PRNU = {"row": 1.0, "column": 1.5, "pixel": 2.0}, {"row": 0.4, "column": 0.3, "pixel": 1.0}
SHAPE, EXPOSURE, SERIES = (200, 240), 0.01, 24


def moments(photons, mean, variance, exposure=EXPOSURE):
    """Light levels of given moments without noise in them."""
    columns = np.broadcast_arrays(np.asarray(photons, float), exposure, 1e6, mean, variance, 1e6)
    none = torch.zeros(0, dtype=torch.float64)
    return Levels(*(torch.tensor(np.array(x)) for x in columns), none.long(), none, none)


def ideal(photons, **changes):
    """A linear camera without any noise in its moments; saturated levels have no variance."""
    of = {"gain": GAIN, "noise": NOISE, "top": 4000.0} | changes
    electrons = EFFICIENCY * np.asarray(photons, float)
    mean = OFFSET + of["gain"] * electrons
    variance = of["gain"] ** 2 * (of["noise"] ** 2 + electrons) + 1 / 12
    return moments(photons, np.minimum(mean, of["top"]), np.where(mean < of["top"], variance, 0.01))


def pattern(rng, parts):
    row, column = rng.standard_normal((SHAPE[0], 1)), rng.standard_normal((1, SHAPE[1]))
    return sum(
        parts[name] * x
        for name, x in (("row", row), ("column", column), ("pixel", rng.standard_normal(SHAPE)))
    )


def camera(rng, photons, frames, exposure=EXPOSURE, patterns=(0.0, 0.0)):
    """Frames of a camera in NumPy alone, which saturates at 4095 DN."""
    dark, response = patterns
    electrons = rng.poisson(
        EFFICIENCY * photons * (1 + response / 100) + CURRENT * exposure, (frames, *SHAPE)
    )
    numbers = OFFSET + dark + GAIN * (electrons + NOISE * rng.standard_normal(electrons.shape))
    return torch.from_numpy(np.clip(np.round(numbers), 0, 4095).astype(np.int32))


@pytest.fixture(scope="module")
def known():
    """A sheet of simulated frames of known truth."""
    rng = np.random.default_rng(5)
    patterns = pattern(rng, DSNU), pattern(rng, PRNU)
    grid = np.linspace(0, 21000, 22)
    pairs = [(p, EXPOSURE) for p in grid] + [(0.0, t) for t in (0.11, 0.21, 0.31)]
    parts = [
        reduce(camera(rng, p, 2, t, patterns), photons=p, exposure=t, scatter="steady")
        for p, t in pairs
    ]
    series = [
        spatial_series(p, EXPOSURE, camera(rng, p, SERIES, patterns=patterns))
        for p in (0.0, 9000.0)
    ]
    return emva_sheet(joined(parts), Nonuniformity(*series))


@pytest.mark.parametrize(
    ("key", "truth", "within"),
    [
        ("K", GAIN, 0.006),  # of 96 000 pixels and 12 levels
        ("eta", 100 * EFFICIENCY, 0.006),
        ("sigma_d", NOISE, 0.01),
        ("mu_y_dark", OFFSET + GAIN * CURRENT * EXPOSURE, 0.005),
        ("mu_p_min", ((NOISE**2 + CURRENT * 0 + 1 / 12 / GAIN**2) ** 0.5 + 0.5) / EFFICIENCY, 0.02),
        # of the level at 18000 the converter cuts 4 %, which lowers its variance
        ("mu_p_sat", 17000.0, 0.0),
        ("mu_e_sat", 9350.0, 0.006),
        ("SNR_max", 9350.0**0.5, 0.004),
        ("mu_I_mean", CURRENT, 0.01),
        ("mu_I_var", CURRENT, 0.1),
        ("DSNU1288_DN", 7.25**0.5, 0.05),
        ("DSNU1288_row_DN", 1.0, 0.15),  # 200 rows: 5 % each standard error
        ("DSNU1288_column_DN", 1.5, 0.15),
        ("DSNU1288_pixel_DN", 2.0, 0.02),
        ("DSNU1288_pixel", 5.0, 0.02),
        ("PRNU1288", 1.25**0.5, 0.05),
        ("PRNU1288_row", 0.4, 0.15),
        ("PRNU1288_column", 0.3, 0.2),
        ("PRNU1288_pixel", 1.0, 0.02),
    ],
)
def test_a_camera_of_known_truth(known, key, truth, within):
    assert known[key].bound == ""
    assert known[key].reason == ""
    assert known[key].value == pytest.approx(truth, rel=max(within, 1e-12))


def test_the_known_camera_is_linear(known):
    assert -0.2 < known["LE_min"].value < 0 < known["LE_max"].value < 0.2


def test_published_numbers_of_the_first_reference_set():
    file = DATA / "EMVA1288_ReferenceSet_001_CCD_12Bit_moments.csv"
    if not file.is_file():
        pytest.skip(f"no {file.name} in {DATA}: set NEUSEE_EMVA1288")
    names = {
        "pixels": "npix",
        "mean": "mean_DN",
        "variance": "temporal_var_DN2",
        "exposure": "exposure_ns",
    }
    found = emva_sheet(table(file=file, **names, drift="mean_diff", exposure_unit="ns"))
    assert {key: found[key].value for key in PUBLISHED} == pytest.approx(PUBLISHED, rel=1e-5)
    assert found.transfer.saturation == 36


def test_moments_without_noise_give_the_camera_back():
    found = emva_sheet(ideal(np.linspace(0, 20000, 41)))
    assert found["K"].value == pytest.approx(GAIN, rel=1e-12)
    assert found["eta"].value == pytest.approx(100 * EFFICIENCY, rel=1e-12)
    assert found["sigma_d"].value == pytest.approx(NOISE, rel=1e-12)
    assert abs(found["LE_max"].value) < 1e-10
    assert found["DR_dB"].value == pytest.approx(
        20 * np.log10(found["mu_p_sat"].value / found["mu_p_min"].value)
    )


def test_linearity_error_is_the_weighted_fit_of_the_standard():
    photons = np.linspace(0, 17500, 36)
    levels = ideal(photons)
    bent = levels._replace(mean=levels.mean * (1 - 0.03 * (levels.mean / 4095) ** 2))
    found = emva_sheet(bent)
    y = bent.mean.numpy()[1:] - bent.mean.numpy()[0]
    used = (y >= 0.05 * y[-1]) & (y <= 0.95 * y[-1])
    line = np.polynomial.Polynomial.fit(photons[1:][used], y[used], 1, w=1 / y[used])
    apart = 100 * (y[used] / line(photons[1:][used]) - 1)
    assert (found["LE_min"].value, found["LE_max"].value) == pytest.approx(
        (apart.min(), apart.max()), rel=1e-8
    )


def test_saturation_is_the_last_peak_and_no_noise_of_saturated_levels():
    assert saturation_point(np.array([1.0, 2, 3, 4, 3.9, 4.1, 1, 0])) == 5
    assert saturation_point(np.array([1.0, 2, 3, 4, 0, 0, 0.1, 0.05])) == 3
    assert saturation_point(np.array([1.0, 2, 3, 4])) == 3


def test_without_saturation_there_are_limits_only():
    found = emva_sheet(ideal(np.linspace(0, 9000, 19)))
    assert {found[key].bound for key in ("mu_p_sat", "mu_e_sat", "SNR_max", "DR", "DR_dB")} == {">"}
    assert "saturation was not reached" in found["mu_p_sat"].reason
    assert found["K"].bound == ""


def test_dark_noise_below_rounding_is_a_limit():
    found = emva_sheet(ideal(np.linspace(0, 20000, 41), noise=0.5))
    assert (found["sigma_y_dark"].value, found["sigma_y_dark"].bound) == (
        pytest.approx(0.24**0.5),
        "<",
    )
    assert found["sigma_d"].value == pytest.approx((0.24 - 1 / 12) ** 0.5 / GAIN, rel=1e-9)
    assert [found[key].bound for key in ("sigma_d", "mu_p_min", "mu_e_min", "DR")] == [
        "<",
        "<",
        "<",
        ">",
    ]
    assert "below the 0.49 DN that the standard sets" in found["sigma_d"].reason


def test_without_a_gain_nothing_is_told_in_electrons():
    levels = ideal(np.linspace(0, 20000, 41))
    series = spatial_series(0.0, EXPOSURE, torch.arange(100).reshape(1, 10, 10).expand(4, 10, 10))
    found = emva_sheet(
        levels._replace(variance=torch.full((41,), 5.0)), Nonuniformity(series, None)
    )
    in_electrons = [
        q for q in found.quantities if "e-" in q.unit or q.key.startswith(("SNR", "DR", "K", "eta"))
    ]
    in_electrons = [q for q in in_electrons if not q.key.endswith("general")]
    assert len(in_electrons) == 19
    assert {(q.value, q.text, q.reason != "") for q in in_electrons} == {
        (None, "not measured", True)
    }
    assert found["DSNU1288_DN"].value > 0


def test_without_photons_gain_and_noise_remain():
    found = emva_sheet(ideal(np.linspace(0, 20000, 41)), photons_told=False)
    assert [found[key].value for key in ("eta", "R", "mu_p_min", "mu_p_sat")] == [None] * 4
    assert "photons of the levels are not told" in found["eta"].reason
    assert found["mu_e_sat"].value == pytest.approx(EFFICIENCY * 17500, rel=1e-9)
    assert found["DR"].value > 0


def test_what_needs_more_frames_says_so():
    found = emva_sheet(ideal([0, 1000, 2000, 20000]))
    assert "1 exposure: three" in found["mu_I_mean"].reason
    assert all("series" in found[key].reason for key in ("DSNU1288", "PRNU1288", "PRNU1288_row"))
    with pytest.raises(ValueError, match="needs dark frames"):
        emva_sheet(ideal([1000, 2000]))
    with pytest.raises(ValueError, match="there is 1: give two"):
        emva_sheet(ideal([0, 2000]))


def test_a_dark_current_within_its_error_is_not_told():
    jumps = np.resize([1.0, -1.0], 9)
    darks = moments(np.zeros(9), OFFSET + jumps, 40 + jumps, np.arange(9.0))
    found = emva_sheet(joined([ideal(np.linspace(500, 20000, 40)), darks]))
    assert ["no rise with the exposure" in found[k].reason for k in ("mu_I_mean", "mu_I_var")] == [
        True,
        True,
    ]


def test_parts_of_the_spatial_variance_solve_the_equations_of_the_standard():
    rng = np.random.default_rng(3)
    frames = (
        rng.integers(0, 50, (5, 12, 20))
        + 9 * rng.integers(0, 5, (12, 1))
        + 4 * rng.integers(0, 5, (1, 20))
    )
    image, left = frames.mean(0), frames.var(0, ddof=1).mean() / 5
    total = image.var(ddof=1) - left
    columns, rows = image.mean(0).var() - left / 12, image.mean(1).var() - left / 20
    equations = [
        [1, 1, 1],
        [1, 0, 1 / 20],
        [0, 1, 1 / 12],
    ]  # of row, column and pixel: total, means of rows, of columns
    found = spatial_variances(spatial_series(1.0, 1.0, torch.from_numpy(frames)))
    assert found[1:] == pytest.approx(np.linalg.solve(equations, [total, rows, columns]), rel=1e-10)
    assert found.total == pytest.approx(total, rel=1e-12)


def test_a_series_is_of_two_frames_or_more_of_one_size():
    with pytest.raises(ValueError, match="1 frame"):
        spatial_series(0.0, 1.0, torch.zeros(1, 9, 9))
    with pytest.raises(ValueError, match="are no series"):
        spatial_series(0.0, 1.0, [torch.zeros(9, 9), torch.zeros(9, 8)])
    with pytest.raises(ValueError, match="too small"):
        spatial_series(0.0, 1.0, torch.zeros(2, 4, 9))


def test_spectrograms_of_noise_and_of_a_wave():
    rng = np.random.default_rng(1)
    image = 3.0 * rng.standard_normal((400, 200)) + 20 * np.sin(2 * np.pi * 0.1 * np.arange(200))
    flat, wave = spectrogram(image, vertical=True), spectrogram(image)
    assert np.argmax(wave.amplitude) == 20
    assert wave.frequency[20] == pytest.approx(0.1)
    assert wave.amplitude[20] == pytest.approx(20 * 200**0.5 / 2, rel=0.02)
    assert np.median(np.delete(wave.amplitude, (0, 20))) == pytest.approx(3.0, rel=0.02)
    assert (flat.frequency[-1], len(flat.frequency)) == (0.5, 201)
    # Parseval
    assert (np.delete(wave.amplitude, 0) ** 2 * 2).sum() / 200 == pytest.approx(
        image.var(), rel=0.02
    )


def test_profiles_are_lines_of_the_frame():
    image = np.arange(48.0).reshape(6, 8)
    rows, columns = profiles(image), profiles(image, vertical=True)
    assert [x.tolist() for x in rows] == [
        [*range(24, 32)],
        [*range(20, 28)],
        [*range(8)],
        [*range(40, 48)],
    ]
    assert columns.middle.tolist() == [4, 12, 20, 28, 36, 44]
    assert columns.greatest.tolist() == [7, 15, 23, 31, 39, 47]


def test_defects_stand_out_of_the_histogram():
    rng = np.random.default_rng(2)
    total = np.round(40 * rng.standard_normal((90, 110)) + 5000).astype(np.int64)
    total[4, 7] += 3000
    found = defects(total, 0.1)
    assert found.pixels.sum() == total.size
    assert len(found.pixels) <= 256
    assert found.deviation[-1] == pytest.approx(300, abs=15)
    assert found.pixels[-1] == 1
    assert found.normal.sum() == pytest.approx(total.size, rel=0.02)
    apart = np.abs(total - total.mean())
    beyond = [100 * (apart >= 10 * d).mean() for d in found.distance[:-1]]
    assert found.beyond[:-1].tolist() == pytest.approx(beyond, rel=1e-12)
    assert found.beyond[0] == 100
    assert found.beyond[-1] == pytest.approx(100 / total.size)


def test_uneven_light_is_no_defect():
    y, x = np.mgrid[:30, :40]
    slope = 7 * y + 3 * x
    slope[10, 20] += 50
    assert without_trend(slope).shape == (26, 36)
    assert np.unique(without_trend(slope)).tolist() == [-50, 0, 24 * 50]


def dsnu_in_numbers(frames):
    """DSNU1288 in DN of dark frames: in total, and of rows, columns and pixels."""
    series = Nonuniformity(spatial_series(0.0, 1.0, frames), None)
    quantities = emva_sheet(ideal([0, 1000, 2000]), series).quantities
    return [q for q in quantities if q.key.startswith("DSNU1288") and q.unit == "DN"]


def test_a_nonuniformity_within_chance_is_a_limit():
    rng = np.random.default_rng(11)
    stated, most = 0, 0.0
    for _ in range(60):
        frames = torch.from_numpy(
            np.round(100 + 10 * rng.standard_normal((3, 24, 32))).astype(np.int64)
        )
        found = dsnu_in_numbers(frames)
        stated += sum(q.bound == "" for q in found)
        most = max(most, *(q.value for q in found))
    assert stated <= 0.1 * 4 * 60  # two standard errors of a variance from few rows
    assert most < 10 / 3**0.5  # of a single averaged pixel


def test_a_nonuniformity_beyond_chance_is_stated():
    rng = np.random.default_rng(12)
    image = 100 + 5 * rng.standard_normal((24, 32))
    frames = torch.from_numpy(
        np.round(image + 4 * rng.standard_normal((9, 24, 32))).astype(np.int64)
    )
    total, _, _, pixel = dsnu_in_numbers(frames)
    assert (total.bound, pixel.bound) == ("", "")
    assert (total.value, pixel.value) == (pytest.approx(5, rel=0.1), pytest.approx(5, rel=0.1))


def test_the_general_model_of_a_linear_camera_is_the_linear_one():
    found = emva_sheet(ideal(np.linspace(0, 20000, 41)))
    noise = NOISE**2 + 1 / 12 / GAIN**2
    least = (0.5 + np.sqrt(0.25 + noise)) / EFFICIENCY
    most = EFFICIENCY * found["mu_p_sat"].value
    assert found["mu_p_min_general"].value == pytest.approx(least, rel=1e-9)
    assert found["SNR_max_general"].value == pytest.approx(
        20 * np.log10(most / np.sqrt(most + noise)), rel=1e-9
    )
    assert found["DR_general"].value == pytest.approx(
        20 * np.log10(most / EFFICIENCY / least), rel=1e-9
    )


def test_the_general_model_of_a_bent_camera_has_the_slope_at_each_level():
    photons = np.linspace(0, 17000, 41)
    levels = ideal(photons)
    bend = 0.4 / 17000  # the signal is lower by 40 % of the line at the end
    bent = levels._replace(mean=OFFSET + (levels.mean - OFFSET) * (1 - bend * levels.photons))
    found = general_model(emva_sheet(bent).transfer)
    slope = GAIN * EFFICIENCY * (1 - 2 * bend * photons)
    assert found.slope == pytest.approx(slope, rel=1e-9)
    assert found.ratio == pytest.approx(
        (photons * slope / np.sqrt(levels.variance.numpy()))[1:], rel=1e-9
    )


def test_the_general_model_needs_levels():
    found = emva_sheet(ideal([0, 1000, 20000]))
    assert {found[key].value for key in ("mu_p_min_general", "SNR_max_general", "DR_general")} == {
        None
    }
    dim = emva_sheet(ideal(np.linspace(0, 9000, 10), noise=0.4), photons_told=False)
    assert (
        dim["mu_p_min_general"].value,
        dim["DR_general"].bound,
        dim["SNR_max_general"].bound,
    ) == (None, ">", ">")


def test_light_that_scatters_tells_no_slope_of_a_few_levels():
    rng = np.random.default_rng(7)
    levels = ideal(np.linspace(0, 20000, 31))
    truth = emva_sheet(levels)["SNR_max_general"].value
    for scatter, told in ((1e-4, True), (0.02, False)):
        light = OFFSET + (levels.mean - OFFSET) * (
            1 + scatter * torch.from_numpy(rng.standard_normal(31))
        )
        found = emva_sheet(levels._replace(mean=light.clamp(max=4000.0)))["SNR_max_general"]
        assert (found.value is not None) == told
        assert (
            found.value == pytest.approx(truth, abs=0.05)
            if told
            else "the light scatters" in found.reason
        )
