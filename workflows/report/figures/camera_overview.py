"""Camera overview: the scene, its pictures without and with mask, and the restored picture with its error."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from neusee.workflows.report.figures.style import ORANGE, canvas, drawn, encoded, picture


@drawn
def overview(
    *,
    truth: Tensor,
    plain: Tensor,
    mask: Tensor,
    restored: Tensor | None = None,
    spots: Mapping[str, Tensor] | None = None,
) -> Any:
    """Draw the scene, its pictures without and with mask, and the restored picture with its error if it is given."""
    white = high(truth)
    pictures = {"truth": truth, "plain lens": plain, "with mask": mask}
    pictures |= {} if restored is None else {"restored": restored}
    count = len(pictures) + (restored is not None)
    figure, axes = canvas(2.6 * count, 3.4, 1, count)
    for ax, (name, image) in zip(axes[0], pictures.items(), strict=False):
        picture(ax, encoded(centre(image, truth) / white), name)
        _ring(ax, spots or {}, truth)
    if restored is not None:
        _error(figure, axes[0, -1], (centre(restored, truth) - truth).abs().mean(0) / white)
        _ring(axes[0, -1], spots or {}, truth)
    return figure


def _error(figure: Any, ax: Any, error: Tensor) -> None:
    shown = picture(ax, error.cpu().numpy(), "|restored − truth|", cmap="viridis", vmin=0.0, vmax=high(error))
    bar = figure.colorbar(shown, ax=ax, fraction=0.046, pad=0.03, extend="max")
    bar.set_label("fraction of white", fontsize=9)
    bar.ax.tick_params(labelsize=9)


def high(values: Tensor) -> float:
    """Return the 99.5 % quantile of the pixel values of an image as white level, but at least 1e-9."""
    sample = values.detach().flatten()[:: max(1, values.numel() // 200_000)].float()
    return max(float(torch.quantile(sample, 0.995)), 1e-9)


def centre(image: Tensor, like: Tensor) -> Tensor:
    """Crop the centre of an image to the size of the image ``like``; the optical axis stays at pixel N // 2."""
    top, left = (image.shape[d] // 2 - like.shape[d] // 2 for d in (-2, -1))
    if top < 0 or left < 0:
        raise ValueError(f"a picture of shape {tuple(image.shape)} is smaller than the scene, {tuple(like.shape)}")
    return image[..., top : top + like.shape[-2], left : left + like.shape[-1]].float()


def _ring(ax: Any, spots: Mapping[str, Tensor], like: Tensor) -> None:
    """Draw a ring around the brightest pixel of each laser, unless this pixel is on the rim: that laser is outside."""
    from matplotlib.patches import Circle

    radius = max(like.shape[-1] / 14, 3.0)
    images = [centre(spot, like) for spot in spots.values()]
    for y, x in {divmod(int(image.sum(0).argmax()), image.shape[-1]) for image in images}:
        if not (0 < y < like.shape[-2] - 1 and 0 < x < like.shape[-1] - 1):
            continue
        for width, colour in ((3.0, "black"), (1.4, ORANGE)):
            ax.add_patch(Circle((x, y), radius, fill=False, color=colour, linewidth=width))
