"""Linear estimates of reflectance spectra from RGB."""

import functools
from collections.abc import Callable

import torch
from torch import Tensor

from neusee.nodes import Check, Node, node
from neusee.nodes.precision import single
from neusee.nodes.spectra._cie_tables import mallett, paints, require_range, to_srgb
from neusee.nodes.spectra._low_rank_cube import (
    Share,
    Source,
    as_low_rank_cube,
    compress,
    few_planes,
    linear_planes,
    plane_checks,
)
from neusee.nodes.values import Bands, LowRankCube

_FIRST, _LAST = 380e-9, 780e-9  #: m, range of the measured reflectances and of the basis


@node(rtol=1e-5)
def lift_mallett(rgb: Tensor, bands: Bands) -> Tensor:
    """Reconstruct the reflectance of each pixel from RGB as a weighted sum of three basis spectra.

    The basis spectra sum to 1 at every wavelength. `RGB_to_sd_Mallett2019` of colour-science gives
    the same numbers for a single pixel, without a gradient.

    Shapes: rgb (3, y, x) -> (band, y, x).
    Units:  linear sRGB to reflectance; the estimate is linear and keeps HDR values above 1.
    Error:  real paints: PSNR 31 dB (CAVE balloons); the result, rendered to sRGB under D65, is
            within 5e-3 of rgb. Negative results are clipped.
    Raises: ValueError where rgb is not (3, y, x) or bands leave 380 to 780 nm.
    Source: Mallett and Yuksel, Spectral primary decomposition, EGSR 2019; basis from
            colour-science.
    """
    return _lifted(rgb, _basis(bands))


@node(rtol=1e-6)
def lift_mallett_mixture(rgb: Tensor, bands: Bands, *, within: Share = 1e-6) -> LowRankCube:
    """Compute the result of `spectra.lift_mallett` as a low-rank cube: a sum of a few basis images
    times spectra.

    Pixels are computed block by block, so that the full cube is never in memory.

    Shapes: rgb (3, y, x) -> planes (k, y, x), basis (band, k), residual_max and residual_rms (k +
            1, band) float64.
    Units:  planes and residuals are reflectances; the basis has no unit.
    Error:  as `spectra.compress`, relative to `lift_mallett` in float64; float32 differs by
            round-off.
    Raises: ValueError where `lift_mallett` or `spectra.compress` raises ValueError.
    Source: as `lift_mallett`.
    """
    return _mixed(rgb, _basis(bands), within)


@node(rtol=1e-5)
def lift_lmmse(rgb: Tensor, bands: Bands) -> Tensor:
    """Estimate reflectance from RGB by the linear minimum-mean-square-error estimator fitted to
    measured colour charts.

    W = C T^t (T C T^t)^-1 with C = E[s s^t] over the paints and the matrix T from reflectance under
    D65 to linear sRGB.

    Shapes: rgb (3, y, x) -> (band, y, x).
    Units:  linear sRGB to reflectance; the estimate is linear and keeps HDR values above 1.
    Error:  real paints: PSNR 33.3 dB, mean relative error 0.15 (CAVE balloons); the result,
            rendered to sRGB, is rgb exactly, except where a negative result is clipped. White gets
            the reflectance of white paint: 0.62 at 400 nm, 0.94 to 1.12 from 420 nm.
    Raises: ValueError where rgb is not (3, y, x), and where bands leave 380 to 780 nm or are too
            few or too close to distinguish colours.
    Source: Wiener estimation as in Pratt and Mancill, Appl. Opt. 15, 73 (1976); charts of
            colour-science.
    """
    return _lifted(rgb, _estimator(bands))


@node(rtol=1e-6)
def lift_lmmse_mixture(rgb: Tensor, bands: Bands, *, within: Share = 1e-6) -> LowRankCube:
    """Compute the result of `spectra.lift_lmmse` as a low-rank cube: a sum of a few basis images
    times spectra.

    Pixels are computed block by block, so that the full cube is never in memory.

    Shapes: rgb (3, y, x) -> planes (k, y, x), basis (band, k), residual_max and residual_rms (k +
            1, band) float64.
    Units:  planes and residuals are reflectances; the basis has no unit.
    Error:  as `spectra.compress`, relative to `lift_lmmse` in float64; float32 differs by
            round-off.
    Raises: ValueError where `lift_lmmse` or `spectra.compress` raises ValueError.
    Source: as `lift_lmmse`.
    """
    return _mixed(rgb, _estimator(bands), within)


# --- hooks of both lifts --------------------------------------------------------------------------


def _attach(lift: Node, low_rank: Node, matrix: Callable[[Bands], Tensor]) -> None:
    """Attach a float64 reference, a check and a low-rank variant to a node that multiplies RGB
    by a matrix.
    """

    @lift.reference
    def lifted(rgb: Tensor, bands: Bands) -> Tensor:
        return torch.einsum("bc,cyx->byx", matrix(bands).to(rgb.device), rgb.double()).relu()

    @lift.check
    def _(result: Tensor, rgb: Tensor, bands: Bands) -> list[Check]:
        return lift_checks(result, rgb, bands, matrix(bands))

    @low_rank.reference
    def _(rgb: Tensor, bands: Bands, *, within: float = 1e-6) -> LowRankCube:
        assert compress.hooks.reference is not None
        planes: LowRankCube = compress.hooks.reference(lifted(rgb, bands), within=within)
        return planes

    low_rank.check(plane_checks)
    lift.low_rank_form = low_rank


def lift_checks(
    result: Tensor, rgb: Tensor, bands: Bands, matrix: Tensor | None = None
) -> list[Check]:
    """Report the colour error of spectra estimated from RGB, and the share of negative light that
    was clipped to 0.

    A large picture is sampled at some 100 000 pixels.
    """
    # a sample of the pixels is enough
    step = max(1, rgb[0].numel() // 65536)
    colours, spectra = (t.detach().flatten(1)[:, ::step].double().cpu() for t in (rgb, result))
    scale = max(float(colours.abs().max()), 1e-30)
    error = float((to_srgb(bands.centres) @ spectra - colours).abs().max()) / scale
    checks = [
        Check(
            f"colours of the estimated spectra differ from the RGB input by {error:.2g} of the"
            " largest RGB value",
            float(result.min()) >= 0,
        )
    ]
    if matrix is not None:
        unclipped = matrix.cpu() @ colours
        negative_share = float(unclipped.clamp_max(0).abs().sum()) / max(
            float(unclipped.abs().sum()), 1e-30
        )
        checks.append(
            Check(
                f"{negative_share:.2%} of the reconstructed light was negative and is clipped to 0",
                negative_share < 0.05,
            )
        )
    return checks


def needs_rgb(rgb: Tensor) -> None:
    """Raise ValueError unless ``rgb`` is a picture of three channels (3, y, x)."""
    if rgb.ndim != 3 or rgb.shape[0] != 3:
        raise ValueError(
            f"rgb has shape {tuple(rgb.shape)}, not (3, y, x): connect a scene of three channels"
        )


def _lifted(rgb: Tensor, matrix: Tensor) -> Tensor:
    """Multiply an RGB picture by a matrix (band, 3), and set negative results to 0 in place to
    save memory.
    """
    needs_rgb(rgb)
    rgb = single(rgb)
    return torch.relu_(matrix.to(rgb) @ rgb.flatten(1)).reshape(-1, *rgb.shape[1:])


def _mixed(rgb: Tensor, matrix: Tensor, within: float) -> LowRankCube:
    """Estimate spectra from an RGB picture by a matrix (band, 3), and return the spectra as a
    low-rank cube.

    For a picture that requires a gradient, the full cube is computed, so that the gradient reaches
    the picture.
    """
    needs_rgb(rgb)
    flat_picture, matrix_float64 = rgb.detach().flatten(1), matrix.to(rgb.device)
    if (cube := linear_planes(flat_picture, matrix_float64, within)) is not None:
        return as_low_rank_cube(cube, _lifted(rgb, matrix) if rgb.requires_grad else rgb)
    dtype = rgb.dtype if rgb.dtype == torch.float64 else torch.float32
    source = Source(
        lambda pixels: (matrix_float64 @ flat_picture[:, pixels].double()).clamp_min_(0),
        len(matrix_float64),
        flat_picture.shape[1],
        dtype,
    )
    return as_low_rank_cube(
        few_planes(source, within), _lifted(rgb, matrix) if rgb.requires_grad else rgb
    )


def _basis(bands: Bands) -> Tensor:
    """Return the matrix (band, 3) of the basis reflectances of Mallett and Yuksel."""
    inside_charts(bands)
    return mallett().at(bands.centres).T


def _estimator(bands: Bands) -> Tensor:
    """Return the matrix (band, 3) of the estimator for bands."""
    inside_charts(bands)
    return _solved(tuple(float(c) for c in bands.centres))


@functools.lru_cache(maxsize=16)
def _solved(centres: tuple[float, ...]) -> Tensor:
    """Return the matrix (band, 3) float64 of `lift_lmmse` for bands with the given centre
    wavelengths in m.
    """
    wavelengths = torch.tensor(centres, dtype=torch.float64)
    return lift_matrix(torch.cat([paint.at(wavelengths) for paint in paints()]), wavelengths)


def lift_matrix(measured: Tensor, centres: Tensor) -> Tensor:
    """Return the matrix that estimates reflectance from linear sRGB, fitted to the measured spectra
    ``measured``.

    Shapes: known (spectrum, band) -> (band, 3) float64.
    """
    spectra_products, rgb_of_spectra = measured.T @ measured / len(measured), to_srgb(centres)
    rgb_products = rgb_of_spectra @ spectra_products @ rgb_of_spectra.T
    if len(centres) < 3 or not float(torch.linalg.cond(rgb_products)) < 1e10:
        ends = (
            f"{len(centres)} bands from {float(centres[0]) * 1e9:.4g} to"
            f" {float(centres[-1]) * 1e9:.4g} nm"
        )
        raise ValueError(
            f"{ends} cannot distinguish three colours: use more bands, such as 31 from 400 to"
            " 700 nm"
        )
    # least mean square error: E[s c'] E[c c']^-1 for colours c of spectra s
    weights: Tensor = torch.linalg.solve(rgb_products, rgb_of_spectra @ spectra_products).T
    return weights


def inside_charts(bands: Bands) -> None:
    """Raise ValueError for bands outside 380 to 780 nm, the range of the measured colour charts."""
    require_range(bands.centres, (_FIRST, _LAST), "reflectances are known from")


_attach(lift_mallett, lift_mallett_mixture, _basis)
_attach(lift_lmmse, lift_lmmse_mixture, _estimator)
