"""Write the demonstration's mask and network as they ship, and say what that changes.

    python tests/benchmarks/ship_demonstration.py mask.safetensors network.safetensors recipes/samples

The relief becomes a grey picture of 12 bits that states the height of white and the pitch, the weights become half
floats.
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
        f"doe.depth: {depth * 1e6:.4f} um; levels change the relief by {float(wrong.abs().max()) * 1e9:.2f} nm at most"
    )


def network(file: Path, out: Path) -> None:
    """The weights in half precision."""
    with safe_open(file, framework="pt") as tensors:
        said = tensors.metadata()
    weights = load_file(file)
    half = {name: x.to(torch.float16) for name, x in weights.items()}
    worst = max(float((half[n].float() - x).norm() / x.norm().clamp_min(1e-30)) for n, x in weights.items())
    save_file(half, out / "demonstration_network.safetensors", said)
    print(f"{sum(x.numel() for x in half.values())} numbers; halving changes a tensor by {worst:.1e} at most")


if __name__ == "__main__":
    relief, weights, out = map(Path, sys.argv[1:])
    mask(relief, out)
    network(weights, out)
    for path in out.glob("demonstration_*"):
        print(f"{path.name}: {path.stat().st_size} bytes")
