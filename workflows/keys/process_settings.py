"""Settings of a process that decide what any code computes: number types of torch, and the code of `neusee.workflows`.

The number of threads and deterministic algorithms change results only within rounding and do not count.
"""

from __future__ import annotations

import codecs
import functools
import hashlib
import locale
import sys
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from neusee.nodes.exact_convolution import tf32_setting
from neusee.workflows.keys.regular_file import bytes_of
from neusee.workflows.keys.usual_settings import OWN_USUAL, USUAL

_KINDS, _is_cast = ("cpu", "cuda"), torch.is_autocast_enabled
_HALF = float("0.5")
#: how NumPy prints numbers in a new process
_PRINTED = {"precision": 8, "threshold": 1000, "edgeitems": 3, "linewidth": 75, "suppress": False, "nanstr": "nan"} | {
    "infstr": "inf",
    "formatter": None,
    "sign": "-",
    "floatmode": "maxprec",
}
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


def own_settings(reads_time: bool) -> dict[str, str]:
    """Return the settings that code of a user may read, and neusee does not, where they are not the usual ones.

    With ``reads_time`` the code may read the time zone.
    """
    now = {"floating-point errors": _errors(), "printed numbers": _printing(), "encoding of texts": _encoding()}
    now["code at the start of Python"] = _code_at_start()
    if reads_time:
        now["time zone"] = _time_zone()
    return {name: value for name, value in now.items() if value != USUAL[name]}


def _errors() -> str:
    """Return which floating-point errors of NumPy end a calculation or call a function; warnings decide nothing."""
    kinds = [f"{name} {does}" for name, does in np.geterr().items() if does in ("raise", "call", "log")]
    return ", ".join(kinds) or OWN_USUAL["floating-point errors"]


def _printing() -> str:
    """Return how NumPy prints numbers, where it was told to.

    The option ``legacy`` does not count: colour-science sets it, and whether it is loaded decides no result.
    """
    now: Mapping[str, object] = {**np.get_printoptions()}
    other = [f"{name}={now[name]}" for name, value in _PRINTED.items() if now.get(name, value) != value]
    return ", ".join(other) or OWN_USUAL["printed numbers"]


def _encoding() -> str:
    """Return the encoding of a text file that is opened without one."""
    return codecs.lookup(locale.getpreferredencoding(False)).name


def _code_at_start() -> str:
    """Return a digest of the modules with which a user or a system changes Python when it starts."""
    files = [getattr(sys.modules.get(name), "__file__", None) for name in ("sitecustomize", "usercustomize")]
    texts = [bytes_of(file) for file in files if file is not None and Path(file).is_file()]
    if not texts:
        return OWN_USUAL["code at the start of Python"]
    return hashlib.blake2b(b"\0".join(texts), digest_size=4).hexdigest()


def _time_zone() -> str:
    """Return the names of the time zone and a digest of its offsets from UTC in each week from 1970 to 2040."""
    weeks = range(0, 2_208_988_800, 7 * 86_400)
    offsets = [time.localtime(week).tm_gmtoff for week in weeks]
    if not any(offsets):
        return OWN_USUAL["time zone"]
    return f"{'/'.join(time.tzname)} {hashlib.blake2b(repr(offsets).encode(), digest_size=4).hexdigest()}"


@functools.cache
def workflows_digest() -> str:
    """Return the digest of all source files of `neusee.workflows`, for a node that imports any of them."""
    folder = Path(__file__).parents[1]
    text = hashlib.blake2b(digest_size=16)
    for path in sorted(folder.rglob("*.py")):
        text.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return text.hexdigest()
