"""Table of renamed recipe keys, nodes and parameters, with which messages give the new name for an old one."""

from __future__ import annotations

from collections.abc import Iterable

_CALLED = {
    "element": "mask",
    "steps.element": "steps.fabricated",
    "train.rates.element": "train.rates.mask",
    "train.mask.kind=element": "recipe_mask",
    "train_lift.least": "train_lift.min_rate",
    "train_lift.warm": "train_lift.warmup",
    "train_lift.average": "train_lift.ema_decay",
    "train_lift.judge": "train_lift.validation_batches",
    "sensor.pedestal": "sensor.offset",
    "reading.pedestal_subtracted": "reading.offset_subtracted",
    "camera.dark_noise": "camera.temporal_dark_noise",
    "sensor.gather": "sensor.add_photons",
    "metrics.peak": "metrics.peak_irradiance",
    "optics.spot": "optics.laser_irradiance",
    "losses.bsr": "losses.background_loss",
    "losses.lsr": "losses.suppression_loss",
    "sensor.read_noise.pedestal": "offset",
    "sensor.read_noise.sigma": "read_noise",
    "sensor.photon_transfer.pedestal": "offset",
    "sensor.photon_transfer.sigma": "read_noise",
    "calibrate.expose.pedestal": "offset",
    "calibrate.expose.sigma": "read_noise",
    "calibrate.density.pedestal": "offset",
    "calibrate.prior.pedestal": "offset",
    "calibrate.camera.dark_noise": "temporal_dark_noise",
    "calibrate.camera_prior.dark_noise": "temporal_dark_noise",
    "restore.electrons.pedestal": "offset",
    "restore.electrons.pedestal_subtracted": "offset_subtracted",
}  #: old name -> new name, of a key by path, of a node by name, of a parameter by node and name

_UNIT = "a gain has its own unit: write {}.gain: 0.37 e-/DN, or 2.7 DN/e-"
_GRID = ("samples", "pitch", "diameter", "aperture")
_ON_A_GRID = (
    *(f"doe.{mask}" for mask in ("flat", "vortex", "axicon", "spiral_axicon", "cubic", "half_rings", "zernike")),
    *("doe.pixelwise", "doe.unet", "doe.smooth", "flare.dirt", "optics.pupil"),
)  #: nodes that had parameters of the pupil grid in version 0.1
_STOP = (
    "is set by the step of the pupil grid: write stop: {node: optics.stop, with: {samples: …, pitch: …, diameter: …, "
    "aperture: …}}, add stop: stop to `from` here, and remove these parameters here"
)
_GONE = {
    **{f"{node}.{name}": _STOP for node in _ON_A_GRID for name in _GRID},
    "optics.start": "is called optics.shortest now",
    "optics.stop": "is called optics.longest now: a stop is that of the lens",  # also a node, so not in `_CALLED`
    "reading.gain_unit": _UNIT.format("sensor"),
    "camera.gain_unit": _UNIT.format("camera"),
    **dict.fromkeys(
        (
            "sensor.digitize.gain_unit",
            "sensor.photon_transfer.gain_unit",
            "metrics.saturated.gain_unit",
            "restore.electrons.gain_unit",
            "restore.clipped.gain_unit",
            "calibrate.expose.gain_unit",
            "calibrate.density.gain_unit",
            "calibrate.camera.gain_unit",
        ),
        "a gain has its own unit: write gain: 0.37 e-/DN, or 2.7 DN/e-, and remove this parameter",
    ),
}  #: what to write instead of a key or a parameter that was removed

#: present names of the parameters in a posterior of version 0.1
POSTERIOR_NAMES = {"pedestal": "offset", "dark_noise": "temporal_dark_noise"}


def new_name(old: str) -> str | None:
    """Return the present name of an old recipe path, or None for a path that was never renamed."""
    parts = old.split(".")
    for n in range(len(parts), 0, -1):
        if now := _CALLED.get(".".join(parts[:n])):
            return ".".join([now, *parts[n:]])
    return None


def instead(old: str) -> str:
    """Return a message that says what to write instead of an old recipe path, or an empty text for any other path."""
    if now := new_name(old):
        return f"is called {now} now"
    return _GONE.get(old, "")


def became_input(node: str, parameters: Iterable[str]) -> bool:
    """Return True if a node's ``parameters`` contain those of the pupil grid, which is now an input of the node."""
    return node in _ON_A_GRID and not set(_GRID).isdisjoint(parameters)


def old_names() -> tuple[str, ...]:
    """Return the old names of all renamed or removed recipe keys, nodes and parameters."""
    return (*_CALLED, *_GONE)
