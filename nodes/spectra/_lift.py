"""Lifts: estimates of reflectance spectra from RGB, linear ones and the neural network MST++."""

import functools
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from neusee.nodes import Check, Node, ParameterError, node
from neusee.nodes.file_headers import archive_needs, safetensors_need
from neusee.nodes.network_weights import empty, wrong_weights
from neusee.nodes.precision import single
from neusee.nodes.resampling import mirrored
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
from neusee.nodes.units import DataFile
from neusee.nodes.values import Bands, LowRankCube

_SHORTEST, _LONGEST = 380e-9, 780e-9  #: m, range of the measured reflectances and of the basis


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
    return _lifted_low_rank(rgb, _basis(bands), within)


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
    return _lifted_low_rank(rgb, _estimator(bands), within)


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
    # about 65536 pixels are enough
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


def require_rgb(rgb: Tensor) -> None:
    """Raise ValueError unless ``rgb`` is a picture of three channels (3, y, x)."""
    if rgb.ndim != 3 or rgb.shape[0] != 3:
        raise ValueError(
            f"rgb has shape {tuple(rgb.shape)}, not (3, y, x): connect a scene of three channels"
        )


def _lifted(rgb: Tensor, matrix: Tensor) -> Tensor:
    """Multiply an RGB picture by a matrix (band, 3), and set negative results to 0 in place to
    save memory.
    """
    require_rgb(rgb)
    rgb = single(rgb)
    return torch.relu_(matrix.to(rgb) @ rgb.flatten(1)).reshape(-1, *rgb.shape[1:])


def _lifted_low_rank(rgb: Tensor, matrix: Tensor, within: float) -> LowRankCube:
    """Estimate spectra from an RGB picture by a matrix (band, 3), and return the spectra as a
    low-rank cube.

    For a picture that requires a gradient, the full cube is computed, so that the gradient reaches
    the picture.
    """
    require_rgb(rgb)
    flat_picture, matrix_float64 = rgb.detach().flatten(1), matrix.to(rgb.device)
    cube = linear_planes(flat_picture, matrix_float64, within)
    if cube is None:
        cube = few_planes(_blockwise_lift(flat_picture, matrix_float64), within)
    full_cube_or_picture = _lifted(rgb, matrix) if rgb.requires_grad else rgb
    return as_low_rank_cube(cube, full_cube_or_picture)


def _blockwise_lift(picture: Tensor, matrix: Tensor) -> Source:
    """Return the spectra of a flat picture (channel, pixel) by a matrix (band, channel), to be
    computed in blocks of pixels.
    """
    dtype = picture.dtype if picture.dtype == torch.float64 else torch.float32
    return Source(
        lambda pixels: (matrix @ picture[:, pixels].double()).clamp_min_(0),
        len(matrix),
        picture.shape[1],
        dtype,
    )


def _basis(bands: Bands) -> Tensor:
    """Return the matrix (band, 3) of the basis reflectances of Mallett and Yuksel."""
    inside_charts(bands)
    return mallett().at(bands.centres).T


def _estimator(bands: Bands) -> Tensor:
    """Return the matrix (band, 3) of the estimator for bands."""
    inside_charts(bands)
    return _estimator_of(tuple(float(c) for c in bands.centres))


@functools.lru_cache(maxsize=16)
def _estimator_of(centres: tuple[float, ...]) -> Tensor:
    """Return the matrix (band, 3) float64 of `lift_lmmse` for bands with the given centre
    wavelengths in m.
    """
    wavelengths = torch.tensor(centres, dtype=torch.float64)
    return lift_matrix(torch.cat([paint.at(wavelengths) for paint in paints()]), wavelengths)


def lift_matrix(measured: Tensor, centres: Tensor) -> Tensor:
    """Return the matrix that estimates reflectance from linear sRGB, fitted to the measured spectra
    ``measured``.

    Shapes: measured (spectrum, band) -> (band, 3) float64.
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
    # least mean square error: E[s c^T] E[c c^T]^-1 for colours c of spectra s
    weights: Tensor = torch.linalg.solve(rgb_products, rgb_of_spectra @ spectra_products).T
    return weights


def inside_charts(bands: Bands) -> None:
    """Raise ValueError for bands outside 380 to 780 nm, the range of the measured colour charts."""
    require_range(bands.centres, (_SHORTEST, _LONGEST), "reflectances are known from")


_attach(lift_mallett, lift_mallett_mixture, _basis)
_attach(lift_lmmse, lift_lmmse_mixture, _estimator)


# --- mst plus plus --------------------------------------------------------------------------------

# MST++, a network that reconstructs 31 bands from RGB in three stages of spectral attention.
#
# The modules have the names of the published network, so that the published checkpoint loads
# unchanged: 1 619 625 parameters in 227 tensors. Architecture: Cai et al., CVPRW 2022; reference
# code caiyuanhao1998/MST-plus-plus (MIT).


BANDS = 31


class MSTPlusPlus(nn.Module):
    """The network MST++ from RGB pictures (n, 3, y, x) in [0, 1], of any size, to 31 bands (n,
    31, y, x).
    """

    def __init__(self) -> None:
        super().__init__()
        self.conv_in = _conv(3, BANDS)
        self.body = nn.Sequential(*(Stage(BANDS) for _ in range(3)))
        self.conv_out = _conv(BANDS, BANDS)

    def forward(self, rgb: Tensor) -> Tensor:
        height, width = rgb.shape[-2:]
        first = self.conv_in(mirrored(rgb, -height % 8, -width % 8))
        result: Tensor = self.conv_out(self.body(first)) + first
        return result[..., :height, :width]


class Stage(nn.Module):
    """A stage of MST++: a U-Net with spectral attention, two downsampling steps and a residual
    connection.
    """

    def __init__(self, dim: int) -> None:
        """Build a stage with ``dim`` channels, doubled at each of two halvings of the size."""
        super().__init__()
        self.embedding = _conv(dim, dim)
        self.encoder_layers = nn.ModuleList(
            nn.ModuleList([Blocks(d), nn.Conv2d(d, 2 * d, 4, 2, 1, bias=False)])
            for d in (dim, 2 * dim)
        )
        self.bottleneck = Blocks(4 * dim)
        self.decoder_layers = nn.ModuleList(
            nn.ModuleList(
                [nn.ConvTranspose2d(2 * d, d, 2, 2), nn.Conv2d(2 * d, d, 1, bias=False), Blocks(d)]
            )
            for d in (2 * dim, dim)
        )
        self.mapping = _conv(dim, dim)

    def forward(self, x: Tensor) -> Tensor:
        features, skips = self.embedding(x), []
        for attend, shrink in _layers_of(self.encoder_layers):
            skips.append(attend(features))
            features = shrink(skips[-1])
        features = self.bottleneck(features)
        for (grow, fuse, attend), skip in zip(
            _layers_of(self.decoder_layers), reversed(skips), strict=True
        ):
            features = attend(fuse(torch.cat([grow(features), skip], 1)))
        result: Tensor = self.mapping(features) + x
        return result


class Blocks(nn.Module):
    """A transformer block: spectral attention and a feed-forward network, each with a residual
    connection.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.blocks = nn.ModuleList([nn.ModuleList([SpectralAttention(dim), Normed(dim)])])

    def forward(self, x: Tensor) -> Tensor:
        for attend, feed in _layers_of(self.blocks):
            x = attend(x) + x
            x = feed(x) + x
        return x


class SpectralAttention(nn.Module):
    """Self-attention between bands: 31 x 31 weights per head, at a cost that is linear in the
    number of pixels.
    """

    def __init__(self, dim: int) -> None:
        """Build the attention of ``dim`` channels, as one head for each 31 of them."""
        super().__init__()
        self.heads = dim // BANDS
        self.to_q, self.to_k, self.to_v = (nn.Linear(dim, dim, bias=False) for _ in range(3))
        self.rescale = nn.Parameter(torch.ones(self.heads, 1, 1))
        self.proj = nn.Linear(dim, dim)
        self.pos_emb = nn.Sequential(_depthwise(dim), nn.GELU(), _depthwise(dim))

    def forward(self, x: Tensor) -> Tensor:
        shape = x.shape
        pixels = x.flatten(2).transpose(1, 2)
        value = self.to_v(pixels).transpose(1, 2)
        query, key, value_heads = (
            t.unflatten(1, (self.heads, -1)) for t in (*self._across(pixels), value)
        )
        scores = (key @ query.transpose(-1, -2)) * self.rescale
        attended = (scores.softmax(-1) @ value_heads).flatten(1, 2).transpose(1, 2)
        result: Tensor = self.proj(attended).transpose(1, 2).reshape(shape) + self.pos_emb(
            value.reshape(shape)
        )
        return result

    def _across(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Return the queries and keys of the attention, with each band normalised to unit length
        over all pixels.
        """
        query, key = (
            F.normalize(projection(pixels).transpose(1, 2), dim=-1)
            for projection in (self.to_q, self.to_k)
        )
        return query, key


class Normed(nn.Module):
    """A layer norm over the bands, followed by a feed-forward network."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.fn = FeedForward(dim)
        self.norm = nn.LayerNorm(dim)

    def forward(self, x: Tensor) -> Tensor:
        result: Tensor = self.fn(self.norm(x.movedim(1, -1)).movedim(-1, 1))
        return result


class FeedForward(nn.Module):
    """A feed-forward network with four times as many hidden channels and a depthwise 3 x 3
    convolution.
    """

    def __init__(self, dim: int) -> None:
        """Build the network for ``dim`` channels."""
        super().__init__()
        widening, narrowing = (
            nn.Conv2d(dim, 4 * dim, 1, bias=False),
            nn.Conv2d(4 * dim, dim, 1, bias=False),
        )
        self.net = nn.Sequential(widening, nn.GELU(), _depthwise(4 * dim), nn.GELU(), narrowing)

    def forward(self, x: Tensor) -> Tensor:
        result: Tensor = self.net(x)
        return result


def _layers_of(layers: nn.ModuleList) -> Iterable[Iterable[nn.Module]]:
    return cast(Iterable[Iterable[nn.Module]], layers)


def _conv(inputs: int, outputs: int) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, padding=1, bias=False)


def _depthwise(dim: int) -> nn.Conv2d:
    return nn.Conv2d(dim, dim, 3, padding=1, groups=dim, bias=False)


# --- mst lift node --------------------------------------------------------------------------------

# Estimates of spectra in 31 bands from linear RGB by the neural network MST++.


@node(rtol=1e-3)
def lift_mst_plus_plus(
    rgb: Tensor,
    bands: Bands,
    *,
    weights: DataFile | None = None,
    untrained: Literal["refuse", "allow"] = "refuse",
    rng: torch.Generator,
) -> Tensor:
    """Reconstruct the spectrum of each pixel from RGB by the network MST++.

    The picture is stretched to [0, 1], and the cube is scaled back to keep radiometry. The
    published checkpoint loads unchanged (.pth or .safetensors). Without weights the network
    consists of random orthogonal layers from `rng`: a recipe runs, but the spectra have no meaning.

    Shapes: rgb (3, y, x) -> (31, y, x).
    Units:  linear sRGB to the quantity of the training data, taken as reflectance; negative results
            are clipped.
    Error:  published: relative error 0.16, PSNR 34.3 dB (NTIRE 2022); one pass, without the
            eightfold self-ensemble.
    Raises: ParameterError before the run without weights, or where the weights do not fit the
            network; ValueError unless the bands are 31 from 400 to 700 nm.
    Source: Cai et al., MST++, CVPR Workshops 2022 (NTIRE spectral recovery).
    """
    require_rgb(rgb)
    need_mst_plus_plus_bands(bands)
    network = (
        _loaded_network(weights) if weights is not None else _untrained_network(untrained, rng)
    )
    return torch.relu_(lift_pictures(network.to(rgb), rgb[None])[0])


@lift_mst_plus_plus.reference
def _(
    rgb: Tensor,
    bands: Bands,
    *,
    weights: Path | None = None,
    untrained: str = "refuse",
    rng: torch.Generator,
) -> Tensor:
    result: Tensor = lift_mst_plus_plus.fn(
        rgb.double(), bands, weights=weights, untrained=untrained, rng=rng
    )
    return result


@lift_mst_plus_plus.preflight
def _(*, weights: Path | None = None, untrained: str = "refuse", **params: Any) -> list[str]:
    if weights is not None:
        _fitting_tensors(weights)
        return []
    if untrained == "refuse":
        text = (
            "MST++ has no weights: give a checkpoint file in weights, use spectra.lift_lmmse, or"
            " set untrained: allow"
        )
        raise ParameterError("weights", text)
    return ["MST++ is untrained: the spectra have no meaning"]


@lift_mst_plus_plus.check
def _(
    result: Tensor, rgb: Tensor, bands: Bands, *, weights: Path | None = None, **params: Any
) -> list[Check]:
    noise = (
        []
        if weights is not None
        else [Check("MST++ is untrained: the spectra have no meaning", False)]
    )
    return lift_checks(result, rgb, bands) + noise


def lift_pictures(network: nn.Module, rgb: Tensor) -> Tensor:
    """Reconstruct the spectra (n, 31, y, x) of pictures (n, 3, y, x) by the network MST++.

    Each picture is stretched to [0, 1], and the result is scaled back. Negative values are kept.
    """
    darkest, brightest = rgb.amin((1, 2, 3), keepdim=True), rgb.amax((1, 2, 3), keepdim=True)
    span = brightest - darkest
    cube: Tensor = network((rgb - darkest) / span.where(span > 0, 1.0))
    return cube * span + darkest


def start_mst_plus_plus(rng: torch.Generator, linear: Tensor | None = None) -> MSTPlusPlus:
    """Return an MST++ network for training, with random weights or with the weights of a linear
    estimate.

    ``linear`` is the matrix (31, 3) of the linear estimate of spectra from RGB. The skip connection
    around the body then has this matrix, and the last layer starts at 0. Training adds the
    corrections that image structure and a non-linear estimate allow.
    """
    network = _untrained_network("allow", rng).requires_grad_(True).train()
    if linear is not None:
        with torch.no_grad():
            network.conv_in.weight.zero_()[:, :, 1, 1] = linear.to(network.conv_in.weight)
            network.conv_out.weight.zero_()
    return network


def need_mst_plus_plus_bands(bands: Bands) -> None:
    """Raise ValueError unless the bands are the 31 bands of MST++, from 400 to 700 nm."""
    centres = bands.centres.cpu().double()
    published = torch.linspace(400e-9, 700e-9, BANDS, dtype=torch.float64)
    if len(centres) != BANDS or float((centres - published).abs().max()) > 0.5e-9:
        raise ValueError(
            f"MST++ gives {BANDS} bands from 400 to 700 nm, not {len(centres)} from"
            f" {float(centres[0]) * 1e9:.4g} to {float(centres[-1]) * 1e9:.4g} nm: use these 31"
            " bands, or another node such as spectra.lift_lmmse"
        )


def _empty_network() -> MSTPlusPlus:
    return empty(MSTPlusPlus).requires_grad_(False).eval()


def _loaded_network(weights: Path) -> nn.Module:
    network = _empty_network()
    network.load_state_dict(_fitting_tensors(weights), assign=True)
    return network


def _untrained_network(untrained: str, rng: torch.Generator) -> MSTPlusPlus:
    """Return an MST++ network with random orthogonal weights; raise ValueError unless that is
    allowed.
    """
    if untrained != "allow":
        raise ValueError(
            "MST++ has no weights: give a checkpoint file in weights, or set untrained: allow"
        )
    network = _empty_network().to_empty(device=rng.device)
    for name, tensor in network.named_parameters():
        # scales begin at 1, biases at 0
        if name.endswith(("rescale", "norm.weight")):
            nn.init.ones_(tensor)
        elif tensor.ndim == 1:
            nn.init.zeros_(tensor)
        else:
            nn.init.orthogonal_(tensor, generator=rng)
    return network


def _fitting_tensors(weights: Path) -> dict[str, Tensor]:
    """Read the tensors of a checkpoint file, and raise ParameterError unless they fit MST++ and
    are finite.
    """
    tensors = {
        name.removeprefix("module."): tensor
        for name, tensor in _checkpoint_tensors(weights).items()
    }
    wrong = _misfits(tensors)
    if wrong:
        text = (
            f"{weights} holds {len(tensors)} tensors, and {len(wrong)} tensors do not fit MST++,"
            f" such as {wrong[0]}"
        )
        raise ParameterError("weights", text)
    for name, values in tensors.items():
        if problem := wrong_weights(weights, name, values):
            raise ParameterError("weights", problem)
    return {name: tensor.float() for name, tensor in tensors.items()}


def _misfits(tensors: Mapping[str, Tensor]) -> list[str]:
    """Return the names of tensors that MST++ needs in another shape, or does not have."""
    expected = _empty_network().state_dict()
    shapes = {name: tensor.shape for name, tensor in tensors.items()}
    wrong_shape = [name for name in expected if shapes.get(name) != expected[name].shape]
    return wrong_shape + [name for name in tensors if name not in expected]


def _checkpoint_tensors(weights: Path) -> dict[str, Tensor]:
    """Read the named tensors of a checkpoint file.

    The file is .safetensors or a pickle that holds only tensors, with or without the key
    `state_dict`.
    """
    is_plain = weights.suffix == ".safetensors"
    if is_plain:
        safetensors_need(weights, parameter="weights")
    else:
        archive_needs(weights, 2.0, "weights")
    try:
        if is_plain:
            from safetensors.torch import load_file

            return load_file(weights)
        content = torch.load(weights, map_location="cpu", weights_only=True)
    except Exception as read_error:  # each library raises its own errors for a broken file
        raise ParameterError(
            "weights", f"{weights} holds no tensors that can be read safely: {read_error}"
        ) from None
    state = content.get("state_dict", content) if isinstance(content, dict) else content
    if not isinstance(state, dict) or not all(isinstance(v, Tensor) for v in state.values()):
        raise ParameterError(
            "weights", f"{weights} is not a state dict: save the output of model.state_dict()"
        )
    return state
