"""Figures of the optics: height and phase of the mask, point-spread functions, laser suppression by wavelength."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from neusee.nodes import metrics
from neusee.nodes.optics import mask_turns
from neusee.nodes.values import Bands, Psf, Pupil
from neusee.workflows.report.figures.point_labels import plain_ticks
from neusee.workflows.report.figures.style import BLUE, GREEN, VERMILION, canvas, drawn, nanometres, nearest, picture

_WAVELENGTHS = (450e-9, 550e-9, 638e-9)  #: m, at which phase and PSF are drawn


@drawn
def height(*, pupil: Pupil) -> Any:
    """Draw maps of the mask height, and of the wrapped phase at three wavelengths, over the clear aperture."""
    figure, axes = canvas(13.0, 3.5, 1, 4)
    step = max(1, pupil.height.shape[-1] // 540)
    clear = pupil.aperture[::step, ::step] > 0
    half = float(pupil.pitch) * pupil.height.shape[-1] / 2 * 1e3
    extent = (-half, half, -half, half)
    metres = pupil.height[::step, ::step].double()
    _map(figure, axes[0, 0], (metres * 1e6).where(clear, torch.nan), "height", "µm", extent, cmap="cividis")
    for ax, wavelength in zip(axes[0, 1:], _WAVELENGTHS, strict=True):
        band, name = nearest(pupil.wavelengths, wavelength)
        turns = torch.remainder(mask_turns(pupil, band, step), 1.0).where(clear, torch.nan)
        _map(figure, ax, turns, f"phase at {name}", "turns, wrapped", extent, cmap="twilight", vmin=0.0, vmax=1.0)
    axes[0, 0].set_ylabel("v (mm)")
    return figure


def _map(
    figure: Any, ax: Any, values: Tensor, title: str, unit: str, extent: tuple[float, ...], **options: Any
) -> None:
    shown = ax.imshow(values.cpu().numpy(), origin="lower", extent=extent, **options)
    ax.set(title=title, xlabel="u (mm)")
    ax.grid(False)
    bar = figure.colorbar(shown, ax=ax, fraction=0.046, pad=0.03)
    bar.set_label(unit, fontsize=9)
    bar.ax.tick_params(labelsize=9)


@drawn
def psf(*, plain: Psf, mask: Psf, bands: Bands, pixel_pitch: float) -> Any:
    """Draw the logarithm of the PSF at three wavelengths, and the encircled energy, for plain lens and mask."""
    figure, axes = canvas(13.0, 6.6, 2, 4)
    figure.get_layout_engine().set(w_pad=0.1, h_pad=0.1)
    shown: Any = None
    for row, (arm, each) in enumerate({"plain lens": plain, "with mask": mask}.items()):
        for column, wavelength in enumerate(_WAVELENGTHS):
            shown = _spot(axes[row, column], each, *nearest(bands.centres, wavelength), pixel_pitch, arm)
        _encircled(axes[row, 3], each, bands, pixel_pitch, arm)
    bar = figure.colorbar(shown, ax=axes[:, :3].ravel().tolist(), fraction=0.025, pad=0.01)
    bar.set_label("log₁₀ (pixel / peak of the clear lens)", fontsize=10)
    bar.ax.tick_params(labelsize=9)
    return figure


def _spot(ax: Any, psf: Psf, band: int, name: str, pitch: float, arm: str) -> Any:
    size = min(257, *psf.intensity.shape[-2:])
    log = _window(metrics.over_clear_peak(psf, band), size).double().clamp_min(1e-30).log10()
    shown = picture(ax, log.cpu().numpy(), f"{arm}, {name}", origin="lower", cmap="viridis", vmin=-8.0, vmax=0.0)
    ax.set_xlabel(f"{size * pitch * 1e6:.0f} µm across")
    return shown


def _window(image: Tensor, size: int) -> Tensor:
    """Return the middle ``size`` by ``size`` pixels of an image; the optical axis stays at pixel N // 2."""
    top, left = (n // 2 - size // 2 for n in image.shape[-2:])
    return image[top : top + size, left : left + size]


def _encircled(ax: Any, psf: Psf, bands: Bands, pitch: float, arm: str) -> None:
    """Draw the encircled energy of a PSF over the radius at three wavelengths, as a fraction of the pupil's light."""
    for wavelength, colour in zip(_WAVELENGTHS, (BLUE, "#00785A", "#B3261E"), strict=True):
        band, name = nearest(bands.centres, wavelength)
        share = metrics.encircled_curve(psf.intensity[band])
        microns = (torch.arange(len(share)) + 0.5) * pitch * 1e6
        ax.semilogx(microns.numpy(), share.numpy(), color=colour, label=name)
    title = f"{arm}: encircled energy"
    ax.set(ylim=(0.0, 1.02), title=title, xlabel="radius (µm)", ylabel="share of the pupil's light")
    ax.legend(loc="best")
    plain_ticks(ax.xaxis)


@drawn
def suppression(*, lsr: Tensor, bands: Bands, psf: Psf, bsr: Tensor | None = None) -> Any:
    """Draw the laser suppression ratio (LSR) over wavelength with its lower bound, and beside it the BSR if given."""
    figure, axes = canvas(11.0 if bsr is not None else 6.4, 4.2, 1, 2 if bsr is not None else 1)
    nm, left = nanometres(bands.centres), axes[0, 0]
    _unsuppressed(left)
    left.semilogy(nm, lsr.cpu().numpy(), "o-", color=VERMILION, markersize=3.5, label="with mask")
    left.semilogy(nm, metrics.least_lsr(psf).cpu().numpy(), "--", color=BLUE, label="energy floor")
    left.set(title="laser suppression ratio (peak / clear peak)", ylabel="LSR")
    if bsr is not None:
        right = axes[0, 1]
        _unsuppressed(right)
        right.plot(nm, bsr.cpu().numpy(), "s-", color=GREEN, markersize=3.5, label="with mask")
        right.set_ylim(0.0, max(1.1, 1.1 * float(bsr.max())))
        right.set(title="background kept in the field (BSR)", ylabel="BSR")
    for ax in axes[0]:
        ax.set_xlabel("wavelength (nm)")
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.17), ncols=3)
    return figure


def _unsuppressed(ax: Any) -> None:
    ax.axhline(1.0, color="black", linewidth=0.8, linestyle=":", label="plain lens")
