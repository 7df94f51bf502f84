"""The field-dependent PSF of a camera, fitted to measured frames of point sources."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import torch
from pydantic import AfterValidator, Field
from torch import Generator, Tensor
from torch.nn.functional import avg_pool2d, conv2d, pad

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.restore._point_frames import (
    Camera,
    Layout,
    Linear,
    Seen,
    State,
    linear,
    moved,
    node_weights,
    read_points,
    refuse_bad_frames,
)
from neusee.nodes.sensor._digitization import Bits
from neusee.nodes.sensor._frame_file import Curve
from neusee.nodes.sensor._saturation import Well, refuse_without_room, refuse_without_steps
from neusee.nodes.units import DataFiles, Electrons, Gain, Shape
from neusee.nodes.values import MeasuredPsf

# --- point fit ------------------------------------------------------------------------------------

# The maximum likelihood PSF for frames of point sources, and random draws of its error.
#
# Places, signals, backgrounds and PSFs are fitted together by Gauss-Newton steps (Bjoerck,
# Numerical Methods for Least Squares Problems, 1996, ch. 9), so that the error of the centring is
# part of the error of the PSF.


_SEARCH = 6  #: largest distance in pixels of a point from its first guess
_STEPS = 30  #: largest number of Gauss-Newton steps
_ENOUGH = 1e-4  #: the fit ends when no point moves by more pixels in a step
_MOST = 0.4  #: largest move of a point in one step, pixels
_HALVED = 8  #: largest number of times that a step is halved
_SURE = 4.0  #: a pixel is used if its expectation is this many standard deviations below saturation
_CALM = 1e-9  #: damping of a step, relative to the largest curvature
_ITERATIONS = 300  #: largest number of conjugate gradient iterations
_RESIDUAL = 1e-8  #: the iterations end at this squared residual, relative to the first
_SHARED = 1.02  #: inflation of a variance above which the points depend on several PSFs each
_CORE = 2  #: radius in pixels of the core of a PSF, in which points are counted
_ALONE = 1e-9  #: lower limit of an eigenvalue of A^T A, for nodes that cannot be separated
_LOCAL = 5  #: side in pixels of the square over which chi-square is averaged


class Fit(NamedTuple):
    """The fitted PSFs and draws of them, in the form of `MeasuredPsf`."""

    kernels: Tensor  #: (node, channel, y, x)
    draws: Tensor  #: (draw, node, channel, y, x)
    state: State
    chi: Tensor  #: (channel,)
    support: Tensor  #: (node,)
    inflation: Tensor  #: (node,)


def fitted(pixels: Seen, layout: Layout, count: int, rng: Generator) -> Fit:
    """Return the PSFs at the nodes, and draws of them; raise ValueError if a part of a PSF is
    measured by no pixel.
    """
    share = node_weights(pixels.middle, layout.shape, layout.zones)
    state, weight = _start(pixels, share, layout.window)
    unchanged_ways = _hold(linear(pixels, state, share), state.kernels, weight)
    _refuse_unseen(linear(pixels, state, share), weight)
    for _ in range(_STEPS):
        linear_model = linear(pixels, state, share)
        residual = pixels.light - linear_model.model(state.background)
        step = _solved(
            linear_model, unchanged_ways, weight, _slope(linear_model, state, weight, residual)
        )
        offset_before = state.offset
        state = _ahead(
            pixels, state, share, weight, step._replace(offset=step.offset.clamp(-_MOST, _MOST))
        )
        weight = _weight(pixels, linear(pixels, state, share).model(state.background))
        if float((state.offset - offset_before).abs().max()) < _ENOUGH:
            break
    linear_model = linear(pixels, state, share)
    residual = pixels.light - linear_model.model(state.background)
    _refuse_unseen(linear_model, weight)
    kernels = gauged(state.kernels)
    local_misfit = _misfit(linear_model, weight, residual)
    draws = []
    for _ in range(count):
        # the step for a random noise of the frames is a draw of the error
        noise = _normal(weight, rng) * weight.sqrt()
        slope = linear_model.slope(noise)
        slope = slope._replace(
            background=slope.background + _normal(pixels.doubt, rng) / pixels.doubt.sqrt()
        )
        drawn_kernels = gauged(
            state.plus(_solved(linear_model, unchanged_ways, weight, slope)).kernels
        )
        draws.append((kernels + local_misfit * (drawn_kernels - kernels)).float())
    return Fit(
        kernels,
        torch.stack(draws),
        state,
        _reduced_chi_square(weight, residual, linear_model),
        *_support(linear_model, weight),
    )


def gauged(kernels: Tensor) -> Tensor:
    """Return the kernels, shifted so that their centres are in the middle of the window, and scaled
    to sum 1.

    The centre is the mean place, weighted by the square of the sum of the channels. Noise in the
    wings hardly changes it.
    """
    offset = kernels.new_zeros(len(kernels), 2)
    centred = kernels
    # repeated, because the centre of a shifted kernel is again a little off the middle
    for _ in range(6):
        offset = offset - centre(centred)
        centred = moved(kernels, offset)
    return centred / centred.sum((-2, -1), keepdim=True)


def centre(kernels: Tensor) -> Tensor:
    """Return the centre (node, 2) of kernels (node, channel, y, x), in pixels from the middle
    pixel.
    """
    power = kernels.mean(1).square()
    y, x = (torch.arange(n, dtype=power.dtype) - n // 2 for n in power.shape[-2:])
    power_sum = power.sum((-2, -1))
    return torch.stack(
        [(power.sum(-1) * y).sum(-1) / power_sum, (power.sum(-2) * x).sum(-1) / power_sum], -1
    )


# --- start ----------------------------------------------------------------------------------------


def _start(pixels: Seen, share: Tensor, window: tuple[int, int]) -> tuple[State, Tensor]:
    """Return a first guess and the weight (channel, pixel) of each pixel.

    The guess has the same PSF at all nodes, the mean of the unclipped points.
    """
    points, channels, nodes = len(pixels.owner), len(pixels.light), share.shape[1]
    kernels = pixels.light.new_zeros(nodes, channels, *window)
    state = State(
        kernels,
        pixels.light.new_zeros(points, channels),
        pixels.light.new_zeros(points, 2),
        pixels.background,
    )
    linear_model = linear(pixels, state, share)
    stamps = linear_model.stamps_of(pixels.light - pixels.background.T[:, pixels.frame])
    weight = _weight(pixels, pixels.light)
    weights = linear_model.stamps_of(weight)
    # points without a clipped pixel in any channel
    unclipped_points = (
        (linear_model.stamps_of(pixels.clipped.double()) == 0).all(1).flatten(1).all(1)
    )
    valid = (weights[unclipped_points] > 0).double()
    # mean of these points at their valid pixels, each divided by its light
    guess = (stamps[unclipped_points] * valid).sum(0) / (
        valid * stamps[unclipped_points].sum((-2, -1), keepdim=True)
    ).sum(0).clamp_min(1e-9)
    guess = guess.clamp_min(0.0)
    guess = guess / guess.sum((-2, -1), keepdim=True).clamp_min(1e-9)
    for _ in range(2):
        offset, signal = _registered(stamps, weights, guess)
    return State(guess.expand_as(kernels).contiguous(), signal, offset, pixels.background), weight


def _registered(stamps: Tensor, weights: Tensor, guess: Tensor) -> tuple[Tensor, Tensor]:
    """Return the offset of each point, in whole pixels, at which the guessed PSF fits best, and its
    signal in each channel.
    """
    channels, search_padding = len(guess), (_SEARCH,) * 4
    product = conv2d(pad(weights * stamps, search_padding), guess[:, None], groups=channels)
    norm = conv2d(pad(weights, search_padding), guess.square()[:, None], groups=channels).clamp_min(
        1e-30
    )
    # largest product^2 / norm, summed over channels: the gain of a least-squares signal
    best_place = (product.clamp_min(0.0).square() / norm).sum(1).flatten(1).argmax(1)
    signal = (
        (product / norm)
        .flatten(2)
        .gather(2, best_place[:, None, None].expand(-1, channels, 1))[..., 0]
    )
    side = 2 * _SEARCH + 1
    offset = torch.stack([best_place // side, best_place % side], 1).double() - _SEARCH
    return offset, signal.clamp_min(1e-3)


# --- steps ----------------------------------------------------------------------------------------


def _weight(pixels: Seen, expected: Tensor) -> Tensor:
    """Return 1 / variance of each pixel; 0 for a pixel that is clipped, or is expected within
    `_SURE` standard deviations of the clip level.
    """
    background = pixels.background.T[:, pixels.frame]
    variance = pixels.floor.T[:, pixels.frame] + (expected - background).clamp_min(0.0)
    unusable = pixels.clipped | (expected > pixels.level - _SURE * variance.sqrt())
    return torch.where(unusable, 0.0, 1.0 / variance)


def _slope(near: Linear, state: State, weight: Tensor, residual: Tensor) -> State:
    """Return the gradient of the log likelihood with respect to a state, including the measured
    backgrounds.
    """
    slope = near.slope(weight * residual)
    pull_to_background = (near.seen.background - state.background) / near.seen.doubt
    return slope._replace(background=slope.background + pull_to_background)


def _ahead(pixels: Seen, state: State, share: Tensor, weight: Tensor, step: State) -> State:
    """Return the state after a step, which is halved until chi-square falls; the old state if it
    never falls.
    """
    square_before = _square(pixels, state, linear(pixels, state, share), weight)
    for _ in range(_HALVED):
        next_state = state.plus(step)
        if float(_square(pixels, next_state, linear(pixels, next_state, share), weight)) < float(
            square_before
        ):
            return next_state
        step = State(*(0.5 * entry for entry in step))
    return state


def _square(pixels: Seen, state: State, near: Linear, weight: Tensor) -> Tensor:
    """Return chi-square of the frames and of their measured backgrounds."""
    background_misfit = (pixels.background - state.background).square() / pixels.doubt
    return (
        weight * (pixels.light - near.model(state.background)).square()
    ).sum() + background_misfit.sum()


def _curvature(near: Linear, weight: Tensor) -> State:
    """Return an approximate diagonal of the normal matrix; for the PSFs, shifts of the points are
    neglected.
    """
    stamps = near.stamps_of(weight)
    kernels = torch.tensordot(
        near.share.square(), near.signal.square()[..., None, None] * stamps, ([0], [0])
    )
    signal = (stamps * near.patterns[0].square()).sum((-2, -1))
    offset = (stamps * near.patterns[1:].square()).sum((-3, -2, -1)).T
    count = weight.new_zeros(len(near.seen.background), len(weight)).index_add(
        0, near.seen.frame, weight.T
    )
    diagonal = State(kernels, signal, offset, count + 1.0 / near.seen.doubt)
    return State(*(x + 1e-3 * x.amax() * (x <= 0) + _CALM * x.amax() for x in diagonal))


def _solved(near: Linear, hold: Hold, weight: Tensor, right: State) -> State:
    """Return the step for a gradient, by conjugate gradients with a diagonal preconditioner.

    A shift of all points is equivalent to a shift of the PSFs, and a factor of a PSF to a factor of
    the signals. ``hold`` removes this ambiguity.
    """
    diagonal = _curvature(near, weight)
    inverse_diagonal = State(*(1.0 / x for x in diagonal))
    damping = State(*(_CALM * x.amax() * torch.ones_like(x) for x in diagonal))
    x = State(*(torch.zeros_like(entry) for entry in right))
    residual = _free(right, hold)
    # the iteration is restricted to changes that the frames determine
    direction = _free(residual.times(inverse_diagonal), hold)
    residual_norm = residual.dot(direction)
    first_norm = residual_norm
    for _ in range(_ITERATIONS):
        if float(residual_norm) <= _RESIDUAL * float(first_norm):
            break
        product = near.slope(weight * near.change(direction)).plus(direction.times(damping))
        product = product._replace(
            background=product.background + direction.background / near.seen.doubt
        )
        product = _free(product, hold)
        step = residual_norm / direction.dot(product)
        x, residual = x.plus(direction, step), residual.plus(product, -step)
        preconditioned = _free(residual.times(inverse_diagonal), hold)
        residual_norm, norm_before = residual.dot(preconditioned), residual_norm
        direction = preconditioned.plus(direction, residual_norm / norm_before)
    return x


class Hold(NamedTuple):
    """The changes that are excluded from a fit, because a shift of all points is equivalent to a
    shift of the PSFs.
    """

    points: Tensor  #: (point, point), projection on the excluded shifts of the points
    #: (direction, node, channel, y, x), excluded changes of the PSFs: their shifts
    ways: Tensor | None


def _hold(near: Linear, kernels: Tensor, weight: Tensor) -> Hold:
    """Return the excluded changes.

    If each point depends on one PSF, the points are held, so that a PSF need not be known between
    pixels. If points depend on several PSFs, the PSFs are held in the middle of their windows: PSFs
    with different shifts would add up to a wider PSF.
    """
    if float(_support(near, weight)[1].max()) > _SHARED:
        return Hold(torch.zeros_like(near.share @ near.share.T), _ways(kernels))
    return Hold(near.share @ torch.linalg.pinv(near.share), None)


def _free(change: State, hold: Hold) -> State:
    """Return a change without its part that does not change the frames, which the fit would leave
    undetermined.
    """
    kernels = change.kernels - change.kernels.mean((-2, -1), keepdim=True)
    for direction in () if hold.ways is None else hold.ways:
        kernels = kernels - (direction * kernels).sum((-3, -2, -1), keepdim=True) * direction
    return change._replace(kernels=kernels, offset=change.offset - hold.points @ change.offset)


def _ways(kernels: Tensor) -> Tensor:
    """Return the changes (2, node, channel, y, x) of each PSF for a shift down and to the right,
    orthogonal and of unit length.
    """
    directions = list[Tensor]()
    for direction in torch.gradient(kernels, dim=(-2, -1)):
        direction = direction - direction.mean((-2, -1), keepdim=True)
        # Gram-Schmidt: orthogonal to the first direction
        for other in directions:
            direction = direction - (direction * other).sum((-3, -2, -1), keepdim=True) * other
        directions.append(
            direction / direction.square().sum((-3, -2, -1), keepdim=True).sqrt().clamp_min(1e-30)
        )
    return torch.stack(directions)


def _refuse_unseen(near: Linear, weight: Tensor) -> None:
    """Raise ValueError if a pixel of a PSF is saturated, or beyond the edge, in every frame."""
    information = torch.tensordot(
        near.share.square(), (near.stamps_of(weight) > 0).double(), ([0], [0])
    )
    if missing := int((information <= 0).any(1).sum()):
        raise ValueError(
            f"{missing} pixels of the PSF are saturated, or beyond the edge, in every frame: add"
            " frames of a shorter exposure, move points from the edge, or choose a smaller window"
            " or fewer zones"
        )


# --- error ----------------------------------------------------------------------------------------


def _misfit(near: Linear, weight: Tensor, residual: Tensor) -> Tensor:
    """Return the square root of the reduced chi-square around each pixel of the window (y, x), at
    least 1.
    """
    squares, count = (
        near.stamps_of(x).sum((0, 1)) for x in (weight * residual.square(), (weight > 0).double())
    )
    local_means = [
        avg_pool2d(x[None, None], _LOCAL, 1, _LOCAL // 2, count_include_pad=False)[0, 0]
        # sums of squares and numbers of pixels around each pixel of the window
        for x in (squares, count)
    ]
    free_share = 1.0 - _unknowns(near) / float((weight > 0).sum())
    return (local_means[0] / (free_share * local_means[1]).clamp_min(1e-9)).clamp_min(1.0).sqrt()


def _reduced_chi_square(weight: Tensor, residual: Tensor, near: Linear) -> Tensor:
    """Return chi-square per degree of freedom (channel,)."""
    free_share = 1.0 - _unknowns(near) / float((weight > 0).sum())
    return (weight * residual.square()).sum(1) / ((weight > 0).sum(1) * free_share).clamp_min(1.0)


def _support(near: Linear, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Return for each node the effective number of points, and the inflation of the variance of its
    PSF.

    The effective number is the number of points in the middle of the zone that would determine the
    PSF equally well. The variance is inflated because a point between nodes depends on several
    PSFs. Both are those of the worst pixel in the core. With A the bilinear weights of the points
    that show a pixel, the number is 1 / diag((A^T A)^-1), and the inflation is diag((A^T A)^-1)
    diag(A^T A) (Kutner et al., Applied Linear Statistical Models, 5th ed., 2005, sec. 10.5): 1 for
    points in the middles of zones.
    """
    pixel_shown = near.stamps_of(weight) > 0
    middle_y, middle_x = (n // 2 for n in pixel_shown.shape[-2:])
    core_shown = (
        pixel_shown[
            ..., middle_y - _CORE : middle_y + _CORE + 1, middle_x - _CORE : middle_x + _CORE + 1
        ]
        .flatten(1)
        .double()
    )
    # the different sets of points that show a pixel
    patterns = torch.unique(core_shown, dim=1).T
    weight_products = near.share.T @ (patterns[:, :, None] * near.share)
    eigenvalues, eigenvectors = torch.linalg.eigh(weight_products)
    inverse = (eigenvectors.square() / eigenvalues.clamp_min(_ALONE)[:, None]).sum(-1)
    return (1.0 / inverse).amin(0), (inverse * weight_products.diagonal(dim1=-2, dim2=-1)).amax(0)


def _unknowns(near: Linear) -> float:
    """Return the number of fitted values, limited to 90 % of the number of pixels."""
    points, channels = near.signal.shape
    window = near.patterns.shape[-2] * near.patterns.shape[-1]
    number = near.share.shape[1] * channels * window + points * (channels + 2)
    return min(float(number), 0.9 * near.seen.light.numel())


def _normal(like: Tensor, rng: Generator) -> Tensor:
    drawn = torch.randn(like.shape, generator=rng, device=rng.device, dtype=like.dtype)
    return drawn.to(like)


# --- measured psf ---------------------------------------------------------------------------------

# The PSF of a camera by field, measured from frames of point sources.


_GOOD = 1.5  #: reduced chi-square above which the check of the fit fails
#: inflation of a variance above which the deviation may be smaller than the true error
_INFLATED = 4.0


def _require_odd(window: tuple[int, int]) -> tuple[int, int]:
    if any(n % 2 == 0 or n < 5 for n in window):
        raise ValueError(f"{list(window)} must be two odd numbers of at least 5")
    return window


Window = Annotated[Shape, AfterValidator(_require_odd)]
Draws = Annotated[int, Field(ge=4, le=1000)]


@node(device="cpu")
def measured_psf(
    responses: Tensor,
    *,
    files: DataFiles | None = None,
    window: Window = (65, 65),
    zones: Shape = (1, 1),
    draws: Draws = 24,
    shape: Shape,
    gain: Gain,
    offset: Electrons,
    full_well: Well,
    read_noise: Electrons,
    bits: Bits = 16,
    curve: Curve | None = None,
    rng: Generator,
) -> MeasuredPsf:
    """Measure the PSF of each channel by field from frames of point sources.

    Each frame shows one or several points. A file whose name begins with `dark` has no light: the
    mean of these files takes the place of `offset`. The signal, place and background of each point
    are free, so that exposures may have different lengths: a long one tells of the wings, a short
    one of the core. Pixels that are clipped, or expected within four standard deviations of
    clipping, do not count. The PSF is known at the middles of ``zones`` equal parts of the frame,
    and bilinear between them. All is fitted together: least squares, with the noise of the model.

    Shapes: responses (channel, band), of which only the number of channels counts
            -> kernels (row, column, channel, *window), with draws and deviation.
    Units:  files DN; kernels a share of the light in the window. Each kernel has the sum 1, and its
            centre, weighted by the square of the mean of the channels, is the middle pixel:
            distortion and an absolute shift are not measured, lateral colour is. ``outside`` bounds
            the light beyond the window if it falls as 1 / r^3 or faster from the rim, which light
            bent by the edge of a pupil does.
    Error:  `deviation`, from draws of the noise of photons, converter, background and centring: a
            relative standard deviation of 1 / sqrt(2 draws). Where the frames fit worse than their
            noise, the deviation grows by the root of chi-square in 5 x 5 pixels. Points far from
            the middles of the zones tell the PSFs of several nodes at once and inflate the
            variance. Up to an ``inflation`` of 3 the deviation was right; at 7 the error was up to
            1.7 times the deviation. Points between pixels are interpolated: 1e-4 for an image with
            up to 0.4 periods in a pixel; a sharper image shows as chi-square. The background beyond
            the windows counts as free of the light of points; pixels beyond windows twice as wide
            give it where there are enough.
    Raises: ParameterError before the run with every frame that cannot be used, and every zone
            without a point that is not saturated; ValueError where a pixel of the PSF is saturated
            in every frame.
    Source: Anderson and King, Publ. Astron. Soc. Pac. 112, 1360 (2000), an effective PSF from
            undersampled stars; Papandreou and Yuille, NIPS 23 (2010), for the draws.
    """
    camera = gain, offset, full_well, bits, read_noise
    layout = Layout(_pair(shape), _pair(window), _pair(zones))
    refuse_bad_frames(files or (), len(responses), layout, camera, curve)
    pixels = read_points(files or (), layout.window, camera)
    fit = fitted(pixels, layout, draws, rng)
    kernels = fit.kernels.reshape(*zones, *fit.kernels.shape[1:])
    drawn_kernels = fit.draws.reshape(-1, *kernels.shape)
    deviation = (drawn_kernels.double() - kernels).square().mean(0).sqrt()
    places = pixels.middle + fit.state.offset
    points = torch.cat(
        [pixels.owner[:, None].double(), places, fit.state.signal.sum(1, keepdim=True)], 1
    )
    support_and_inflation = (x.reshape(*zones) for x in (fit.support, fit.inflation))
    return MeasuredPsf(
        kernels,
        deviation,
        drawn_kernels,
        points,
        fit.chi,
        _outside(kernels, drawn_kernels.double()),
        *support_and_inflation,
    )


@measured_psf.preflight
def _(
    *,
    responses: Tensor | None = None,
    files: Sequence[Path] | None,
    window: tuple[int, int],
    zones: tuple[int, int],
    shape: tuple[int, int],
    **params: Any,
) -> list[str]:
    if files is None:
        raise ParameterError("files", "give the folder with frames of point sources")
    names = ("gain", "offset", "full_well", "bits", "read_noise")
    gain, offset, full_well, bits, read_noise = (params[name] for name in names)
    refuse_without_room(full_well, offset=offset, read_noise=read_noise)
    refuse_without_steps(full_well, gain=gain, bits=bits)
    camera: Camera = gain, offset, full_well, bits, read_noise
    channels = None if responses is None else len(responses)
    layout = Layout(_pair(shape), _pair(window), _pair(zones))
    refuse_bad_frames(files, channels, layout, camera, params.get("curve"))
    return []


@measured_psf.check
def _(result: MeasuredPsf, *inputs: Any, **params: Any) -> list[Check]:
    peak = (result.deviation.amax((-2, -1)) / result.kernels.amax((-2, -1))).max()
    fit = ", ".join(f"{x:.2f}" for x in result.fit.tolist())
    finite = all(math.isfinite(float(x.sum())) for x in result)
    return [
        Check(
            f"{len(result.places)} points; chi-square per pixel {fit}",
            float(result.fit.max()) < _GOOD,
        ),
        _counted(result),
        Check(f"deviation at most {float(peak):.2g} of the peak", finite),
        Check(
            f"light beyond the window at most {float(result.outside.max()):.2g}, if it falls as 1 /"
            " r^3 or faster"
        ),
    ]


def _counted(result: MeasuredPsf) -> Check:
    """Return a check of the effective number of points of each PSF; it fails, and names the zone,
    if the inflation of a variance is too large.
    """
    fewest, largest_inflation = float(result.support.min()), float(result.inflation.max())
    row, column = divmod(int(result.inflation.argmax()), result.inflation.shape[1])
    text = (
        f"each zone has {fewest:.2g} points or more in effect, inflation of variance at most"
        f" {largest_inflation:.3g}"
    )
    if largest_inflation <= _INFLATED:
        return Check(text)
    reason = (
        f" in zone ({row + 1}, {column + 1}), more than {_INFLATED:g}: its points lie far from the"
        " middle of the zone and tell several PSFs at once, so that the deviation may be too"
        " small; take frames with points near the middles of the zones, or choose fewer zones"
    )
    return Check(text + reason, False)


def _pair(numbers: Sequence[int]) -> tuple[int, int]:
    y, x = numbers
    return y, x


def _outside(kernels: Tensor, draws: Tensor) -> Tensor:
    """Return a bound (channel,) of the light beyond the window: 2 pi R^2 times (mean at the rim
    plus two standard deviations), the largest of all zones.
    """
    y, x = kernels.shape[-2:]
    in_rim = torch.ones(y, x, dtype=torch.bool)
    in_rim[2:-2, 2:-2] = False
    rim_level, spread = (
        kernels[..., in_rim].mean(-1),
        (draws - kernels)[..., in_rim].mean(-1).square().mean(0).sqrt(),
    )
    # light that falls as 1 / r^3 beyond r = R: the integral of level (R / r)^3 2 pi r dr is
    # 2 pi R^2 level
    bound = 2.0 * math.pi * (min(y, x) / 2.0) ** 2 * (rim_level.clamp_min(0.0) + 2.0 * spread)
    return bound.amax((0, 1))
