"""A point-spread function from its definition alone, in NumPy, as a reference for the code under
test.

The pupil has samples at x_j = (j - (N - 1)/2) pitch, the sensor has pixels at x = i pixel_pitch
with i = 0 on the axis. A source at the angle a has its spot at f a. With A the amplitude that the
aperture passes, the field on the sensor is

    U(y, x) = sum over k, j of A exp(2 pi i (index height + path) / wavelength)
                                 exp(-2 pi i ((x - f a_x) x_j + (y - f a_y) y_k) / (wavelength f))

and the share of the clear pupil's light that a pixel gets, sampled at the pixel's middle, is

    |U|^2 (pitch pixel_pitch / (wavelength f))^2 / sum of A^2.

Phases are counted in turns and reduced to half a turn before a sine or a cosine is taken. All
numbers are taken as the binary fractions that they are: a float32 height enters without any
rounding. ``np.longdouble`` has 64 bits of mantissa on x86; where it has fewer, both functions lose
accuracy and nothing else.
"""

from fractions import Fraction

import numpy as np

RADIANS = np.longdouble("6.283185307179586476925286766559005768394")  # in one turn


def round_stop(samples, pitch, diameter):
    """Give the amplitude, 1 or 0, of a round stop: 1 where the middle of a sample lies within the
    radius or on it.

    The decision is one of whole numbers, for the pitch and the diameter (m) as they are written in
    decimals.
    """
    halves = 2 * np.arange(samples) - (samples - 1)  # positions in halves of a pitch
    limit = int((Fraction(str(float(diameter))) / Fraction(str(float(pitch)))) ** 2)
    return (halves[:, None] ** 2 + halves[None, :] ** 2 <= limit).astype(float)


def point_spread(
    height,
    path,
    aperture,
    index,
    wavelength,
    pitch,
    focal_length,
    pixel_pitch,
    points,
    angle=(0, 0),
):
    """Sum the intensity (share of the light per pixel) at single points, each sample by itself, in
    longdouble.

    ``height``, ``path`` (m) and ``aperture`` (amplitude) have the shape (v, u); ``index`` is that
    of the material less that of air. ``points`` are pairs (iy, ix) of pixels from the axis, whole
    or not; ``angle`` is (a_y, a_x) in rad.
    """
    amplitude = np.asarray(aperture, np.longdouble)
    open_to_light = amplitude != 0
    rows, columns = np.nonzero(open_to_light)
    amplitude = amplitude[open_to_light]
    surface = _surface(height, path, index, wavelength)[open_to_light]
    v, u = (_positions(samples, pitch) for samples in open_to_light.shape)
    intensity = []
    for iy, ix in points:
        fy = _frequency(iy, angle[0], wavelength, focal_length, pixel_pitch)
        fx = _frequency(ix, angle[1], wavelength, focal_length, pixel_pitch)
        turns = surface - _reduced(fy * v)[rows] - _reduced(fx * u)[columns]
        phase = RADIANS * _reduced(turns)
        # pairwise sums
        real, imaginary = np.sum(amplitude * np.cos(phase)), np.sum(amplitude * np.sin(phase))
        intensity.append(real**2 + imaginary**2)
    share = _share(amplitude, wavelength, pitch, focal_length, pixel_pitch)
    return np.array(intensity, np.longdouble) * share


def window(
    height, path, aperture, index, wavelength, pitch, focal_length, pixel_pitch, shape, angle=(0, 0)
):
    """Multiply the pupil by one matrix for each axis: the intensity (share of the light per pixel)
    of a whole window.

    ``shape`` is (ny, nx); the pixel (ny // 2, nx // 2) lies on the axis. The phases are those of
    `point_spread`, reduced in longdouble; the products are float64. The other arguments are those
    of `point_spread`.
    """
    amplitude = np.asarray(aperture, np.longdouble)
    field = amplitude * _phasor(_surface(height, path, index, wavelength))
    for_axis = []
    for samples, pixels, a in zip(field.shape, shape, angle, strict=True):
        i = np.arange(pixels) - pixels // 2
        frequency = _frequency(i, a, wavelength, focal_length, pixel_pitch)
        for_axis.append(
            _phasor(-frequency[:, None] * _positions(samples, pitch)[None, :]).astype(complex)
        )
    u = for_axis[0] @ field.astype(complex) @ for_axis[1].T
    return (u.real**2 + u.imag**2) * float(
        _share(amplitude, wavelength, pitch, focal_length, pixel_pitch)
    )


def _positions(samples, pitch):
    """Place the middles of the samples along one axis (m)."""
    return (2 * np.arange(samples, dtype=np.longdouble) - (samples - 1)) / 2 * np.longdouble(pitch)


def _surface(height, path, index, wavelength):
    """Count the turns that the mask and the path add at each sample, reduced."""
    height, path = np.asarray(height, np.longdouble), np.asarray(path, np.longdouble)
    wavelength = np.longdouble(wavelength)
    return _reduced(
        _reduced(np.longdouble(index) * height / wavelength) + _reduced(path / wavelength)
    )


def _frequency(i, a, wavelength, focal_length, pixel_pitch):
    """Count the turns per metre of pupil at pixel ``i`` from the axis, for a source at the angle
    ``a`` (rad).
    """
    f = np.longdouble(focal_length)
    distance = np.asarray(i, np.longdouble) * np.longdouble(pixel_pitch) - f * np.longdouble(a)
    return distance / (np.longdouble(wavelength) * f)


def _share(amplitude, wavelength, pitch, focal_length, pixel_pitch):
    """Give the factor from |U|^2 to the share of the clear pupil's light per pixel."""
    cell = (
        np.longdouble(pitch)
        * np.longdouble(pixel_pitch)
        / (np.longdouble(wavelength) * np.longdouble(focal_length))
    )
    return cell**2 / np.sum(amplitude**2)


def _reduced(turns):
    """Take away the whole turns: what is left is within half a turn, and exact."""
    return turns - np.rint(turns)


def _phasor(turns):
    """Give exp(2 pi i turns) in the precision of longdouble."""
    phase = RADIANS * _reduced(turns)
    return np.cos(phase) + 1j * np.sin(phase)
