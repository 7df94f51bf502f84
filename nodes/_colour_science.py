"""The package colour-science, imported without what it changes: how NumPy prints every number of
the process.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

__depends__ = ("unaffected:state",)  # how numbers are printed decides no result


@functools.cache
def colour_science() -> Any:
    """Return the module ``colour``."""
    options_before = np.get_printoptions()
    import colour

    np.set_printoptions(**options_before)
    return colour
