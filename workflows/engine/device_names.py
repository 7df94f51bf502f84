"""Names of the devices of this machine that a run may use, such as ``cpu`` or ``cuda:0,cuda:1``."""

from __future__ import annotations

import torch


def check_devices(text: str) -> None:
    """Raise ValueError for a list of devices that names a device twice, or a device that this machine does not have."""
    names = text.split(",")
    if len(set(names)) < len(names):
        raise ValueError(f"{text}: names a device twice; name each device once")
    for name in names:
        try:
            torch.empty(0, device=name)
        except (RuntimeError, AssertionError) as error:
            raise ValueError(f"{name}: {str(error).partition(chr(10))[0]}") from error
