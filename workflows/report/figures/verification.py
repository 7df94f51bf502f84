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


_LEAST = 1e-17  #: an error of zero has no place on a logarithmic axis
STRENGTHS = (0.0, 1.0, 1e3, 1e6)  #: peak of the laser divided by the white of the scene
METHODS = ("shifted PSF, added", "scene and laser\nin one convolution")


@drawn
def error_time(*, rows: Sequence[tuple[str, str, float, float]]) -> Any:
    """Draw the error of variants of a step over their run time; a row has property, new value,
    error and seconds.
    """
    figure, axes = canvas(6.4, 4.2)
    ax = axes[0, 0]
    marks = zip(
        dict.fromkeys(line for line, *_ in rows),
        itertools.cycle((BLUE, GREEN, VERMILION, ORANGE)),
        strict=False,
    )
    for line, colour in marks:
        mine = [row for row in rows if row[0] == line]
        ax.loglog(
            [r[3] * 1e3 for r in mine],
            [max(r[2], _LEAST) for r in mine],
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
                PointLabel(1e3 * took, max(e, _LEAST), text, BLACK)
                for _, text, e, took in rows
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
    ax.set_xticks(range(len(STRENGTHS)), [f"{s:.0e}" if s > 1 else f"{s:.0f}" for s in STRENGTHS])
    ax.set_yticks(range(len(METHODS)), METHODS)
    ax.invert_yaxis()
    ax.grid(False)
    title = "largest float32 error far from the laser / range of the scene"
    ax.set(xlabel="peak of the laser / white of the scene", title=title)
    return figure


def _verdict(error: float) -> tuple[str, str]:
    if error < 1e-5:
        return "sound", "#9AD6C1"
    return ("watch", "#F6D58A") if error < 1e-3 else ("wrong", "#F2B08A")


def laser_trial(step: Callable[..., Any], psf: Psf, size: int = 192) -> Tensor:
    """Return the float32 error of the image of a laser, for each way to add the laser and for
    each laser strength.
    """
    band, half = psf.intensity.shape[0] // 2, min(64, *(n // 2 for n in psf.intensity.shape[-2:]))
    top, left = (n // 2 - half for n in psf.intensity.shape[-2:])
    core = psf.intensity[band : band + 1, top : top + 2 * half, left : left + 2 * half]
    kernel = Psf(core / core.sum(), psf.clear_peak[band : band + 1])
    scene = torch.rand(1, size, size, generator=torch.Generator().manual_seed(3))
    position = size // 2 - 11
    return torch.tensor(
        [_errors(step, scene, kernel, strength, position, half) for strength in STRENGTHS]
    ).T


def _errors(
    step: Callable[..., Any], scene: Tensor, psf: Psf, strength: float, position: int, half: int
) -> list[float]:
    point = torch.zeros_like(scene)
    point[..., position, position] = strength
    spot = torch.zeros_like(scene)
    spot[..., position - half : position + half, position - half : position + half] = (
        strength * psf.intensity
    )
    double = psf._replace(intensity=psf.intensity.double())
    truth = step(scene.double(), double) + spot.double()
    results = (step(scene, psf) + spot, step(scene + point, psf))
    down, across = (torch.arange(n) - position for n in scene.shape[-2:])
    far = torch.hypot(down[:, None].double(), across[None, :].double()) > 16
    return [
        float(((x.double() - truth).abs()[..., far]).max() / (scene.max() - scene.min()))
        for x in results
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
    lit = signal > 0
    clipped = lit & (variance < _CLIPPED * predicted)
    unclipped = lit & ~clipped & (variance > 0)
    light, floor = signal[unclipped], float(predicted[0].sqrt())
    ax.loglog(
        light.numpy(),
        variance[unclipped].sqrt().numpy(),
        "o",
        color=BLACK,
        markersize=4,
        label="flat fields",
    )
    ax.loglog(
        light.numpy(),
        predicted[unclipped].sqrt().numpy(),
        "-",
        color="#777777",
        linewidth=1.2,
        label="predicted",
    )
    shot = (predicted[unclipped] - predicted[0]).clamp_min(0.0).sqrt()
    ax.loglog(light.numpy(), shot.numpy(), "--", color=BLUE, label="shot noise, slope ½")
    if floor > 0:  # a sensor without noise has no floor, which a logarithmic axis could not show
        ax.axhline(floor, color=GREEN, linestyle="-.", label=f"dark noise, {floor:.3g} DN, slope 0")
    full = float(signal.max())
    ax.axvline(
        full, color=VERMILION, linestyle=":", label=f"largest signal, {full:,.0f} DN above dark"
    )
    lowest = (
        min([x for x in (floor, *variance[unclipped].sqrt().tolist()) if x > 0], default=1.0) / 3
    )
    if bool(clipped.any()):
        heights = variance[clipped].sqrt().clamp_min(1.3 * lowest)
        ax.loglog(
            signal[clipped].numpy(),
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
