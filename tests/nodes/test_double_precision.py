"""Every node that offers float64 against a sum in longdouble that shares no line with it: 1e-11 of
the largest value.

Each reference is written in NumPy from the formula in the node's docstring. A float32 anywhere on
the way, such as that of an integer tensor times a Python number, misses the limit by four decimal
places.
"""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from neusee.nodes import doe, flare, laser, losses, metrics, optics, restore, scene, sensor, spectra
from neusee.nodes.values import Bands, LowRankCube, Psf, Pupil, Stop
from tests.nodes.optics.independent_psf import window
from tests.nodes.test_contract import NODES

LIMIT = 1e-11
L = np.longdouble
PI = L("3.14159265358979323846264338327950288")
TURN = 2 * PI


def draw(*shape, seed=0, low=0.1):
    return torch.tensor(low + np.random.default_rng([seed, *shape]).random(shape))


def exact(x):
    return np.asarray(x.numpy() if isinstance(x, torch.Tensor) else x, L)


# --- inputs, all float64 --------------------------------------------------------------------------

CENTRES = torch.tensor([412.3e-9, 487.9e-9, 561.7e-9, 688.1e-9], dtype=torch.float64)
BANDS = Bands(
    CENTRES,
    torch.full((4,), 9.7e-9, dtype=torch.float64),
    torch.tensor([0.1, 0.2, 0.3, 0.4]).double(),
)
STOP = Stop(torch.tensor(24), torch.tensor(3.3e-4).double(), torch.tensor(7.9e-3).double())
SCENE, IMAGE = draw(4, 11, 9), draw(4, 11, 9, seed=1)
PSF = Psf(draw(4, 7, 8) / 60, draw(4))
WIDE = Psf(draw(4, 12, 13) / 160, draw(4, low=0.02) / 4)
RESPONSES, ILLUMINANT, LEVEL, ROWS = draw(3, 4), draw(4, seed=2), 1e3 * draw(4, seed=3), draw(2, 4)
PLANES, BASIS = draw(3, 11, 9), draw(4, 3)
LOW_RANK = LowRankCube(
    PLANES, BASIS, torch.tensor([9.0, 9.0, 9.0, 0.0]).double()[:, None].expand(4, 4)
)
PICTURE, TRUTH = draw(3, 13, 12), draw(3, 13, 12, seed=1)
HEIGHT = 140e-6 * draw(24, 24)
DISC = torch.tensor(np.hypot(*np.meshgrid(*[np.arange(24) - 11.5] * 2)) <= 11.5).double()
INDEX = torch.tensor([0.4683, 0.4629, 0.4596, 0.4555], dtype=torch.float64)
PUPIL = Pupil(
    DISC,
    DISC * draw(24, 24, low=0.0),
    HEIGHT,
    3e-6 * draw(24, 24, seed=4),
    INDEX,
    CENTRES,
    STOP.pitch,
)
WELL = {"full_well": 25500.0, "quantum_efficiency": 0.56, "pixel_pitch": 2.9e-6, "exposure": 0.013}
SHUTTER = {"pixel_pitch": 2.9e-6, "exposure": 0.013}
FILLS = L(25500.0) / L(0.56)
AREA = L(0.013) * L(2.9e-6) ** 2


# --- references -----------------------------------------------------------------------------------


def photons_per_joule(centres):
    return exact(centres) / (L(6.62607015e-34) * L(299792458.0))


def dft(x):
    """Give the Fourier sum of a picture, sum x exp(-2 pi i (j k / n)), with whole turns taken
    away first.
    """
    for axis in (-2, -1):
        n = x.shape[axis]
        turns = np.outer(np.arange(n), np.arange(n)) % n / L(n)
        kernel = np.cos(TURN * turns) - 1j * np.sin(TURN * turns)
        x = np.moveaxis(np.tensordot(kernel, x, (1, axis)), 0, axis)
    return x


def frequencies(shape):
    """Give the spatial frequencies of `dft` in cycles per pixel."""
    y, x = ((np.arange(n) + n // 2) % n - n // 2 for n in shape)
    return y[:, None] / L(shape[0]), x[None, :] / L(shape[1])


def half(size):
    return slice(0, size // 2 + 1)


def psf_of(pupil, **camera):
    found = []
    for index, wavelength in zip(pupil.index, pupil.wavelengths, strict=True):
        one = window(
            pupil.height.numpy(),
            pupil.path.numpy(),
            pupil.amplitude.numpy(),
            float(index),
            float(wavelength),
            float(pupil.pitch),
            camera["focal_length"],
            camera["pixel_pitch"],
            camera["shape"],
            camera["angle"],
        )
        found.append(
            one * float((exact(pupil.amplitude) ** 2).sum() / (exact(pupil.aperture) ** 2).sum())
        )
    return np.stack(found)


def pupil_path(height, index, bands, stop, **terms):
    n, scale = int(stop.samples), 2 * exact(stop.pitch) / exact(stop.diameter)
    line = (np.arange(n) - L(n - 1) / 2) * scale
    v, u = line[:, None], line[None, :]
    square = v**2 + u**2
    modes = {
        4: np.sqrt(L(3)) * (2 * square - 1),
        7: np.sqrt(L(8)) * (3 * square - 2) * v,
        9: np.sqrt(L(8)) * (3 * u**2 * v - v**3),
        11: np.sqrt(L(5)) * (6 * square**2 - 6 * square + 1),
    }
    path = L(terms["defocus"]) * L(550e-9) * square + sum(
        L(c) * modes[j] for j, c in terms["aberrations"].items()
    )
    return np.where(square <= 1, path, 0)


def convolved(radiance, psf, border="zero"):
    scene, kernel = exact(radiance), exact(psf.intensity)
    (y, x), (m, n) = scene.shape[1:], kernel.shape[1:]
    result = np.zeros_like(scene)
    for i in range(-m, y + m):
        for j in range(-n, x + n):
            if border == "zero" and not (0 <= i < y and 0 <= j < x):
                continue
            light = scene[:, mirrored(i, y), mirrored(j, x)]
            for p in range(max(0, i - m // 2), min(y, i - m // 2 + m)):
                for q in range(max(0, j - n // 2), min(x, j - n // 2 + n)):
                    result[:, p, q] += light * kernel[:, p - i + m // 2, q - j + n // 2]
    return result


def mirrored(i, n):
    i = i % (2 * n - 2)
    return min(i, 2 * n - 2 - i)


def summed(radiance, psf, rows, **how):
    cube = np.tensordot(exact(radiance.basis), exact(radiance.planes), 1)
    return np.tensordot(exact(rows), convolved(cube, psf, **how), 1)


def saturating(bands):
    return FILLS / photons_per_joule(bands.centres) / AREA


def spot(psf, bands, *, strength, **_):
    unit = (exact(bands.weights) * exact(psf.clear_peak) / saturating(bands)).sum()
    return exact(psf.intensity) * (L(strength) * exact(bands.weights) / unit)[:, None, None]


def ghost_light(spot, *_, energy, **__):
    return L(energy) * exact(spot).sum()


def share(psf, radiance):
    return convolved(radiance, psf).sum((1, 2)) / exact(radiance).sum((1, 2))


def outside(psf, pupil):
    passed = (exact(pupil.amplitude) ** 2).sum() / (exact(pupil.aperture) ** 2).sum()
    return 1 - exact(psf.intensity).sum((1, 2)) / passed


def contrasts(psf, up_to=1):
    """Yield the contrast of each band at the half spectrum's frequencies that the clear aperture
    passes.
    """
    for kernel, peak in zip(exact(psf.intensity), exact(psf.clear_peak), strict=True):
        fy, fx = (f[..., half(kernel.shape[1])] for f in frequencies(kernel.shape))
        otf = dft(kernel)[:, half(kernel.shape[1])]
        radius = np.sqrt(fy**2 + np.abs(fx) ** 2)
        yield (np.abs(otf) / np.abs(otf[0, 0]))[radius <= min(np.sqrt(4 * peak / PI), L(up_to))]


def mtf_rms(psf):
    return np.array([np.sqrt((c**2).mean()) for c in contrasts(psf)])


def contrast_loss(psf, *, floor, up_to):
    return sum(-np.log(np.sqrt(c**2 + L(floor) ** 2)).mean() for c in contrasts(psf, up_to))


def encircled(psf, *, pixel_pitch, radius):
    y, x = ((np.arange(n) - n // 2) * L(pixel_pitch) for n in psf.intensity.shape[1:])
    return (exact(psf.intensity) * (np.sqrt(y[:, None] ** 2 + x[None, :] ** 2) <= L(radius))).sum(
        (1, 2)
    )


def limits(psf):
    kernel, peak = exact(psf.intensity), exact(psf.clear_peak)
    light, top = kernel.sum((1, 2)), kernel.max((1, 2))
    fy, fx = frequencies(kernel.shape[1:])
    passed = [(np.sqrt(fy**2 + fx**2) <= np.sqrt(4 * p / PI)).mean(dtype=L) for p in peak]
    bound = np.sqrt(top / light)
    rows = [
        light / (kernel[0].size * peak),
        np.sqrt((kernel**2).sum((1, 2))) / light,
        bound,
        bound / np.sqrt(passed),
    ]
    return np.stack([*rows, np.sqrt(L(2)) * rows[3]])


def wells(image, bands, level, spots, lines, **_):
    each = [(exact(image) * (exact(level) / saturating(bands))[:, None, None]).sum(0)]
    each += [
        (exact(s) / saturating(b)[:, None, None]).sum(0) for s, b in zip(spots, lines, strict=True)
    ]
    return sum(each).max()


def p_norm(psf, *, power, log):
    ratio = exact(psf.intensity) / exact(psf.clear_peak)[:, None, None]
    peaks = (ratio ** L(power)).sum((1, 2)) ** (1 / L(power))
    return np.log(peaks + L(1e-30)).sum() if log else peaks.sum()


def seen_behind(
    psf,
    illuminant,
    responses,
    bands,
    *,
    light,
    read_noise,
    veil,
    limit,
    transmittance,
    contrast,
    up_to,
):
    """Yield NEQ x S of each channel behind mask and grey filter, and S, at the frequencies that
    count.
    """
    kernel = exact(psf.intensity)
    square = sum(np.abs(f) ** 2 for f in frequencies(kernel.shape[1:]))
    power = np.divide(1, square, out=np.zeros_like(square), where=square > 0)
    power *= L(contrast) / power.mean()
    passed = min(L(1), L(limit) / (kernel / exact(psf.clear_peak)[:, None, None]).max())
    counted = (square > 0) & (square <= L(up_to) ** 2)
    seen = exact(responses) * exact(illuminant) * exact(bands.centres)
    for part in seen / seen.sum(1, keepdims=True):
        otf = dft(np.tensordot(part, kernel, 1))
        noise = passed * (L(light) * L(transmittance) + L(veil)) + L(read_noise) ** 2
        yield ((passed * L(light) * np.abs(otf)) ** 2 / noise * power)[counted], power[counted]


def filtered_error(*inputs, **how):
    return np.mean(
        [np.log((s / (1 + snr)).sum() / s.sum()) for snr, s in seen_behind(*inputs, **how)]
    )


def information(*inputs, **how):
    return -np.mean([np.log2(1 + snr).mean() for snr, _ in seen_behind(*inputs, **how)])


def wiener_loss(psf, illuminant, responses, bands, *, noise, colour, up_to):
    kernel = exact(psf.intensity)
    y, x = kernel.shape[1:]
    square = sum(f**2 for f in frequencies((y, x)))
    power = (square + L(1) / (x * y)) ** L(-1.5)
    signal = power / power.mean() / L(noise)
    counted = (square > 0) & (square <= L(up_to) ** 2)
    seen = exact(responses) * exact(illuminant) * exact(bands.centres)
    spectra_, logs = dft(kernel), []
    for part in seen / seen.sum(1, keepdims=True):
        channel = np.tensordot(part, spectra_, 1)
        filtered = signal * np.conj(channel) / (signal * np.abs(channel) ** 2 + 1)
        wrong = signal * np.abs(1 - filtered * channel) ** 2 + np.abs(filtered) ** 2
        for weight, band in zip(part, spectra_, strict=True):
            wrong = wrong + L(colour) * weight * signal * np.abs(filtered * (band - channel)) ** 2
        logs.append(np.log(wrong[counted].sum() / signal[counted].sum()))
    return np.mean(logs)


def filtered(
    psf,
    illuminant,
    responses,
    bands,
    *,
    electrons,
    read_noise,
    glare,
    prnu,
    residual_glare,
    variance,
    up_to,
):
    """Error, information, mean log NEQ and light of each channel, by sums over all frequencies."""
    kernel, columns = exact(psf.intensity), []
    square = sum(f**2 for f in frequencies(kernel.shape[1:]))
    power = np.divide(1, square, out=np.zeros_like(square), where=square > 0)
    power *= L(variance) / power.mean()
    seen = exact(responses) * exact(illuminant) * exact(bands.centres)
    for part in seen / seen.sum(1, keepdims=True):
        otf = dft(np.tensordot(part, kernel, 1))
        whole = L(electrons) * otf[0, 0].real + L(glare)
        noise = (
            whole
            + L(read_noise) ** 2
            + (L(prnu) * whole) ** 2
            + (L(residual_glare) * L(glare)) ** 2
        )
        neq = (L(electrons) * np.abs(otf)) ** 2 / noise
        low = (square > 0) & (square <= L(up_to) ** 2)
        error = (power / (1 + neq * power)).sum() / power.sum()
        columns.append(
            (error, np.log2(1 + neq * power).mean() / 2, np.log(neq[low]).mean(), otf[0, 0].real)
        )
    return np.array(columns, L).T


def weakest(light, lsr, bands, lines):
    """The light times the largest of the ratios at the band that is nearest to the mean of each
    line.
    """
    centres = [float((x.centres * x.weights).sum() / x.weights.sum()) for x in lines]
    found = [exact(lsr)[np.abs(np.asarray(bands.centres) - c).argmin()] for c in centres]
    return exact(light) * min(max(found), L(1))


def warmed(psf, plain, *, pixel_pitch, dwell):
    """Heat of the hottest pixel over that of the clear lens: every pixel warms every pixel of
    silicon.
    """
    import mpmath

    y, x = psf.intensity.shape[1:]
    at = np.stack(np.meshgrid(np.arange(y), np.arange(x), indexing="ij"), -1).reshape(-1, 2)
    squares = ((at[:, None] - at) ** 2).sum(-1)
    with mpmath.workdps(30):
        reach, pitch = mpmath.sqrt(4 * mpmath.mpf(8.8e-5) * dwell), mpmath.mpf(pixel_pitch)
        each = {
            int(n): mpmath.erfc(mpmath.sqrt(int(n)) * pitch / reach) / (mpmath.sqrt(int(n)) * pitch)
            for n in np.unique(squares)
            if n
        }
        disc = pitch / mpmath.sqrt(mpmath.pi)
        each[0] = (
            2 * mpmath.pi * mpmath.quad(lambda r: mpmath.erfc(r / reach), [0, disc]) / pitch**2
        )
    kernel = np.array([L(str(each[n])) for n in squares.flat], L).reshape(squares.shape)
    hottest = [
        (kernel @ exact(one.intensity).reshape(len(one.intensity), -1).T).max(0)
        for one in (psf, plain)
    ]
    return hottest[0] / hottest[1]


def bounds(psf, *, electrons, read_noise, glare):
    """Logarithms of value and bound of each inequality, from Parseval's sum of |OTF|**2; c =
    0.45962.
    """
    c, n, rows = L(0.45962), L(electrons), []
    quiet, noise = L(read_noise) ** 2, n + L(glare) + L(read_noise) ** 2
    for kernel, p0 in zip(exact(psf.intensity), exact(psf.clear_peak), strict=True):
        fy, fx = frequencies(kernel.shape)
        square = np.abs(dft(kernel)) ** 2
        inside = square[np.sqrt(fy**2 + fx**2) <= np.sqrt(4 * p0 / PI)]
        peak, lsr = kernel.max(), kernel.max() / p0
        grey = n**2 * lsr**2 * c / 4 / (n * lsr + quiet)
        stop = n**2 * lsr ** L(1.5) * c / 4 / (n * np.sqrt(lsr) + quiet)
        mask, most = n**2 * inside.mean() / noise, n**2 * lsr / 4 / noise
        both = max(grey, stop)
        pairs = (
            (kernel**2).sum(),
            peak,
            inside.mean() / (c / 4),
            lsr / c,
            mask / grey,
            most / grey,
            mask / both,
        )
        rows.append(
            [*np.log([*pairs, most / both]), np.log(n**2 * inside / noise).mean(), np.log(most)]
        )
    return np.array(rows, L).T


def fused_silica(wavelength):
    square = (exact(wavelength) * L(10) ** 6) ** 2
    terms = ((0.6961663, 0.0684043), (0.4079426, 0.1162414), (0.8974794, 9.896161))
    return np.sqrt(1 + sum(L(b) * square / (square - L(c) ** 2) for b, c in terms)) - 1


def wrapped(height, *, wrap_at, **_):
    wave = L(wrap_at) / fused_silica(wrap_at)
    return exact(height) - wave * np.floor(exact(height) / wave)


def stepped(height, *, max_height, levels, **_):
    step = L(max_height) / (levels - 1)
    return step * np.rint(np.clip(exact(height), 0, L(max_height)) / step)


def averaged(height, stop, *, feature):
    sigma = L(feature) / exact(stop.pitch) / np.sqrt(8 * np.log(L(2)))
    n = len(height)
    far = np.abs(np.arange(n)[:, None] - np.arange(n))
    weights = np.where(far <= 6 * sigma + L(0.5), np.exp(-(far.astype(L) ** 2) / (2 * sigma**2)), 0)
    weights = weights / weights.sum(1, keepdims=True)
    return weights @ exact(height) @ weights.T


def pulse_over_thresholds(spot, line, exposure, **_):
    """The fluence of one pulse over the published thresholds of a CMOS, in J/m2 from J/cm2:
    first traces and others.
    """
    thresholds = [L("0.1"), L("100"), L("0.2419"), L("2.0054")]
    return np.array(
        [exact(spot).sum(0).max() * L(exposure) / (threshold * 10_000) for threshold in thresholds]
    )


def photons(irradiance, bands, responses, level, **_):
    weights = exact(responses) * photons_per_joule(bands.centres) * AREA * exact(level)
    return np.tensordot(weights, exact(irradiance), 1)


def level(image, bands, responses, *, strength, **_):
    weights = exact(responses) * photons_per_joule(bands.centres) * AREA
    return np.full(4, L(strength) * FILLS / np.tensordot(weights, exact(image), 1).max())


def white_light(signal, clipped, psf, bands, illuminant, responses, *, white=None, **_):
    weights = exact(responses) * photons_per_joule(bands.centres) * AREA * exact(illuminant)
    if white is not None:
        return np.full(4, L(white) * FILLS / weights.sum(1).max())
    passed = (weights / weights.sum(1, keepdims=True)) @ exact(psf.intensity).sum((1, 2))
    whole = weights.sum(1) * L(0.56) * passed
    shown = (exact(signal) / whole[:, None, None]).max(0)[~clipped.any(0).numpy()]
    return np.full(4, np.quantile(shown, L("0.995")))


def gaussian_line(*, wavelength, fwhm, count, floor, **_):
    import mpmath

    with mpmath.workdps(40):
        sigma, width = (
            mpmath.mpf(fwhm) / (2 * mpmath.sqrt(2 * mpmath.log(2))),
            3 * mpmath.mpf(fwhm) / count,
        )
        edges = [width * (mpmath.mpf(i) - mpmath.mpf(count) / 2) for i in range(count + 1)]
        inside = [mpmath.ncdf(b / sigma) - mpmath.ncdf(a / sigma) for a, b in pairwise(edges)]
        weights = [w + floor * width / (sigma * mpmath.sqrt(2 * mpmath.pi)) for w in inside]
        return np.array([float(w / sum(weights)) for w in weights], L)


def slopes_penalty(slopes):
    return ((np.sqrt((exact(slopes).reshape(len(slopes), -1) ** 2).sum(1)) - 1) ** 2).mean()


def spectrum_difference(a, b):
    scale = np.sqrt(L(a.shape[-1] * a.shape[-2]))
    return np.abs(dft(exact(a) - exact(b)) / scale).mean()


def shown(x):
    inside = np.clip(exact(x), 0, 1)
    dark = inside <= L("0.0031308")
    return np.where(
        dark, L("12.92") * inside, L("1.055") * inside ** (1 / L("2.4")) - L("0.055")
    ) + L("0.1") * (exact(x) - inside)


CAMERA = {
    "focal_length": 0.11,
    "pixel_pitch": 2.9e-6,
    "shape": (12, 15),
    "angle": (3.1e-5, -5.7e-5),
}
LENS = {"defocus": 37.5, "aberrations": {4: 1.1e-6, 7: -3e-7, 9: 2e-7, 11: 5e-8}}
GHOST = {
    "focal_length": 0.11,
    "pixel_pitch": 2.9e-6,
    "count": 1,
    "energy": 0.03,
    "spread": 0.1,
    "radius": 9e-6,
}


def first(x):
    return x[0] if isinstance(x, tuple) else x


def case(node, inputs, reference, params=None, take=first, like=None):
    """A call of a node, the reference of the tensors that ``take`` picks, and the scale if not
    their largest value.
    """
    return SimpleNamespace(
        node=node, inputs=inputs, reference=reference, params=params or {}, take=take, like=like
    )


def rng():
    return torch.Generator().manual_seed(5)


PROTECTED = {"light": 70.0, "read_noise": 3.7, "veil": 11.0, "limit": 0.03, "transmittance": 0.9, "contrast": 0.2,
             "up_to": 0.41}  # fmt: skip
CASES = [
    case(doe.equal_filter, (IMAGE, ILLUMINANT, BANDS, [BANDS]), weakest),
    case(doe.fabricate, (HEIGHT,), wrapped, {"wrap_at": 550e-9}),
    case(doe.fabricate, (HEIGHT,), stepped, {"max_height": 9.1e-5, "levels": 5}),
    case(doe.material, (BANDS,), lambda b: fused_silica(b.centres)),
    case(doe.smooth, (HEIGHT, STOP), averaged, {"feature": 1.1e-3}),
    case(flare.ghosts, (draw(4, 65, 65), BANDS, draw(2) * 1e-6), ghost_light, GHOST, take=lambda x: x.sum()),
    case(losses.background_loss, (PSF, SCENE), lambda p, s: (1 / share(p, s)).sum()),
    case(losses.charbonnier, (PICTURE, TRUTH), lambda a, b: np.sqrt((exact(a) - exact(b)) ** 2 + L(1e-6)).mean()),
    case(losses.contrast, (WIDE,), contrast_loss, {"floor": 1e-3, "up_to": 0.31}),
    case(losses.fft_l1, (PICTURE, TRUTH), spectrum_difference),
    case(losses.filtered_error, (WIDE, ILLUMINANT, RESPONSES, BANDS), filtered_error, PROTECTED),
    case(losses.gradient_penalty, (draw(3, 4, 5),), slopes_penalty),
    case(losses.information, (WIDE, ILLUMINANT, RESPONSES, BANDS), information, PROTECTED),
    case(losses.log_error, (PICTURE, TRUTH), lambda a, b: np.log(np.mean((shown(a) - shown(b)) ** 2) + L(1e-6))),
    case(losses.mrae, (PICTURE, TRUTH),
         lambda a, b: (np.abs(exact(a) - exact(b)) / np.maximum(np.abs(exact(b)), L(0.02))).mean()),
    case(losses.suppression_loss, (PSF,), p_norm, {"power": 16.0, "log": False}),
    case(losses.suppression_loss, (PSF,), p_norm, {"power": 9.5, "log": True}),
    case(losses.wiener, (WIDE, ILLUMINANT, RESPONSES, BANDS), wiener_loss,
         {"noise": 1e-2, "colour": 0.7, "up_to": 0.41}),
    case(metrics.bsr, (PSF, SCENE), share),
    case(metrics.encircled, (PSF,), encircled, {"pixel_pitch": 2.9e-6, "radius": 2.9e-6 * 3}),
    case(metrics.encircled, (WIDE,), encircled, {"pixel_pitch": 1e-6, "radius": 4.99999999e-6}),
    case(metrics.filtered_picture, (WIDE, ILLUMINANT, RESPONSES, BANDS), filtered,
         {"electrons": 70.0, "read_noise": 3.7, "glare": 11.0, "prnu": 0.013, "residual_glare": 0.03, "variance": 0.2,
          "up_to": 0.41}, take=torch.stack),
    case(metrics.heat_ratio, (WIDE, Psf(draw(4, 12, 13, seed=1) / 160, WIDE.clear_peak)), warmed,
         {"pixel_pitch": 2.9e-6, "dwell": 3.1e-7}),
    case(metrics.light_outside, (PSF, PUPIL), outside),
    case(metrics.limits, (WIDE,), limits, take=torch.stack),
    case(laser.damage, (IMAGE, spectra.line(wavelength=532e-9)), pulse_over_thresholds,
         {"pixel_pitch": 2.9e-6, "exposure": 0.1, "dwell": 0.1, "pulse_duration": 1e-8},
         take=lambda d: d.ratio[[0, 4, 5, 6]]),
    case(metrics.lsr, (PSF,), lambda p: exact(p.intensity).max((1, 2)) / exact(p.clear_peak)),
    case(metrics.mtf, (WIDE,), mtf_rms),
    case(metrics.peak_bsr, (IMAGE, SCENE), lambda x, y: exact(x).max((-2, -1)) / exact(y).max((-2, -1))),
    case(metrics.protection_bounds, (WIDE,), bounds, {"electrons": 70.0, "read_noise": 3.7, "glare": 11.0},
         take=lambda b: torch.cat([torch.stack(b[:8]).log(), torch.stack(b[8:])])),
    case(metrics.peak_irradiance, (IMAGE, BANDS, LEVEL, [SCENE], [BANDS]), wells, WELL),
    case(optics.image, (SCENE, PSF), convolved, {"border": "zero"}),
    case(optics.image, (SCENE, PSF), convolved, {"border": "reflect"}),
    case(optics.image_channels, (LOW_RANK, PSF, ROWS), summed, {"border": "zero"}),
    case(optics.image_channels, (LOW_RANK, PSF, ROWS), summed, {"border": "reflect"}),
    case(optics.laser_irradiance, (PSF, BANDS), spot, {"strength": 1e6 / 3, **WELL}),
    case(optics.psf, (PUPIL,), psf_of, {**CAMERA, "precision": "double"}),
    case(optics.psf, (PUPIL._replace(height=HEIGHT.float(), path=PUPIL.path.float()),), psf_of,
         {**CAMERA, "precision": "double"}),
    case(optics.pupil, (HEIGHT, INDEX, BANDS, STOP), pupil_path, LENS, take=lambda p: p.path),
    case(restore.colour, (PICTURE, draw(3, 3)), lambda c, m: np.tensordot(exact(m), exact(c), 1)),
    case(restore.electrons, (1e4 * PICTURE,), lambda r, gain, offset: exact(r) / L(gain) - L(offset),
         {"gain": 2.7, "offset": 390.1}),
    case(restore.white_level, (1e4 * PICTURE, PICTURE > 1.0, PSF, BANDS, ILLUMINANT, RESPONSES), white_light, WELL),
    case(restore.white_level, (1e4 * PICTURE, PICTURE > 1.0, PSF, BANDS, ILLUMINANT, RESPONSES), white_light,
         {"white": 0.7, **WELL}),
    case(sensor.add_photons, (PICTURE, [TRUTH], [PICTURE]), lambda p, a, b: exact(p) + exact(a[0]) + exact(b[0])),
    case(sensor.expose, (IMAGE, BANDS, RESPONSES, LEVEL), photons, SHUTTER),
    case(scene.grey, (PICTURE,),
         lambda p: np.stack(3 * [L("0.2126") * exact(p)[0] + L("0.7152") * exact(p)[1] + L("0.0722") * exact(p)[2]])),
    case(sensor.full_well, (PICTURE,), lambda e, capacity: np.minimum(exact(e), L(capacity)), {"capacity": 0.7}),
    case(sensor.level, (IMAGE, BANDS, RESPONSES), level, {"strength": 0.7, **WELL}),
    case(sensor.saturation, (BANDS,), lambda b, **_: saturating(b), WELL),
    case(spectra.bands, (), lambda start, stop, count: L(start) + (L(stop) - L(start)) / (count - 1) * np.arange(count),
         {"start": 401e-9, "stop": 699e-9, "count": 7}),
    case(spectra.illuminate, (SCENE, ILLUMINANT), lambda r, i: exact(r) * exact(i)[:, None, None]),
    case(spectra.line, (), gaussian_line, {"wavelength": 532e-9, "fwhm": 3e-9, "count": 5, "floor": 1e-3},
         take=lambda b: b.weights),
    case(spectra.rows, (BANDS, RESPONSES),
         lambda b, r: np.vstack([exact(r), np.ones(4)]) * exact(b.centres)),
]  # fmt: skip


@pytest.mark.parametrize(
    "one", CASES, ids=lambda c: f"{c.node.path} {'' if not c.params else next(iter(c.params))}"
)
def test_the_error_in_float64(one):
    given = {**one.params, **({"rng": rng()} if one.node.random else {})}
    found = one.take(one.node(*one.inputs, **given))
    expected = np.asarray(one.reference(*one.inputs, **one.params), L)
    assert found.dtype == torch.float64
    assert found.shape == expected.shape
    assert np.abs(exact(found) - expected).max() <= LIMIT * np.abs(expected).max()


#: nodes without a case, with the reason
_ELSEWHERE = {
    "gives float32, as stated": ("doe.axicon", "doe.cubic", "doe.flat", "doe.half_rings", "doe.pixelwise",
        "doe.shade", "doe.spiral_axicon", "doe.unet", "doe.vortex", "doe.zernike", "flare.dirt", "scene.exr",
        "scene.hyperspectral", "scene.photograph", "scene.targets", "spectra.lift_mst_plus_plus", "restore.fft_mamba",
        "restore.nafnet", "restore.network", "restore.unet"),
    "draws": ("calibrate.expose", "doe.height_error", "optics.direction", "restore.spread_by_field",
        "restore.wiener_spread", "sensor.dark_current", "sensor.digitize", "sensor.photon_noise",
        "sensor.photon_transfer", "sensor.read_noise",
        "spectra.grain", "spectra.leaves", "spectra.metamers"),
    "reads tables or files": ("calibrate.descriptor", "calibrate.frames", "calibrate.hot_pixels",
        "calibrate.point_source", "calibrate.table", "restore.colour_matrix", "sensor.frame",
        "spectra.illuminant", "spectra.lift_lmmse", "spectra.lift_lmmse_mixture", "spectra.lift_mallett",
        "spectra.lift_mallett_mixture", "spectra.line_table", "spectra.reflectances", "spectra.render",
        "optics.white_irradiance", "spectra.responses"),
    "computes float64 numbers from parameters": ("laser.light", "laser.wavefront"),
    "is a fit or a likelihood, with tests of its own": ("calibrate.camera", "calibrate.camera_prior",
        "calibrate.density", "calibrate.least_squares", "calibrate.levels", "calibrate.prior", "calibrate.reduce",
        "calibrate.stray_light", "calibrate.stray_prior", "calibrate.sufficient", "restore.filter_facts",
        "restore.find_lasers", "restore.found_glare", "restore.found_nearby", "restore.informed",
        "restore.measured_psf", "restore.nearby_glare",
        "restore.richardson_lucy", "restore.unrolled", "restore.wiener", "restore.wiener_by_field",
        "restore.wiener_problem", "spectra.compress"),
    "copies, counts or states": ("laser.bright_pixels", "laser.damaged_pixels", "laser.dazzle", "laser.dazzle_curve",
        "metrics.saturated", "optics.pupil_of_bands", "optics.stop", "restore.clipped", "sensor.crop", "sensor.limits",
        "spectra.filters"),
    "has a stated error above 1e-11": ("flare.stray_light", "flare.stray_shares", "metrics.quality",
        "metrics.spectral_error", "optics.few_bands", "optics.few_bands_checked"),
}  # fmt: skip


def test_every_node_has_a_case_or_a_reason():
    tried = {one.node.path for one in CASES}
    listed = [path for paths in _ELSEWHERE.values() for path in paths]
    assert len(listed) == len(set(listed))
    assert tried.isdisjoint(listed)
    assert {n.path for n in NODES} == tried | set(listed)
