"""Bounds on what any mask can gain over a grey filter, or over a smaller stop, of the same peak."""

import math
from typing import Annotated, Any, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.metrics._filtered_picture import Light
from neusee.nodes.optics._lens import averaging, cut_off, round_lens, stop_width
from neusee.nodes.units import Electrons
from neusee.nodes.values import Psf

#: integral of the squared MTF of a round pupil over all frequencies, divided by the peak of its PSF
CLEAR = 0.45962
_ROUNDING = 1e-3  #: relative; the sampled lens band and float32


class ProtectionBounds(NamedTuple):
    """Values of a mask and their bounds, by band: each value is at most the bound beside it."""

    power: Tensor  #: (band,) mean of |OTF|**2 over the sampled frequencies
    power_bound: Tensor  #: (band,) LSR times the peak of the clear lens
    contrast: Tensor  #: (band,) mean of |OTF|**2 over the lens band, relative to the clear lens
    contrast_bound: Tensor  #: (band,) LSR / 0.4596
    #: (band,) mean NEQ over the lens band, relative to a grey filter of the same peak
    over_filter: Tensor
    over_filter_bound: Tensor  #: (band,)
    #: (band,) the same, relative to the better of the filter and the stop of the same peak
    over_both: Tensor
    over_both_bound: Tensor  #: (band,)
    log_neq: Tensor  #: (band,) mean over the lens band of the logarithm of the NEQ
    log_neq_bound: Tensor  #: (band,) logarithm of the largest mean NEQ

    def broken(self) -> list[str]:
        """Return the names of the values that exceed their bounds by more than sampling and
        rounding explain.
        """
        # the fields alternate: a value, and its bound
        pairs = [
            (name, getattr(self, name), getattr(self, f"{name}_bound"))
            for name in self._fields[::2]
        ]
        return [
            name
            for name, value, bound in pairs
            if bool((value - bound > _ROUNDING * (1 + bound.abs())).any())
        ]


@node(rtol=1e-6)
def protection_bounds(
    psf: Psf,
    *,
    electrons: Light,
    read_noise: Electrons,
    glare: Annotated[Electrons, Field(ge=0)] = 0.0,
) -> ProtectionBounds:
    """Compare a mask with the largest gain that any mask of its peak can have over a filter and a
    stop.

    The mean of |OTF|**2 over all frequencies is the sum of PSF**2, at most the peak L p0. A round
    pupil has c p0, with c = 0.4596. A mask therefore has at most L / c of the clear lens's mean
    MTF**2 over the whole lens band. Its mean NEQ over that band is at most (L n + s**2) / (c L (n +
    g + s**2)) times that of a grey filter of the same peak, with n electrons of the scene, g of
    glare and the read noise s. A stop of the diameter L**(1/4) has another such bound. Where pixels
    average, c and the peaks of lens and stop are those behind the pixels. The mean of a logarithm
    is at most the logarithm of the mean.

    Shapes: psf.intensity (band, y, x) -> ten of (band,) float64.
    Units:  electrons, read_noise and glare e- a pixel.
    Error:  1e-3: the lens band in whole frequencies. Assumed: one wavelength a band, PSF as shares
            of the light of the clear pupil (not renormalised within its window), a lens band that
            the pixels resolve, and means over the whole lens band. A part of the band has no such
            bound.
    Source: Parseval's theorem and Jensen's inequality; c by numerical integration of the MTF of a
            round pupil.
    """
    clear_peak = psf.clear_peak.double().cpu()
    peak = psf.intensity.amax((-2, -1)).double().cpu()
    cut_offs, sides = cut_off(psf).cpu(), averaging(psf).cpu()
    contrast_by_band = [
        _contrast(kernel.double(), float(cut))
        for kernel, cut in zip(psf.intensity.cpu(), cut_offs, strict=True)
    ]
    power, mean_square, log_contrast = (
        torch.stack(column) for column in zip(*contrast_by_band, strict=True)
    )
    lsr, noise = peak / clear_peak, electrons + glare + read_noise**2
    clear_lens = round_lens(cut_offs, sides)
    # for points the mean over the lens band is CLEAR over 4, the exact value
    clear_contrast = torch.where(sides > 0, clear_lens.power, CLEAR / 4)
    stop_width_share = stop_width(lsr, cut_offs, sides)
    stop_contrast = torch.where(
        sides > 0,
        stop_width_share**6 * round_lens(stop_width_share * cut_offs, sides).power,
        lsr**1.5 * CLEAR / 4,
    )
    # the filter of the same peak lowers the OTF by its transmittance, LSR
    filter_neq = _rival(lsr**2 * clear_contrast, lsr, electrons, read_noise)
    stop_neq = _rival(stop_contrast, stop_width_share.square(), electrons, read_noise)
    largest_contrast = lsr * clear_lens.peak / 4  # mean of |OTF|**2 over the lens band, by Parseval
    mask_neq, mask_bound = (
        electrons**2 * mean_square / noise,
        electrons**2 * largest_contrast / noise,
    )
    better_neq = torch.maximum(filter_neq, stop_neq)
    contrast = mean_square / clear_contrast
    scale = math.log(electrons**2 / noise)
    indicators = (
        power,
        peak,
        contrast,
        largest_contrast / clear_contrast,
        mask_neq / filter_neq,
        mask_bound / filter_neq,
        mask_neq / better_neq,
        mask_bound / better_neq,
    )
    return ProtectionBounds(*indicators, log_contrast + scale, mask_bound.log())


def _rival(power: Tensor, passed: Tensor, electrons: float, read_noise: float) -> Tensor:
    """Return the mean NEQ over the lens band of a clear pupil with the mean |OTF|**2 ``power``."""
    return electrons**2 * power / (electrons * passed + read_noise**2)


def stop_diameter(psf: Psf, lsr: float) -> Tensor:
    """Compute the diameter of the round stop that lowers the brightest pixel to a share ``lsr`` of
    that of the lens.

    Without an average over pixels it is lsr**(1/4). Pixels average more of the lens's peak away
    than of the wider spot of a stop, so that a stop of this diameter lowers the brightest pixel
    less than it should.

    Shapes: of psf the cut-off and the average over pixels (band,) -> (band,) float64.
    Units:  lsr 1; result 1, the diameter of the lens.
    Error:  1e-4, for a round aperture without aberrations.
    Raises: nothing.
    Source: the peak of a round pupil goes with its area squared, times what `nodes.optics` says
            pixels leave of it.
    """
    cuts, sides = cut_off(psf).cpu(), averaging(psf).cpu()
    return stop_width(torch.full_like(cuts, lsr), cuts, sides)


def _contrast(kernel: Tensor, cut: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return the mean of |OTF|**2 over all frequencies and over the lens band, and the mean of
    its logarithm there.
    """
    squared_otf = torch.fft.fft2(kernel).abs().square()
    fy, fx = (torch.fft.fftfreq(n, dtype=torch.float64) for n in kernel.shape)
    in_band = torch.hypot(fy[:, None], fx) <= cut
    return (
        squared_otf.mean(),
        squared_otf[in_band].mean(),
        squared_otf[in_band].clamp_min(1e-30).log().mean(),
    )


def largest_glare(lsr: float, electrons: float, read_noise: float) -> float:
    """Return the glare in e- a pixel above which no mask of an LSR has a higher mean NEQ than a
    filter of its peak.
    """
    noise = read_noise**2
    return (lsr * electrons + noise) / (CLEAR * lsr) - electrons - noise


@protection_bounds.check
def _(result: ProtectionBounds, *inputs: Any, **params: Any) -> list[Check]:
    broken = result.broken()
    gain, bound = float(result.over_both.mean()), float(result.over_both_bound.mean())
    return [
        Check(
            f"mean NEQ {gain:.3g} times that of the better of filter and stop, at most {bound:.3g}",
            not broken,
        )
    ]
