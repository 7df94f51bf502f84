"""Whose module is it: one of neusee, whose nodes its own tests prove, or one of the user?"""

from __future__ import annotations

PROVEN = ("neusee.",)  #: packages whose nodes are not observed


def is_own(module: str) -> bool:
    """Return True for a module outside of neusee, whose nodes are proven by its own tests."""
    return not f"{module}.".startswith(PROVEN)
