"""Import of the package colour-science that restores NumPy's print options, which it changes for
the whole process.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

__depends__ = ("unaffected:state",)  # print options affect no result


@functools.cache
def colour_science() -> Any:
    """Return the module ``colour``, and keep NumPy's print options as they are."""
    options_before = np.get_printoptions()
    import colour

    np.set_printoptions(**options_before)
    return colour
