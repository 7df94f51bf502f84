"""Figure of the tables of the user: camera, glass, light, lasers and height map, each as its file holds it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from neusee.nodes import doe, spectra
from neusee.workflows.report.figures.style import BLACK, BLUE, GREEN, ORANGE, VERMILION, canvas, drawn, nanometres

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
    """Draw each table of the user in a panel of its own; an argument that is no file or coefficients is left out.

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
    columns = min(3, len(panels))
    figure, axes = canvas(_WIDTH * columns, 4.2 * -(-len(panels) // columns), -(-len(panels) // columns), columns)
    for ax in axes.ravel()[len(panels) :]:
        ax.remove()
    for draw, ax in zip(panels, axes.ravel(), strict=False):
        draw(figure, ax)
    return figure


def _camera(ax: Any, file: Path) -> None:
    curves, absolute = spectra.camera_curves(file)
    table, mono = curves.table(), len(curves.columns) == 1
    colours = _COLOURS if not mono else (BLACK,)
    for column, values, colour in zip(curves.columns, table.values, colours, strict=True):
        shown = 100 * values if absolute else values / table.values.max()
        ax.plot(nanometres(table.wavelengths), shown.numpy(), ".-", color=colour, label=column.quantity)
    ax.set(title=file.name, ylabel="quantum efficiency (%)" if absolute else "relative sensitivity")
    _spectral(ax)


def _glass(ax: Any, glass: Any) -> None:
    wavelengths, index = doe.index_curve(glass)
    ax.plot(nanometres(wavelengths), index.numpy(), "-", color=BLUE, label="as used")
    if isinstance(glass, Path) and (rows := doe.index_rows(glass)):
        ax.plot(nanometres(rows[0]), rows[1].numpy(), ".", color=BLACK, label="rows of the file")
    name = glass.name if isinstance(glass, Path) else "Sellmeier coefficients"
    ax.set(title=name, ylabel="refractive index")
    _spectral(ax)


def _light(ax: Any, file: Path) -> None:
    table = spectra.light_curve(file).table()
    power = table.values[0] / table.values.max()
    ax.plot(nanometres(table.wavelengths), power.numpy(), ".-", color=ORANGE, label="illuminant")
    ax.set(title=file.name, ylabel="spectral power / largest")
    _spectral(ax)


def _lasers(ax: Any, files: Mapping[str, Path]) -> None:
    """Draw each laser: separate lines as bars from 0, a spectrum as a curve, both relative to the largest value."""
    for number, (name, file) in enumerate(files.items()):
        laser = spectra.laser_table(file)
        table = laser.power.table()
        look = {"color": _LASERS[number % len(_LASERS)], "linestyle": _STYLES[number % len(_STYLES)]}
        nm, power = nanometres(table.wavelengths), (table.values[0] / table.values.max()).numpy()
        if laser.widths is None:
            ax.plot(nm, power, label=f"{name}, {file.name}", **look)
        else:
            ax.vlines(nm, 0, power, label=f"{name}, {file.name}", colors=look["color"], linestyles=look["linestyle"])
    ax.set(title="lasers", ylabel="power / largest")
    _spectral(ax)


def _spectral(ax: Any) -> None:
    ax.set_xlabel("wavelength (nm)")
    if ax.get_ylabel() != "refractive index":
        ax.set_ylim(bottom=min(0.0, ax.get_ylim()[0]) if ax.dataLim.y0 < 0 else 0.0)
    ax.margins(x=0.05)
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.17), ncols=2)


def _height(figure: Any, ax: Any, file: Path, depth: float | None, unit: float | None, pitch: float | None) -> None:
    heights, own = doe.height_map(file, depth=depth, unit=unit, pitch=pitch)
    step = max(1, max(heights.shape) // 540)
    half = [n * (own * 1e3 if own else 1.0) / 2 for n in heights.shape]
    extent = (-half[1], half[1], -half[0], half[0])
    microns = (heights[::step, ::step].double() * 1e6).numpy()
    shown = ax.imshow(microns, origin="lower", extent=extent, cmap="cividis")
    what = "mm" if own else "samples"
    ax.set(title=file.name, xlabel=f"u ({what})", ylabel=f"v ({what})")
    ax.grid(False)
    bar = figure.colorbar(shown, ax=ax, fraction=0.046, pad=0.03)
    bar.set_label("height (µm)", fontsize=9)
    bar.ax.tick_params(labelsize=9)
