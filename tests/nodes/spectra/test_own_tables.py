"""Tables of one's own: a mono camera, a light and a laser from CSV files with their units in the
header.
"""

import numpy as np
import pytest
import torch

from neusee.nodes import ParameterError
from neusee.nodes.sensor import expose
from neusee.nodes.spectra import bands, illuminant, line, line_table, mean_wavelength, responses
from neusee.nodes.values import Bands

QE = [
    (350, 20),
    (400, 45),
    (450, 60),
    (525, 69),
    (600, 62),
    (700, 45),
    (850, 19),
    (950, 7),
    (1050, 1.2),
    (1100, 0.2),
]
MONO = "# from a data sheet; read off the curve\nwavelength (nm),QE (%)\n" + "".join(
    f"{w},{q}\n" for w, q in QE
)
PLANCK, LIGHT, CHARGE = 6.62607015e-34, 299792458.0, 1.602176634e-19


@pytest.fixture
def write(tmp_path):
    """Write a file and return its path."""

    def write(text, name="mine.csv"):
        (tmp_path / name).write_text(text, encoding="utf-8")
        return tmp_path / name

    return write


def at(*nanometres, width=0.0):
    centres = torch.tensor(nanometres, dtype=torch.float64) * 1e-9
    return Bands(centres, torch.full_like(centres, width * 1e-9), torch.ones_like(centres))


# --- a camera -------------------------------------------------------------------------------------


def test_a_mono_camera_has_one_channel_relative_to_its_largest_qe(write):
    found = responses(at(350, 525, 562.5, 1064, 1100, 1101), camera=write(MONO))
    wanted = np.interp([350, 525, 562.5, 1064, 1100], *zip(*QE, strict=True)) / 69
    np.testing.assert_allclose(found[0].numpy(), [*wanted, 0.0], rtol=1e-12)
    known = responses.hooks.shape(at(*range(400, 406)), camera=write(MONO))
    assert found.shape == known.shape == (1, 6)


def test_photons_at_1064_nm_are_the_direct_sum(write):
    laser = line(wavelength=1064e-9, fwhm=4e-9)
    light = (
        torch.rand(5, 6, 7, generator=torch.Generator().manual_seed(3), dtype=torch.float64) * 1e-3
    )
    found = expose(
        light, laser, responses(laser, camera=write(MONO)), pixel_pitch=2.9e-6, exposure=0.1
    )
    wanted = np.zeros((6, 7))
    for centre, image in zip(laser.centres.tolist(), light.numpy(), strict=True):
        share = (
            np.interp(centre * 1e9, *zip(*QE, strict=True)) / 69
        )  # linear there: the mean is the value at the centre
        wanted += image * share * 0.1 * 2.9e-6**2 * centre / (PLANCK * LIGHT)
    np.testing.assert_allclose(found[0].numpy(), wanted, rtol=1e-9)
    assert wanted.min() > 1e-5


def test_percent_fraction_and_responsivity_are_one_camera(write):
    """The responsivity in A/W is QE times charge times wavelength, over Planck's constant times
    the speed of light.
    """
    fraction = "wavelength (um),quantum efficiency (1)\n" + "".join(
        f"{w / 1000!r},{q / 100!r}\n" for w, q in QE
    )
    amperes = "wavelength (nm),S (A/W)\n" + "".join(
        f"{w},{q / 100 * CHARGE * w * 1e-9 / (PLANCK * LIGHT)!r}\n" for w, q in QE
    )
    sampled = at(*(w for w, _ in QE))
    found = [
        responses(sampled, camera=write(t, f"{i}.csv"))
        for i, t in enumerate((MONO, fraction, amperes))
    ]
    torch.testing.assert_close(found[1], found[0], rtol=1e-12, atol=0)
    torch.testing.assert_close(found[2], found[0], rtol=1e-12, atol=0)
    for i, text in enumerate((MONO, fraction, amperes)):
        (note,) = responses.hooks.preflight(camera=write(text, f"{i}.csv"))
        assert "the largest QE is 0.69, at 525 nm" in note
        assert note.endswith("electrons are right with sensor.quantum_efficiency=0.69")


@pytest.mark.parametrize("efficiency", [0.3, 0.69])
def test_an_absolute_table_gives_its_electrons_whatever_the_efficiency_of_the_sensor(
    write, efficiency
):
    table, sampled = write(MONO), at(*(w for w, _ in QE))
    found = responses(sampled, camera=table, quantum_efficiency=efficiency)[0] * efficiency
    torch.testing.assert_close(
        found, torch.tensor([q / 100 for _, q in QE], dtype=torch.float64), rtol=1e-12, atol=0
    )
    (note,) = responses.hooks.preflight(camera=table, quantum_efficiency=efficiency)
    counts = "and the QE of the table counts for electrons, not sensor.quantum_efficiency=0.3"
    assert note.endswith(
        counts if efficiency == 0.3 else "at 525 nm, as sensor.quantum_efficiency=0.69"
    )


def test_a_relative_table_counts_with_the_efficiency_of_the_sensor(write):
    table = write("wavelength (nm),signal (1)\n400,3\n700,5\n")
    found = (responses(at(400, 700), camera=table, quantum_efficiency=each) for each in (None, 0.3))
    torch.testing.assert_close(*found, rtol=0, atol=0)


def test_a_relative_curve_says_nothing_of_electrons(write):
    assert (
        responses.hooks.preflight(camera=write("wavelength (nm),signal (1)\n400,3\n700,5\n")) == []
    )


def test_a_byte_order_mark_blank_lines_and_comments_do_not_count(write):
    text = (
        "\ufeff# a; comment with semicolons\n\nwavelength [nm],QE [%]\n# the blue"
        " end\n400,50\n\n700,100\n"
    )
    torch.testing.assert_close(
        responses(at(400, 550), camera=write(text))[0], torch.tensor([0.5, 0.75]).double()
    )


# --- a light --------------------------------------------------------------------------------------

LAMP = "wavelength (nm),power (W/nm)\n380,1\n500,3\n560,9\n780,0\n"


def test_a_light_is_not_known_beyond_its_table(write):
    with pytest.raises(
        ValueError, match=r"reach from 350 to 750 nm, but mine\.csv is tabulated from 380 to 780 nm"
    ):
        illuminant(bands(start=400e-9, stop=700e-9, count=4), kind=write(LAMP))


def test_a_light_within_its_table_is_the_mean_of_its_power(write):
    grid = bands(start=450e-9, stop=690e-9, count=4)
    found = illuminant(grid, kind=write(LAMP)).numpy()
    fine = (np.arange(100000) + 0.5) / 100000 * 80 - 40
    exact = np.array(
        [
            np.interp(c + fine, [380, 500, 560, 780], [1, 3, 9, 0]).mean()
            for c in (450, 530, 610, 690)
        ]
    )
    np.testing.assert_allclose(found, exact / exact.mean(), rtol=1e-8)
    (check,) = illuminant.hooks.check(torch.from_numpy(found), grid, kind=write(LAMP))
    assert check.text.startswith("mine.csv: relative power")


def test_a_light_that_is_too_short_is_refused_before_the_run(write):
    with pytest.raises(
        ParameterError, match="give a longer table, or choose bands inside that range"
    ) as error:
        illuminant.hooks.preflight(
            bands=bands(start=400e-9, stop=800e-9, count=5), kind=write(LAMP)
        )
    assert error.value.parameter == "kind"
    assert (
        illuminant.hooks.preflight(
            bands=bands(start=450e-9, stop=690e-9, count=4), kind=write(LAMP)
        )
        == []
    )


# --- a laser --------------------------------------------------------------------------------------


def test_lines_become_bands_with_the_share_of_their_power(write):
    text = "wavelength (nm),power (mW),fwhm (um)\n457.9,30,1e-5\n488,150,1e-5\n514.5,220,2e-5\n"
    found = line_table(file=write(text))
    np.testing.assert_allclose(found.centres.numpy(), [457.9e-9, 488e-9, 514.5e-9], rtol=1e-12)
    np.testing.assert_allclose(found.widths.numpy(), [1e-11, 1e-11, 2e-11], rtol=1e-12)
    np.testing.assert_allclose(found.weights.numpy(), np.array([30, 150, 220]) / 400, rtol=1e-12)


def test_one_line_alone_is_a_laser(write):
    found = line_table(file=write("wavelength (nm),share (%)\n1064,100\n"))
    assert found.centres.tolist() == [1064 * 1e-9]
    assert (found.widths.tolist(), found.weights.tolist()) == ([0.0], [1.0])


@pytest.mark.parametrize("count", [3, 5, 40])
def test_a_spectrum_is_divided_into_bands_with_its_exact_energy(write, count):
    """A Gaussian in steps of 0.01 nm: its tails of 5e-4 end 3.29 sigma from the centre, and the
    rest is an integral.
    """
    sigma, centre = 1.5, 808.0
    nm = np.arange(790, 826.005, 0.01)
    rows = "".join(f"{w:.2f},{np.exp(-(((w - centre) / sigma) ** 2) / 2):.9g}\n" for w in nm)
    file = write("wavelength (nm),power (mW/nm)\n" + rows)
    found = line_table(file=file, count=count)
    ends = (
        float(found.centres[0] - found.widths[0] / 2),
        float(found.centres[-1] + found.widths[-1] / 2),
    )
    np.testing.assert_allclose(
        ends, (centre + np.array([-1, 1]) * 3.290527 * sigma) * 1e-9, rtol=1e-7
    )
    edges = np.linspace(*ends, count + 1) * 1e9
    erf = np.vectorize(lambda x: float(torch.erf(torch.tensor(x, dtype=torch.float64))))
    energy = np.diff(erf((edges - centre) / (sigma * 2**0.5)))
    np.testing.assert_allclose(found.weights.numpy(), energy / energy.sum(), rtol=5e-5)
    (check,) = line_table.hooks.check(found, file=file, count=count)
    assert check.ok
    assert check.text == f"mine.csv in {count} bands: mean 808 nm, 808 nm in the table"


def test_bands_that_shift_the_mean_of_a_spectrum_are_told(write):
    text = "wavelength (nm),power (W/nm)\n" + "".join(
        f"{w},{9 if w in (801, 802) else 0.01}\n" for w in range(800, 900)
    )
    file = write(text)
    (few,), (many,) = (
        [*line_table.hooks.check(line_table(file=file, count=n), file=file, count=n)]
        for n in (1, 200)
    )
    assert not few.ok
    assert many.ok


def test_many_lines_are_told_to_cost_time(write):
    text = "wavelength (nm),power (mW)\n" + "".join(f"{500 + i},1\n" for i in range(51))
    (note,) = line_table.hooks.preflight(file=write(text))
    assert "each of the 51 lines takes a PSF of its own" in note
    assert mean_wavelength(line_table(file=write(text))) == pytest.approx(525e-9, rel=1e-12)
