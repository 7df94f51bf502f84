"""Variables of the environment that decide no result, or that keys count by what they do.

Nothing here imports anything: a process with other surroundings asks for them before it starts.
"""

from __future__ import annotations

_COUNTED = ("OMP", "MKL", "OPENBLAS", "NUMEXPR")
_OF_LOCALE = ("ALL", "CTYPE", "NUMERIC", "TIME", "COLLATE", "MESSAGES", "MONETARY")
OF_THREADS = (*(f"{name}_NUM_THREADS" for name in _COUNTED), "VECLIB_MAXIMUM_THREADS")
OF_LANGUAGES = ("LANG", "LANGUAGE", *(f"LC_{name}" for name in _OF_LOCALE))
_WHO = ("HOME", "USER", "LOGNAME", "USERNAME")
_PLACES = ("PATH", "VIRTUAL_ENV", "TMPDIR", "TZ", "TZDIR", "LOCPATH")
_FEW = frozenset({*_PLACES, *OF_THREADS, *OF_LANGUAGES, *_WHO})
_OF_PROGRAMS = (
    "LD_",
    "DYLD_",
    "PYTHON",
    "CONDA",
    "XDG_",
    "NEUSEE_",
    "GLIBC_",
    "MALLOC_",
    "TORCH",
    "PYTORCH",
)
_OF_DEVICES = ("CUDA", "NVIDIA", "HIP", "ROCM", "OMP_", "GOMP_", "KMP_", "MKL_", "OPENBLAS_")
#: of terminals and windows, for which many libraries ask
_TERMINALS = ("COLUMNS", "LINES", "TERM", "COLORTERM", "NO_COLOR", "FORCE_COLOR", "CI", "PWD")
OF_WINDOWS = frozenset({*_TERMINALS, "DISPLAY", "WAYLAND_DISPLAY", "MPLBACKEND"})


def is_known(name: str) -> bool:
    """Return True for a variable that decides no result, or that keys count."""
    return name in _FEW or name.startswith((*_OF_PROGRAMS, *_OF_DEVICES))
