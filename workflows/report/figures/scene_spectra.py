"""Figure of the spectra of three scene pixels, and of the RGB values from which these spectra are reconstructed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from neusee.nodes.spectra import mean_wavelength
from neusee.nodes.values import Bands
from neusee.workflows.report.figures.camera_overview import high
from neusee.workflows.report.figures.point_labels import PointLabel, place_labels
from neusee.workflows.report.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    VERMILION,
    canvas,
    drawn,
    encoded,
    nanometres,
    picture,
)

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
    """Draw the spectra of three scene pixels, the illuminant, and the spectral responses of the sensor channels."""
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
    """Return (y, x) of the reddest, the greenest and the bluest pixel of the scene that is neither dark nor clipped."""
    inner = torch.nn.functional.avg_pool2d(scene[None].float(), 5, 1, 2)[0] if min(scene.shape[-2:]) >= 5 else scene
    lit, white = inner.amax(0), high(scene)
    usable = (lit > 0.2 * white) & (lit < 0.9 * white)
    share = inner / inner.sum(0).clamp_min(1e-9)
    return [divmod(int(channel.where(usable, -1.0).argmax()), scene.shape[-1]) for channel in share]


def _scene(ax: Any, scene: Tensor, points: list[tuple[int, int]]) -> None:
    picture(ax, encoded(scene / high(scene)), "three points of the scene")
    for y, x in points:
        for colour, width in (("white", 2.5), ("black", 1.0)):
            ax.plot(x, y, "o", mfc="none", mec=colour, markersize=9, mew=width)


def _spectra(ax: Any, scene: Tensor, radiance: Tensor, bands: Bands, points: list[tuple[int, int]]) -> None:
    nm = nanometres(bands.centres)
    for name, (y, x), style in zip(_POINTS, points, ("-", "--", "-."), strict=True):
        rgb = scene[:, y, x].tolist()
        row, column = (p * r // s for p, r, s in zip((y, x), radiance.shape[-2:], scene.shape[-2:], strict=True))
        label = f"{name}: RGB {rgb[0]:.2f} {rgb[1]:.2f} {rgb[2]:.2f}"
        colour = encoded(0.75 * scene[:, y : y + 1, x : x + 1] / max(*rgb, 1e-9))[0, 0]
        ax.plot(nm, radiance[:, row, column].cpu().numpy(), style, color=colour, label=label)
    ax.set(title="spectra reconstructed from RGB", ylabel="relative spectral radiance")


def _channels(ax: Any, illuminant: Tensor, responses: Tensor, bands: Bands) -> None:
    nm = nanometres(bands.centres)
    ax.plot(nm, illuminant.cpu().numpy(), color="black", linestyle="--", label="illuminant")
    for channel, (colour, name) in zip(responses, CHANNELS if len(responses) > 1 else MONO, strict=True):
        ax.plot(nm, channel.cpu().numpy(), color=colour, label=name)
    ax.set(title="illuminant and channels", ylabel="relative")


def _lasers(ax: Any, lines: Mapping[str, Bands]) -> None:
    """Draw a vertical line at the wavelength of each laser; one label stands for three or more lasers."""
    for number, (name, line) in enumerate(lines.items()):
        nm = mean_wavelength(line) * 1e9
        label = f"laser {name}, {nm:.0f} nm" if len(lines) < 3 else f"{len(lines)} lasers" if number == 0 else None
        style = "-." if len(lines) == 2 and number == 1 else ":"
        ax.axvline(nm, color="#555555", linewidth=1.2, linestyle=style, label=label)
