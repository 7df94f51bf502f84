"""What a PSF refuses: aliases of the pupil's samples, points too far apart, and more light than the pupil passes."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from neusee.nodes.optics._pixel_average import spot
from neusee.nodes.optics._psf_definition import Geometry
from neusee.nodes.values import Pupil

#: relative light above that of the pupil, by the type of the PSF, that rounding may add
GAINED_LIGHT = {torch.float32: 1e-5, torch.float64: 1e-9}
_FAST = 1.2  #: f-number below which the scalar theory of this PSF needs a note


def refuse_aliases(pupil: Pupil, camera: Geometry) -> None:
    """Raise ValueError if the PSF window includes aliases, which a sampled pupil repeats every lambda f / pitch.

    With ``pixel="zoh"`` the repeated light is real, because square pillars do send light there.
    """
    if camera.pixel == "zoh":
        return
    shortest, pitch = float(pupil.wavelengths.min()), float(pupil.pitch)
    limit = shortest * camera.focal_length / (2 * pitch)
    for axis, n, at in zip("yx", camera.shape, spot(camera), strict=True):
        reach = max(abs(0 - at), abs(n - 1 - at)) * camera.pixel_pitch
        if reach > limit * (1 + 1e-9):
            raise ValueError(
                f"the window reaches {reach * 1e3:.3g} mm from the spot along {axis}, but at {shortest * 1e9:.4g} nm "
                f"a pupil pitch of {pitch * 1e6:.4g} um carries only {limit * 1e3:.3g} mm (lambda f / (2 pitch)) "
                f"before the PSF repeats: write {_finer_grid(pupil, reach / limit)} for the same aperture, or choose "
                "a smaller angle or window, or pixel='zoh'"
            )


def _finer_grid(pupil: Pupil, factor: float) -> str:
    """Return the settings of a pupil grid of the same width with a pitch that is ``factor`` times finer."""
    samples, pitch = pupil.height.shape[0], float(pupil.pitch)
    needed = math.ceil(samples * factor * (1 - 1e-12))
    needed += (needed - samples) % 2  # so that the axis stays on a sample, or between two samples
    return f'optics.samples={needed} optics.pitch="{samples * pitch / needed * 1e6:.10g} um"'


def refuse_coarse_points(pupil: Pupil, camera: Geometry) -> None:
    """Raise ValueError if the middles of the pixels are further apart than wavelength x f-number.

    The sum of equally spaced points is the light of a PSF up to that pitch, which is the period of the fastest fringe.
    """
    if camera.sensor != "point":
        return
    shortest = float(pupil.wavelengths.min())
    widest = float(pupil.pitch) * max(pupil.height.shape)
    if _coarse(camera, shortest, widest):
        diameter = min(_diameter(pupil, widest), widest)
        if _coarse(camera, shortest, diameter):
            number = camera.focal_length / diameter
            raise ValueError(
                f"points {camera.pixel_pitch * 1e6:.3g} um apart miss or repeat the light of a spot at "
                f"{shortest * 1e9:.4g} nm and f/{number:.3g}, where wavelength x f-number is "
                f"{shortest * number * 1e6:.3g} um: write sensor.sampling=integrated to average over each pixel, or "
                "choose a finer pitch"
            )


def spread_points_notes(pupil: Pupil, camera: Geometry) -> list[str]:
    """Return a note for points so far apart that a peak between them is missed, as of the spot behind a mask.

    The Airy pattern in the middle between four points says by how much.
    """
    if camera.sensor == "integrated" or pupil.diameter.is_meta or not float(pupil.diameter) > 0:
        return []
    fringe = float(pupil.wavelengths.min()) * camera.focal_length / float(pupil.diameter)
    if camera.pixel_pitch <= fringe / 2 * (1 + 1e-9):
        return []
    away = torch.tensor(math.pi * min(camera.pixel_pitch / math.sqrt(2) / fringe, 1.22), dtype=torch.float64)
    lost = 1 - float((2 * torch.special.bessel_j1(away) / away).square())
    return [
        f"points {camera.pixel_pitch * 1e6:.3g} um apart are further apart than half of wavelength x f-number, "
        f"{fringe / 2 * 1e6:.3g} um: a peak between them shows up to {lost:.0%} too low"
    ]


def _coarse(camera: Geometry, wavelength: float, diameter: float) -> bool:
    return camera.pixel_pitch * diameter > wavelength * camera.focal_length * (1 + 1e-9)


def _diameter(pupil: Pupil, widest: float) -> float:
    """Return the diameter of the clear aperture, or its larger side where the pupil does not name the diameter."""
    named = pupil.diameter
    if not named.is_meta and float(named) > 0:
        return float(named)
    if pupil.aperture.is_meta:
        return 0.0
    open_ = pupil.aperture.detach() != 0
    sides = [_extent(open_.any(axis)) for axis in (0, 1)]
    return float(pupil.pitch) * max(sides)


def _extent(open_: Tensor) -> int:
    at = open_.nonzero()
    return int(at[-1] - at[0]) + 1 if len(at) else 0


def fast_lens_notes(pupil: Pupil, camera: Geometry) -> list[str]:
    """Return a note for a lens of f/1.2 or faster, whose light is too oblique for this model."""
    diameter = 0.0 if pupil.diameter.is_meta else float(pupil.diameter)
    number = camera.focal_length / diameter if diameter else math.inf
    if number > _FAST * (1 + 1e-9):
        return []
    return [
        f"f/{number:.3g}: the PSF is that of scalar theory, and the acceptance of microlenses is ignored; "
        "a real sensor loses part of this oblique light"
    ]


def refuse_gained_light(intensity: Tensor, lights: list[float], wavelengths: Tensor) -> None:
    """Raise ValueError if a window holds more light than the pupil passes, beyond the error of the PSF.

    ``lights`` has the light that the pupil passes in each band, as a share of that of the clear pupil.
    """
    shares = intensity.detach().sum(-1).sum(-1, dtype=torch.float64).tolist()
    for share, light, wavelength in zip(shares, lights, wavelengths.tolist(), strict=True):
        if share > light * (1 + GAINED_LIGHT[intensity.dtype]):
            raise ValueError(
                f"the window holds {share:.6g} of the light of the clear pupil at {wavelength * 1e9:.4g} nm, but the "
                f"pupil passes only {light:.6g}: the samples of the PSF are too far apart; average over each pixel "
                "(sensor.sampling=integrated)"
            )
