"""What is known of a restored frame, in sentences with the numbers of the run: invented pixels, and the interval."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from neusee.nodes.values import Shading
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.report.figures.frame_and_interval import BRIGHT, half_width, unexplained
from neusee.workflows.report.figures.shading_field import NORMAL
from neusee.workflows.report.result_numbers import Value

_NEEDS = ("restored", "restored_spread", "raw[mask]", "clipped[mask]")
_FRAME = "sensor.frame"
_WIENER = ("restore.wiener", "restore.wiener_by_field")  #: filters of which the interval is
_MEASURED = "restore.spread_by_field"
_SHADING = "shading"


def said_of_frame(recipe: Recipe, keys: Mapping[str, str], value: Value) -> dict[str, str]:
    """Return what is known of a restored frame as the paragraph ``frame``; nothing for a run without a frame."""
    if not keys.keys() >= set(_NEEDS) or recipe.steps["raw[mask]"].node.path != _FRAME:
        return {}
    restored, spread, _, clipped = (value(step) for step in _NEEDS)
    if restored.shape != spread.shape:
        return {}
    invented = clipped.any(0)
    half = half_width(spread, recipe.steps["restored_spread"].params["draws"])
    name = recipe.steps["raw[mask]"].params["file"].name
    parts = [_invented(name, invented), _interval(half, invented), _doubtful(restored, half, invented)]
    if _SHADING in recipe.steps and _SHADING in keys:
        parts.append(_shading(value(_SHADING)))
    parts.append(_limits(recipe))
    return {"frame": " ".join(part for part in parts if part)}


def _invented(name: str, invented: Tensor) -> str:
    count, share = int(invented.sum()), float(invented.double().mean())
    if not count:
        return f"No pixel of {name} is saturated, so that nothing in the restored picture is invented."
    are = "pixel is" if count == 1 else "pixels are"
    return (
        f"In {name} {count:,} {are} saturated in at least one channel, {share:.2%} of the picture: what stands there "
        "is invented from the surroundings and the prior of the filter (orange in the figure, white in "
        "data/invented.png)."
    )


def _interval(half: Tensor, invented: Tensor) -> str:
    if bool(invented.all()):
        return ""
    widths = half.mean(0)[~invented].flatten()
    widths = widths[:: max(1, len(widths) // 1_000_000)].double()
    middle, most = (float(torch.quantile(widths, q)) for q in (0.5, 0.95))
    return (
        f"Elsewhere a restored pixel is known to ±{middle:.2g} of white in half of the pixels and to ±{most:.2g} in "
        "95 % of them, with a probability of 90 % under the model of the interval."
    )


def _doubtful(restored: Tensor, half: Tensor, invented: Tensor) -> str:
    """Return a sentence on the pixels that no scene can explain, if there are more than chance makes."""
    wrong = unexplained(restored, half, invented)
    count = int(wrong.sum())
    if float(wrong.double().mean()) < 1e-3 and count < 20:
        return ""
    return (
        f"{count:,} other pixels are restored darker than black or brighter than {BRIGHT:g} times white, by more than "
        "this interval (red in the figure): no scene explains them, and the model does not hold there. Either "
        "light of a laser or a lamp was taken for scene, or white is set too low (frame.white). Do not trust them or "
        "their surroundings; restore=search finds lasers and removes them."
    )


def _shading(found: Shading) -> str:
    """Return what the frames tell of dirt, as a smooth transmission."""
    count = int(found.frames)
    frames = "one frame tells" if count == 1 else f"{count} frames tell"
    told = f"{frames} {float(found.told):.0%} of the variance of the shading"
    width = f"±{NORMAL * float(found.deviation.median()):.2g}"
    if not bool(found.identifiable):
        return (
            f"Dirt is not identifiable: {told}, and the probability that there is none is {float(found.clean):.0%}. "
            "At least 8 different scenes, half of the variance and at most 5% are needed. "
            f"The frame is left as it is. The logarithm of a transmission stays unknown to {width} in half of the "
            "field; the interval of the picture includes this."
        )
    low, high = (float(end) for end in found.transmission.aminmax())
    return (
        f"The frame was divided by a transmission of {low:.2f} to {high:.2f} relative to its geometric mean, whose "
        f"logarithm is known to {width} in half of the field: {told}. What all scenes have in common cannot be told "
        "from dirt, nor a constant factor. Light that dirt scatters into the picture is not removed."
    )


def _limits(recipe: Recipe) -> str:
    step = recipe.steps.get("deconvolved")
    own = step is not None and step.node.path in _WIENER and "deconvolved" in recipe.steps["restored"].sources
    whose = "" if own else "The interval is that of a Wiener filter, not of the method that restored this picture. "
    measured = recipe.steps["restored_spread"].node.path == _MEASURED
    known = "blur, the error of the measured PSF" if measured else "blur"
    return (
        f"{whose}The interval includes noise, {known} and saturation. It does not include lasers that the filter is "
        "not told of, errors of the camera's description, and colours that no three channels tell apart."
    )
