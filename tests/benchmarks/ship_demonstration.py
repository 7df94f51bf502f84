"""Write the demonstration's mask and the network of `restore: neusee` as they ship, and say what that changes.

    python tests/benchmarks/ship_demonstration.py --mask mask.safetensors --network best.safetensors recipes/samples

The relief becomes a grey picture of 12 bits that states the height of white and the pitch, the weights become half
floats.
"""

from __future__ import annotations

import argparse
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
    save_file(half, out / "neusee_network.safetensors", said)
    print(f"{sum(x.numel() for x in half.values())} numbers; halving changes a tensor by {worst:.1e} at most")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--mask", type=Path)
    parser.add_argument("--network", type=Path)
    given = parser.parse_args()
    if given.mask:
        mask(given.mask, given.out)
    if given.network:
        network(given.network, given.out)
    for path in (given.out / "demonstration_mask.png", given.out / "neusee_network.safetensors"):
        print(f"{path.name}: {path.stat().st_size} bytes")
