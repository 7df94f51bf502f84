"""Settings of a process that decide what any code computes: number types of torch, and the code of `neusee.workflows`.

The number of threads and deterministic algorithms change results only within rounding and do not count.
"""

from __future__ import annotations

import functools
import hashlib
import sys
from pathlib import Path

import torch

from neusee.nodes.exact_convolution import tf32_setting
from neusee.workflows.keys.usual_settings import USUAL

_KINDS, _is_cast = ("cpu", "cuda"), torch.is_autocast_enabled
_HALF = float("0.5")
_SMALLEST = sys.float_info.min  #: its half is 0 where a process flushes small numbers to 0

torch.get_default_device()  # imports what it needs now, because a process may lose the right to read files later


def settings() -> dict[str, str]:
    """Return the settings of torch and Python that differ from those of a new process."""
    now = {
        "default dtype": str(torch.get_default_dtype()),
        "default device": str(torch.get_default_device()),
        "matmul precision": torch.get_float32_matmul_precision(),
        "TF32": str(tf32_setting()),
        "autocast": ", ".join(f"{kind} {torch.get_autocast_dtype(kind)}" for kind in _KINDS if _is_cast(kind)) or "off",
        "numbers below 1e-308": "kept" if _SMALLEST * _HALF else "0",
        "assert statements": f"left out by -{'O' * sys.flags.optimize}" if sys.flags.optimize else "run",
    }
    return {name: value for name, value in now.items() if value != USUAL[name]}


@functools.cache
def workflows_digest() -> str:
    """Return the digest of all source files of `neusee.workflows`, for a node that imports any of them."""
    folder = Path(__file__).parents[1]
    text = hashlib.blake2b(digest_size=16)
    for path in sorted(folder.rglob("*.py")):
        text.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return text.hexdigest()
