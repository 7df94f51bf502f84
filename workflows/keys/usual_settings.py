"""Settings of a new process, from which `process_settings.settings` tells the differences; torch is not needed."""

from __future__ import annotations

#: settings that only code of a user reads
OWN_USUAL = {
    "floating-point errors": "told",
    "printed numbers": "as NumPy prints",
    "encoding of texts": "utf-8",
    "time zone": "UTC",
    "code at the start of Python": "none",
}
#: settings of a new process
USUAL = {
    "default dtype": "torch.float32",
    "default device": "cpu",
    "matmul precision": "highest",
    "TF32": "True",
    "autocast": "off",
    "numbers below 1e-308": "kept",
    "assert statements": "run",
    **OWN_USUAL,
}
