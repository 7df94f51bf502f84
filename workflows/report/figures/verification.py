"""Figures that verify a run: round-off, error against time, photon-transfer curve."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from neusee.nodes.values import Psf
from neusee.workflows.report.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    VERMILION,
    PointLabel,
    canvas,
    drawn,
    place_labels,
    plain_ticks,
)

# --- numerics -------------------------------------------------------------------------------------

# Pictures of numerical accuracy: error against run time, and round-off error of a strong laser in
# float32.


_LEAST_ERROR = 1e-17  #: drawn in place of zero, which a logarithmic axis cannot show
STRENGTHS = (0.0, 1.0, 1e3, 1e6)  #: peak of the laser divided by the white of the scene
METHODS = ("shifted PSF, added", "scene and laser\nin one convolution")


@drawn
def error_time(*, rows: Sequence[tuple[str, str, float, float]]) -> Any:
    """Draw the error of variants of a step over their run time; a row has property, new value,
    error and seconds.
    """
    figure, axes = canvas(6.4, 4.2)
    ax = axes[0, 0]
    lines_and_colours = zip(
        dict.fromkeys(line for line, *_ in rows),
        itertools.cycle((BLUE, GREEN, VERMILION, ORANGE)),
        strict=False,
    )
    for line, colour in lines_and_colours:
        rows_of_line = [row for row in rows if row[0] == line]
        ax.loglog(
            # a row: property, new value, error, seconds
            [r[3] * 1e3 for r in rows_of_line],
            [max(r[2], _LEAST_ERROR) for r in rows_of_line],
            "o",
            color=colour,
            label=line,
        )
    ax.margins(x=0.25, y=0.35)
    plain_ticks(ax.xaxis)
    ax.set(title="PSF: error against run time", xlabel="run time (ms)", ylabel="error / peak")
    figure.legend(loc="outside lower center", ncols=2)
    place_labels(
        figure,
        {
            ax: [
                PointLabel(1e3 * seconds, max(error, _LEAST_ERROR), text, BLACK)
                for _, text, error, seconds in rows
                if text
            ]
        },
    )
    return figure


@drawn
def stability(*, step: Callable[..., Any], psf: Psf) -> Any:
    """Draw the float32 error of two ways to add a laser to an image: as a shifted PSF, or before
    the convolution.
    """
    errors = laser_trial(step, psf)
    figure, axes = canvas(6.4, 3.6)
    ax = axes[0, 0]
    for column in range(len(STRENGTHS)):
        for row in range(len(METHODS)):
            error = float(errors[row, column])
            verdict, colour = _verdict(error)
            ax.barh(row, 0.94, 0.9, left=column - 0.47, color=colour)
            ax.text(
                column,
                row,
                f"{verdict}\n{error:.1e}",
                ha="center",
                va="center",
                color="black",
                fontsize=10,
            )
    ax.set_xticks(
        range(len(STRENGTHS)),
        [f"{strength:.0e}" if strength > 1 else f"{strength:.0f}" for strength in STRENGTHS],
    )
    ax.set_yticks(range(len(METHODS)), METHODS)
    ax.invert_yaxis()
    ax.grid(False)
    title = "largest float32 error far from the laser / range of the scene"
    ax.set(xlabel="peak of the laser / white of the scene", title=title)
    return figure


def _verdict(error: float) -> tuple[str, str]:
    """Return the verdict on a relative error in one word, and its colour."""
    if error < 1e-5:
        return "sound", "#9AD6C1"
    return ("watch", "#F6D58A") if error < 1e-3 else ("wrong", "#F2B08A")


def laser_trial(step: Callable[..., Any], psf: Psf, size: int = 192) -> Tensor:
    """Return the largest float32 error of the image of a laser (method, strength), for each way to
    add the laser and for each laser strength.
    """
    band, half_size = (
        psf.intensity.shape[0] // 2,
        min(64, *(side // 2 for side in psf.intensity.shape[-2:])),
    )
    first_row, first_column = (side // 2 - half_size for side in psf.intensity.shape[-2:])
    # the middle of the PSF in the middle band, at most 128 x 128 pixels
    psf_core = psf.intensity[
        band : band + 1,
        first_row : first_row + 2 * half_size,
        first_column : first_column + 2 * half_size,
    ]
    kernel = Psf(psf_core / psf_core.sum(), psf.clear_peak[band : band + 1])
    scene = torch.rand(1, size, size, generator=torch.Generator().manual_seed(3))
    # off the middle, where a mistake of symmetry would not show
    position = size // 2 - 11
    return torch.tensor(
        [_errors(step, scene, kernel, strength, position, half_size) for strength in STRENGTHS]
    ).T


def _errors(
    step: Callable[..., Any], scene: Tensor, psf: Psf, strength: float, position: int, half: int
) -> list[float]:
    """Return the largest float32 error far from the laser, for both `METHODS`, over the range of
    the scene.
    """
    point = torch.zeros_like(scene)
    point[..., position, position] = strength
    laser_image = torch.zeros_like(scene)
    laser_image[..., position - half : position + half, position - half : position + half] = (
        strength * psf.intensity
    )
    double_psf = psf._replace(intensity=psf.intensity.double())
    truth = step(scene.double(), double_psf) + laser_image.double()
    # the laser added to the image, or to the scene before the convolution
    results = (step(scene, psf) + laser_image, step(scene + point, psf))
    rows_from_laser, columns_from_laser = (
        torch.arange(side) - position for side in scene.shape[-2:]
    )
    # more than 16 pixels from the laser
    is_far = (
        torch.hypot(rows_from_laser[:, None].double(), columns_from_laser[None, :].double()) > 16
    )
    return [
        float(((image.double() - truth).abs()[..., is_far]).max() / (scene.max() - scene.min()))
        for image in results
    ]


# --- photon transfer ------------------------------------------------------------------------------

# Figure of the photon-transfer curve: standard deviation over mean signal of simulated flat fields
# of the sensor.


#: a level with less than this share of the predicted variance is clipped by the well or the
#: converter
_CLIPPED = 0.5
_OPEN = {"color": VERMILION, "markersize": 6, "markerfacecolor": "none"}


@drawn
def transfer(*, measured: Tensor) -> Any:
    """Draw the photon-transfer curve of a sensor from a table of signal DN, variance DN² and
    predicted variance DN².

    The first row is measured without light. The axes follow the levels that are not clipped, and a
    triangle marks each clipped level.
    """
    signal, variance, predicted = measured.detach().double().cpu().unbind(1)
    figure, axes = canvas(6.6, 4.4)
    ax = axes[0, 0]
    is_lit = signal > 0
    is_clipped = is_lit & (variance < _CLIPPED * predicted)
    is_unclipped = is_lit & ~is_clipped & (variance > 0)
    signal_shown, dark_noise = signal[is_unclipped], float(predicted[0].sqrt())
    ax.loglog(
        signal_shown.numpy(),
        variance[is_unclipped].sqrt().numpy(),
        "o",
        color=BLACK,
        markersize=4,
        label="flat fields",
    )
    ax.loglog(
        signal_shown.numpy(),
        predicted[is_unclipped].sqrt().numpy(),
        "-",
        color="#777777",
        linewidth=1.2,
        label="predicted",
    )
    # variances add: that of the dark is subtracted
    shot_noise = (predicted[is_unclipped] - predicted[0]).clamp_min(0.0).sqrt()
    ax.loglog(
        signal_shown.numpy(), shot_noise.numpy(), "--", color=BLUE, label="shot noise, slope ½"
    )
    # a sensor without noise has no floor, which a logarithmic axis could not show
    if dark_noise > 0:
        ax.axhline(
            dark_noise,
            color=GREEN,
            linestyle="-.",
            label=f"dark noise, {dark_noise:.3g} DN, slope 0",
        )
    largest_signal = float(signal.max())
    ax.axvline(
        largest_signal,
        color=VERMILION,
        linestyle=":",
        label=f"largest signal, {largest_signal:,.0f} DN above dark",
    )
    lowest = (
        min(
            [
                deviation
                for deviation in (dark_noise, *variance[is_unclipped].sqrt().tolist())
                if deviation > 0
            ],
            default=1.0,
        )
        / 3
    )
    if bool(is_clipped.any()):
        heights = variance[is_clipped].sqrt().clamp_min(1.3 * lowest)
        ax.loglog(
            signal[is_clipped].numpy(),
            heights.numpy(),
            "v",
            label="clipped: noise at most as drawn",
            **_OPEN,
        )
    ax.set_ylim(lowest, 3 * max(float(predicted.max().sqrt()), lowest))
    title = "photon-transfer curve of this sensor"
    ax.set(title=title, xlabel="mean above dark (DN)", ylabel="standard deviation (DN)")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.15), ncols=2)
    return figure
