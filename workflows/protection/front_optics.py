"""Fronts, which are a lens with or without the mask in a stop of some diameter, and what is measured of each once.

A grey filter needs no front of its own: it scales the light of scene and laser.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neusee.nodes import metrics
from neusee.nodes.metrics import (
    TARGETS,
    GlareLevels,
    PictureSpectrum,
    detail_energy,
    glare_levels,
    picture_spectrum,
    radial_contrast,
)
from neusee.nodes.values import Bands, Psf
from neusee.workflows.keys.cache_key import digest, plain
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.keys.input_file_digest import file_digest
from neusee.workflows.protection.camera_parts import ProtectionCamera
from neusee.workflows.protection.unknown_conditions import Condition
from neusee.workflows.store.memo import compute_once
from neusee.workflows.store.result_store import Store

_ABOUT = {"step": "study protection"}
_SOURCES = (picture_spectrum, detail_energy, glare_levels)


@dataclass(frozen=True)
class Front:
    """A lens with or without the mask, in a stop of a relative diameter, or with a notch filter."""

    masked: bool
    diameter: float = 1.0
    notch: float | None = None  #: m, centre of a notch filter
    depth: float = 0.0  #: of the notch

    @property
    def notches(self) -> dict[str, Any]:
        """Return the parameters of `doe.shade` for the notch filter, if there is one."""
        return {} if self.notch is None else {"notches": (self.notch,), "depth": self.depth}


@dataclass(frozen=True)
class FrontMeasures:
    """What is measured of one front under one condition."""

    spectrum: PictureSpectrum
    energy: Mapping[str, Tensor]  #: by target (channel,)
    peak: float  #: laser suppression ratio at the worst of all bands of the recipe
    heat: float  #: heat of the hottest pixel relative to the clear lens, at the worst of them; NaN if not asked for
    radius: Tensor  #: (ring,) cycles per pixel
    square: Tensor  #: (ring,) mean of |OTF|**2
    glare: Mapping[int, GlareLevels]  #: by the side of the field in pixels
    colour: Tensor  #: (channel,) response to the laser


@dataclass(frozen=True)
class FrontSettings:
    """The settings of the protection study that determine what is measured of a front."""

    variance: float  #: of the contrast of the scene
    up_to: float  #: cycles per pixel, of the mean log NEQ
    size: float  #: height of the targets in pixels
    fields: tuple[int, ...]  #: sides of the field in pixels
    dwell: float | None  #: s; None: the peak alone counts


class FrontBench:
    """Measures fronts of one camera, each only once, because the store keeps the result."""

    def __init__(self, camera: ProtectionCamera, store: Store, settings: FrontSettings) -> None:
        self.camera, self.store, self.settings = camera, store, settings
        self._psfs: dict[Front, Psf] = {}
        self._harms: dict[Front, dict[str, Tensor]] = {}
        code = Code(store.code_memo)
        files = [file_digest(Path(inspect.getfile(one))) for one in _SOURCES]
        files += [file_digest(Path(__file__)), file_digest(Path(inspect.getfile(ProtectionCamera)))]
        steps = [camera.recipe.steps[name] for name in ("psf[mask]", "pupil[mask]", "index", "responses")
                 if name in camera.recipe.steps]  # fmt: skip
        params = [{name: plain(value) for name, value in step.params.items()} for step in steps]
        self._key = [camera.keys, [code.of(node) for node in camera.nodes], files, params,
                     camera.bands.centres.tolist(), camera.laser_bands.centres.tolist(),
                     repr(settings)]  # fmt: skip

    def measure(self, front: Front, condition: Condition) -> FrontMeasures:
        """Return what is measured of a front under a condition, from the store if it is there."""
        key = digest("protection front", self._key, repr(front), condition.plain)
        found = compute_once(self.store, key, dict, lambda: self._measure(front, condition), _ABOUT)
        return _measures(found)

    def _measure(self, front: Front, condition: Condition) -> dict[str, Tensor]:
        camera, s = self.camera, self.settings
        light = camera.illuminant, camera.responses, camera.bands
        known, true = self._known(front), self._psf(front, camera.bands, condition)
        spectrum = picture_spectrum(true, known, *light, s.variance, s.up_to)
        radius, square = radial_contrast(true, *light)
        found: dict[str, Tensor] = {f"spectrum.{name}": x for name, x in spectrum._asdict().items()}
        found |= {f"energy.{name}": x for name, x in detail_energy(true, *light, s.size).items()}
        found |= {"radius": radius, "square": square, **self._harm(front)}
        return found | self._glare(front, condition)

    def _harm(self, front: Front) -> dict[str, Tensor]:
        """Return peak and heat at the worst of all bands of the recipe; they are computed once.

        A mask may pass a laser in a narrow band that lies between the few bands of the scene.
        """
        if front not in self._harms:
            bands = self.camera.laser_bands
            columns = (torch.split(values, 1) for values in bands)
            single = (Bands(*values) for values in zip(*columns, strict=True))
            peaks, heats = zip(*(self._harm_in(front, band) for band in single), strict=True)
            self._harms[front] = {"peak": torch.stack(peaks).max(), "heat": torch.stack(heats).max()}
        return self._harms[front]

    def _harm_in(self, front: Front, band: Bands) -> tuple[Tensor, Tensor]:
        """Return peak and heat in one band, both relative to the clear lens."""
        psf = self._psf(front, band, None)
        peak = metrics.lsr(psf).max()
        if self.settings.dwell is None:
            return peak, torch.tensor(torch.nan, dtype=torch.float64)
        clear = self._psf(Front(False), band, None)
        pitch = self.camera.lens["pixel_pitch"]
        return peak, metrics.heat_ratio(psf, clear, pixel_pitch=pitch, dwell=self.settings.dwell).max()

    def _known(self, front: Front) -> Psf:
        """Return the PSF that the filter knows, without the unknown conditions; it is computed once."""
        if front not in self._psfs:
            self._psfs[front] = self._psf(front, self.camera.bands, None)
        return self._psfs[front]

    def _psf(self, front: Front, bands: Bands, condition: Condition | None, **more: Any) -> Psf:
        return self.camera.psf(front.masked, front.diameter, bands, condition, **front.notches, **more)

    def _laser_psf(self, front: Front, line: Bands, condition: Condition, **more: Any) -> Psf:
        return self.camera.laser_psf(front.masked, front.diameter, line, condition, **front.notches, **more)

    def _glare(self, front: Front, condition: Condition) -> dict[str, Tensor]:
        """Return the levels of a laser's light over each field, with the light that the lens scatters.

        Wider fields are for a laser on the axis alone, and only as wide as the samples of the pupil carry.
        """
        camera = self.camera
        line = camera.laser_line(condition.wavelength)
        found = {"colour": camera.laser_colour(line)}
        reach = min(self.settings.fields)
        spot = (condition.direction[0] * reach, condition.direction[1] * reach)
        scale = camera.lens["pixel_pitch"] / camera.lens["focal_length"]
        for side in self.settings.fields if condition.direction == (0.0, 0.0) else (reach,):
            shape, angle = (side, side), (spot[0] * scale, spot[1] * scale)
            try:
                light = self._laser_psf(front, line, condition, shape=shape, angle=angle)
            except ValueError:  # the pupil is too coarse
                if side == reach:
                    raise
                continue
            levels = glare_levels(light.intensity[0], float(light.clear_peak))
            found |= {f"level.{side}": levels.level, f"share.{side}": levels.share}
        return found


def _measures(found: Mapping[str, Any]) -> FrontMeasures:
    sides = [int(name.removeprefix("level.")) for name in found if name.startswith("level.")]
    return FrontMeasures(
        PictureSpectrum(*(found[f"spectrum.{name}"] for name in PictureSpectrum._fields)),
        {name: found[f"energy.{name}"] for name in TARGETS},
        float(found["peak"]),
        float(found["heat"]),
        found["radius"],
        found["square"],
        {side: GlareLevels(found[f"level.{side}"], found[f"share.{side}"]) for side in sides},
        found["colour"],
    )
