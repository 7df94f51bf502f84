"""The camera of a recipe as a physics of deepinv."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from neusee.nodes.restore import MeasuringSensor, frame_blur, measuring_sensor
from neusee.nodes.sensor import crop
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.recipe_graph import Recipe, unknown_step
from neusee.workflows.store.result_store import Store

if TYPE_CHECKING:
    from neusee.workflows.priors.deepinv_camera import CameraPhysics

_OPTICS = ("illuminant", "responses", "bands", "matrix")  #: steps common to all arms
#: steps of the sensor, one in each arm
_SENSOR = ("charge", "dark", "read", "well", "digital", "signal")


def as_physics(
    recipe: Recipe,
    *,
    arm: str = "mask",
    glare: Tensor | None = None,
    unit: float | None = None,
    dtype: torch.dtype = torch.float32,
    store: Store | None = None,
    device: str = "cpu",
) -> CameraPhysics:
    """Return the camera of a recipe as a linear physics of deepinv, with its sensor noise and its
    frame.

    The physics maps a scene in the channels of the sensor, as behind a perfect lens without losses,
    to the expected electrons on the sensor, by the PSF that a grey scene has. ``frame`` is the
    frame of the recipe, ``mask`` is 0 where a pixel of it clipped, and `CameraPhysics.likelihood` a
    data fidelity that counts a clipped pixel as one that is at least as bright as the clip level.

    Args:
        arm: ``mask`` or ``plain``
        glare: known electrons beside the scene, such as those of a laser, (channel, y, x), at least
            as large as the frame, cropped to its middle; it is taken away from the frame
        unit: the electrons of a value of 1 in the scene; None: the full well, so that a scene lies
            between 0 and 1, as denoisers expect. Frames are in units of ``frame_unit``, this number
            times the largest gain of the blur.
        dtype: of the operator and the frame
        store, device: of the run of the recipe

    Raises: ModuleNotFoundError without deepinv or one of the packages that deepinv imports;
            ValueError for a recipe without these steps or with a sensor that is not of this kind,
            and for a glare of another number of channels.
    """
    physics_class = _deepinv_camera()
    needed_steps = [*_OPTICS, *(f"{name}[{arm}]" for name in ("psf", "clipped", *_SENSOR))]
    for name in needed_steps:
        if name not in recipe.steps:
            raise ValueError(
                f"as_physics needs the step {name}: {unknown_step(name, recipe.steps)}"
            )
    sensor = measuring_sensor(*(recipe.steps[f"{name}[{arm}]"].params for name in _SENSOR))
    outputs = [*_OPTICS, f"psf[{arm}]", f"signal[{arm}]", f"clipped[{arm}]"]
    values = {
        name.partition("[")[0]: value
        for name, value in run(recipe, store, outputs, device=device).values.items()
    }
    return physics_class(
        *_parts(values, sensor, glare, dtype),
        sensor.well if unit is None else unit,
        values["matrix"],
    )


def _deepinv_camera() -> type[CameraPhysics]:
    """Import and return the class; raise ModuleNotFoundError with the command to install a missing
    package.
    """
    try:
        from neusee.workflows.priors.deepinv_camera import CameraPhysics
    except ModuleNotFoundError as error:
        if str(error.name).startswith("neusee"):
            raise
        text = (
            f'as_physics needs {error.name}, which is not installed: pip install "neusee[deepinv]"'
        )
        raise ModuleNotFoundError(text, name=error.name) from None
    return CameraPhysics


def _parts(
    values: Mapping[str, Any], sensor: MeasuringSensor, glare: Tensor | None, dtype: torch.dtype
) -> tuple[Any, MeasuringSensor, Tensor, Tensor, Tensor]:
    """Return the blur, the sensor, the frame in electrons, the mask of its unclipped pixels, and
    the known pattern.
    """
    frame, unclipped = values["signal"].to(dtype), (~values["clipped"]).to(dtype)
    size = (frame.shape[-2], frame.shape[-1])
    blur = frame_blur(
        values["psf"], values["illuminant"], values["responses"], values["bands"], size, dtype
    )
    if glare is not None and (glare.ndim != 3 or len(glare) != len(frame)):
        raise ValueError(
            f"glare {tuple(glare.shape)} must be (channel, y, x) with the {len(frame)} channels of"
            " the frame"
        )
    pattern = torch.zeros_like(frame) if glare is None else crop(glare.to(frame), shape=size)
    return blur, sensor, frame, unclipped, pattern
