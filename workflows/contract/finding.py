"""What one rule found about one node."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Finding:
    """The outcome of a rule, such as ``Finding("reference", False, "off by 3e-3, more than rtol = 1e-5")``."""

    rule: str
    ok: bool | None  #: None if the node leaves out what would be good to have
    text: str
