"""Damage of a sensor by the light of a laser on it: how near each kind of damage is, and with which probability."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.input_files import once_per_version
from neusee.nodes.laser._damage_laws import DIFFUSIVITY, KINDS, DamageLaw, damage_at, matching_laws
from neusee.nodes.laser._damage_published import PUBLISHED_DAMAGE
from neusee.nodes.laser._damage_table import read_damage_laws
from neusee.nodes.spectra._bands import mean_wavelength
from neusee.nodes.units import DataFile, PositiveLength, Time
from neusee.nodes.values import Bands, LaserLight

Thresholds = Literal["published"] | DataFile
_FAR = 10.0  #: least reach of heat, in diameters of the published spot, of a law that is scaled by its steady heat


class SpotDamage(NamedTuple):
    """How near a laser is to each kind of damage of a sensor, one entry for each law that holds for it."""

    ratio: Tensor  #: (law,) float64, exposure of the worst pixel over the threshold of the median device
    probability: Tensor  #: (law,) float64, share of devices that are damaged; -1 for a law without a spread
    low: Tensor  #: (law,) float64, lower end of the 90 % interval of the probability; -1 for a law without a spread
    high: Tensor  #: (law,) float64, upper end; -1 for a law without a spread
    peak: Tensor  #: (law,) float64, W/m2, or J/m2 of one pulse, in the brightest pixel
    threshold: Tensor  #: (law,) float64, W/m2 or J/m2 in the brightest pixel at the threshold of the median device
    pattern: Tensor  #: (y, x) uint8, sum of 2^k over the kinds of damage k of `KINDS` in each pixel


@node(rtol=1e-5)
def damage(
    spot: Tensor,
    line: Bands,
    light: LaserLight | None = None,
    *,
    pixel_pitch: PositiveLength,
    exposure: Time,
    dwell: Time,
    pulse_duration: Time | None = None,
    device: str = "CMOS",
    thresholds: Thresholds = "published",
    resilience: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1.0,
) -> SpotDamage:
    """Compare the irradiance, or the fluence of a pulse, that a laser brings to the sensor with thresholds of damage.

    A threshold of continuous light belongs to a spot of a stated diameter. It is compared with the spot that heats the
    worst pixel equally in the steady state: the sum of E dA / (2 pi r) over all pixels. A small diffraction-limited
    spot so needs more irradiance, inversely to its diameter. A fluence is compared pixel by pixel. A pulse train is
    judged by both, the mean irradiance and the fluence of one pulse. ``thresholds`` are the published laws, or a CSV
    file of your own; ``dwell`` is how long the laser stays on the spot. Gain, full well, quantum efficiency and the
    exposure time of a continuous laser do not enter. The pattern is that of one device, whose threshold is
    ``resilience`` times that of the median device.

    Shapes: spot (band, y, x), line (band,) -> six of (law,) float64, and the pattern (y, x).
    Units:  spot W/m2, mean over the exposure; result W/m2 or J/m2.
    Error:  of continuous light 1.4 % too little heat for a spot of 5 pixels and 0.6 % for one of 9; pixels must resolve
            the spot, lambda N / p above 1, else the peak at a point is higher. Heat outside the window, heat that
            pulses add up, and several lasers at once are left out. The laws are those of few devices: an estimate, no
            certificate.
    Raises: ParameterError before the run where no law holds for device, wavelength and duration, and for a mistake in
            the file of thresholds; ValueError for a pulsed laser of which no pulse falls into the exposure.
    Source: the source of each law; Carslaw, Jaeger, Conduction of Heat in Solids, 2nd ed., ch. 10 (steady heat).
    """
    rows, pattern = [], torch.zeros(spot.shape[-2:], dtype=torch.uint8, device=spot.device)
    for law in laws_of(mean_wavelength(line), _is_train(light), dwell, pulse_duration, device, thresholds):
        image = exposed(spot, light, law, exposure)
        level = _equivalent(image, law, pixel_pitch, dwell)
        top, worst = float(image.max()), float(level.max())
        found = damage_at(law, worst)
        chances = (-1.0 if x is None else x for x in found[1:])
        pattern |= (level >= law.median * resilience).to(torch.uint8) << KINDS.index(law.damage)
        rows.append((found.ratio, *chances, top, top / found.ratio if worst > 0 else math.inf))
    ratio, chance, low, high, peak, threshold = torch.tensor(rows, dtype=torch.float64).reshape(-1, 6).T.contiguous()
    return SpotDamage(ratio, chance, low, high, peak, threshold, pattern)


@damage.preflight
def _(
    *,
    line: Bands | None = None,
    light: LaserLight | None = None,
    dwell: float,
    pulse_duration: float | None = None,
    device: str = "CMOS",
    thresholds: Thresholds = "published",
    **params: Any,
) -> list[str]:
    every = _known(thresholds)
    if line is None or line.centres.is_meta:
        return []
    choice = {"dwell": dwell, "pulse_duration": pulse_duration, "device": device, "thresholds": thresholds}
    laws = laws_before(line, light, **choice)
    if not any(law.quantity == ("irradiance" if pulse_duration is None else "fluence") for law in laws):
        raise ParameterError(*_no_law(every, mean_wavelength(line), dwell, pulse_duration, device))
    return [f"{law.damage} of a {law.device}: {law.median / 1e4:.4g} {law.unit}, {law.source}" for law in laws]


@damage.check
def _(result: SpotDamage, spot: Tensor, line: Bands, light: LaserLight | None = None, **params: Any) -> list[Check]:
    rows = zip(*(column.tolist() for column in result[:6]), strict=True)
    laws = laws_before(line, light, **params)
    return [Check(_sentence(law, list(row)), row[0] < 1) for law, row in zip(laws, rows, strict=True)]


def _sentence(law: DamageLaw, row: list[float]) -> str:
    ratio, chance, low, high, peak, threshold = row
    text = f"{law.damage} damage: {peak / 1e4:.3g} of {threshold / 1e4:.3g} {law.unit}, {ratio:.3g} times the threshold"
    if chance < 0:
        return f"{text}; no probability, because the source states no spread"
    return f"{text}; {chance:.2g} of devices damaged (90 % interval {low:.2g} to {high:.2g})"


def laws_of(
    wavelength: float,
    train: bool,
    dwell: float,
    pulse_duration: float | None = None,
    device: str = "CMOS",
    thresholds: Thresholds = "published",
) -> tuple[DamageLaw, ...]:
    """Return the laws that hold for a laser: those of continuous light, those of a pulse, or both for a pulse train."""
    every = _known(thresholds)
    pulses = () if pulse_duration is None else matching_laws(every, device, wavelength, pulse_duration, "fluence")
    steady = matching_laws(every, device, wavelength, dwell, "irradiance") if pulse_duration is None or train else ()
    return (*steady, *pulses)


def laws_before(line: Bands, light: LaserLight | None, **params: Any) -> tuple[DamageLaw, ...]:
    """Return the laws for a laser, from the parameters of the step; a laser that is not yet known may be a train."""
    choice = {name: params[name] for name in ("dwell", "pulse_duration", "device", "thresholds") if name in params}
    unknown = light is not None and light.pulses.is_meta
    return laws_of(mean_wavelength(line), unknown or _is_train(light), **choice)


def exposed(spot: Tensor, light: LaserLight | None, law: DamageLaw, exposure: float) -> Tensor:
    """Return the irradiance in W/m2, or the fluence of one pulse in J/m2, of each pixel (y, x) of a laser spot."""
    image = spot.detach().sum(0, dtype=torch.float64)
    if law.quantity == "irradiance":
        return image
    if light is None or not float(light.pulse_fluence) > 0:  # a laser that is given by its strength
        return image * exposure
    pulses = float(light.pulses)
    if not pulses > 0:
        text = "no pulse falls into the exposure, yet every pulse hits the sensor"
        raise ValueError(f"{text}: give the laser a pulse_delay of 0 to judge its damage")
    return image * (exposure / pulses)


def _equivalent(image: Tensor, law: DamageLaw, pitch: float, dwell: float) -> Tensor:
    """Return the peak (y, x) of the spot of a law's own diameter that heats each pixel as the image does.

    A spot that heat does not leave within the dwell time, such as that of one pulse, is compared as it is.
    """
    if law.quantity == "fluence" or law.spot is None or math.sqrt(8 * DIFFUSIVITY * dwell) < _FAR * law.spot:
        return image
    return steady_heat(image, pitch) / (law.spot / 2 * math.sqrt(math.pi / 8))


def steady_heat(image: Tensor, pitch: float) -> Tensor:
    """Return the steady heat (y, x) of an irradiance on a half-space: the integral of E dA / (2 pi r), in W/m.

    Each pixel is evenly lit; the integral of 1 / r over its square is exact.
    """
    rows, columns = image.shape
    y, x = (torch.arange(2 * n, dtype=torch.float64, device=image.device) for n in (rows, columns))
    y, x = torch.minimum(y, 2 * rows - y)[:, None], torch.minimum(x, 2 * columns - x)
    corners = [(y + j, x + i, 4 * i * j) for j in (-0.5, 0.5) for i in (-0.5, 0.5)]
    kernel = sum(sign * (u * torch.asinh(v / u.abs()) + v * torch.asinh(u / v.abs())) for u, v, sign in corners)
    size = (2 * rows, 2 * columns)
    heat: Tensor = torch.fft.irfft2(torch.fft.rfft2(image, size) * torch.fft.rfft2(torch.as_tensor(kernel)), size)
    return heat[:rows, :columns].clamp_min(0) * (pitch / (2 * math.pi))


def _is_train(light: LaserLight | None) -> bool:
    """Return True if more than one pulse of a laser falls into an exposure."""
    return light is not None and float(light.pulses) > 1


def _known(thresholds: Thresholds) -> tuple[DamageLaw, ...]:
    if not isinstance(thresholds, Path):
        return PUBLISHED_DAMAGE
    try:
        return _from_file(thresholds)
    except ValueError as error:
        raise ParameterError("thresholds", str(error)) from None


@once_per_version
def _from_file(file: Path) -> tuple[DamageLaw, ...]:
    return read_damage_laws(file)


def _no_law(
    laws: tuple[DamageLaw, ...], wavelength: float, dwell: float, pulse_duration: float | None, device: str
) -> tuple[str, str]:
    """Return the parameter and the message for a laser that no law covers."""
    kind = f"light that stays {dwell:.3g} s" if pulse_duration is None else f"pulses of {pulse_duration:.3g} s"
    text = f"no threshold of damage for the device {device} at {wavelength * 1e9:.5g} nm and {kind}"
    devices = sorted({law.device for law in laws})
    if device.casefold() not in {name.casefold() for name in devices}:
        return "device", f"{text}: there are laws for {', '.join(devices)}"
    ends = [min(law.wavelengths[0] for law in laws), max(law.wavelengths[1] for law in laws)]
    known = f"the laws reach from {ends[0] * 1e9:.4g} to {ends[1] * 1e9:.4g} nm"
    return "thresholds", f"{text} ({known}): give a file of your own thresholds"
