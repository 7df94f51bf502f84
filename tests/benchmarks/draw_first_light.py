"""Draws the picture of the README from a real run: ``python
tests/benchmarks/draw_first_light.py``.
"""

import inspect
from pathlib import Path

import torch

import neusee
from neusee.nodes.sensor import saturation
from neusee.workflows import load

PICTURE = Path(__file__).parents[2] / "recipes" / "guide" / "first_light.png"
WANTED = "developed, restored, image, bands, level, spot, line, developed_quality, restored_quality"
COLOURS = 200  #: of the palette, so that the picture stays below 100 kB
ARMS = {"plain": ("plain lens", "#d55e00"), "mask": ("behind the mask", "#0072b2")}
CURVE = (
    "irradiance, in units of saturation",
    "pixels from the laser\n(brightest pixel of each column)",
)


def irradiance(result, step, arm):
    """Return the irradiance on the sensor, scene and laser, as a multiple of what saturates a
    pixel.
    """
    sensor = {
        name: step.params[name]
        for name in inspect.signature(saturation).parameters
        if name != "bands"
    }
    scene = saturation(result["bands"], **sensor) / result["level"]
    laser = saturation(result["line[green]"], **sensor)
    lit = (result[f"image[{arm}]"], scene), (result[f"spot[{arm},green]"], laser)
    return sum((light / full[:, None, None]).sum(0) for light, full in lit)


def show(axis, picture, title, *below):
    """Show a linear picture (3, y, x) with what is to be said of it."""
    from kornia.color import linear_rgb_to_rgb

    axis.imshow(linear_rgb_to_rgb(picture.clamp(0, 1)).permute(1, 2, 0).numpy())
    axis.set(xticks=[], yticks=[])
    axis.set_title(title, fontsize=11)
    axis.set_xlabel("\n".join(below), fontsize=9)


def compare(axis, total, centre):
    """Draw the irradiance of both arms across the laser."""
    for arm, (name, colour) in ARMS.items():
        peak = float(total[arm].max())
        axis.semilogy(
            torch.arange(total[arm].shape[-1]) - centre, total[arm].amax(0), color=colour, lw=1.2
        )
        axis.axhline(peak, color=colour, lw=0.8, ls=":")
        axis.text(-255, peak * 1.15, f"{name}: {peak:.3g}", color=colour, fontsize=8)
    axis.set(xlim=(-260, 260), ylim=(1, 3000))
    axis.set_title(CURVE[0], fontsize=11)
    axis.set_xlabel(CURVE[1], fontsize=9)
    axis.tick_params(labelsize=8)


def draw(result, step):
    """Draw three pictures and the irradiance across the laser."""
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(
        1, 4, figsize=(10.4, 3.05), dpi=100, layout="constrained", width_ratios=[1, 1, 1, 1.25]
    )
    total = {arm: irradiance(result, step, arm) for arm in ARMS}
    for axis, (arm, (name, _)) in zip(axes, ARMS.items(), strict=False):
        psnr = float(result[f"developed_quality[{arm}]"].psnr)
        peak = f"peak {float(total[arm].max()):.3g} × saturation"
        show(axis, result[f"developed[{arm}]"], name, peak, f"PSNR {psnr:.1f} dB")
    last = f"PSNR {float(result['restored_quality'].psnr):.1f} dB"
    show(axes[2], result["restored"], "restored", "from the picture behind the mask", last)
    compare(axes[3], total, int(total["plain"].argmax()) % total["plain"].shape[-1])
    return figure


def main():
    """Run the default recipe, and write the picture with a palette of few colours, dithered."""
    from PIL import Image

    recipe = load("first_light", [f"outputs=[{WANTED}]"])
    draw(neusee.run(recipe), recipe.steps["peak[plain]"]).savefig(PICTURE)
    with Image.open(PICTURE) as drawn:
        picture = drawn.convert("RGB")
    palette = picture.quantize(COLOURS, method=Image.Quantize.FASTOCTREE, kmeans=2)
    picture.quantize(palette=palette).save(PICTURE, optimize=True)
    print(PICTURE, PICTURE.stat().st_size)


if __name__ == "__main__":
    main()
