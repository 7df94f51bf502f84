"""Style of all figures: colours for colour-blind readers, light background, text of at least 9 points, PNG format."""

from __future__ import annotations

import functools
import io
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Literal, ParamSpec

import torch
from torch import Tensor

P = ParamSpec("P")

#: Colours of the palette of Okabe and Ito, which people with any common kind of colour vision can tell apart.
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
    """Return a new matplotlib figure of ``width`` by ``height`` inches, and the array of its axes."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=120, layout=layout)
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def drawn(draw: Callable[P, Any]) -> Callable[P, bytes]:
    """Decorate a drawing function, so that the function uses the common style and returns the bytes of a PNG file."""

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
    out, engine = io.BytesIO(), figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
    drawn_part = figure.get_tightbbox(figure.canvas.get_renderer()).padded(_MARGIN)
    figure.set_layout_engine(None)
    more = {"metadata": {"Software": "neusee"}, "pil_kwargs": {"compress_level": _COMPRESSION}}
    figure.savefig(out, format="png", bbox_inches=drawn_part, **more)
    return out.getvalue()


def warm() -> None:
    """Import what figures need and find the font, so that the first picture takes no longer than others."""
    with styled():
        figure, axes = canvas(1.0, 1.0)
        axes[0, 0].set_title("a")
        png_of(figure)


def picture(axes: Any, image: Any, title: str, **options: Any) -> Any:
    """Show an image without axis ticks; pass ``options``, such as the colour scale, to ``imshow``."""
    shown = axes.imshow(image, **options)
    axes.set(title=title, xticks=[], yticks=[])
    axes.grid(False)
    for spine in axes.spines.values():
        spine.set_visible(False)
    return shown


def encoded(linear: Tensor) -> Any:
    """Return linear sRGB (3, y, x) as gamma-encoded values (y, x, 3), clipped to [0, 1]; NaN becomes 0."""
    from kornia.color import linear_rgb_to_rgb

    rgb = torch.nan_to_num(linear.detach().to("cpu", torch.float32)).clamp(0.0, 1.0)
    return linear_rgb_to_rgb(rgb[None])[0].permute(1, 2, 0).clamp(0.0, 1.0).numpy()


def nanometres(metres: Tensor) -> Any:
    """Convert a tensor of wavelengths in metres to a NumPy array in nanometres."""
    return metres.detach().double().cpu().numpy() * 1e9


def nearest(centres: Tensor, metres: float) -> tuple[int, str]:
    """Return the index of the spectral band nearest to a wavelength, and its centre as text, such as ``550 nm``."""
    band = int((centres - metres).abs().argmin())
    return band, f"{float(centres[band]) * 1e9:.0f} nm"
