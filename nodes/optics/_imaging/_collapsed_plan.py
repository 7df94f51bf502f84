"""The choice of the cheapest way to compute weighted sums over the bands of an image with a bounded error."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes.optics._imaging._psf_energy import Passed, by_window, spread
from neusee.nodes.optics._imaging._summed_convolution import Mix
from neusee.nodes.optics._transform._chirp_transform import smooth

_SMALL = 0.05  #: share of the error bound that is spent on omitting weak bands
_FARTHER = 6  #: numbers of planes that are tried, from the least sufficient number on
_EVERY = 8  #: one band of this many is tested first for a smaller window


class Given(NamedTuple):
    """The properties of scene, PSF and weights from which a convolution plan is chosen; float64, on the CPU."""

    rows: Tensor  #: (row, band)
    basis: Tensor  #: (band, k)
    rest: Tensor  #: (k + 1, band) norm of the residual of each band after the first 0, 1, ... k planes
    most: Tensor  #: (k,) the same norm of each plane
    gram: Tensor  #: (k, k) products of the planes
    copies: int  #: the largest number of copies of a scene point: 9 where the border reflects
    passed: Passed
    size: tuple[int, int]
    reflect: bool
    share: Tensor | None = None  #: (band, j) weights of the PSFs in each band, where only few bands have a PSF


class Plan(NamedTuple):
    """A way to convolve a scene with a PSF: basis images, kernels, bands and PSF window, with error bound and cost."""

    planes: int
    bands: Tensor  #: indices of the bands that are not omitted
    window: tuple[int, int]
    kernels: Tensor | None  #: (kernel, bands used); None: each PSF is a kernel
    mix: Mix
    off: Tensor  #: (row,) upper bound of the omitted light
    number: int  #: of kernels
    cost: float  #: estimated seconds on two cores
    whole: bool  #: nothing but zeros is omitted

    @property
    def kept(self) -> list[int]:
        """Return the numbers of planes, kernels and bands, and the PSF window's size, as in `Channels.kept`."""
        return [self.planes, self.number, len(self.bands), *self.window]


class Fewer(NamedTuple):
    """A small set of convolution kernels, brightest first, whose weighted sums approximate a larger set of kernels."""

    kernels: Tensor  #: (q, band)
    mixed: Tensor  #: (row x plane, q)
    off: Tensor  #: (q - 1, row) upper bound of the light that the first 1, 2, ... kernels omit


def with_windows(given: Given, intensity: Tensor, brightest: Tensor, within: float) -> Given:
    """Return ``given`` with the light that smaller PSF windows omit, or unchanged if these windows omit too much."""
    few, signed = slice(_EVERY // 2, None, _EVERY), given.passed.signed
    if given.share is None and len(intensity) > _EVERY:
        some = given._replace(rows=given.rows[:, few], basis=given.basis[few], rest=given.rest[:, few])
        if not _narrow(some._replace(passed=by_window(intensity[few], signed)), within * brightest):
            return given
    return given._replace(passed=spread(by_window(intensity, signed), given.share))


def _narrow(given: Given, limit: Tensor) -> bool:
    """Return True if the second largest PSF window omits little enough light for some number of basis images."""
    bands, planes = torch.arange(len(given.basis)), range(1, len(given.most) + 1)
    return len(given.passed.windows) > 1 and any(
        bool((given.rows.abs() @ _tail(given, bands, k, 1) <= limit).all()) for k in planes
    )


def choose(given: Given, brightest: Tensor, within: float) -> Plan:
    """Return the cheapest convolution plan that omits at most ``within`` of the brightest pixel, or a complete plan."""
    bands, lost = _strong(given, brightest, within)
    whole = min(_plans(given, bands, lost, len(given.most), 0), key=lambda plan: plan.cost)
    best = whole._replace(whole=True)
    if within <= 0:
        return best
    for k in _enough(given, bands, lost, brightest, within):
        fewer = _fewer(given, bands, k, brightest)
        for j in range(len(given.passed.windows)):
            found = _plans(given, bands, lost, k, j, (within * brightest, fewer))
            best = min([best, *found], key=lambda plan: plan.cost)
    return best


def _strong(given: Given, brightest: Tensor, within: float) -> tuple[Tensor, Tensor]:
    """Return the bands to convolve, and an upper bound of the light that the omitted bands add to each weighted sum."""
    may = given.rows.abs() * (given.rest[0] * given.passed.total)
    share = torch.where(may > 0, may / brightest.clamp_min(1e-300)[:, None], 0.0).amax(0)
    order = share.argsort()
    weak = order[share[order].cumsum(0) <= _SMALL * max(within, 0.0)]
    bands = torch.ones_like(share, dtype=torch.bool).index_fill_(0, weak, False)
    if not bool(bands.any()):
        bands[int(share.argmax())] = True
    return bands.nonzero()[:, 0], may[:, ~bands].sum(1)


def _enough(given: Given, bands: Tensor, lost: Tensor, brightest: Tensor, within: float) -> list[int]:
    """Return how many basis images each picture needs for an error of at most ``within`` times the brightest pixel."""
    off = lost + (given.rest[:, bands] * given.passed.total[bands]) @ given.rows[:, bands].abs().T
    fits = [k for k in range(1, len(given.most) + 1) if bool((off[k] <= within * brightest).all())]
    return fits[:_FARTHER]


def _plans(
    given: Given, bands: Tensor, lost: Tensor, k: int, j: int, within: tuple[Tensor, Fewer] | None = None
) -> Iterator[Plan]:
    """Yield up to three convolution plans that use the first ``k`` basis images and the PSF window number ``j``.

    The kernels of the three plans are one for each plane and row, one for each PSF, and fewer kernels to mix.
    """
    rows, basis, through = given.rows[:, bands], given.basis[bands, :k], given.passed.total[bands]
    off = lost + rows.abs() @ (given.rest[k, bands] * through) + rows.abs() @ _tail(given, bands, k, j)
    if within is not None and not bool((off <= within[0]).all()):
        return
    count = len(rows)
    u = torch.eye(count, dtype=torch.float64).repeat_interleave(k, 1)
    x = torch.eye(k, dtype=torch.float64).repeat(count, 1)
    sums = _sums(rows, basis)

    def plan(kernels: Tensor | None, mix: Mix, off: Tensor) -> Plan:
        window = given.passed.windows[j]
        each = len(bands) if given.share is None else given.share.shape[1]
        cost = _cost(given, window, k, each, kernels, mix)
        return Plan(k, bands, window, kernels, mix, off, each if kernels is None else len(kernels), cost, False)

    yield plan(sums, Mix(u, x, None, count), off)
    if given.share is None:
        yield plan(None, Mix(rows, basis, None), off)
    else:
        yield plan(None, Mix(u, x, sums @ given.share[bands], count), off)
    if within is not None:
        limit, few = within
        for q in (few.off + off <= limit).all(1).nonzero()[:1, 0].tolist():
            yield plan(few.kernels[: q + 1], Mix(u, x, few.mixed[:, : q + 1], count), off + few.off[q])


def _fewer(given: Given, bands: Tensor, k: int, brightest: Tensor) -> Fewer:
    """Return a small set of kernels: singular vectors of the matrix that sums the bands of the PSF to kernels."""
    rows, band = given.rows[:, bands], given.passed.total[bands]
    plane = torch.where(brightest[:, None] > 0, given.most[:k] / brightest[:, None], 0.0).flatten()
    scaled = plane[:, None] * _sums(rows, given.basis[bands, :k]) * band
    a, s, b = torch.linalg.svd(scaled, full_matrices=False)
    off = [(scaled - (a[:, :q] * s[:q]) @ b[:q]).abs().sum(1).reshape(len(rows), -1).sum(1) for q in range(1, len(s))]
    kernels = torch.where(band > 0, b / band, 0.0)
    mixed = torch.where(plane[:, None] > 0, a * s / plane[:, None], 0.0)
    unknown = torch.where((brightest == 0) & (rows != 0).any(1), math.inf, 0.0)  # a row without weight above
    return Fewer(kernels, mixed, torch.stack(off) * brightest + unknown if off else brightest[None][:0])


def _sums(rows: Tensor, basis: Tensor) -> Tensor:
    """Return the weight of each PSF band in the convolution kernel of each weighted sum and each basis image."""
    return (rows[:, None, :] * basis.T).flatten(0, 1)


def _tail(given: Given, bands: Tensor, k: int, j: int) -> Tensor:
    """Return, for each band, an upper bound of the light that the PSF outside the window adds to an image pixel.

    The bound is Young's inequality in three norms.
    """
    basis = given.basis[bands, :k]
    beyond, above = given.passed.beyond[j, bands], given.passed.above[j, bands]
    top = given.rest[0, bands] + given.rest[k, bands]
    power = ((basis @ given.gram[:k, :k]) * basis).sum(1).clamp_min(0) * given.copies
    return torch.minimum(top * beyond, (power * beyond * above).sqrt() * (1 + 1e-6))


def _cost(given: Given, window: tuple[int, int], k: int, bands: int, kernels: Tensor | None, mix: Mix) -> float:
    """Return the seconds that a convolution plan is expected to take on two cores: FFTs, products and kernel sums."""
    area = math.prod(transform(given, window))
    count = bands if kernels is None else len(kernels)
    terms = len(mix.x) if mix.x is not None else k
    products = terms * (k + len(given.rows) + (count if mix.y is not None else 0) + 8)
    sums = 0 if kernels is None else count * bands * math.prod(window)
    return area * (2e-9 * (k + count + len(given.rows)) + 3e-11 * products) + 1.4e-11 * sums


def transform(given: Given, window: tuple[int, int]) -> tuple[int, int]:
    """Return the shortest FFT lengths (y, x) for which the convolution has no wrap-around within the image."""
    if given.reflect:
        y, x = (smooth(s + w - 1) for s, w in zip(given.size, window, strict=True))
    else:
        y, x = (smooth(max(s + w // 2, s + w - 1 - w // 2)) for s, w in zip(given.size, window, strict=True))
    return y, x
