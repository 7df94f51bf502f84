"""Settings of the estimate of damage, dazzle and eye exposure: the block safety."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar

from pydantic import Field, ValidationError, field_validator, model_validator

from neusee.nodes import ParameterError
from neusee.nodes.flare import Surfaces
from neusee.nodes.laser import Beam, DamageLaw, TrainRule, beam, read_damage_laws
from neusee.nodes.optics import refuse_impossible_f_number
from neusee.nodes.sensor import Bits, electrons_to_clip, refuse_without_steps
from neusee.nodes.units import (
    BeamRadius,
    Count,
    Diameter,
    Distance,
    Efficiency,
    Electrons,
    Energy,
    Exposure,
    FocalLength,
    Frequency,
    Gain,
    Luminance,
    PixelPitch,
    PositiveAngle,
    Power,
    Shape,
    Time,
    Visibility,
    Wavelength,
    Waves,
)
from neusee.workflows.graph.errors import Diagnostic, nearest
from neusee.workflows.recipe.blocks.settings_block import SettingsBlock, located
from neusee.workflows.recipe.text.recipe_files import refuse_outside
from neusee.workflows.recipe.text.references import References, Scope, broken
from neusee.workflows.recipe.text.yaml_values import Value, Where, dotted, kind

if TYPE_CHECKING:
    from neusee.workflows.graph.recipe_graph import Step


# --- sensor facts ---------------------------------------------------------------------------------

# The sensor of an estimate of safety: its pixels, and the electrons that saturate a pixel.


Passing = Annotated[float, Field(gt=0, le=1)]


class SensorFacts(SettingsBlock):
    """Properties of the sensor on which damage and dazzle depend; None for the quantum efficiency
    means that it is unknown.
    """

    pixel_pitch: PixelPitch
    shape: Shape
    quantum_efficiency: Efficiency | None = (
        None  #: at the wavelength of the laser; with ``responses``, that of the sensor
    )
    #: step of the response of each channel to the laser, such as ``laser_responses``
    responses: str | None = None
    full_well: Annotated[Electrons, Field(ge=1)] | None = None
    gain: Gain | None = None  #: with ``bits``: the converter may end below the full well
    bits: Bits | None = None
    offset: Electrons = 0.0  #: part of a well that is filled without light
    exposure: Exposure | None = None

    @property
    def fills(self) -> float:
        """Return the number of photoelectrons that saturate a pixel, at its full well or at the end
        of the range of the converter.
        """
        well = self.full_well or math.inf
        if self.gain is None or self.bits is None or self.full_well is None:
            return well - self.offset
        return electrons_to_clip(well, self.gain, self.bits, self.offset)

    @model_validator(mode="after")
    def _leaves_room_for_light(self) -> SensorFacts:
        """Refuse an offset that fills the pixel.

        A converter without a step below the full well is refused too.
        """
        if not self.fills > 0:
            problem = f"an offset of {self.offset:g} e- leaves no room for light"
            raise ValueError(
                f"{problem} in a full well of {self.full_well:g} e-, or in the range of the"
                " converter"
            )
        if self.full_well is not None and self.gain is not None and self.bits is not None:
            refuse_without_steps(self.full_well, gain=self.gain, bits=self.bits)
        return self


@dataclass(frozen=True)
class LaserChannels:
    """Responses of the colour channels to a laser, with the steps that compute them, so that they
    can be computed at another wavelength too.
    """

    line: Step  #: step of the bands of the laser
    responses: Step
    #: response of the channel that responds most, relative to the quantum efficiency of the sensor
    largest: float
    key: str  #: of the responses; part of the key of an estimate


# --- safety block ---------------------------------------------------------------------------------

# Settings of the estimate of damage, dazzle and eye exposure, which form the block ``safety`` of a
# recipe.


KEY, LASERS = "safety", "lasers"  #: keys of the two blocks in a recipe
#: properties of a sensor that a computation of saturation needs
SATURATION = ("quantum_efficiency", "full_well", "exposure")
BEAM = (
    "wavelength",
    "power",
    "pulse_energy",
    "pulse_duration",
    "repetition_rate",
    "waist",
    "divergence",
    "m_squared",
)

Above = Annotated[float, Field(gt=0, le=1e9)]  #: a number above 0
Exponent = Annotated[float, Field(ge=0, le=1)]
Model = TypeVar("Model", bound=SettingsBlock)


class Laser(SettingsBlock):
    """Light of a laser in physical units, its distance from the camera, and the air between
    both.
    """

    wavelength: Wavelength
    power: Power | None = None  #: of a pulse train: the mean
    pulse_energy: Energy | None = None
    pulse_duration: Time | None = None
    repetition_rate: Frequency | None = None
    waist: BeamRadius | None = None  #: radius of the beam at the exit of the laser
    divergence: PositiveAngle | None = None  #: full angle
    m_squared: Annotated[float, Field(ge=1, le=1e6)] | None = None
    convention: Literal["1/e2", "1/e"] = "1/e2"  #: of waist and divergence
    distance: Distance
    air_transmittance: Passing | None = None  #: over the whole distance
    visibility: Visibility | None = None  #: None: clear air, unless its transmittance is given
    haze: Literal["kruse", "kim"] = "kim"

    def beam(self, values: Mapping[str, float] | None = None) -> Beam:
        """Return the beam with ``values`` in place of the values of the laser; raise
        `ParameterError` if the values contradict each other.
        """
        parameters = {name: getattr(self, name) for name in BEAM}
        parameters |= {name: value for name, value in (values or {}).items() if name in BEAM}
        return beam(**parameters, convention=self.convention)

    @model_validator(mode="after")
    def _has_one_air(self) -> Laser:
        if self.air_transmittance is not None and self.visibility is not None:
            raise ValueError("the air is given twice: remove air_transmittance or visibility")
        return self


class Scatter(SettingsBlock):
    """Light that the lens scatters, by the law of Harvey and Shack: a veil around the spot,
    behind a mask too.
    """

    #: scattered part of the light; an assumption unless the recipe states it
    share: Annotated[float, Field(gt=0, lt=1)] = 0.005
    l: Annotated[float, Field(gt=0, le=10)] = 0.01  #: width of the scatter, as a sine  # noqa: E741
    s: Annotated[float, Field(ge=-10, le=0)] = -1.5  #: slope far outside of the width
    surfaces: Surfaces | None = None  #: of `flare.stray_light`, in place of these numbers


class Lens(SettingsBlock):
    """Lens of the camera: its focal length, its clear diameter, its transmittance, its focus and
    its scatter.
    """

    focal_length: FocalLength
    diameter: Diameter
    transmittance: Passing = 1.0
    focus: Literal["infinity", "laser"] | Distance = "infinity"  #: distance, or always on the laser
    defocus: Waves = 0.0  #: of the lens at its rim, added to that of the distance, at 550 nm
    scatter: Scatter | None = Scatter()  #: None: a lens that scatters nothing
    stop: str | None = None  #: step that returns the stop; its grid may narrow the diameter

    @model_validator(mode="after")
    def _can_focus(self) -> Lens:
        refuse_impossible_f_number(self.focal_length, self.diameter, "diameter")
        return self


class Spots(SettingsBlock):
    """Names of the steps, for plain lens and mask, that compute PSFs or ranked pixels at the
    wavelength of the laser.

    ``laser_psf`` means ``laser_psf[plain,pointer]`` and ``laser_psf[mask,pointer]`` for the laser
    ``pointer``.
    """

    plain: str | None = None
    mask: str | None = None


class Protection(SettingsBlock):
    """Protections that are compared with the plain lens: the mask of the recipe, a grey filter and
    a smaller stop.
    """

    #: step of the laser suppression ratio (LSR) at the wavelength of the laser, as in `Spots`
    mask: str | None = None
    filter: Passing | None = None  #: transmittance
    stop: Diameter | None = None  #: diameter
    notch_index: Annotated[float, Field(ge=1, le=4)] = (
        1.8  #: effective index of a notch filter, which shifts with angle
    )
    spots: Spots = Spots()  #: PSFs of the pattern of damage
    pixels: Spots = Spots()  #: steps of `laser.bright_pixels`, which give the dazzled area


class Damage(SettingsBlock):
    """Thresholds of damage that apply, and the duration of the exposure."""

    device: str = "CMOS"  #: class of the sensor, as the table of thresholds names it
    dwell: Time = 1.0  #: s, for which the light stays on one place of the sensor
    #: of (published spot / spot), by which a smaller spot raises the threshold; 0: not at all
    small_spot_exponent: Exponent = 0.0
    file: Path | None = None  #: table with thresholds of the user, used where they apply


class Dazzle(SettingsBlock):
    """Largest part of the picture that may be lost, and the feature that decides whether a part is
    lost.
    """

    share: Passing = 0.1  #: of the picture
    contrast: Above = 0.5  #: Weber contrast of the feature
    feature: Above = 10.0  #: pixels across the feature
    background: Electrons = 1000.0  #: a pixel around the feature
    threshold: Above | None = None  #: least signal-to-noise ratio (5), or least contrast (0.05)
    rule: Literal["snr", "contrast"] = "snr"
    read_noise: Electrons = 0.0

    @property
    def least(self) -> float:
        """Return the least signal-to-noise ratio, or the least contrast, at which the feature is
        seen.
        """
        return self.threshold or {"snr": 5.0, "contrast": 0.05}[self.rule]


class EyeDazzle(SettingsBlock):
    """Conditions under which a viewer must see a target beside the laser: background luminance,
    target and viewer.
    """

    angles: Annotated[tuple[PositiveAngle, ...], Field(min_length=1)] = tuple(
        map(math.radians, (1.0, 5.0, 10.0, 20.0))
    )
    #: night, dusk and day
    backgrounds: Annotated[tuple[Luminance, ...], Field(min_length=1)] = (0.1, 10.0, 1000.0)
    contrast: Above = 0.2  #: Weber contrast of the target
    size: PositiveAngle = math.radians(10 / 60)  #: across the target, from 1 to 60 arc minutes
    age: Annotated[float, Field(ge=23, le=75)] = 40.0  #: years
    #: of the iris: 0 black, 0.5 brown, 1.0 to 1.2 light
    pigmentation: Annotated[float, Field(ge=0, le=1.2)] = 0.5
    margin: Above = 2.6  #: contrast that the viewer needs, over the threshold of the laboratory

    @field_validator("angles")
    @classmethod
    def _has_an_equation(cls, angles: tuple[float, ...]) -> tuple[float, ...]:
        """Refuse angles for which the glare equation does not hold."""
        for angle in angles:
            if not math.radians(0.1) <= angle <= math.radians(100):
                raise ValueError(
                    f"an angle of {math.degrees(angle):.3g} deg is outside the glare equation,"
                    " which holds from 0.1 to 100 deg"
                )
        return angles

    @field_validator("backgrounds")
    @classmethod
    def _is_lit(cls, backgrounds: tuple[float, ...]) -> tuple[float, ...]:
        if min(backgrounds) <= 0:
            raise ValueError(
                "a background without light shows no target: write a background above 0 cd/m2"
            )
        return backgrounds

    @field_validator("size")
    @classmethod
    def _has_a_threshold(cls, size: float) -> float:
        if not 1 <= math.degrees(size) * 60 <= 60.000001:
            raise ValueError(
                f"a target of {math.degrees(size) * 60:.3g} arc minutes has no known threshold:"
                " write a size from 1 to 60 arc minutes"
            )
        return size


class Eye(SettingsBlock):
    """Exposure of an eye to the laser: its duration, the rule for pulse trains, and the conditions
    of dazzle.
    """

    #: None: 0.25 s for visible light, until the eye turns away, and 10 s for other light
    exposure: Exposure | None = None
    #: for trains of pulses; `N^(-1/4)` is the stricter rule of 2007
    rule: TrainRule = "IEC 60825-1:2014"
    dazzle: EyeDazzle = EyeDazzle()


class Unevenness(SettingsBlock):
    """Factors by which the irradiance of a laser exceeds that of an even Gaussian beam, in places
    or for moments.
    """

    #: factor on the irradiance; 1: not counted
    hot_spots: Annotated[float, Field(ge=1, le=1000)] = 1.0
    cn2: Above | None = None  #: m^(-2/3), of the turbulent air; None: not counted
    #: part of the time in which the irradiance behind turbulent air is below the assumed one
    worst: Annotated[float, Field(gt=0, lt=1)] = 0.99


class SafetySettings(SettingsBlock):
    """Settings in the block ``safety`` of a recipe."""

    laser: str | None = None
    distances: tuple[Distance, Distance] = (1.0, 1e5)
    lens: Lens
    sensor: SensorFacts
    damage: Damage | None = Damage()  #: None, written none or null: damage is not estimated
    dazzle: Dazzle | None = None  #: None: dazzle is not estimated
    eye: Eye = Eye()
    beam: Unevenness = Unevenness()
    protection: Protection = Protection()
    draws: Annotated[Count, Field(ge=100, le=10_000)] = 1000

    @field_validator("damage", mode="before")
    @classmethod
    def _may_be_none(cls, damage: object) -> object:
        return None if damage == "none" else damage

    @field_validator("distances")
    @classmethod
    def _rises(cls, distances: tuple[float, float]) -> tuple[float, float]:
        if not distances[0] < distances[1]:
            raise ValueError(
                f"the distances run from {distances[0]:g} m to {distances[1]:g} m: write the"
                " shorter distance first"
            )
        return distances

    @model_validator(mode="after")
    def _knows_saturation(self) -> SafetySettings:
        """Refuse dazzle without the efficiency, the full well and the exposure of the sensor."""
        lacking = [name for name in SATURATION if getattr(self.sensor, name) is None]
        if self.dazzle is not None and lacking:
            names = ", ".join(lacking)
            raise ValueError(
                f"dazzle needs {names} of the sensor: write sensor.{lacking[0]}, or dazzle: null"
            )
        return self


@dataclass(frozen=True)
class Safety:
    """Settings of an estimate, the laser that they name, and where each value was written."""

    laser: Laser
    settings: SafetySettings
    name: str  #: of the laser
    #: value in the recipe by setting, such as ``laser.power`` or ``lens.diameter``
    values: Mapping[str, Value]
    #: thresholds of damage in the file of the user; empty without a file
    laws: tuple[DamageLaw, ...]
    channels: LaserChannels | None = None  #: None unless the settings name a step of responses


def read_safety(
    root: Value, references: References, diagnostics: list[Diagnostic], files: dict[Where, str]
) -> Safety | None:
    """Return the settings in the block ``safety`` of a recipe, or None for null or a mistake;
    report each mistake.

    The full path of a file is added to ``files``, by the path of the value in the recipe.
    """
    block = _settings_of(root, references, diagnostics)
    if block is None:
        return None
    earlier_mistakes = len(diagnostics)
    block = _located_in(block, root.mark.file)
    settings = _validated(SafetySettings, block, diagnostics)
    laser_value = _laser_of(root, block, references, diagnostics)
    laser = None if laser_value is None or broken(laser_value) else _laser(laser_value, diagnostics)
    laws = _laws(block, diagnostics, files)
    if (
        settings is None
        or laser is None
        or laser_value is None
        or len(diagnostics) > earlier_mistakes
    ):
        return None
    values = {dotted(path): value for path, value in _leaves(block, ())}
    # the laser of the settings alone, under the name ``laser``
    values |= {dotted(path): value for path, value in _leaves(laser_value, ("laser",))}
    return Safety(laser, settings, str(laser_value.path[-1]), values, laws)


def _settings_of(
    root: Value, references: References, diagnostics: list[Diagnostic]
) -> Value | None:
    """Return the block ``safety`` with its references resolved, or None for null or a mistake."""
    lasers = root.items[LASERS].items if LASERS in root.items else {}
    # every setting of a laser may be written, whatever step reads it
    references.used |= {(LASERS, *pair) for pair in product(lasers, Laser.model_fields)}
    block = references.resolve(root.items[KEY], Scope({}, KEY))
    if broken(block) or block.data is None:
        return None
    if isinstance(block.data, dict):
        return block
    message = f"must be a mapping of settings, not {kind(block)}"
    diagnostics.append(Diagnostic(block.mark, KEY, message))
    return None


def _laws(
    block: Value, diagnostics: list[Diagnostic], files: dict[Where, str]
) -> tuple[DamageLaw, ...]:
    """Return the thresholds of damage in the file of the user; report a mistake in the file."""
    file = block.below(("damage", "file"))
    if file is None or not isinstance(file.data, str):
        return ()
    path = (Path(file.mark.folder) / Path(file.data).expanduser()).resolve()
    files[file.path] = str(path)
    try:
        refuse_outside(path, file.mark)
        if not path.is_file():
            raise ValueError(f"no such file: {path}")
        return read_damage_laws(path)
    except (ValueError, OSError) as error:
        diagnostics.append(Diagnostic(file.mark, file.name, str(error)))
        return ()


def _validated(model: type[Model], block: Value, diagnostics: list[Diagnostic]) -> Model | None:
    """Return the settings in a block, or None with a diagnostic for each mistake."""
    try:
        return model.model_validate(block.plain)
    except ValidationError as error:
        diagnostics += (located(block, model, details) for details in error.errors())
        return None


def _located_in(value: Value, file: str) -> Value:
    """Return a mapping whose location is the place where ``file`` sets one of its values, in place
    of its location in an earlier option.
    """
    if not isinstance(value.data, dict):
        return value
    items = {key: _located_in(item, file) for key, item in value.data.items()}
    place_in_file = next((item.key for item in items.values() if item.key.file == file), None)
    if place_in_file is None or value.key.file == file:
        return replace(value, data=items)
    return replace(value, data=items, key=place_in_file, mark=place_in_file)


def _laser_of(
    root: Value, block: Value, references: References, diagnostics: list[Diagnostic]
) -> Value | None:
    """Return the laser that the settings name, or the only laser, with references resolved; None
    for a mistake.
    """
    lasers = {
        str(name): value
        for name, value in (root.items[LASERS].items if LASERS in root.items else {}).items()
    }
    setting = block.child("laser")
    if setting is not None and setting.data is not None:
        if str(setting.data) not in lasers:
            message = (
                f"the recipe has no laser {setting.data}; {nearest(str(setting.data), lasers)}"
            )
            diagnostics.append(Diagnostic(setting.mark, setting.name, message))
            return None
        name = str(setting.data)
    elif len(lasers) != 1:
        message_of_several = (
            f"the recipe has the lasers {', '.join(lasers)}: write safety.laser=NAME"
        )
        diagnostics.append(
            Diagnostic(block.key, KEY, message_of_several if lasers else "the recipe has no laser")
        )
        return None
    else:
        name = next(iter(lasers))
    return references.resolve(lasers[name], Scope({}, f"{LASERS}.{name}"))


def _laser(item: Value, diagnostics: list[Diagnostic]) -> Laser | None:
    """Return the validated settings of a laser, without the values that only steps of the recipe
    read; report each mistake.
    """
    if not isinstance(item.data, dict):
        diagnostics.append(
            Diagnostic(item.mark, item.name, f"must be a mapping of values, not {kind(item)}")
        )
        return None
    laser_settings = Value(
        {key: setting for key, setting in item.data.items() if key in Laser.model_fields},
        item.key,
        item.key,
        item.path,
    )
    laser = _validated(Laser, laser_settings, diagnostics)
    try:
        if laser is not None:
            laser.beam()
    except ParameterError as error:
        value = item.child(error.parameter)
        diagnostics.append(
            Diagnostic(
                value.mark if value else item.key, f"{item.name}.{error.parameter}", str(error)
            )
        )
        return None
    return laser


def _leaves(value: Value, path: Where) -> Iterator[tuple[Where, Value]]:
    """Yield each single value in a mapping with its path in the mapping; for a reference this is
    not the path of its target.
    """
    for key, child in value.items.items():
        if isinstance(child.data, dict):
            yield from _leaves(child, (*path, key))
        else:
            yield (*path, key), child
