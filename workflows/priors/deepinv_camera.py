"""A camera in the classes of deepinv: operator, noise and data fidelity. Importing this file
imports deepinv.
"""

from __future__ import annotations

from typing import Any

import torch
from deepinv.optim import DataFidelity
from deepinv.physics import LinearPhysics
from deepinv.physics.noise import NoiseModel
from torch import Tensor

from neusee.nodes.restore import FrameBlur, MeasuringSensor, colour


class SensorNoise(NoiseModel):  # type: ignore[misc]  # deepinv has no types
    """Noise of a sensor as a noise model of deepinv: photon noise, dark current, read noise, full
    well and converter.
    """

    def __init__(
        self, sensor: MeasuringSensor, pattern: Tensor, unit: float, rng: torch.Generator
    ) -> None:
        super().__init__(rng=rng)
        self.sensor, self.unit = sensor, unit
        self.register_buffer("pattern", pattern, persistent=False)

    def forward(self, input: Tensor, seed: int | None = None, **_: Any) -> Tensor:
        """Return one measurement of the expected electrons ``input``, without the known pattern, in
        units of ``unit``.
        """
        self.rng_manual_seed(seed)
        measured = self.sensor.measured(input * self.unit + self.pattern.to(input), self.rng)
        noisy: Tensor = (measured - self.pattern.to(input) - self.sensor.dark) / self.unit
        return noisy


class CameraPhysics(LinearPhysics):  # type: ignore[misc]
    """A camera as a linear physics of deepinv: it blurs and crops scenes, and sets clipped pixels
    to 0.

    Scenes (batch, channel, y, x) are larger than frames: the border beyond the frame is unknown
    too. `crop` returns the part of a scene that lies in the frame, and `colour` this part in linear
    sRGB. Scenes are in units of ``unit`` electrons. Frames are in units of ``frame_unit``, which is
    ``unit`` times the largest gain of the blur, so that the norm of `A` is at most 1; `electrons`
    returns a frame in electrons. Buffers: ``frame`` is the measured frame without the known
    pattern, 0 where it clipped; ``mask`` is 1 where a pixel is known and 0 where it clipped. A
    simulated frame ``y = physics(x)`` has clipped pixels of its own:
    ``physics.update(mask=physics.unclipped(y))``.
    """

    def __init__(
        self,
        blur: FrameBlur,
        sensor: MeasuringSensor,
        frame: Tensor,
        mask: Tensor,
        pattern: Tensor,
        unit: float,
        matrix: Tensor,
        seed: int = 0,
    ) -> None:
        rng, gain = torch.Generator(frame.device).manual_seed(seed), blur.gain()
        noise = SensorNoise(sensor, pattern, unit * gain, rng)
        super().__init__(
            img_size=(len(blur.transfer), *blur.scene), noise_model=noise, device=frame.device
        )
        self.sensor_of, self.unit, self.frame_unit = sensor, unit, unit * gain
        self.scene_size, self.frame_size = blur.scene, blur.frame
        self.register_buffer("transfer", torch.view_as_real(blur.transfer / gain), persistent=False)
        self.register_buffer("mask", mask, persistent=False)
        self.register_buffer("matrix", matrix, persistent=False)
        known_frame = mask * (frame - pattern - sensor.dark)[None] / self.frame_unit
        self.register_buffer("frame", known_frame, persistent=False)

    @property
    def blur(self) -> FrameBlur:
        """Return the blur, scaled to a largest gain of 1, without the mask of clipped pixels."""
        return FrameBlur(torch.view_as_complex(self.transfer), self.scene_size, self.frame_size)

    def A(self, x: Tensor, mask: Tensor | None = None, **_: Any) -> Tensor:
        """Return the expected frames of scenes; clipped pixels are 0."""
        self.update_parameters(mask=mask)
        frame: Tensor = self.mask.to(x) * self.blur.seen(x)
        return frame

    def A_adjoint(self, y: Tensor, mask: Tensor | None = None, **_: Any) -> Tensor:
        """Return the adjoint of `A`, applied to frames."""
        self.update_parameters(mask=mask)
        return self.blur.adjoint(self.mask.to(y) * y)

    def noise(self, x: Tensor, **kwargs: Any) -> Tensor:
        """Return measurements of expected frames; clipped pixels are 0."""
        noisy: Tensor = self.mask.to(x) * self.noise_model(x, **kwargs)
        return noisy

    def unclipped(self, y: Tensor) -> Tensor:
        """Return 1 for each pixel below the clip level, and 0 for all others."""
        return (self.electrons(y) < self.sensor_of.level).to(y)

    def electrons(self, y: Tensor) -> Tensor:
        """Return frames in electrons, including the known pattern and the dark electrons, without
        the offset.
        """
        electrons: Tensor = (
            y * self.frame_unit + self.noise_model.pattern.to(y) + self.sensor_of.dark
        )
        return electrons

    def even(self) -> Tensor:
        """Return a uniform scene with the mean of each channel of the frame, a good first
        iterate.
        """
        frame_of_ones = self.A(self.frame.new_ones(1, *self.img_size)).sum((-2, -1), keepdim=True)
        # clipped pixels are 0 in both sums
        channel_light = self.frame.sum((-2, -1), keepdim=True) / frame_of_ones.clamp_min(
            torch.finfo(frame_of_ones.dtype).tiny
        )
        even_scene: Tensor = channel_light.expand(1, *self.img_size).clone()
        return even_scene

    def crop(self, x: Tensor) -> Tensor:
        """Return the part of scenes inside the frame."""
        return self.blur.cropped(x)

    def colour(self, x: Tensor) -> Tensor:
        """Return the part of scenes inside the frame in linear sRGB, developed as in the recipe."""
        picture: Tensor = colour(self.crop(x) * self.unit, self.matrix)
        return picture

    def likelihood(self, floor: float = 0.0, scale: float | None = None) -> SensorLikelihood:
        """Return the negative log-likelihood of frames as a data fidelity; see
        `SensorLikelihood`.
        """
        return SensorLikelihood(self.sensor_of, self.frame_unit, floor, scale)


class SensorLikelihood(DataFidelity):  # type: ignore[misc]
    """The negative log-likelihood of a frame as a data fidelity; a clipped pixel only gives a lower
    bound of its light.

    A known pixel is normal with the variance of photons, read noise and rounding. A clipped pixel,
    where the mask of the physics is 0, contributes the logarithm of the upper tail beyond the clip
    level.

    Args:
        floor: expectations below this value, in the unit of the frame, have the variance of this
            value, so that steps of one size suit dark and bright pixels
        scale: factor of the negative log-likelihood; 1 gives nats; None gives the variance at the
            floor, so that a dark pixel counts as in `deepinv.optim.L2` and a step size of about 1
            suits
    """

    def __init__(
        self, sensor: MeasuringSensor, unit: float, floor: float = 0.0, scale: float | None = None
    ) -> None:
        super().__init__()
        self.sensor, self.unit, self.floor = sensor, unit, floor * unit
        variance_at_floor = float(sensor.variance(torch.zeros((), dtype=torch.float64), self.floor))
        self.scale = variance_at_floor / unit**2 if scale is None else scale

    def fn(self, x: Tensor, y: Tensor, physics: CameraPhysics, *_: Any, **__: Any) -> Tensor:
        """Return the scaled negative log-likelihood of each frame of a batch (batch,)."""
        return self.scale * self.sensor.surprise(
            *self._electrons(x, y, physics), self.floor
        ).flatten(1).sum(1)

    def grad(self, x: Tensor, y: Tensor, physics: CameraPhysics, *_: Any, **__: Any) -> Tensor:
        """Return the gradient of `fn` with respect to the scenes."""
        slope = self.sensor.surprise_slope(*self._electrons(x, y, physics), self.floor)
        return physics.blur.adjoint(self.scale * self.unit * slope)

    def _electrons(
        self, x: Tensor, y: Tensor, physics: CameraPhysics
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return expected electrons, measured electrons, and the mask of known pixels."""
        return physics.electrons(physics.blur.seen(x)), physics.electrons(y), physics.mask.to(y)
