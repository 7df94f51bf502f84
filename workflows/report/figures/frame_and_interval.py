"""A frame that somebody took, the restored picture, and what is not known of each of its pixels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from torch import Tensor

from neusee.workflows.report.figures.style import ORANGE, VERMILION, canvas, drawn, encoded, picture

BRIGHT = 1.5  #: times white, which nothing that is lit by the light of the scene exceeds by much
_LEVEL = 0.95  #: of the quantile of Student's t that ends an interval of 90 %
_EACH = 4  #: degrees of freedom of a draw, whose errors are averaged over 7 x 7 pixels and alike in a few of them


def half_width(spread: Tensor, draws: int) -> Tensor:
    """Return half the width of the 90 % interval, from the standard deviation that was estimated from ``draws``."""
    from scipy.stats import t

    return spread * float(t.ppf(_LEVEL, _EACH * draws))


def unexplained(restored: Tensor, half: Tensor, invented: Tensor) -> Tensor:
    """Return True for pixels (y, x) that no scene explains: darker than black or brighter than `BRIGHT` white.

    The half width of the interval is allowed for, and saturated pixels do not count.
    """
    outside = (restored < -half) | (restored > BRIGHT + half)
    return outside.any(0) & ~invented


@drawn
def restored_frame(*, frame: Tensor, restored: Tensor, spread: Tensor, clipped: Tensor, draws: int) -> Any:
    """Draw a frame, the restored picture, and half the width of the 90 % interval, with marked pixels in colour."""
    figure, axes = canvas(11.0, 4.1, 1, 3)
    picture(axes[0, 0], encoded(frame), "frame")
    picture(axes[0, 1], encoded(restored), "restored")
    wide, saturated = half_width(spread, draws), clipped.any(0)
    half, invented = wide.mean(0).cpu().numpy(), saturated.cpu().numpy()
    top = float(np.quantile(half[~invented], 0.995)) if not invented.all() else float(half.max())
    shown = picture(axes[0, 2], half, "90 % interval, ±", cmap="viridis", vmin=0.0, vmax=max(top, 1e-9))
    bar = figure.colorbar(shown, ax=axes[0, 2], fraction=0.046, pad=0.03, extend="max")
    bar.set_label("fraction of white", fontsize=9)
    bar.ax.tick_params(labelsize=9)
    strange = unexplained(restored, wide, saturated).cpu().numpy()
    _mark(axes[0, 2], {"saturated: invented": (invented, ORANGE), "no scene explains": (strange, VERMILION)})
    return figure


def _mark(ax: Any, kinds: Mapping[str, tuple[Any, str]]) -> None:
    """Colour pixels by kind, and name the kinds that there are, with their share, below the picture."""
    from matplotlib.colors import to_rgba
    from matplotlib.patches import Patch

    handles = []
    for name, (where, colour) in kinds.items():
        if not where.any():
            continue
        over = np.zeros((*where.shape, 4))
        over[where] = to_rgba(colour)
        ax.imshow(over)
        handles.append(Patch(facecolor=colour, label=f"{name} ({where.mean():.2%})"))
    if handles:
        ax.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.02), fontsize=9)
