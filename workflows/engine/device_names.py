"""Names of the devices of this machine that a run may use, such as ``cpu`` or ``cuda:0,cuda:1``."""

from __future__ import annotations

import torch


def check_devices(text: str) -> None:
    """Raise ValueError for a list of devices with the same device twice, or with one that cannot compute a recipe here.

    ``cpu:0,cpu:1`` are two lanes of one CPU, and so two devices.
    """
    found = dict[tuple[str, int], str]()
    for name in text.split(","):
        try:
            place = torch.empty(0, device=name).device
        except (RuntimeError, AssertionError) as error:
            raise ValueError(f"{name}: {_reason(str(error))}") from error
        if place.type == "meta":
            raise ValueError(f"{name}: a tensor there has a shape and no values: write cpu or cuda")
        lane = place.type, torch.device(name).index or place.index or 0
        if lane in found:
            again = name if name == found[lane] else f"{found[lane]} and {name} are one device"
            raise ValueError(
                f"{text}: names a device twice ({again}): name each device once; cpu:0,cpu:1 are two lanes"
            )
        found[lane] = name


def _reason(text: str) -> str:
    """Return why a device cannot compute here, from the error of torch, without the names of its operators."""
    if "aten::" in text:
        return "this build of PyTorch cannot compute there: write cpu, or cuda on a machine with a GPU of NVIDIA"
    return text.partition("\n")[0]
