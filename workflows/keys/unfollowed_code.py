"""The error for code that rests on something that a cache key cannot cover."""


class UnfollowedCode(LookupError):
    """A node has no cache key; the message has file, line, reason and what to write."""
