"""Detail: how well a tri-bar, an edge and a line of text are detected, by the ideal observer."""

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from neusee.nodes.metrics._filtered_picture import channel_psf
from neusee.nodes.values import Bands, Psf

_FINE = 8  #: samples of a target along each axis of a pixel, whose mean the pixel takes
_LETTERS = {
    "S": ("01110", "10001", "10000", "01110", "00001", "10001", "01110"),
    "T": ("11111", "00100", "00100", "00100", "00100", "00100", "00100"),
    "O": ("01110", "10001", "10001", "10001", "10001", "10001", "01110"),
    "P": ("11110", "10001", "10001", "11110", "10000", "10000", "10000"),
}  #: five by seven dots, as on a display
TEXT = "STOP"  #: the line of text
TARGETS = ("tri-bar", "edge", "text")


def detail_targets(size: float) -> dict[str, Tensor]:
    """Return the targets (y, x) of a height of ``size`` pixels as relative contrasts with mean 0,
    bright 1 above dark.

    tri-bar: three bars in place of the grey square that holds as much light. edge: a square that is
    bright on one half. text: the word "STOP" in letters of five by seven dots in place of an even
    grey line.
    """
    draw_target: Mapping[str, Callable[[float], Tensor]] = {
        "tri-bar": _bars,
        "edge": _edge,
        "text": _text,
    }
    return {name: _in_pixels(draw_target[name](size)) for name in TARGETS}


def _bars(size: float) -> Tensor:
    """Return three bright bars with two gaps as wide, in a square of ``size`` pixels, in fine
    samples.

    The mean is subtracted: an even grey square of the same light would not be detected.
    """
    sample_count = round(size * _FINE)
    columns = torch.arange(sample_count, dtype=torch.float64)
    is_bright = (torch.floor(5 * columns / sample_count) % 2 == 0).double()
    return is_bright.expand(sample_count, sample_count) - is_bright.mean()


def _edge(size: float) -> Tensor:
    """Return a dark and a bright half of a square of ``size`` pixels, in fine samples, of mean
    0.
    """
    sample_count = round(size * _FINE)
    step = torch.where(torch.arange(sample_count) < sample_count // 2, -0.5, 0.5).double()
    return step.expand(sample_count, sample_count) - step.mean()


def _text(size: float) -> Tensor:
    """Return the line of text with letters ``size`` pixels high, in fine samples, of mean 0."""
    columns = [[[int(dot) for dot in row] + [0] for row in _LETTERS[letter]] for letter in TEXT]
    # a column of space after each letter but the last
    dots = torch.cat([torch.tensor(rows, dtype=torch.float64) for rows in columns], 1)[:, :-1]
    row_count = round(size * _FINE)
    column_count = round(size * _FINE * dots.shape[1] / 7)
    rows, dot_columns = (
        torch.arange(n) * k // n for n, k in ((row_count, 7), (column_count, dots.shape[1]))
    )
    dots_in_samples = dots[rows][:, dot_columns]
    return dots_in_samples - dots_in_samples.mean()


def _in_pixels(fine: Tensor) -> Tensor:
    """Return the mean of the fine samples of each pixel, with zeros around a target that ends
    within a pixel.
    """
    sides = [-(-n // _FINE) * _FINE for n in fine.shape]
    padded = torch.zeros(*sides, dtype=torch.float64)
    padded[: fine.shape[0], : fine.shape[1]] = fine
    pixels: Tensor = padded.reshape(sides[0] // _FINE, _FINE, sides[1] // _FINE, _FINE).mean((1, 3))
    return pixels


def detail_energy(
    psf: Psf, illuminant: Tensor, responses: Tensor, bands: Bands, size: float
) -> dict[str, Tensor]:
    """Return the sum over pixels of the squared picture of each target, by channel: (channel,)
    float64.

    The picture of a target is the target behind the PSF. The window of the PSF must hold the
    target.
    """
    otf = torch.fft.fft2(channel_psf(psf, illuminant, responses, bands))
    energies = {}
    for name, target in detail_targets(size).items():
        if max(target.shape) > min(otf.shape[-2:]):
            text = (
                f"{name} of {tuple(target.shape)} pixels does not fit the PSF window"
                f" {tuple(otf.shape[-2:])}"
            )
            raise ValueError(f"{text}: choose smaller targets, or a wider window")
        spectrum = otf.abs() * torch.fft.fft2(target, s=otf.shape[-2:]).abs()
        energies[name] = spectrum.square().mean((-2, -1))  # Parseval
    return energies


def detection_snr(energy: Tensor, amplitude: float, contrast: float, noise: Tensor) -> Tensor:
    """Return the signal-to-noise ratio d' of the ideal observer, all channels together: the square
    sums over pixels.

    ``amplitude`` is the scene light in e- times the transmittance of a filter; ``noise`` (noise,
    channel) in e-**2. The observer knows target and place; d' is the distance of the two answers in
    standard deviations.

    Source: Barrett and Myers, Foundations of Image Science, section 13.2.8 (ideal observer for a
            known signal).
    """
    contributions = (amplitude * contrast) ** 2 * energy / noise
    return contributions.sum(-1).sqrt()
