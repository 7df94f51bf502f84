"""Photographs of noise that are the same in every process, whichever tests ran before.

Pillow draws its noise from the C library's generator, so that the picture depends on all that was
drawn before.
"""

import numpy as np
from PIL import Image


def noise_photograph(sigma=60.0, seed=0):
    """An RGB picture of 60 x 50 pixels, grey noise around the middle of the scale."""
    grey = 128.0 + sigma * np.random.default_rng(seed).standard_normal((50, 60))
    return Image.fromarray(np.clip(np.rint(grey), 0, 255).astype(np.uint8)).convert("RGB")
