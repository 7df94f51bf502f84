"""From three channels to a spectrum, linearly."""

import functools

import torch
from torch import Tensor

from neusee.nodes import Check, Node, node
from neusee.nodes._half_precision import single
from neusee.nodes.spectra._low_rank_cube import Share, compress, mixture, said_of_planes
from neusee.nodes.spectra._principal_planes import Source, few_planes
from neusee.nodes.spectra._spectral_tables import mallett, paints, to_srgb
from neusee.nodes.values import Bands, LowRankCube

_FIRST, _LAST = 380e-9, 780e-9  #: m, where measured reflectances and the basis are known


@node(rtol=1e-5)
def lift_mallett(rgb: Tensor, bands: Bands) -> Tensor:
    """Build each pixel's reflectance of three basis spectra, whose sum is 1 at every wavelength.

    Shapes: rgb (3, y, x) -> (band, y, x).
    Units:  linear sRGB to reflectance; linear, so that HDR values above 1 stay.
    Error:  real paints: PSNR 31 dB (CAVE balloons); back to sRGB under D65 within 5e-3. Negative results are clipped.
    Raises: ValueError where rgb is not (3, y, x) or bands leave 380 to 780 nm.
    Source: Mallett and Yuksel, Spectral primary decomposition, EGSR 2019; basis from colour-science.
    """
    return _lifted(rgb, _basis(bands))


@lift_mallett.reference
def _(rgb: Tensor, bands: Bands) -> Tensor:
    return torch.einsum("bc,cyx->byx", _basis(bands).to(rgb.device), rgb.double()).relu()


@lift_mallett.check
def _(result: Tensor, rgb: Tensor, bands: Bands) -> list[Check]:
    return lift_checks(result, rgb, bands, _basis(bands))


@node(rtol=1e-6)
def lift_mallett_mixture(rgb: Tensor, bands: Bands, *, within: Share = 1e-6) -> LowRankCube:
    """Give the reflectance of `lift_mallett` as few planes, some pixels at a time: the cube is never in memory.

    Shapes: rgb (3, y, x) -> planes (k, y, x), basis (band, k), rest and spread (k + 1, band) float64.
    Units:  planes, rest and spread those of reflectance; the basis has none.
    Error:  as `spectra.compress` of the lift in float64, which `lift_mallett` is within a few of its own roundings.
    Raises: ValueError as `lift_mallett` and `spectra.compress`.
    Source: as `lift_mallett`.
    """
    return _mixed(rgb, _basis(bands), within)


@lift_mallett_mixture.reference
def _(rgb: Tensor, bands: Bands, *, within: float = 1e-6) -> LowRankCube:
    return _mixed_whole(lift_mallett, rgb, bands, within)


lift_mallett_mixture.check(said_of_planes)


lift_mallett.low_rank_form = lift_mallett_mixture


@node(rtol=1e-5)
def lift_lmmse(rgb: Tensor, bands: Bands) -> Tensor:
    """Take the linear least-mean-square-error estimate of the reflectance, over the paints of measured colour charts.

    W = C T^t (T C T^t)^-1 with C = E[s s^t] over the paints and T from reflectance under D65 to linear sRGB.

    Shapes: rgb (3, y, x) -> (band, y, x).
    Units:  linear sRGB to reflectance; linear, so that HDR values above 1 stay.
    Error:  real paints: PSNR 33.3 dB, mean relative error 0.15 (CAVE balloons); back to sRGB exactly, but where a
            negative result was clipped. White is that of white paint: 0.62 at 400 nm, 0.94 to 1.12 from 420 nm.
    Raises: ValueError where rgb is not (3, y, x), bands leave 380 to 780 nm, or are too few or too close to see colour.
    Source: Wiener estimation as in Pratt and Mancill, Appl. Opt. 15, 73 (1976); charts of colour-science.
    """
    return _lifted(rgb, _estimator(bands))


@lift_lmmse.reference
def _(rgb: Tensor, bands: Bands) -> Tensor:
    return torch.einsum("bc,cyx->byx", _estimator(bands).to(rgb.device), rgb.double()).relu()


@lift_lmmse.check
def _(result: Tensor, rgb: Tensor, bands: Bands) -> list[Check]:
    return lift_checks(result, rgb, bands, _estimator(bands))


@node(rtol=1e-6)
def lift_lmmse_mixture(rgb: Tensor, bands: Bands, *, within: Share = 1e-6) -> LowRankCube:
    """Give the reflectance of `lift_lmmse` as few planes, some pixels at a time: the cube is never in memory.

    Shapes: rgb (3, y, x) -> planes (k, y, x), basis (band, k), rest and spread (k + 1, band) float64.
    Units:  planes, rest and spread those of reflectance; the basis has none.
    Error:  as `spectra.compress` of the lift in float64, which `lift_lmmse` is within a few of its own roundings.
    Raises: ValueError as `lift_lmmse` and `spectra.compress`.
    Source: as `lift_lmmse`.
    """
    return _mixed(rgb, _estimator(bands), within)


@lift_lmmse_mixture.reference
def _(rgb: Tensor, bands: Bands, *, within: float = 1e-6) -> LowRankCube:
    return _mixed_whole(lift_lmmse, rgb, bands, within)


lift_lmmse_mixture.check(said_of_planes)


lift_lmmse.low_rank_form = lift_lmmse_mixture


def lift_checks(result: Tensor, rgb: Tensor, bands: Bands, matrix: Tensor | None = None) -> list[Check]:
    """What was clipped, and how far the spectra are from the colours they came from, on some 65 000 pixels."""
    step = max(1, rgb[0].numel() // 65536)
    colours, spectra = (t.detach().flatten(1)[:, ::step].double().cpu() for t in (rgb, result))
    scale = max(float(colours.abs().max()), 1e-30)
    off = float((to_srgb(bands.centres) @ spectra - colours).abs().max()) / scale
    checks = [Check(f"back in sRGB within {off:.2g} of the brightest", float(result.min()) >= 0)]
    if matrix is not None:
        raw = matrix.cpu() @ colours
        below = float(raw.clamp_max(0).abs().sum()) / max(float(raw.abs().sum()), 1e-30)
        checks.append(Check(f"{below:.2%} of the energy was negative and is clipped", below < 0.05))
    return checks


def needs_rgb(rgb: Tensor) -> None:
    """Refuse what is not a picture of three channels."""
    if rgb.ndim != 3 or rgb.shape[0] != 3:
        raise ValueError(f"rgb {tuple(rgb.shape)} must be (3, y, x): wire a scene of three channels")


def _lifted(rgb: Tensor, matrix: Tensor) -> Tensor:
    """One product straight into the result, clipped in place: no second cube."""
    needs_rgb(rgb)
    rgb = single(rgb)
    return torch.relu_(matrix.to(rgb) @ rgb.flatten(1)).reshape(-1, *rgb.shape[1:])


def _mixed(rgb: Tensor, matrix: Tensor, within: float) -> LowRankCube:
    """The planes; a learnt picture is lifted whole, so that its gradient flows."""
    needs_rgb(rgb)
    flat, exact = rgb.detach().flatten(1), matrix.to(rgb.device)
    dtype = rgb.dtype if rgb.dtype == torch.float64 else torch.float32
    source = Source(lambda part: (exact @ flat[:, part].double()).clamp_min_(0), len(exact), flat.shape[1], dtype)
    return mixture(few_planes(source, within), _lifted(rgb, matrix) if rgb.requires_grad else rgb)


def _mixed_whole(lift: Node, rgb: Tensor, bands: Bands, within: float) -> LowRankCube:
    """The reference of both: the cube of the other reference, and its own components."""
    assert lift.hooks.reference is not None
    assert compress.hooks.reference is not None
    found: LowRankCube = compress.hooks.reference(lift.hooks.reference(rgb, bands), within=within)
    return found


def _basis(bands: Bands) -> Tensor:
    inside_charts(bands)
    return mallett().at(bands.centres).T


def _estimator(bands: Bands) -> Tensor:
    inside_charts(bands)
    return _solved(tuple(float(c) for c in bands.centres))


@functools.lru_cache(maxsize=16)
def _solved(centres: tuple[float, ...]) -> Tensor:
    """W, (band, 3) float64."""
    at = torch.tensor(centres, dtype=torch.float64)
    return lift_matrix(torch.cat([paint.at(at) for paint in paints()]), at)


def lift_matrix(known: Tensor, centres: Tensor) -> Tensor:
    """W of known reflectances (spectrum, band): the matrix (band, 3) float64 from linear sRGB to the likeliest one."""
    second, rgb = known.T @ known / len(known), to_srgb(centres)
    seen = rgb @ second @ rgb.T
    if len(centres) < 3 or not float(torch.linalg.cond(seen)) < 1e10:
        ends = f"{len(centres)} bands from {float(centres[0]) * 1e9:.4g} to {float(centres[-1]) * 1e9:.4g} nm"
        raise ValueError(f"{ends} cannot carry three colours: use more bands, such as 31 from 400 to 700 nm")
    weights: Tensor = torch.linalg.solve(seen, rgb @ second).T
    return weights


def inside_charts(bands: Bands) -> None:
    """Refuse bands at which no chart was measured."""
    low, high = float(bands.centres.min()), float(bands.centres.max())
    if low < _FIRST - 1e-12 or high > _LAST + 1e-12:
        raise ValueError(
            f"bands from {low * 1e9:.4g} to {high * 1e9:.4g} nm, but reflectances are known from 380 to 780 nm: "
            "choose bands inside it"
        )
