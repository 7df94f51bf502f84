"""Style of all figures: colours, light background, large text, PNG, and labels of points."""

from __future__ import annotations

import functools
import io
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Literal, NamedTuple, ParamSpec

import torch
from torch import Tensor

# --- style ----------------------------------------------------------------------------------------

# Style of all figures: colours for colour-blind readers, light background, text of at least 9
# points, PNG format.


P = ParamSpec("P")

#: Colours of the palette of Okabe and Ito, which people with any common kind of colour vision can
#: tell apart.
BLUE, ORANGE, GREEN, VERMILION = "#0072B2", "#E69F00", "#009E73", "#D55E00"
BLACK = "#000000"

_MARGIN = 0.08  #: inches around what is drawn
_COMPRESSION = 3  #: of zlib: half the time of its usual 6, and files that are 4 % larger
_RC: Mapping[str, Any] = {
    "font.family": ["DejaVu Sans"],
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.labelsize": 10,
    "xtick.labelsize": 9,
    "ytick.labelsize": 9,
    "legend.fontsize": 9,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "image.interpolation": "nearest",
}


def canvas(
    width: float,
    height: float,
    rows: int = 1,
    columns: int = 1,
    layout: Literal["constrained"] | None = "constrained",
    **options: Any,
) -> tuple[Any, Any]:
    """Return a new matplotlib figure of ``width`` by ``height`` inches, and the array of its
    axes.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=120, layout=layout)
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def panels(
    count: int, across: int, width: float, height: float, below: float = 0.0, **options: Any
) -> tuple[Any, list[Any]]:
    """Return a figure of ``count`` panels of ``width`` by ``height`` inches, at most ``across`` in
    a row, and their axes.

    ``below`` is the height (inches) of what stands below or beside the panels, such as a legend.
    """
    columns = min(across, count)
    # rounded up
    rows = -(-count // columns)
    figure, axes = canvas(width * columns, height * rows + below, rows, columns, **options)
    for unused in axes.flat[count:]:
        unused.set_axis_off()
    return figure, list(axes.flat[:count])


def drawn(draw: Callable[P, Any]) -> Callable[P, bytes]:
    """Decorate a drawing function, so that the function uses the common style and returns the
    bytes of a PNG file.
    """

    @functools.wraps(draw)
    def inner(*args: P.args, **kwargs: P.kwargs) -> bytes:
        with styled():
            return png_of(draw(*args, **kwargs))

    return inner


@contextmanager
def styled() -> Iterator[None]:
    """Use the common style for the figures that are made in the ``with`` block."""
    import matplotlib

    with matplotlib.rc_context(dict(_RC)):
        yield


def png_of(figure: Any) -> bytes:
    """Return a matplotlib figure as the bytes of a PNG file, cut to what is drawn.

    The axes are placed here, because `savefig` draws the whole figure twice to place them.
    """
    buffer, layout_engine = io.BytesIO(), figure.get_layout_engine()
    if layout_engine is not None:
        layout_engine.execute(figure)
    drawn_part = figure.get_tightbbox(figure.canvas.get_renderer()).padded(_MARGIN)
    figure.set_layout_engine(None)
    png_options = {
        "metadata": {"Software": "neusee"},
        "pil_kwargs": {"compress_level": _COMPRESSION},
    }
    figure.savefig(buffer, format="png", bbox_inches=drawn_part, **png_options)
    return buffer.getvalue()


def warm() -> None:
    """Import the modules that figures need and find the font, so that the first picture takes no
    longer than others.
    """
    with styled():
        figure, axes = canvas(1.0, 1.0)
        axes[0, 0].set_title("a")
        png_of(figure)


def picture(axes: Any, image: Any, title: str, **options: Any) -> Any:
    """Show an image without axis ticks; pass ``options``, such as the colour scale, to
    ``imshow``.
    """
    shown_image = axes.imshow(image, **options)
    axes.set(title=title, xticks=[], yticks=[])
    axes.grid(False)
    for spine in axes.spines.values():
        spine.set_visible(False)
    return shown_image


def encoded(linear: Tensor) -> Any:
    """Return linear sRGB (3, y, x) as gamma-encoded values (y, x, 3), clipped to [0, 1]; NaN
    becomes 0.
    """
    from kornia.color import linear_rgb_to_rgb

    rgb = torch.nan_to_num(linear.detach().to("cpu", torch.float32)).clamp(0.0, 1.0)
    return linear_rgb_to_rgb(rgb[None])[0].permute(1, 2, 0).clamp(0.0, 1.0).numpy()


def nanometres(metres: Tensor) -> Any:
    """Convert a tensor of wavelengths in metres to a NumPy array in nanometres."""
    return metres.detach().double().cpu().numpy() * 1e9


def nearest(centres: Tensor, metres: float) -> tuple[int, str]:
    """Return the index of the spectral band nearest to a wavelength, and its centre as text,
    such as ``550 nm``.
    """
    band = int((centres - metres).abs().argmin())
    return band, f"{float(centres[band]) * 1e9:.0f} nm"


# --- point labels ---------------------------------------------------------------------------------

# Labels of the points of a diagram, each where the label covers no other label, no marker and no
# note.


_OFFSETS = (
    (6, 4),
    (6, -12),
    (-6, 4),
    (-6, -12),
    (0, 9),
    (0, -17),
    (16, 13),
    (-16, 13),
    (16, -21),
    (-16, -21),
)
_MARKER = 12  #: pixels, the side of the square that the marker of a point takes
_LABEL_GAP = 3  #: pixels between two labels side by side
_FRAME = {
    "boxstyle": "round,pad=0.15",
    "facecolor": "white",
    "edgecolor": "black",
    "linewidth": 0.8,
}
_MOST_DECADES = 2.5  #: decades of an axis with numbers between the powers of ten
#: numbers of a decade, and their least distance in decades
_SUBS = (((1.0, 2.0, 5.0), 0.3), ((1.0, 3.0), 0.47))
_POINTS = 9.0  #: size of the numbers of an axis
_AXIS_SHARE = 0.85  #: share of the length of an axis that is left after the layout


class PointLabel(NamedTuple):
    """A point of a diagram, with the text and the colour of its label; a point without text only
    takes its place.
    """

    x: float
    y: float
    text: str
    colour: str


def place_labels(
    figure: Any, points: Mapping[Any, Sequence[PointLabel]], framed: bool = False
) -> None:
    """Write the labels of the points of each diagram where nothing is covered; omit labels without
    free space.

    ``framed`` labels have a white box, to be read on a picture.
    """
    figure.draw_without_rendering()
    renderer = figure.canvas.get_renderer()
    for ax, labels in points.items():
        taken_boxes = _taken(ax, labels, renderer)
        for point in labels:
            if point.text:
                _place(ax, point, taken_boxes, renderer, framed)


def _taken(ax: Any, points: Sequence[PointLabel], renderer: Any) -> list[Any]:
    """Return the boxes in pixels that the markers, the notes and the legend of a diagram cover."""
    from matplotlib.transforms import Bbox

    centres = (ax.transData.transform((point.x, point.y)) for point in points)
    half_side = _MARKER / 2
    legend = [ax.get_legend()] if ax.get_legend() else []
    return [
        *(
            Bbox.from_bounds(pixel_x - half_side, pixel_y - half_side, _MARKER, _MARKER)
            for pixel_x, pixel_y in centres
        ),
        *(artist.get_window_extent(renderer) for artist in (*ax.texts, *legend)),
    ]


def _place(ax: Any, point: PointLabel, taken: list[Any], renderer: Any, framed: bool) -> None:
    """Write a label at the first offset at which it overlaps no box in ``taken``, and append its
    box to ``taken``.
    """
    from matplotlib.patheffects import withStroke

    inside = ax.get_window_extent()
    style = {
        "color": point.colour,
        "path_effects": [withStroke(linewidth=2.5, foreground="white")],
        "zorder": 5,
    }
    style |= {"bbox": _FRAME} if framed else {}
    for offset_x, offset_y in _OFFSETS:
        side = "center"
        if offset_x:
            side = "left" if offset_x > 0 else "right"
        placement = {"xytext": (offset_x, offset_y), "textcoords": "offset points", "ha": side}
        text = ax.annotate(point.text, (point.x, point.y), **placement, fontsize=9, **style)
        text.set_in_layout(False)
        box = text.get_window_extent(renderer)
        padded = box.padded(_LABEL_GAP, _LABEL_GAP * framed)
        if _contains(inside, box) and not any(padded.overlaps(other) for other in taken):
            taken.append(box)
            return
        text.remove()


def _contains(outer: Any, box: Any) -> bool:
    """Return True if a box lies in another one."""
    within_width = bool(outer.x0 <= box.x0 and box.x1 <= outer.x1)
    return within_width and bool(outer.y0 <= box.y0 and box.y1 <= outer.y1)


def plain_ticks(axis: Any) -> None:
    """Label a logarithmic axis with plain numbers such as 0.5 and 20, as many as fit without
    touching.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    least, greatest = sorted(axis.get_view_interval())
    decades, axis_length, label_length = (
        math.log10(greatest / least),
        _length(axis),
        _label_size(axis, least, greatest),
    )
    # the gap between two numbers of a decade, in points, has room for a number
    ticks_that_fit = [
        subs
        for subs, gap in _SUBS
        if decades <= _MOST_DECADES and gap * axis_length / decades > label_length
    ]
    ticks = ticks_that_fit[0] if ticks_that_fit else (1.0,)
    tick_count = max(2, int(axis_length / label_length))
    axis.set_major_locator(LogLocator(subs=ticks, numticks=tick_count))
    axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def _length(axis: Any) -> float:
    """Return a low estimate of the length of an axis in points, before the layout is known."""
    box = axis.axes.get_window_extent()
    pixels = box.width if axis.axis_name == "x" else box.height
    return float(_AXIS_SHARE * pixels * 72 / axis.figure.dpi)


def _label_size(axis: Any, low: float, high: float) -> float:
    """Return the space in points along an axis that the longest plain number between two values
    needs.
    """
    if axis.axis_name == "y":
        return 1.5 * _POINTS
    ends = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    # a digit is about 0.65 of the size of the letters wide; one more as a gap
    return 0.65 * _POINTS * (1 + max(len(f"{10.0**end:g}") for end in ends))
