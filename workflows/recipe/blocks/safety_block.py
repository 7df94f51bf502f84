"""Settings of the estimate of damage, dazzle and eye exposure, which form the block ``safety`` of a recipe."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal, TypeVar

from pydantic import Field, ValidationError, field_validator, model_validator

from neusee.nodes import ParameterError
from neusee.nodes.laser import PUBLISHED_DAMAGE, Beam, DamageLaw, beam, read_damage_laws
from neusee.nodes.units import (
    Count,
    Electrons,
    Energy,
    Frequency,
    PositiveAngle,
    PositiveLength,
    Power,
    Shape,
    Time,
    Wavelength,
)
from neusee.workflows.graph.diagnostics import Diagnostic, nearest
from neusee.workflows.recipe.blocks.settings_block import SettingsBlock, located
from neusee.workflows.recipe.text.references import References, Scope, broken
from neusee.workflows.recipe.text.yaml_values import Value, Where, dotted, kind

KEY, LASERS = "safety", "lasers"  #: keys of the two blocks in a recipe
SATURATION = ("quantum_efficiency", "full_well", "exposure")  #: facts of a sensor without which nothing saturates
BEAM = ("wavelength", "power", "pulse_energy", "pulse_duration", "repetition_rate", "waist", "divergence", "m_squared")

Above = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Passing = Annotated[float, Field(gt=0, le=1)]
Model = TypeVar("Model", bound=SettingsBlock)


class Laser(SettingsBlock):
    """Light of a laser in physical units, its distance from the camera, and the air between both."""

    wavelength: Wavelength
    power: Power | None = None  #: of a pulse train: the mean
    pulse_energy: Energy | None = None
    pulse_duration: Time | None = None
    repetition_rate: Frequency | None = None
    waist: PositiveLength | None = None  #: radius of the beam at the exit of the laser
    divergence: PositiveAngle | None = None  #: full angle
    m_squared: Above | None = None
    convention: Literal["1/e2", "1/e"] = "1/e2"  #: of waist and divergence
    distance: PositiveLength
    air_transmittance: Passing | None = None  #: over the whole distance
    visibility: PositiveLength | None = None  #: None: clear air, unless its transmittance is given
    haze: Literal["kruse", "kim"] = "kim"

    def beam(self, values: Mapping[str, float] | None = None) -> Beam:
        """Return the beam with ``values`` in place of its own; raise `ParameterError` for values that disagree."""
        given = {name: getattr(self, name) for name in BEAM}
        given |= {name: value for name, value in (values or {}).items() if name in BEAM}
        return beam(**given, convention=self.convention)

    @model_validator(mode="after")
    def _has_one_air(self) -> Laser:
        if self.air_transmittance is not None and self.visibility is not None:
            raise ValueError("the air is stated twice: leave air_transmittance or visibility out")
        return self


class Lens(SettingsBlock):
    """Lens of the camera: its focal length, its clear diameter and its transmittance."""

    focal_length: PositiveLength
    diameter: PositiveLength
    transmittance: Passing = 1.0
    stop: str | None = None  #: step that returns the stop; its grid may narrow the diameter


class Spots(SettingsBlock):
    """Steps for the plain lens and the mask, at the wavelength of the laser: PSFs, or pixels ranked by their light.

    ``laser_psf`` means ``laser_psf[plain,pointer]`` and ``laser_psf[mask,pointer]`` for the laser ``pointer``.
    """

    plain: str | None = None
    mask: str | None = None


class Protection(SettingsBlock):
    """Protections beside the plain lens: the mask of the recipe, a grey filter and a smaller stop."""

    mask: str | None = None  #: step of the laser suppression ratio (LSR) at the wavelength of the laser, as in `Spots`
    filter: Passing | None = None  #: transmittance
    stop: PositiveLength | None = None  #: diameter
    spots: Spots = Spots()  #: PSFs of the pattern of damage
    pixels: Spots = Spots()  #: steps of `laser.bright_pixels`, which give the dazzled area


class SensorFacts(SettingsBlock):
    """What damage and dazzle need to know of the sensor; no quantum efficiency means that none is known."""

    pixel_pitch: PositiveLength
    shape: Shape
    quantum_efficiency: Passing | None = None  #: at the wavelength of the laser
    full_well: Electrons | None = None
    exposure: Time | None = None


class Damage(SettingsBlock):
    """Which thresholds of damage hold, and for which exposure."""

    device: str = "CMOS"  #: class of the sensor, as the table of thresholds names it
    dwell: Time = 1.0  #: s, for which continuous light stays on one place of the sensor
    spot: Literal["diffraction", "published"] = "diffraction"  #: for which spot a continuous threshold is taken
    file: Path | None = None  #: table of thresholds of the user, in place of the published ones


class Dazzle(SettingsBlock):
    """How much of the picture may be lost, and when a feature counts as lost."""

    share: Passing = 0.1  #: of the picture
    contrast: Above = 0.5  #: Weber contrast of the feature
    feature: Above = 10.0  #: pixels across the feature
    background: Electrons = 1000.0  #: a pixel around the feature
    threshold: Above | None = None  #: least signal-to-noise ratio (5), or least contrast (0.05)
    rule: Literal["snr", "contrast"] = "snr"
    read_noise: Electrons = 0.0

    @property
    def least(self) -> float:
        """Return the least signal-to-noise ratio, or the least contrast, at which the feature is seen."""
        return self.threshold or {"snr": 5.0, "contrast": 0.05}[self.rule]


class Eye(SettingsBlock):
    """How long an eye looks into the laser."""

    exposure: Time | None = None  #: None: 0.25 s for visible light, until the eye turns away, and 10 s for other light


class SafetySettings(SettingsBlock):
    """Settings in the block ``safety`` of a recipe."""

    laser: str | None = None
    distances: tuple[PositiveLength, PositiveLength] = (1.0, 1e5)
    lens: Lens
    sensor: SensorFacts
    damage: Damage = Damage()
    dazzle: Dazzle | None = None  #: None: dazzle is not asked for
    eye: Eye = Eye()
    protection: Protection = Protection()
    draws: Annotated[Count, Field(ge=100, le=10_000)] = 1000

    @field_validator("distances")
    @classmethod
    def _rises(cls, distances: tuple[float, float]) -> tuple[float, float]:
        if not distances[0] < distances[1]:
            raise ValueError(f"from {distances[0]:g} m to {distances[1]:g} m: write the shorter distance first")
        return distances

    @model_validator(mode="after")
    def _knows_saturation(self) -> SafetySettings:
        lacking = [name for name in SATURATION if getattr(self.sensor, name) is None]
        if self.dazzle is not None and lacking:
            names = ", ".join(lacking)
            raise ValueError(f"dazzle needs {names} of the sensor: give sensor.{lacking[0]}, or write dazzle: null")
        return self


@dataclass(frozen=True)
class Safety:
    """Settings of an estimate, the laser that they name, and where each value was written."""

    laser: Laser
    settings: SafetySettings
    name: str  #: of the laser
    values: Mapping[str, Value]  #: value in the recipe by setting, such as ``laser.power`` or ``lens.diameter``
    laws: tuple[DamageLaw, ...]  #: thresholds of damage: the published ones, or those of the file of the user


def read_safety(
    root: Value, references: References, diagnostics: list[Diagnostic], files: dict[Where, str]
) -> Safety | None:
    """Return the settings in the block ``safety`` of a recipe, or None for null or a mistake; report each mistake.

    The full path of a file is added to ``files``, by the path of the value in the recipe.
    """
    lasers = root.items[LASERS].items if LASERS in root.items else {}
    references.used |= {(LASERS, name, field) for name in lasers for field in Laser.model_fields}
    block = references.resolve(root.items[KEY], Scope({}, KEY))
    if broken(block) or block.data is None:
        return None
    if not isinstance(block.data, dict):
        diagnostics.append(Diagnostic(block.mark, KEY, f"must be a mapping of settings, not {kind(block)}"))
        return None
    before = len(diagnostics)
    block = _located_in(block, root.mark.file)
    settings = _validated(SafetySettings, block, diagnostics)
    item = _laser_of(root, block, references, diagnostics)
    laser = None if item is None or broken(item) else _laser(item, diagnostics)
    laws = _laws(block, diagnostics, files)
    if settings is None or laser is None or item is None or len(diagnostics) > before:
        return None
    values = {dotted(path): value for path, value in _leaves(block, ())}
    values |= {dotted(path): value for path, value in _leaves(item, ("laser",))}
    return Safety(laser, settings, str(item.path[-1]), values, laws)


def _laws(block: Value, diagnostics: list[Diagnostic], files: dict[Where, str]) -> tuple[DamageLaw, ...]:
    """Return the thresholds of damage in the file of the user, or the published ones; report a mistake in the file."""
    given = block.below(("damage", "file"))
    if given is None or not isinstance(given.data, str):
        return PUBLISHED_DAMAGE
    path = (Path(given.mark.folder) / Path(given.data).expanduser()).resolve()
    files[given.path] = str(path)
    try:
        if not path.is_file():
            raise ValueError(f"no such file: {path}")
        return read_damage_laws(path)
    except (ValueError, OSError) as error:
        diagnostics.append(Diagnostic(given.mark, given.name, str(error)))
        return PUBLISHED_DAMAGE


def _validated(model: type[Model], block: Value, diagnostics: list[Diagnostic]) -> Model | None:
    try:
        return model.model_validate(block.plain)
    except ValidationError as error:
        diagnostics += (located(block, model, each) for each in error.errors())
        return None


def _located_in(value: Value, file: str) -> Value:
    """Return a mapping with the place where a file writes into it, in place of that in an option that came before."""
    if not isinstance(value.data, dict):
        return value
    items = {key: _located_in(item, file) for key, item in value.data.items()}
    own = next((item.key for item in items.values() if item.key.file == file), None)
    if own is None or value.key.file == file:
        return replace(value, data=items)
    return replace(value, data=items, key=own, mark=own)


def _laser_of(root: Value, block: Value, references: References, diagnostics: list[Diagnostic]) -> Value | None:
    """Return the laser that the settings name, or the only laser, with references resolved; None for a mistake."""
    lasers = {str(name): value for name, value in (root.items[LASERS].items if LASERS in root.items else {}).items()}
    given = block.child("laser")
    if given is not None and given.data is not None:
        if str(given.data) not in lasers:
            message = f"{given.data} is no laser of the recipe; {nearest(str(given.data), lasers)}"
            diagnostics.append(Diagnostic(given.mark, given.name, message))
            return None
        name = str(given.data)
    elif len(lasers) != 1:
        several = f"the recipe has the lasers {', '.join(lasers)}: write safety.laser=NAME"
        diagnostics.append(Diagnostic(block.key, KEY, several if lasers else "the recipe has no laser"))
        return None
    else:
        name = next(iter(lasers))
    return references.resolve(lasers[name], Scope({}, f"{LASERS}.{name}"))


def _laser(item: Value, diagnostics: list[Diagnostic]) -> Laser | None:
    """Return the light of a laser, without the values that steps of the recipe read; report each mistake."""
    if not isinstance(item.data, dict):
        diagnostics.append(Diagnostic(item.mark, item.name, f"must be a mapping of values, not {kind(item)}"))
        return None
    own = Value({k: v for k, v in item.data.items() if k in Laser.model_fields}, item.key, item.key, item.path)
    laser = _validated(Laser, own, diagnostics)
    try:
        if laser is not None:
            laser.beam()
    except ParameterError as error:
        value = item.child(error.parameter)
        diagnostics.append(Diagnostic(value.mark if value else item.key, f"{item.name}.{error.parameter}", str(error)))
        return None
    return laser


def _leaves(value: Value, path: Where) -> Iterator[tuple[Where, Value]]:
    """Yield each single value below a mapping with the path of its setting, which is not where a reference leads."""
    for key, child in value.items.items():
        if isinstance(child.data, dict):
            yield from _leaves(child, (*path, key))
        else:
            yield (*path, key), child
