"""The package colour-science, imported without what it changes: how NumPy prints every number of the process."""

import numpy as np

__depends__ = ("unaffected:state",)  # how numbers are printed decides no result

_before = np.get_printoptions()
import colour  # noqa: E402

np.set_printoptions(**_before)

__all__ = ["colour"]
