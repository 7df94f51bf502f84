"""A quantity of the EMVA 1288 sheet: a value, a limit, or the reason why there is neither."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

Bound = Literal["", "<", ">"]
_WHOLE = (1e3, 1e7)  #: values that are shown as whole numbers


@dataclass(frozen=True)
class Quantity:
    """A quantity of a sheet by the name, symbol and unit of EMVA 1288; ``value`` is None if the frames do not tell it.

    With a ``bound`` the frames give a limit only: the quantity is below (``<``) or above (``>``) the value. Without a
    value, or with a bound, ``reason`` says why.
    """

    key: str
    symbol: str
    name: str
    unit: str = ""
    value: float | None = None
    bound: Bound = ""
    reason: str = ""

    @property
    def text(self) -> str:
        """Value and unit with four digits or as a whole number, such as ``< 1.4 e-``, or ``not measured``."""
        if self.value is None:
            return "not measured"
        number = f"{self.value:.0f}" if _WHOLE[0] <= abs(self.value) < _WHOLE[1] else f"{self.value:.4g}"
        return f"{self.bound} {number} {self.unit}".strip()

    def told(self, value: float, bound: Bound = "", reason: str = "") -> Quantity:
        """Return the quantity with a value; a value that is not finite counts as none, and needs a reason."""
        if not math.isfinite(value):
            return self.untold(reason or "no finite value follows from these frames")
        return replace(self, value=float(value), bound=bound, reason=reason)

    def untold(self, reason: str) -> Quantity:
        """Return the quantity without a value, and why."""
        return replace(self, value=None, bound="", reason=reason)
