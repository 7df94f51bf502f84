"""PSFs averaged over pixels, in NumPy and double precision, from the transfer function: no line
of the nodes.
"""

import numpy as np

SILICA = 0.46


def autocorrelation(field):
    """The sum over samples of field(j + l) conj(field(j)), with the lag 0 in the middle."""
    rows, columns = field.shape
    spectrum = np.abs(np.fft.fft2(field, (2 * rows, 2 * columns))) ** 2
    lags = np.fft.ifft2(spectrum)
    return np.fft.fftshift(lags)[1:, 1:]  # of 2 n lags the most negative has no pair


def averaged(field, light, alpha, shape, spot=(0.0, 0.0)):
    """The share of ``light`` in each pixel: a Fourier series of the lags, each averaged over the
    pixel by a sinc.

    ``alpha`` is in turns for each sample and pixel; ``spot`` in pixels from the middle pixel n //
    2.
    """
    lags = autocorrelation(field)
    axes = []
    for n, middle, count in zip(shape, spot, field.shape, strict=True):
        lag = np.arange(1 - count, count)
        pixels = np.arange(n) - n // 2 - middle
        axes.append(np.exp(-2j * np.pi * alpha * np.outer(pixels, lag)) * np.sinc(alpha * lag))
    return (axes[0] @ lags @ axes[1].T).real * alpha**2 / light


def by_points(field, light, alpha, shape, spot=(0.0, 0.0)):
    """The same by Gauss-Legendre points across each pixel, with the envelope of square pupil
    samples.
    """
    x, w = np.polynomial.legendre.leggauss(10 + int(3 * alpha * max(field.shape)))
    total = np.zeros(shape)
    j = [np.arange(count) - (count - 1) / 2 for count in field.shape]
    for y_at, y_weight in zip(x / 2, w / 2, strict=True):
        for x_at, x_weight in zip(x / 2, w / 2, strict=True):
            phasors = []
            for n, middle, shift, at in zip(shape, spot, (y_at, x_at), j, strict=True):
                pixels = np.arange(n) - n // 2 - middle + shift
                envelope = np.sinc(alpha * pixels)[:, None]
                phasors.append(np.exp(-2j * np.pi * alpha * np.outer(pixels, at)) * envelope)
            total += y_weight * x_weight * np.abs(phasors[0] @ field @ phasors[1].T) ** 2
    return total * alpha**2 / light


def disc(samples, columns=None):
    """A round aperture that touches the sides of its grid."""
    columns = columns or samples
    v = (np.arange(samples) - (samples - 1) / 2) / (samples / 2)
    u = (np.arange(columns) - (columns - 1) / 2) / (columns / 2)
    return (v[:, None] ** 2 + u**2 <= 1).astype(float)
