"""Pictures of what the camera sees: overview, spectra, restored frame."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neusee.nodes.spectra import mean_wavelength
from neusee.nodes.values import Bands
from neusee.workflows.report.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    VERMILION,
    PointLabel,
    canvas,
    drawn,
    encoded,
    nanometres,
    picture,
    place_labels,
)

# --- camera overview ------------------------------------------------------------------------------

# Camera overview: the scene, its pictures without and with mask, and the restored picture with its
# error.


@drawn
def overview(
    *,
    truth: Tensor,
    plain: Tensor,
    mask: Tensor,
    restored: Tensor | None = None,
    spots: Mapping[str, Tensor] | None = None,
) -> Any:
    """Draw the scene, its pictures without and with mask, and the restored picture with its
    error if it is given.
    """
    white = high(truth)
    pictures = {"truth": truth, "plain lens": plain, "with mask": mask}
    pictures |= {} if restored is None else {"restored": restored}
    columns = len(pictures) + (restored is not None)
    figure, axes = canvas(2.6 * columns, 3.4, 1, columns)
    for ax, (name, image) in zip(axes[0], pictures.items(), strict=False):
        picture(ax, encoded(centre(image, truth) / white), name)
        _ring(ax, spots or {}, truth)
    if restored is not None:
        _error(figure, axes[0, -1], (centre(restored, truth) - truth).abs().mean(0) / white)
        _ring(axes[0, -1], spots or {}, truth)
    return figure


def _error(figure: Any, ax: Any, error: Tensor) -> None:
    """Draw the error of the restored picture with its colour bar."""
    error_image = picture(
        ax, error.cpu().numpy(), "|restored − truth|", cmap="viridis", vmin=0.0, vmax=high(error)
    )
    colour_bar = figure.colorbar(error_image, ax=ax, fraction=0.046, pad=0.03, extend="max")
    colour_bar.set_label("fraction of white", fontsize=9)
    colour_bar.ax.tick_params(labelsize=9)


def high(values: Tensor) -> float:
    """Return the 99.5 % quantile of the pixel values of an image as white level, but at least
    1e-9.
    """
    # about 200 000 pixels are enough, and `quantile` takes no more than some millions
    sampled_pixels = values.detach().flatten()[:: max(1, values.numel() // 200_000)].float()
    return max(float(torch.quantile(sampled_pixels, 0.995)), 1e-9)


def centre(image: Tensor, like: Tensor) -> Tensor:
    """Crop the centre of an image to the size of the image ``like``; the optical axis stays at
    pixel N // 2.
    """
    first_row, first_column = (image.shape[axis] // 2 - like.shape[axis] // 2 for axis in (-2, -1))
    if first_row < 0 or first_column < 0:
        raise ValueError(
            f"a picture of shape {tuple(image.shape)} is smaller than the scene,"
            f" {tuple(like.shape)}"
        )
    return image[
        ..., first_row : first_row + like.shape[-2], first_column : first_column + like.shape[-1]
    ].float()


def _ring(ax: Any, spots: Mapping[str, Tensor], like: Tensor) -> None:
    """Draw a ring around the brightest pixel of each laser, unless this pixel is at the rim,
    because the laser is then outside the picture.
    """
    from matplotlib.patches import Circle

    radius = max(like.shape[-1] / 14, 3.0)
    images = [centre(spot, like) for spot in spots.values()]
    # a set: one ring for lasers at one pixel
    for y, x in {divmod(int(image.sum(0).argmax()), image.shape[-1]) for image in images}:
        if not (0 < y < like.shape[-2] - 1 and 0 < x < like.shape[-1] - 1):
            continue
        for line_width, colour in ((3.0, "black"), (1.4, ORANGE)):
            ax.add_patch(Circle((x, y), radius, fill=False, color=colour, linewidth=line_width))


# --- scene spectra --------------------------------------------------------------------------------

# Figure of the spectra of three scene pixels, and of the RGB values from which these spectra are
# reconstructed.


_POINTS = ("A", "B", "C")
CHANNELS = ((VERMILION, "channel R"), (GREEN, "channel G"), (BLUE, "channel B"))
MONO = ((BLUE, "the one channel"),)


@drawn
def spectra(
    *,
    scene: Tensor,
    radiance: Tensor,
    bands: Bands,
    illuminant: Tensor,
    responses: Tensor,
    lines: Mapping[str, Bands] | None = None,
) -> Any:
    """Draw the spectra of three scene pixels, the illuminant, and the spectral responses of the
    sensor channels.
    """
    figure, axes = canvas(13.0, 4.4, 1, 3, width_ratios=(1.0, 1.35, 1.35))
    points = _points(scene)
    _scene(axes[0, 0], scene, points)
    _spectra(axes[0, 1], scene, radiance, bands, points)
    _channels(axes[0, 2], illuminant, responses, bands)
    for ax in axes[0, 1:]:
        _lasers(ax, lines or {})
        ax.set_xlabel("wavelength (nm)")
        ax.set_ylim(bottom=0.0)
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.17), ncols=2)
    labels = [PointLabel(x, y, name, BLACK) for name, (y, x) in zip(_POINTS, points, strict=True)]
    place_labels(figure, {axes[0, 0]: labels}, framed=True)
    return figure


def _points(scene: Tensor) -> list[tuple[int, int]]:
    """Return (y, x) of the reddest, the greenest and the bluest pixel of the scene that is
    neither dark nor clipped.
    """
    # means of 5 x 5 pixels, so that single noisy pixels are not chosen
    blurred = (
        torch.nn.functional.avg_pool2d(scene[None].float(), 5, 1, 2)[0]
        if min(scene.shape[-2:]) >= 5
        else scene
    )
    brightness, white = blurred.amax(0), high(scene)
    usable = (brightness > 0.2 * white) & (brightness < 0.9 * white)
    share_of_channels = blurred / blurred.sum(0).clamp_min(1e-9)
    return [
        divmod(int(channel.where(usable, -1.0).argmax()), scene.shape[-1])
        for channel in share_of_channels
    ]


def _scene(ax: Any, scene: Tensor, points: list[tuple[int, int]]) -> None:
    """Draw the scene, with rings around the three points."""
    picture(ax, encoded(scene / high(scene)), "three points of the scene")
    for y, x in points:
        for colour, width in (("white", 2.5), ("black", 1.0)):
            ax.plot(x, y, "o", mfc="none", mec=colour, markersize=9, mew=width)


def _spectra(
    ax: Any, scene: Tensor, radiance: Tensor, bands: Bands, points: list[tuple[int, int]]
) -> None:
    """Draw the spectrum of each point, in its colour."""
    wavelengths_nm = nanometres(bands.centres)
    for name, (y, x), style in zip(_POINTS, points, ("-", "--", "-."), strict=True):
        rgb = scene[:, y, x].tolist()
        row, column = (
            # the cube may have fewer pixels than the scene
            pixel * radiance_side // scene_side
            for pixel, radiance_side, scene_side in zip(
                (y, x), radiance.shape[-2:], scene.shape[-2:], strict=True
            )
        )
        label = f"{name}: RGB {rgb[0]:.2f} {rgb[1]:.2f} {rgb[2]:.2f}"
        colour = encoded(0.75 * scene[:, y : y + 1, x : x + 1] / max(*rgb, 1e-9))[0, 0]
        ax.plot(
            wavelengths_nm, radiance[:, row, column].cpu().numpy(), style, color=colour, label=label
        )
    ax.set(title="spectra reconstructed from RGB", ylabel="relative spectral radiance")


def _channels(ax: Any, illuminant: Tensor, responses: Tensor, bands: Bands) -> None:
    """Draw the illuminant, and the response of each channel."""
    wavelengths_nm = nanometres(bands.centres)
    ax.plot(
        wavelengths_nm, illuminant.cpu().numpy(), color="black", linestyle="--", label="illuminant"
    )
    for channel, (colour, name) in zip(
        responses, CHANNELS if len(responses) > 1 else MONO, strict=True
    ):
        ax.plot(wavelengths_nm, channel.cpu().numpy(), color=colour, label=name)
    ax.set(title="illuminant and channels", ylabel="relative")


def _lasers(ax: Any, lines: Mapping[str, Bands]) -> None:
    """Draw a vertical line at the wavelength of each laser; one label stands for three or more
    lasers.
    """
    for number, (name, laser_bands) in enumerate(lines.items()):
        wavelength_nm = mean_wavelength(laser_bands) * 1e9
        label = None
        if len(lines) < 3:
            label = f"laser {name}, {wavelength_nm:.0f} nm"
        elif number == 0:
            label = f"{len(lines)} lasers"
        # two lasers are told apart by their lines
        style = "-." if len(lines) == 2 and number == 1 else ":"
        ax.axvline(wavelength_nm, color="#555555", linewidth=1.2, linestyle=style, label=label)


# --- frame and interval ---------------------------------------------------------------------------

# A frame of a real camera, the restored picture, and the uncertainty of each of its pixels.


BRIGHT = 1.5  #: times white; what the light of the scene illuminates hardly exceeds it
_LEVEL = 0.95  #: of the quantile of Student's t that ends an interval of 90 %
#: degrees of freedom of one draw: its errors are averaged over 7 x 7 pixels, and are correlated
#: among a few of them
_FREEDOM_OF_A_DRAW = 4


def half_width(spread: Tensor, draws: int) -> Tensor:
    """Return half the width of the 90 % interval, from the standard deviation that was estimated
    from ``draws``.
    """
    from scipy.stats import t

    return spread * float(t.ppf(_LEVEL, _FREEDOM_OF_A_DRAW * draws))


def unexplained(restored: Tensor, half: Tensor, invented: Tensor) -> Tensor:
    """Return True for pixels (y, x) that no scene explains: darker than black, or brighter than
    `BRIGHT` times white.

    Such a value is outside by more than the half width of the interval; saturated pixels are False.
    """
    outside = (restored < -half) | (restored > BRIGHT + half)
    return outside.any(0) & ~invented


@drawn
def restored_frame(
    *, frame: Tensor, restored: Tensor, spread: Tensor, clipped: Tensor, draws: int
) -> Any:
    """Draw a frame, the restored picture, and half the width of the 90 % interval, with marked
    pixels in colour.
    """
    figure, axes = canvas(11.0, 4.1, 1, 3)
    picture(axes[0, 0], encoded(frame), "frame")
    picture(axes[0, 1], encoded(restored), "restored")
    half_widths, saturated = half_width(spread, draws), clipped.any(0)
    mean_half_width, invented = half_widths.mean(0).cpu().numpy(), saturated.cpu().numpy()
    upper_end = (
        float(np.quantile(mean_half_width[~invented], 0.995))
        if not invented.all()
        else float(mean_half_width.max())
    )
    interval_image = picture(
        axes[0, 2],
        mean_half_width,
        "90 % interval, ±",
        cmap="viridis",
        vmin=0.0,
        vmax=max(upper_end, 1e-9),
    )
    colour_bar = figure.colorbar(
        interval_image, ax=axes[0, 2], fraction=0.046, pad=0.03, extend="max"
    )
    colour_bar.set_label("fraction of white", fontsize=9)
    colour_bar.ax.tick_params(labelsize=9)
    unexplained_pixels = unexplained(restored, half_widths, saturated).cpu().numpy()
    _mark(
        axes[0, 2],
        {
            "saturated: invented": (invented, ORANGE),
            "no scene explains": (unexplained_pixels, VERMILION),
        },
    )
    return figure


def _mark(ax: Any, kinds: Mapping[str, tuple[Any, str]]) -> None:
    """Colour pixels by kind, and name the kinds that there are, with their share, below the
    picture.
    """
    from matplotlib.colors import to_rgba
    from matplotlib.patches import Patch

    handles = []
    for name, (marked_pixels, colour) in kinds.items():
        if not marked_pixels.any():
            continue
        # RGBA, transparent where nothing is marked
        overlay = np.zeros((*marked_pixels.shape, 4))
        overlay[marked_pixels] = to_rgba(colour)
        ax.imshow(overlay)
        handles.append(Patch(facecolor=colour, label=f"{name} ({marked_pixels.mean():.2%})"))
    if handles:
        ax.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.02), fontsize=9)
