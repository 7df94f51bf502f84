"""Trainable height maps at any sampling: pixels, polynomials, rings and a network.

The network is also available as the node `doe.unet`.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from neusee.nodes import node
from neusee.nodes.doe._analytic_masks import (
    axicon,
    cubic,
    half_rings,
    spiral_axicon,
    vortex,
    zernike,
)
from neusee.nodes.doe._fabrication import smooth
from neusee.nodes.doe._refractive_index import Material, height_checks, height_from_phase
from neusee.nodes.doe._sampled_height_map import height_range, pixelwise
from neusee.nodes.network_weights import loaded, same_layout
from neusee.nodes.optics._pupil import phase_screen, zernike_sum
from neusee.nodes.optics._pupil_grid import PupilGrid, grid_of, inside_stop, pupil_axes, pupil_grid
from neusee.nodes.resampling import enlarge
from neusee.nodes.units import Count, DataFile, Depth, Layers
from neusee.nodes.values import Stop

# --- network --------------------------------------------------------------------------------------

# A height map that a network computes from the pupil coordinates only: smooth, with a million
# parameters.


#: factor in the sines after the first layer: about four periods across the pupil before training
_SINE_FREQUENCY = 15.0


class HeightNet(nn.Module):
    """A network of four downsampling and four upsampling convolutions, from (u, v) to one logit for
    each sample.

    Sines after the first convolution allow finer detail in the height map.
    """

    def __init__(self, width: int = 32) -> None:
        """Build the network with ``width`` channels after the first layer, doubled at each of three
        downsamplings.
        """
        super().__init__()
        sizes = [2, width, 2 * width, 4 * width, 8 * width]
        pairs = zip(pairwise(sizes), [1, 2, 2, 2], strict=True)
        self.down = nn.ModuleList(nn.Conv2d(a, b, 3, stride=s) for (a, b), s in pairs)
        self.up = nn.ModuleList(nn.Conv2d(3 * b, b, 3) for b in sizes[3:0:-1])
        self.last = nn.Conv2d(width, 1, 3)

    def forward(self, pupil_coordinates: Tensor) -> Tensor:
        """Return the logits (y, x) at the coordinates (2, y, x)."""
        level_outputs = [
            torch.sin(_SINE_FREQUENCY * self.down[0](_with_repeated_edges(pupil_coordinates[None])))
        ]
        for layer in self.down[1:]:
            level_outputs.append(F.silu(layer(_with_repeated_edges(level_outputs[-1]))))
        features = level_outputs[-1]
        for layer, skip in zip(self.up, level_outputs[-2::-1], strict=True):
            features = F.silu(
                layer(
                    _with_repeated_edges(
                        torch.cat([enlarge(features, skip.shape[-2], skip.shape[-1]), skip], dim=1)
                    )
                )
            )
        logits: Tensor = self.last(_with_repeated_edges(features))[0, 0]
        return logits


def _with_repeated_edges(x: Tensor) -> Tensor:
    """Pad a tensor by repeating its outermost rows and columns; zero padding would show at the
    edges of the height map.
    """
    x = torch.cat([x[..., :1, :], x, x[..., -1:, :]], dim=-2)
    return torch.cat([x[..., :1], x, x[..., -1:]], dim=-1)


def pupil_coordinates(grid: int, device: torch.device | None = None) -> Tensor:
    """Return the input (2, grid, grid) of the height network: u and v from -1 to 1 across the
    pupil grid.
    """
    line = (torch.arange(grid, dtype=torch.float64, device=device) - (grid - 1) / 2) * (2 / grid)
    v, u = torch.meshgrid(line, line, indexing="ij")
    return torch.stack([u, v]).to(torch.float32)


def network_height(net: nn.Module, samples: int, grid: int, max_height: float) -> Tensor:
    """Return the height map (samples, samples) of a network, between 0 and ``max_height``,
    differentiable with respect to the weights.
    """
    like = next(net.parameters())
    logits = net(pupil_coordinates(min(grid, samples), like.device).to(like))
    return max_height * torch.sigmoid(enlarge(logits, samples, samples))


def new_network(width: int, grid: int, rng: torch.Generator) -> HeightNet:
    """Return a new height network with random orthogonal weights and zero biases.

    The last layer is scaled so that the logits have mean 0 and standard deviation 1, which gives a
    height map that is far from flat.
    """
    net = HeightNet(width).to(rng.device)
    with torch.no_grad():
        for name, parameter in net.named_parameters():
            if name.endswith("bias"):
                parameter.zero_()
            else:
                nn.init.orthogonal_(parameter, gain=2**0.5, generator=rng)
        logits = net(pupil_coordinates(grid, rng.device))
        logit_deviation = logits.std(correction=0).clamp(min=1e-12)
        net.last.weight.div_(logit_deviation)
        net.last.bias = nn.Parameter((-logits.mean() / logit_deviation)[None])
    return net


@node()
def unet(
    stop: Stop,
    *,
    max_height: Depth = 1.2e-6,
    grid: Count = 270,
    width: Layers = 32,
    weights: DataFile | None = None,
    rng: torch.Generator,
) -> Tensor:
    """Compute the height map by a UNet of the pupil coordinates: max_height * sigmoid(UNet(u, v)).

    The network has ``grid`` samples. The bicubic resampling precedes the sigmoid, which keeps all
    heights in range. The coordinates are relative, so that the height map is as wide as the pupil:
    ``weights`` state no size.

    Shapes: stop -> (v, u).
    Units:  m.
    Error:  1e-6 of max_height (float32).
    Source: "Learning to See Through Flare", "Neural Representation of the DOE"; the layer widths
            are ours.
    """
    samples = int(stop.samples)
    net = (
        new_network(width, min(grid, samples), rng)
        if weights is None
        else loaded(partial(HeightNet, width), weights)
    )
    return network_height(net, samples, grid, max_height).detach()


@unet.preflight
def _(*, width: int, weights: Path | None, stop: Stop | None = None, **_: Any) -> list[str]:
    if weights is None:
        return []
    same_layout(partial(HeightNet, width), weights, width)
    if stop is None or stop.pitch.is_meta:
        return []
    span = float(stop.samples * stop.pitch) * 1e3
    return [f"{weights.name} states no size: its height map is as wide as the pupil, {span:.4g} mm"]


unet.check(height_checks)


# --- parametrisations -----------------------------------------------------------------------------

# Trainable height maps for any sampling of the pupil: pixels, Zernike polynomials, rings and a
# network.
#
# Each module is called with the stop and returns the height map (v, u), float32, in m, at least 0.
# The trained parameters do not depend on the sampling: a mask trained on few samples can be
# evaluated on many.


HeightMapOf = Callable[[Stop], Tensor]
#: makes a trainable height map from a stop and the parameters of a node
Start = Callable[[Stop, Mapping[str, Any], torch.Generator], nn.Module]
#: share of the depth at both ends that start values avoid, because the gradient of the sigmoid
#: almost vanishes there
_LOGIT_MARGIN = 0.01
#: margin of trainable height above and below a formula's height map, as a share of its depth
_FREE_SHARE = 0.05


class Pixels(nn.Module):
    """A trainable height map of ``grid`` x ``grid`` pixels, limited to ``max_height`` by a sigmoid
    and resampled by bicubic interpolation.

    The start is the height map ``start``, or a smooth random one with features ``scale`` pupil
    diameters wide.
    """

    def __init__(
        self,
        grid: int,
        max_height: float,
        scale: float,
        rng: torch.Generator,
        start: Tensor | None = None,
    ) -> None:
        """Start from a random height map that is smooth over ``scale`` pupil diameters, or from
        ``start`` in m.
        """
        super().__init__()
        self.max_height = max_height
        if start is None:
            logits = 1.5 * phase_screen(pupil_grid(grid, 1.0, float(grid)), scale, rng)
        else:
            share = enlarge(start.double() / max_height, grid, grid)
            logits = torch.logit(share.clamp(_LOGIT_MARGIN, 1 - _LOGIT_MARGIN))
        self.logits = nn.Parameter(logits.to(torch.float32))

    def forward(self, stop: Stop) -> Tensor:
        """Return the height map (v, u) on the pupil grid of ``stop``."""
        logits: Tensor = self.logits
        samples = int(stop.samples)
        if samples != logits.shape[-1]:
            logits = enlarge(logits, samples, samples)
        return self.max_height * torch.sigmoid(logits)


class Modes(nn.Module):
    """A trainable height map of ``count`` Zernike polynomials, from Noll number 4 on, with
    coefficients in waves rms.

    Numbers 1 to 3 are omitted: piston has no effect, and tilt only shifts the spot. The start is a
    random sum with ``waves`` rms.
    """

    def __init__(
        self, count: int, waves: float, wavelength: float, material: Material, rng: torch.Generator
    ) -> None:
        """Start with a random sum of modes of ``waves`` rms in total, at ``wavelength`` in m."""
        super().__init__()
        self.wavelength, self.material = wavelength, material
        random_direction = torch.randn(count, generator=rng, dtype=torch.float64)
        self.waves = nn.Parameter(
            (waves * random_direction / random_direction.norm()).to(torch.float32)
        )
        self._polynomials = lru_cache(maxsize=1)(self._polynomials_on)

    def _polynomials_on(self, grid: PupilGrid) -> Tensor:
        """Return the Zernike polynomials (mode, v, u) on a pupil grid, 0 outside the stop."""
        v, u = pupil_axes(grid, self.waves.device)
        polynomials = [
            zernike_sum({4 + k: 1.0}, v, u).expand(grid.samples, grid.samples)
            for k in range(len(self.waves))
        ]
        return torch.stack(polynomials).where(inside_stop(grid, v.device), 0.0).to(torch.float32)

    def forward(self, stop: Stop) -> Tensor:
        """Return the height map (v, u) on the pupil grid of ``stop``."""
        grid = grid_of(stop)
        basis = self._polynomials(grid)
        phase = (2 * math.pi * self.waves) @ basis.flatten(1)
        return height_from_phase(
            phase.view(grid.samples, grid.samples), grid, self.wavelength, self.material
        )


class Rings(nn.Module):
    """A trainable height map of ``count`` annuli of equal area, each with a phase gradient a and a
    step c, in waves.

    phi = 2 pi (a r + c), times the sign of u if ``sided``. If ``count`` is a multiple of five, five
    half-rings are a special case. The start has the slopes of the half-rings, alternating by
    fifths, plus ``noise`` random waves.
    """

    def __init__(
        self,
        count: int,
        sided: bool,
        noise: float,
        wavelength: float,
        material: Material,
        rng: torch.Generator,
    ) -> None:
        """Start with slopes of alternating sign in waves at the rim, plus random slopes of standard
        deviation ``noise``.

        ``sided`` inverts the sign of the phase on one side of the axis, as in half rings.
        """
        super().__init__()
        self.sided, self.wavelength, self.material = sided, wavelength, material
        fifth_of_rings = (torch.arange(count) * 5).div(count, rounding_mode="floor")
        # slopes of 12, -18, 24, -30 and 36 waves in the five fifths of the rings
        start_slopes = (12.0 + 6.0 * fifth_of_rings) * (1 - 2 * (fifth_of_rings % 2))
        self.slopes = nn.Parameter(start_slopes + noise * torch.randn(count, generator=rng))
        self.steps = nn.Parameter(torch.zeros(count))
        self._annuli = lru_cache(maxsize=1)(self._annuli_on)

    def _annuli_on(self, grid: PupilGrid) -> Tensor:
        """Return the index (v, u) of the annulus in which each sample lies."""
        v, u = pupil_axes(grid, self.slopes.device)
        return (
            ((v.square() + u.square()) * len(self.slopes))
            .floor()
            .long()
            .clamp(max=len(self.slopes) - 1)
        )

    def forward(self, stop: Stop) -> Tensor:
        """Return the height map (v, u) on the pupil grid of ``stop``."""
        grid = grid_of(stop)
        v, u = pupil_axes(grid, self.slopes.device)
        annulus = self._annuli(grid)
        phase = self.slopes.double()[annulus] * torch.hypot(v, u) + self.steps.double()[annulus]
        side_sign = torch.sign(u) if self.sided else torch.ones_like(u)
        return height_from_phase(
            2 * math.pi * phase * side_sign, grid, self.wavelength, self.material
        )


class Drawn(nn.Module):
    """A trainable height map on ``grid`` samples, computed by a height network: ``net``, or a new
    random one.
    """

    def __init__(
        self,
        width: int,
        grid: int,
        max_height: float,
        rng: torch.Generator,
        net: HeightNet | None = None,
    ) -> None:
        super().__init__()
        self.grid, self.max_height, self.net = (
            grid,
            max_height,
            net or new_network(width, grid, rng),
        )

    def forward(self, stop: Stop) -> Tensor:
        """Return the height map (v, u) on the pupil grid of ``stop``."""
        return network_height(self.net, int(stop.samples), self.grid, self.max_height)


class Written(nn.Module):
    """A trainable height map ``shape``, smoothed by `doe.smooth` to ``feature``, so that training
    uses no detail too fine for the tool.
    """

    def __init__(self, shape: HeightMapOf, feature: float) -> None:
        super().__init__()
        self.shape, self.feature = shape, feature

    def forward(self, stop: Stop) -> Tensor:
        """Return the height map (v, u) on the pupil grid of ``stop``."""
        height: Tensor = smooth(self.shape(stop), stop, feature=self.feature)
        return height


# --- the start, from a step -----------------------------------------------------------------------


def _start_pixels(stop: Stop, params: Mapping[str, Any], rng: torch.Generator) -> Pixels:
    """Return trainable pixels that start at the height map of `doe.pixelwise` with these
    parameters.
    """
    start: Tensor = pixelwise(stop, **params, rng=rng)
    highest = height_range(params["file"], params["depth"])
    return Pixels(int(stop.samples), highest, params["scale"], rng, start.to(rng.device))


def _pixels_from_formula(mask: Callable[..., Tensor]) -> Start:
    """Return a function that makes trainable pixels starting at a formula's height map, away from
    the saturation of their sigmoid.
    """

    def start(stop: Stop, params: Mapping[str, Any], rng: torch.Generator) -> Pixels:
        height = mask(stop, **params)
        free_height = _FREE_SHARE * float(height.amax())
        return Pixels(
            int(stop.samples),
            float(height.amax()) + 2 * free_height,
            1.0,
            rng,
            (height + free_height).to(rng.device),
        )

    return start


def _start_network(stop: Stop, params: Mapping[str, Any], rng: torch.Generator) -> Drawn:
    """Return a trainable height network with the weights of a `doe.unet` step, or with new random
    ones.
    """
    width, grid, weights = (
        params["width"],
        min(params["grid"], int(stop.samples)),
        params["weights"],
    )
    net = None if weights is None else loaded(lambda: HeightNet(width), weights).to(rng.device)
    return Drawn(width, grid, params["max_height"], rng, net)


#: For each node, a function that returns a trainable height map, started at the height map of the
#: node. `doe.flat` is absent because the suppression has no gradient at a flat height map.
PARAMETRISATIONS: dict[str, Start] = {
    "doe.pixelwise": _start_pixels,
    "doe.unet": _start_network,
    **{
        mask.path: _pixels_from_formula(mask)
        for mask in (half_rings, axicon, spiral_axicon, vortex, cubic, zernike)
    },
}


# --- polynomial height maps -----------------------------------------------------------------------

# Trainable height maps with few parameters: products of Legendre polynomials, and polynomials along
# one direction.
#
# Each module is called with the stop and returns the height map (v, u), float32, in m, at least 0,
# for any sampling.


def legendre(position: Tensor, degree: int) -> list[Tensor]:
    """Return the Legendre polynomials of degree 0 to ``degree``, normalised to a root mean square
    of 1 over [-1, 1].
    """
    unscaled = [torch.ones_like(position), position]
    for k in range(1, degree):
        # Bonnet's recursion; the mean square of P_k over [-1, 1] is 1 / (2 k + 1)
        unscaled.append(((2 * k + 1) * position * unscaled[k] - k * unscaled[k - 1]) / (k + 1))
    return [
        math.sqrt(2 * k + 1) * polynomial for k, polynomial in enumerate(unscaled[: degree + 1])
    ]


class Polynomials(nn.Module):
    """A trainable height map of products of Legendre polynomials in both axes of the pupil, up to a
    total degree.

    Piston and tilt are omitted: piston has no effect, and tilt only shifts the spot. Defocus,
    astigmatism, coma and the cubic mask are special cases. The coefficients are in waves rms over
    the square around the stop; the start is a random sum with ``waves`` rms.
    """

    def __init__(
        self, degree: int, waves: float, wavelength: float, material: Material, rng: torch.Generator
    ) -> None:
        """Start with a random sum of products of ``waves`` rms in total, at ``wavelength`` in m."""
        super().__init__()
        self.degree, self.wavelength, self.material = degree, wavelength, material
        random_direction = torch.randn(
            len(list(self._exponents())), generator=rng, dtype=torch.float64
        )
        self.waves = nn.Parameter(
            (waves * random_direction / random_direction.norm()).to(torch.float32)
        )
        self._products = lru_cache(maxsize=1)(self._products_on)

    def _exponents(self) -> Iterator[tuple[int, int]]:
        """Yield the degrees of each product along both axes; a total degree below 2 only shifts the
        spot.
        """
        for total_degree in range(2, self.degree + 1):
            for row_degree in range(total_degree + 1):
                yield row_degree, total_degree - row_degree

    def _products_on(self, grid: PupilGrid) -> Tensor:
        """Return the products (product, v, u) on a pupil grid."""
        rows, columns = (
            legendre(axis, self.degree) for axis in pupil_axes(grid, self.waves.device)
        )
        return torch.stack(
            [
                rows[row_degree] * columns[column_degree]
                for row_degree, column_degree in self._exponents()
            ]
        ).to(torch.float32)

    def forward(self, stop: Stop) -> Tensor:
        """Return the height map (v, u) on the pupil grid of ``stop``."""
        grid = grid_of(stop)
        phase = torch.tensordot(2 * math.pi * self.waves, self._products(grid), 1)
        return height_from_phase(phase, grid, self.wavelength, self.material)


class Streak(nn.Module):
    """A trainable height map that varies along one direction only and spreads light into a line,
    like a cylindrical lens.

    The phase is a sum of Legendre polynomials of degree 2 to ``degree`` in t = u cos a + v sin a.
    The trained parameters are the angle ``a`` in radians and the coefficient of each polynomial in
    waves rms. The start has a random angle and a random sum with ``waves`` rms.
    """

    def __init__(
        self, degree: int, waves: float, wavelength: float, material: Material, rng: torch.Generator
    ) -> None:
        """Start with a random sum of polynomials of ``waves`` rms in total, along a random
        direction.
        """
        super().__init__()
        self.wavelength, self.material = wavelength, material
        random_direction = torch.randn(degree - 1, generator=rng, dtype=torch.float64)
        self.waves = nn.Parameter(
            (waves * random_direction / random_direction.norm()).to(torch.float32)
        )
        self.angle = nn.Parameter(
            (math.pi * torch.rand(1, generator=rng, dtype=torch.float64)).to(torch.float32)
        )

    def forward(self, stop: Stop) -> Tensor:
        """Return the height map (v, u) on the pupil grid of ``stop``."""
        grid = grid_of(stop)
        v, u = pupil_axes(grid, self.waves.device)
        position = u * self.angle.cos() + v * self.angle.sin()
        # from degree 2 on: lower degrees only shift the spot
        polynomials = legendre(position, len(self.waves) + 1)[2:]
        phase = torch.tensordot(2 * math.pi * self.waves.to(position), torch.stack(polynomials), 1)
        return height_from_phase(phase, grid, self.wavelength, self.material)


class LearntStop(nn.Module):
    """A round stop with a trainable diameter, relative to that of the lens, between ``least`` and
    1.

    The amplitude falls over one sample at the rim, so that it has a gradient; `doe.shade` has a
    sharp rim.
    """

    def __init__(self, diameter: float = 0.95, least: float = 0.1) -> None:
        super().__init__()
        self.least = least
        share = torch.tensor((diameter - least) / (1 - least), dtype=torch.float64)
        self.logit = nn.Parameter(torch.logit(share).to(torch.float32).reshape(1))

    def diameter(self) -> Tensor:
        """Return the diameter of the stop over that of the lens, ()."""
        share: Tensor = torch.sigmoid(self.logit)[0]
        return self.least + (1 - self.least) * share

    def forward(self, stop: Stop) -> Tensor:
        """Return the amplitude transmittance (v, u) on the pupil grid of ``stop``, float32 in [0,
        1].
        """
        grid = grid_of(stop)
        v, u = pupil_axes(grid, self.logit.device)
        samples = grid.diameter / grid.pitch
        # half a sample wider, so that a stop of diameter 1 is fully open up to the rim of the lens
        rim_radius = self.diameter().double() * (1 + 1 / samples)
        # falls from 1 to 0 over one sample at the rim
        return (
            (0.5 + (rim_radius - torch.hypot(v, u)) * (samples / 2)).clamp(0, 1).to(torch.float32)
        )
