"""Low-rank approximations of a spectral cube, with an error bound."""

from collections.abc import Callable
from typing import Annotated, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.values import LowRankCube

# --- principal planes -----------------------------------------------------------------------------

# Principal components of a spectral cube, computed and verified in blocks of pixels.


_PIECE_PIXELS = 4096  #: pixels of a block: 31 bands in float64 take 1 MB and fit in the cache
_LEAST_ROUND_OFFS = 8  #: smallest error that can be guaranteed, in round-off units of the planes
#: relative resolution of a root mean square that is computed from products in float64
_RMS_RESOLUTION = 2e-7


class Source(NamedTuple):
    """A spectral cube that is read in blocks of pixels, so that the whole cube is never in
    memory.
    """

    #: a block of pixels, (band, pixel) float64, as a copy that may be changed
    part: Callable[[slice], Tensor]
    bands: int
    pixels: int
    dtype: torch.dtype  #: type of the planes

    def pieces(self) -> list[slice]:
        return [
            slice(i, min(i + _PIECE_PIXELS, self.pixels))
            for i in range(0, self.pixels, _PIECE_PIXELS)
        ]


def few_planes(source: Source, within: float) -> LowRankCube:
    """Approximate a spectral cube by the fewest principal components that keep the rms error within
    a bound.

    The bound ``within`` is relative to the largest element. The planes and the map of errors are
    flat, with all pixels in one row. Raises ValueError for NaN.
    """
    largest, band_products = _largest_and_products(source)
    scale = float(largest.max())
    # products near the limits of float64 are computed again from the cube / its largest element
    scaled = scale > 0 and not 1e-280 < float(band_products.amax()) < 1e280
    if scaled:
        band_products = _largest_and_products(source, scale)[1]
    axes = torch.linalg.eigh(band_products).eigenvectors.flip(1)
    round_off = torch.finfo(source.dtype).eps
    target = max(within, _LEAST_ROUND_OFFS * round_off, _RMS_RESOLUTION) * scale
    spread = _rms_errors(band_products / source.pixels, axes, source.bands, round_off) * (
        scale if scaled else 1.0
    )
    count = max(
        1,
        next(
            (k for k, band_errors in enumerate(spread) if float(band_errors.max()) <= target),
            source.bands,
        ),
    )
    planes, largest_by_band, largest_by_pixel = _projection(source, axes[:, :count])
    residual = bound_by_planes(largest, planes, axes[:, :count], largest_by_band)
    # the estimated rms error cannot exceed the measured largest error
    spread = torch.cat([spread[:count], torch.minimum(spread[count], residual[count])[None]])
    return LowRankCube(planes, axes[:, :count], residual, spread, largest_by_pixel)


def _largest_and_products(source: Source, scale: float = 1.0) -> tuple[Tensor, Tensor]:
    """Return the largest absolute element of each band of a cube, and the Gram matrix of the bands.

    The Gram matrix is that of the cube divided by ``scale``.
    """
    if not source.pixels or not source.bands:
        raise ValueError("the cube has no pixels: give a scene with pixels")
    band_maxima, band_products = [], None
    for piece in source.pieces():
        block = source.part(piece).div_(scale) if scale != 1.0 else source.part(piece)
        band_products = (
            block @ block.T if band_products is None else band_products.addmm_(block, block.T)
        )
        band_maxima.append(block.abs_().amax(1))
    largest = torch.stack(band_maxima).amax(0) * scale
    if band_products is None or not bool(torch.isfinite(largest).all()):
        raise ValueError(
            "the cube holds NaN or infinite values: replace these values, or do not compress the"
            " cube"
        )
    return largest, band_products


def _projection(source: Source, axes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the projection of a spectral cube on the axes (band, k) of principal components,
    computed block by block.

    The result is the basis images (k, pixel) in the precision of the source, and the largest error
    of each band and of each pixel.
    """
    planes = torch.empty(axes.shape[1], source.pixels, dtype=source.dtype, device=axes.device)
    largest_by_band, largest_by_pixel = (
        axes.new_zeros(source.bands),
        planes.new_empty(source.pixels),
    )
    for piece in source.pieces():
        block = source.part(piece)
        planes[:, piece] = axes.T @ block
        block_errors = block.sub_(axes @ planes[:, piece].double()).abs_()
        largest_by_band = torch.maximum(largest_by_band, block_errors.amax(1))
        largest_by_pixel[piece] = block_errors.amax(0)
    # the errors of the pixels are bounds, so they are rounded up
    return planes, largest_by_band, largest_by_pixel.mul_(1 + 2 * torch.finfo(source.dtype).eps)


def _rms_errors(power: Tensor, axes: Tensor, count: int, eps: float) -> Tensor:
    """Return the rms error of each band if a spectral cube is approximated by its first k principal
    components.

    The rows of the result are for k = 0, 1, 2 and so on. The error is that of the omitted
    components plus the round-off of the basis images. ``power`` holds the mean products of the
    bands. The round-off of these products counts as part of the error.
    """
    powers = axes.square() * ((power @ axes) * axes).sum(0).clamp_min(0)
    # power of the components from the k-th on, for k = 0, 1, 2 ...
    omitted = torch.cat([powers.flip(1).cumsum(1).flip(1), torch.zeros_like(powers[:, :1])], 1)[
        :, : count + 1
    ].T
    band_power = power.diagonal()
    product_round_off = 64 * torch.finfo(torch.float64).eps * band_power.sum()
    plane_count = torch.arange(count + 1, dtype=band_power.dtype, device=band_power.device)[:, None]
    return (omitted + product_round_off).sqrt() + eps * (plane_count * band_power).sqrt()


def bound_by_planes(largest: Tensor, planes: Tensor, basis: Tensor, last: Tensor) -> Tensor:
    """Return a bound of the largest error of each band if a cube is approximated by its first k
    principal components.

    The rows of the result are for k = 0, 1, 2 and so on. The errors with no component and with all
    components are measured. In between, the bound adds the omitted components to the error with all
    components.
    """
    by_plane = basis.abs() * torch.maximum(planes.amax(1), -planes.amin(1)).double()
    # round-off of the measurement
    last = last + 4 * torch.finfo(torch.float64).eps * (largest + by_plane.sum(1))
    # row k: upper bound of the sum of the planes from the k-th on
    plane_bounds = by_plane.flip(1).cumsum(1).flip(1).T
    return torch.cat([largest[None], last + plane_bounds[1:], last[None]])


# --- low rank cube --------------------------------------------------------------------------------

# Low-rank approximation of a spectral cube: a sum of a few basis images times spectra, with an
# error bound.


Share = Annotated[float, Field(ge=0, le=1)]  #: relative to the largest element


@node(rtol=1e-6)
def compress(cube: Tensor, *, within: Share = 1e-6) -> LowRankCube:
    """Approximate a spectral cube by the fewest principal components that keep the error within a
    bound.

    A grey scene needs one basis image. A linear estimate from RGB needs three, or a few more if
    pixels are clipped.

    Shapes: cube (band, y, x) -> planes (k, y, x), basis (band, k), residual_max and residual_rms (k
            + 1, band) float64, residual_map (y, x).
    Units:  planes and residuals as the cube; the basis has no unit.
    Error:  `residual_rms[k]` is at most the largest of `within`, 2e-7 and eight round-off units of
            the planes, times the largest element. `residual_max[k]` and `residual_map` are the
            largest errors of a band and of a pixel, measured on every pixel in float64.
            `residual_max[r]` for 0 < r < k is as a rule at most five times too large. The gradient
            treats the basis as constant.
    Raises: ValueError where the cube is not (band, y, x), has no pixels or holds NaN.
    Source: principal components, Pearson 1901; Maloney, J. Opt. Soc. Am. A 3, 1673 (1986) for
            spectra.
    """
    if cube.ndim != 3:
        raise ValueError(
            f"cube has shape {tuple(cube.shape)}, not (band, y, x): compress one scene at a time"
        )
    flat_cube = cube.detach().flatten(1)
    dtype = cube.dtype if cube.dtype == torch.float64 else torch.float32
    source = Source(
        lambda pixels: flat_cube[:, pixels].to(torch.float64, copy=True),
        len(flat_cube),
        flat_cube.shape[1],
        dtype,
    )
    return as_low_rank_cube(few_planes(source, within), cube)


def as_low_rank_cube(flat: LowRankCube, cube: Tensor) -> LowRankCube:
    """Reshape the flattened basis images of a low-rank cube to the rows and columns of ``cube``.

    If ``cube`` requires a gradient, the basis images are computed anew as projections of ``cube``.
    """
    if cube.requires_grad:
        planes = torch.tensordot(flat.basis.T.to(cube), cube, 1)
    else:
        planes = flat.planes.reshape(-1, *cube.shape[-2:])
    return flat._replace(planes=planes, residual_map=flat.residual_map.reshape(cube.shape[-2:]))


@compress.reference
def _(cube: Tensor, *, within: float = 1e-6) -> LowRankCube:
    flat_cube = cube.double().flatten(1)
    axes = torch.linalg.svd(flat_cube, full_matrices=False)[0]
    errors = [
        flat_cube - axes[:, :plane_count] @ (axes[:, :plane_count].T @ flat_cube)
        for plane_count in range(axes.shape[1] + 1)
    ]
    rms_errors = torch.stack([error.square().mean(1).sqrt() for error in errors])
    allowed_error = within * float(flat_cube.abs().max())
    count = max(
        1,
        next(
            (
                plane_count
                for plane_count, x in enumerate(rms_errors)
                if float(x.max()) <= allowed_error
            ),
            axes.shape[1],
        ),
    )
    planes = (axes[:, :count].T @ flat_cube).reshape(-1, *cube.shape[1:])
    residual = torch.stack([error.abs().amax(1) for error in errors])
    largest_by_pixel = errors[count].abs().amax(0).reshape(cube.shape[1:])
    return LowRankCube(
        planes, axes[:, :count], residual[: count + 1], rms_errors[: count + 1], largest_by_pixel
    )


@compress.check
def plane_checks(result: LowRankCube, *inputs: object, **params: object) -> list[Check]:
    """Report the number of basis images of a low-rank cube, and the error relative to the full
    spectral cube.
    """
    rms, largest = (
        float(x[-1].max()) / max(float(result.residual_max[0].max()), 1e-300)
        for x in (result.residual_rms, result.residual_max)
    )
    count = f"{len(result.planes)} basis images for {len(result.basis)} bands"
    return [
        Check(
            f"{count}: error {rms:.2g} rms, {largest:.2g} at most, relative to the largest element"
            " of the cube"
        )
    ]


# --- linear planes --------------------------------------------------------------------------------

# Low-rank form of a spectral cube that is a matrix times a picture, with negative light clipped to
# 0.
#
# Without the clipping, such a cube has as many principal components as the picture has channels,
# and these follow from the products of the channels: the cube itself need not be analysed. The
# clipped light is measured on every pixel.


_LINEAR_PIECE_PIXELS = (
    1 << 14
)  #: pixels of a block: 31 bands in float32 take 2 MB and fit in the cache
_SAMPLED_PIXELS = (
    1 << 14
)  #: pixels of a sample from which the error due to clipping is estimated first
_LEAST_ERROR = 1e-5  #: smallest allowed error: float32 alone has an error of a few 1e-7


class _Axes(NamedTuple):
    """Orthonormal spectra of the unclipped cube, the strongest first, and the weights that compute
    the planes from the picture.
    """

    basis: Tensor  #: (band, k) float64
    weights: Tensor  #: (k, channel) float64
    power: Tensor  #: (k,) mean square of each plane


def linear_planes(picture: Tensor, matrix: Tensor, within: float) -> LowRankCube | None:
    """Return the cube ``matrix @ picture``, clipped at 0, with the smallest number of components
    for an rms error of at most ``within``.

    The error is relative to the largest element. The result is None if more components are needed
    than the picture has channels, or if ``within`` is below 1e-5.

    Shapes: picture (channel, pixel) float32, matrix (band, channel) float64.
    """
    if (
        picture.dtype != torch.float32
        or within < _LEAST_ERROR
        or not bool(torch.isfinite(picture.sum(1)).all())
    ):
        return None
    axes = _axes(picture, matrix)
    sampled_cube = matrix @ picture[:, :: max(1, picture.shape[1] // _SAMPLED_PIXELS)].double()
    allowed_error = within * float(sampled_cube.amax())
    count = next(
        (
            k
            for k in range(1, len(axes.power) + 1)
            if float(_omitted_rms(axes, k).max()) <= allowed_error
        ),
        0,
    )
    # the clipped light alone would exceed the allowed error
    if not count or float(sampled_cube.clamp_max(0).square().mean(1).max()) >= allowed_error**2:
        return None
    cube = _measured_cube(picture, matrix, axes, count)
    return (
        cube
        if float(cube.residual_rms[-1].max()) <= within * float(cube.residual_max[0].max())
        else None
    )


def _axes(picture: Tensor, matrix: Tensor) -> _Axes:
    """Return the principal components of the cube ``matrix @ picture`` before it is clipped."""
    channel_products = matrix.new_zeros(len(picture), len(picture))
    for start in range(0, picture.shape[1], _LINEAR_PIECE_PIXELS):
        block = picture[:, start : start + _LINEAR_PIECE_PIXELS].double()
        channel_products.addmm_(block, block.T)
    values, vectors = torch.linalg.eigh(channel_products / picture.shape[1])
    # root @ root.T is the mean product of the channels
    product_root = vectors * values.clamp_min(0).sqrt()
    basis, strength, _ = torch.linalg.svd(matrix @ product_root, full_matrices=False)
    return _Axes(basis, basis.T @ matrix, strength.square())


def _omitted_rms(axes: _Axes, count: int) -> Tensor:
    """Return the rms error of each band of the unclipped cube if only its first ``count``
    components are kept.
    """
    return (axes.basis[:, count:].square() @ axes.power[count:]).sqrt()


def _measured_cube(picture: Tensor, matrix: Tensor, axes: _Axes, count: int) -> LowRankCube:
    """Return the low-rank cube of the first ``count`` components of ``matrix @ picture``, clipped
    at 0, with the errors that omitted components and clipping leave, measured on every pixel.
    """
    basis, weights = axes.basis[:, :count], axes.weights[:count]
    matrix_of_all, matrix_of_components = (
        matrix.to(picture),
        None if count == len(axes.power) else (basis @ weights).to(picture),
    )
    planes, largest_by_pixel = (
        picture.new_empty(count, picture.shape[1]),
        picture.new_empty(picture.shape[1]),
    )
    block_maxima, block_errors, square_sums = [], [], matrix.new_zeros(len(matrix))
    for start in range(0, picture.shape[1], _LINEAR_PIECE_PIXELS):
        columns = slice(start, start + _LINEAR_PIECE_PIXELS)
        block = picture[:, columns]
        planes[:, columns] = weights @ block.double()
        bands = matrix_of_all @ block
        block_maxima.append(bands.amax(1))
        # with all components the unclipped cube is exact: only clipped (negative) light is an error
        if matrix_of_components is None:
            clipped_light = bands.amin(0).neg_().clamp_min_(0)
            largest_by_pixel[columns], clipped_pixels = clipped_light, clipped_light.nonzero()[:, 0]
            errors = bands[:, clipped_pixels].clamp_max_(0)
        else:
            # clipped cube minus its components
            errors = bands.clamp_min_(0).sub_(matrix_of_components @ block)
            largest_by_pixel[columns] = errors.abs().amax(0)
        if errors.shape[1]:
            block_errors.append(errors.abs().amax(1))
            square_sums += errors.square().sum(1)
    rms = (square_sums / picture.shape[1]).sqrt()
    errors_of_bands = _BandErrors(torch.stack(block_maxima), block_errors, rms)
    return _bounded_cube(planes, basis, axes, largest_by_pixel, errors_of_bands)


class _BandErrors(NamedTuple):
    """Largest elements and errors of each band of a cube, measured in blocks of pixels."""

    block_maxima: Tensor  #: (block, band) largest element
    block_errors: list[Tensor]  #: largest error (band,) of each block with an error
    rms: Tensor  #: (band,) error of the whole cube


def _bounded_cube(
    planes: Tensor,
    basis: Tensor,
    axes: _Axes,
    largest_by_pixel: Tensor,
    measured: _BandErrors,
) -> LowRankCube:
    """Return the low-rank cube with the bounds of its errors, to which the rounding of float32 is
    added.

    ``largest_by_pixel`` is the largest error of each pixel.
    """
    largest = measured.block_maxima.amax(0).double().clamp_min(0)
    plane_maxima = torch.maximum(planes.amax(1), -planes.amin(1)).double()
    rounding = 4 * torch.finfo(planes.dtype).eps * float((basis.abs() @ plane_maxima).max())
    largest_by_band = (
        torch.stack(measured.block_errors).amax(0).double()
        if measured.block_errors
        else torch.zeros_like(largest)
    ) + rounding
    earlier_errors = [_omitted_rms(axes, k) + measured.rms for k in range(planes.shape[0])]
    rms_errors = torch.stack([*earlier_errors, measured.rms]) + rounding
    return LowRankCube(
        planes,
        basis,
        bound_by_planes(largest, planes, basis, largest_by_band),
        rms_errors,
        largest_by_pixel.add_(rounding),
    )
