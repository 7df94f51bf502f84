"""Write the designed mask and the trained network as they ship, and say what that changes.

    python tests/benchmarks/ship_samples.py mask mask.safetensors recipes/samples
    python tests/benchmarks/ship_samples.py network best.safetensors later/best.safetensors
    recipes/samples

The relief becomes a grey picture of 12 bits that states the height of white and the pitch. The
weights become half floats, of several files their mean.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from safetensors import safe_open
from safetensors.torch import load_file, save_file

LEVELS = 4096
PITCH = "14.96 um"  #: of `optics: small`
STEP = 16  #: of the 65 536 greys, between two levels


def mask(file: Path, out: Path) -> None:
    """The relief, counted up from 0, in levels."""
    height = load_file(file)["height"].double()
    height = height - height.min()
    depth = float(height.max()) * (65535 / ((LEVELS - 1) * STEP))  # the depth that white stands for
    levels = (height / float(height.max()) * (LEVELS - 1)).round().numpy().astype(np.uint16) * STEP
    stated = PngInfo()
    stated.add_text("depth", f"{depth * 1e6:.4f} um")
    stated.add_text("pitch", PITCH)
    Image.fromarray(levels).save(out / "demonstration_mask.png", optimize=True, pnginfo=stated)
    wrong = torch.from_numpy(levels.astype(np.float64)) * depth / 65535 - height
    print(
        f"doe.depth: {depth * 1e6:.4f} um; levels change the relief by"
        f" {float(wrong.abs().max()) * 1e9:.2f} nm at most"
    )


def network(files: list[Path], out: Path) -> None:
    """The mean of the weights in half precision."""
    with safe_open(files[0], framework="pt") as tensors:
        said = tensors.metadata()
    each = [load_file(file) for file in files]
    weights = {name: torch.stack([one[name] for one in each]).mean(0) for name in each[0]}
    half = {name: x.to(torch.float16) for name, x in weights.items()}
    worst = max(
        float((half[n].float() - x).norm() / x.norm().clamp_min(1e-30)) for n, x in weights.items()
    )
    save_file(half, out / "neusee_network.safetensors", said)
    print(
        f"{sum(x.numel() for x in half.values())} numbers; halving changes a tensor by {worst:.1e}"
        " at most"
    )


if __name__ == "__main__":
    what, (*given, to) = sys.argv[1], map(Path, sys.argv[2:])
    mask(*given, to) if what == "mask" else network(given, to)
    for path in to.glob("*.png" if what == "mask" else "*.safetensors"):
        print(f"{path.name}: {path.stat().st_size} bytes")
