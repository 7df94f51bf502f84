"""Figures of the optics: mask, point-spread functions, suppression, tables of the user."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neusee.nodes import doe, metrics, spectra
from neusee.nodes.optics import mask_turns
from neusee.nodes.values import Bands, Psf, Pupil
from neusee.workflows.report.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    VERMILION,
    canvas,
    drawn,
    nanometres,
    nearest,
    picture,
    plain_ticks,
)

# --- optics ---------------------------------------------------------------------------------------

# Figures of the optics: height and phase of the mask, point-spread functions, laser suppression by
# wavelength.


_WAVELENGTHS = (450e-9, 550e-9, 638e-9)  #: m, at which phase and PSF are drawn


@drawn
def height(*, pupil: Pupil) -> Any:
    """Draw maps of the mask height, and of the wrapped phase at three wavelengths, over the
    clear aperture.
    """
    figure, axes = canvas(13.0, 3.5, 1, 4)
    # at most 540 samples a side
    stride = max(1, pupil.height.shape[-1] // 540)
    is_clear = pupil.aperture[::stride, ::stride] > 0
    half_width = float(pupil.pitch) * pupil.height.shape[-1] / 2 * 1e3
    extent = (-half_width, half_width, -half_width, half_width)
    heights = pupil.height[::stride, ::stride].double()
    _map(
        figure,
        axes[0, 0],
        (heights * 1e6).where(is_clear, torch.nan),
        "height",
        "µm",
        extent,
        cmap="cividis",
    )
    for ax, wavelength in zip(axes[0, 1:], _WAVELENGTHS, strict=True):
        band, name = nearest(pupil.wavelengths, wavelength)
        turns = torch.remainder(mask_turns(pupil, band, stride), 1.0).where(is_clear, torch.nan)
        _map(
            figure,
            ax,
            turns,
            f"phase at {name}",
            "turns, wrapped",
            extent,
            cmap="twilight",
            vmin=0.0,
            vmax=1.0,
        )
    axes[0, 0].set_ylabel("v (mm)")
    return figure


def _map(
    figure: Any,
    ax: Any,
    values: Tensor,
    title: str,
    unit: str,
    extent: tuple[float, ...],
    **options: Any,
) -> None:
    """Draw one map of the pupil with its colour bar."""
    image = ax.imshow(values.cpu().numpy(), origin="lower", extent=extent, **options)
    ax.set(title=title, xlabel="u (mm)")
    ax.grid(False)
    colour_bar = figure.colorbar(image, ax=ax, fraction=0.046, pad=0.03)
    colour_bar.set_label(unit, fontsize=9)
    colour_bar.ax.tick_params(labelsize=9)


@drawn
def psf(*, plain: Psf, mask: Psf, bands: Bands, pixel_pitch: float) -> Any:
    """Draw the logarithm of the PSF at three wavelengths, and the encircled energy, for plain
    lens and mask.
    """
    figure, axes = canvas(13.0, 6.6, 2, 4)
    figure.get_layout_engine().set(w_pad=0.1, h_pad=0.1)
    last_image: Any = None
    for row, (arm, arm_psf) in enumerate({"plain lens": plain, "with mask": mask}.items()):
        for column, wavelength in enumerate(_WAVELENGTHS):
            last_image = _spot(
                axes[row, column], arm_psf, *nearest(bands.centres, wavelength), pixel_pitch, arm
            )
        _encircled(axes[row, 3], arm_psf, bands, pixel_pitch, arm)
    colour_bar = figure.colorbar(
        last_image, ax=axes[:, :3].ravel().tolist(), fraction=0.025, pad=0.01
    )
    colour_bar.set_label("log₁₀ (pixel / peak of the clear lens)", fontsize=10)
    colour_bar.ax.tick_params(labelsize=9)
    return figure


def _spot(ax: Any, psf: Psf, band: int, name: str, pitch: float, arm: str) -> Any:
    """Draw the logarithm of a PSF around its middle in one band, and return the image."""
    # at most 257 pixels, an odd number with the optical axis in the middle
    size = min(257, *psf.intensity.shape[-2:])
    log_psf = _window(metrics.over_clear_peak(psf, band), size).double().clamp_min(1e-30).log10()
    image = picture(
        ax,
        log_psf.cpu().numpy(),
        f"{arm}, {name}",
        origin="lower",
        cmap="viridis",
        vmin=-8.0,
        vmax=0.0,
    )
    ax.set_xlabel(f"{size * pitch * 1e6:.0f} µm across")
    return image


def _window(image: Tensor, size: int) -> Tensor:
    """Return the middle ``size`` by ``size`` pixels of an image; the optical axis stays at pixel
    N // 2.
    """
    # the axis at N // 2 of the image becomes that of the window
    first_row, first_column = (side // 2 - size // 2 for side in image.shape[-2:])
    return image[first_row : first_row + size, first_column : first_column + size]


def _encircled(ax: Any, psf: Psf, bands: Bands, pitch: float, arm: str) -> None:
    """Draw the encircled energy of a PSF over the radius at three wavelengths, as a fraction of
    the pupil's light.
    """
    for wavelength, colour in zip(_WAVELENGTHS, (BLUE, "#00785A", "#B3261E"), strict=True):
        band, name = nearest(bands.centres, wavelength)
        share = metrics.encircled_curve(psf.intensity[band])
        # the middle of each ring, 1 pixel wide
        microns = (torch.arange(len(share)) + 0.5) * pitch * 1e6
        ax.semilogx(microns.numpy(), share.numpy(), color=colour, label=name)
    title = f"{arm}: encircled energy"
    ax.set(ylim=(0.0, 1.02), title=title, xlabel="radius (µm)", ylabel="share of the pupil's light")
    ax.legend(loc="best")
    plain_ticks(ax.xaxis)


@drawn
def suppression(*, lsr: Tensor, bands: Bands, psf: Psf, bsr: Tensor | None = None) -> Any:
    """Draw the laser suppression ratio (LSR) over wavelength with its lower bound, and beside it
    the BSR if given.
    """
    width, columns = (6.4, 1) if bsr is None else (11.0, 2)
    figure, axes = canvas(width, 4.2, 1, columns)
    wavelengths_nm, lsr_axis = nanometres(bands.centres), axes[0, 0]
    _unsuppressed(lsr_axis)
    lsr_axis.semilogy(
        wavelengths_nm, lsr.cpu().numpy(), "o-", color=VERMILION, markersize=3.5, label="with mask"
    )
    lsr_axis.semilogy(
        wavelengths_nm, metrics.least_lsr(psf).cpu().numpy(), "--", color=BLUE, label="energy floor"
    )
    lsr_axis.set(title="laser suppression ratio (peak / clear peak)", ylabel="LSR")
    if bsr is not None:
        bsr_axis = axes[0, 1]
        _unsuppressed(bsr_axis)
        bsr_axis.plot(
            wavelengths_nm, bsr.cpu().numpy(), "s-", color=GREEN, markersize=3.5, label="with mask"
        )
        bsr_axis.set_ylim(0.0, max(1.1, 1.1 * float(bsr.max())))
        bsr_axis.set(title="background kept in the field (BSR)", ylabel="BSR")
    for ax in axes[0]:
        ax.set_xlabel("wavelength (nm)")
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.17), ncols=3)
    return figure


def _unsuppressed(ax: Any) -> None:
    """Draw the line of a lens that suppresses nothing."""
    ax.axhline(1.0, color="black", linewidth=0.8, linestyle=":", label="plain lens")


# --- own tables -----------------------------------------------------------------------------------

# Figure of the tables of the user: camera, glass, light, lasers and height map, each as its file
# holds it.


_WIDTH = 4.6  #: inches of a panel
_COLOURS = (VERMILION, GREEN, BLUE)
_LASERS = (BLUE, VERMILION, GREEN, ORANGE, BLACK)
_STYLES = ("-", "--", "-.", ":")

Draw = Callable[[Any, Any], None]  #: of the figure and a panel


@drawn
def tables(
    *,
    camera: Any = None,
    glass: Any = None,
    light: Any = None,
    lasers: Mapping[str, Any] | None = None,
    height: Any = None,
    depth: float | None = None,
    unit: float | None = None,
    pitch: float | None = None,
) -> Any:
    """Draw each table of the user in a panel of its own; an argument that is no file or
    coefficients is left out.

    Raises: ValueError if no argument is a table.
    """
    files = {name: file for name, file in (lasers or {}).items() if isinstance(file, Path)}
    panels: list[Draw] = []
    if isinstance(camera, Path):
        panels.append(lambda _, ax: _camera(ax, camera))
    if isinstance(glass, Path | Mapping):
        panels.append(lambda _, ax: _glass(ax, glass))
    if isinstance(light, Path):
        panels.append(lambda _, ax: _light(ax, light))
    if files:
        panels.append(lambda _, ax: _lasers(ax, files))
    if isinstance(height, Path):
        panels.append(lambda figure, ax: _height(figure, ax, height, depth, unit, pitch))
    if not panels:
        raise ValueError("the recipe has no table of its own")
    return _filled(panels)


def _filled(panels: Sequence[Draw]) -> Any:
    """Return a figure of the panels, each drawn by its function, at most three side by side."""
    columns = min(3, len(panels))
    # -(-a // b): a / b rounded up, the number of rows
    figure, axes = canvas(
        _WIDTH * columns, 4.2 * -(-len(panels) // columns), -(-len(panels) // columns), columns
    )
    for ax in axes.ravel()[len(panels) :]:
        ax.remove()
    for draw, ax in zip(panels, axes.ravel(), strict=False):
        draw(figure, ax)
    return figure


def _camera(ax: Any, file: Path) -> None:
    """Draw the curve of each channel of a camera's table, in % or relative to the largest."""
    curves, absolute = spectra.camera_curves(file)
    table, is_mono = curves.table(), len(curves.columns) == 1
    colours = _COLOURS if not is_mono else (BLACK,)
    for column, values, colour in zip(curves.columns, table.values, colours, strict=True):
        shown_values = 100 * values if absolute else values / table.values.max()
        ax.plot(
            nanometres(table.wavelengths),
            shown_values.numpy(),
            ".-",
            color=colour,
            label=column.quantity,
        )
    ax.set(title=file.name, ylabel="quantum efficiency (%)" if absolute else "relative sensitivity")
    _spectral(ax)


def _glass(ax: Any, glass: Any) -> None:
    """Draw the refractive index of a glass, with the rows of its file if it has one."""
    wavelengths, index = doe.index_curve(glass)
    ax.plot(nanometres(wavelengths), index.numpy(), "-", color=BLUE, label="as used")
    if isinstance(glass, Path) and (rows := doe.index_rows(glass)):
        ax.plot(nanometres(rows[0]), rows[1].numpy(), ".", color=BLACK, label="rows of the file")
    name = glass.name if isinstance(glass, Path) else "Sellmeier coefficients"
    ax.set(title=name, ylabel="refractive index")
    _spectral(ax)


def _light(ax: Any, file: Path) -> None:
    """Draw the spectrum of an illuminant's table, relative to the largest value."""
    table = spectra.light_curve(file).table()
    power = table.values[0] / table.values.max()
    ax.plot(nanometres(table.wavelengths), power.numpy(), ".-", color=ORANGE, label="illuminant")
    ax.set(title=file.name, ylabel="spectral power / largest")
    _spectral(ax)


def _lasers(ax: Any, files: Mapping[str, Path]) -> None:
    """Draw each laser: separate lines as bars from 0, a spectrum as a curve, both relative to
    the largest value.
    """
    for number, (name, file) in enumerate(files.items()):
        laser = spectra.laser_table(file)
        table = laser.power.table()
        style = {
            "color": _LASERS[number % len(_LASERS)],
            "linestyle": _STYLES[number % len(_STYLES)],
        }
        wavelengths_nm, power = (
            nanometres(table.wavelengths),
            (table.values[0] / table.values.max()).numpy(),
        )
        if laser.widths is None:
            ax.plot(wavelengths_nm, power, label=f"{name}, {file.name}", **style)
        else:
            ax.vlines(
                wavelengths_nm,
                0,
                power,
                label=f"{name}, {file.name}",
                colors=style["color"],
                linestyles=style["linestyle"],
            )
    ax.set(title="lasers", ylabel="power / largest")
    _spectral(ax)


def _spectral(ax: Any) -> None:
    """Label the axis of wavelengths, and let all but an index begin at 0."""
    ax.set_xlabel("wavelength (nm)")
    if ax.get_ylabel() != "refractive index":
        ax.set_ylim(bottom=min(0.0, ax.get_ylim()[0]) if ax.dataLim.y0 < 0 else 0.0)
    ax.margins(x=0.05)
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.17), ncols=2)


def _height(
    figure: Any, ax: Any, file: Path, depth: float | None, unit: float | None, pitch: float | None
) -> None:
    """Draw a height map's file; without a pitch the axes count its samples."""
    heights, own_pitch = doe.height_map(file, depth=depth, unit=unit, pitch=pitch)
    stride = max(1, max(heights.shape) // 540)
    # mm, or samples without a pitch; (y, x)
    half_sides = [side * (own_pitch * 1e3 if own_pitch else 1.0) / 2 for side in heights.shape]
    extent = (-half_sides[1], half_sides[1], -half_sides[0], half_sides[0])
    microns = (heights[::stride, ::stride].double() * 1e6).numpy()
    image = ax.imshow(microns, origin="lower", extent=extent, cmap="cividis")
    unit_name = "mm" if own_pitch else "samples"
    ax.set(title=file.name, xlabel=f"u ({unit_name})", ylabel=f"v ({unit_name})")
    ax.grid(False)
    colour_bar = figure.colorbar(image, ax=ax, fraction=0.046, pad=0.03)
    colour_bar.set_label("height (µm)", fontsize=9)
    colour_bar.ax.tick_params(labelsize=9)
