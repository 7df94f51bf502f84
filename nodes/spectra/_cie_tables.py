"""Tables of the CIE and measured spectra, from the package colour-science.

Wavelengths are in m, and all values are float64.
"""

import functools
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes._colour_science import colour_science
from neusee.nodes.values import Bands

_ROUNDING_NM = 1e-3  #: nm
_CHARTS = ("BabelColor Average", "ColorChecker N Ohta", "PMC", "ISO 17321-1")


class Table(NamedTuple):
    """A table of spectra that are sampled at the same wavelengths."""

    wavelengths: Tensor  #: (sample,) m, rising
    values: Tensor  #: (spectrum, sample)

    def at(self, centres: Tensor) -> Tensor:
        """Interpolate the spectra of the table linearly at the centres of spectral bands.

        The result is (spectrum, band), on the CPU. The spectra are constant beyond the first and
        last sample.
        """
        wavelengths = centres.detach().cpu().double()
        upper = torch.searchsorted(self.wavelengths, wavelengths).clamp(
            1, len(self.wavelengths) - 1
        )
        lower_wavelength, upper_wavelength = self.wavelengths[upper - 1], self.wavelengths[upper]
        share = ((wavelengths - lower_wavelength) / (upper_wavelength - lower_wavelength)).clamp(
            0, 1
        )
        return self.values[:, upper - 1] * (1 - share) + self.values[:, upper] * share

    def over(self, bands: Bands) -> Tensor:
        """Average each linearly interpolated spectrum of the table over each spectral band.

        The result is (spectrum, band). The spectra are 0 beyond the first and last sample.
        Colour-science samples spectra at points, which changes the energy of the lines of a lamp by
        10 %.
        """
        centres, half_width = (
            bands.centres.detach().cpu().double(),
            bands.widths.detach().cpu().double() / 2,
        )
        is_point = half_width <= 1e-13
        band_mean = (self._below(centres + half_width) - self._below(centres - half_width)) / (
            2 * half_width
        ).where(~is_point, 1.0)
        inside = (centres >= self.wavelengths[0]) & (centres <= self.wavelengths[-1])
        return torch.where(is_point, self.at(centres) * inside, band_mean)

    def _below(self, limits: Tensor) -> Tensor:
        """Return the exact integral of each linearly interpolated spectrum from the first sample
        to each limit.
        """
        steps = self.wavelengths.diff()
        areas = ((self.values[:, 1:] + self.values[:, :-1]) / 2 * steps).cumsum(1)
        full_steps = torch.cat([torch.zeros_like(areas[:, :1]), areas], 1)
        limits_in_range = limits.clamp(self.wavelengths[0], self.wavelengths[-1])
        step = (torch.searchsorted(self.wavelengths, limits_in_range) - 1).clamp(0, len(steps) - 1)
        last_step = (
            (self.values[:, step] + self.at(limits_in_range))
            / 2
            * (limits_in_range - self.wavelengths[step])
        )
        return full_steps[:, step] + last_step


@functools.cache
def observer() -> Table:
    """Return the colour-matching functions of the CIE 1931 observer, 360 to 830 nm in steps of 1
    nm.
    """
    colour = colour_science()

    return _table(colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"])


@functools.cache
def measured_camera(name: str) -> Table:
    """Return the measured spectral sensitivities of the red, green and blue channels of a
    camera.
    """
    colour = colour_science()

    return _table(colour.MSDS_CAMERA_SENSITIVITIES[f"{name} (NPL)"])


@functools.cache
def light(kind: str) -> Table:
    """Return the relative spectral power of a CIE illuminant."""
    colour = colour_science()

    return _table(colour.SDS_ILLUMINANTS[kind])


@functools.cache
def daylight(temperature: float) -> Table:
    """Return the relative spectral power of CIE daylight at a colour temperature from 4000 to 25
    000 K.
    """
    colour = colour_science()

    return _table(
        colour.sd_CIE_illuminant_D_series(colour.temperature.CCT_to_xy_CIE_D(temperature))
    )


@functools.cache
def mallett() -> Table:
    """Return the three basis reflectances of Mallett and Yuksel (2019), 380 to 780 nm in steps
    of 5 nm.
    """
    colour = colour_science()

    return _table(colour.recovery.MSDS_BASIS_FUNCTIONS_sRGB_MALLETT2019)


@functools.cache
def paints() -> tuple[Table, ...]:
    """Return the reflectances of 102 patches of colour charts, some of them measured only from
    400 to 700 nm.
    """
    colour = colour_science()

    patches: list[Table] = []
    for chart in _CHARTS:
        patches += map(_table, colour.SDS_COLOURCHECKERS[chart].values())
    return tuple(patches)


@functools.cache
def gamut_samples(name: str) -> Table:
    """Return the test reflectances of a colour-rendering index: 99 of CIE 2017, or 15 of NIST
    CQS 9.0.
    """
    colour = colour_science()

    if name == "CQS":
        return _table(
            colour.colorimetry.sds_and_msds_to_msds(
                list(colour.quality.SDS_VS["NIST CQS 9.0"].values())
            )
        )
    from colour.quality.cfi2017 import load_TCS_CIE2017

    return _table(load_TCS_CIE2017(colour.SpectralShape(380, 780, 5)))


def to_srgb(centres: Tensor) -> Tensor:
    """Return the matrix (3, band) from reflectance under D65 to linear sRGB, scaled so that
    white is (1, 1, 1).
    """
    colour = colour_science()

    from_xyz = torch.tensor(colour.RGB_COLOURSPACES["sRGB"].matrix_XYZ_to_RGB, dtype=torch.float64)
    matrix = from_xyz @ (observer().at(centres) * light("D65").at(centres))
    return matrix / matrix.sum(1, keepdim=True)


def require_range(
    wavelengths: Tensor,
    covered: Tensor | tuple[float, float],
    source: str,
    fix: str = "choose bands inside that range",
) -> None:
    """Raise ValueError if the wavelengths of bands lie outside the range of a table or file of
    spectra.

    ``covered`` has the range in m. ``source`` starts the message, such as "D65 is tabulated from".
    """
    low, high, first_nm, last_nm = (
        float(x) * 1e9 for x in (wavelengths.min(), wavelengths.max(), covered[0], covered[-1])
    )
    if low < first_nm - _ROUNDING_NM or high > last_nm + _ROUNDING_NM:
        raise ValueError(
            f"the bands reach from {low:.4g} to {high:.4g} nm, but {source} {first_nm:.4g} to"
            f" {last_nm:.4g} nm: {fix}"
        )


def _table(spectra: object) -> Table:
    """Return the spectra of an object of colour-science as a table."""
    import numpy as np

    values = np.atleast_2d(np.asarray(spectra.values).T)  # type: ignore[attr-defined]
    wavelengths = torch.tensor(np.asarray(spectra.wavelengths), dtype=torch.float64) / 1e9  # type: ignore[attr-defined]
    return Table(wavelengths, torch.tensor(values, dtype=torch.float64))
