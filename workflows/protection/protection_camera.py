"""The camera of the protection study: its parts, the measurements of each front, and the unknown
conditions of an attack.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neusee.nodes import Node, metrics, optics
from neusee.nodes.doe import shade
from neusee.nodes.flare import dirt, stray_light, surface_of
from neusee.nodes.metrics import (
    TARGETS,
    GlareLevels,
    PictureSpectrum,
    PixelNoise,
    channel_psf,
    detail_energy,
    glare_levels,
    picture_spectrum,
    radial_contrast,
)
from neusee.nodes.values import Bands, Psf, Pupil, Stop
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import digest, file_digest, plain
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.recipe.distributions.law_text import read_law
from neusee.workflows.recipe.distributions.shapes import draw_laws
from neusee.workflows.store.result_store import Store, compute_once

# --- unknown conditions ---------------------------------------------------------------------------

# The unknown conditions of an attack as probability distributions, with one sampler for all of
# them.
#
# Studies and trainings draw the same conditions for the same seed: wavelength and direction of the
# laser, defocus of the lens, grease on the window, and light scattered by the lens. A study draws a
# list; a training uses the same `draw_laws` for the differences between the camera of one picture
# and the camera that its restorer assumes.

#: largest scattered share of the light; a lens that scatters all light has no picture
_MOST_SCATTER = 0.99


@dataclass(frozen=True)
class UnknownLaws:
    """The distributions of the unknown conditions, as texts such as ``normal(0 waves, 0.25
    waves)``.
    """

    wavelength: str = "uniform(400 nm, 700 nm)"  #: of the laser
    #: direction of the laser from the axis, in fields of view
    direction_y: str = "uniform(-0.25, 0.25)"
    direction_x: str = "uniform(-0.25, 0.25)"
    defocus: str = "normal(0 waves, 0.25 waves)"  #: of the lens, peak to valley at 550 nm
    #: phase of the grease on the window, root mean square at 550 nm
    grease: str = "loguniform(0.005 waves, 0.05 waves)"
    scatter: str = "lognormal(0.005, 2)"  #: share of the light that the lens scatters


@dataclass(frozen=True)
class Condition:
    """One draw of the unknown conditions, in SI units."""

    wavelength: float  #: m
    direction: tuple[float, float]  #: (y, x) from the axis, in fields of view
    defocus: float  #: waves at 550 nm
    grease: float  #: waves at 550 nm
    scatter: float  #: share of the light
    seed: int  #: random seed of the grease pattern

    @property
    def surfaces(self) -> dict[str, dict[str, float]]:
        """Return the parameter ``surfaces`` of `flare.stray_light` for this scattered share."""
        return {"lens": surface_of(self.scatter)}

    @property
    def plain(self) -> dict[str, float | list[float]]:
        """Return the condition as JSON values."""
        return {**asdict(self), "direction": list(self.direction)}


def draw_conditions(
    count: int, seed: int, laws: UnknownLaws | None = None, first: int = 0
) -> list[Condition]:
    """Return ``count`` independent draws of the conditions, starting with the draw number
    ``first``.

    Each draw depends only on its number, the seed and the laws, so that a larger ``count`` starts
    with the same draws.
    """
    texts: Mapping[str, str] = asdict(laws or UnknownLaws())
    columns = draw_laws(
        {name: read_law(text) for name, text in texts.items()}, count, [seed, 4], first
    )
    return [
        Condition(
            wavelength=columns["wavelength"][draw],
            direction=(columns["direction_y"][draw], columns["direction_x"][draw]),
            defocus=columns["defocus"][draw],
            grease=columns["grease"][draw],
            scatter=min(columns["scatter"][draw], _MOST_SCATTER),
            seed=seed + first + draw,
        )
        for draw in range(count)
    ]


def usual_condition(laws: UnknownLaws | None = None) -> Condition:
    """Return the condition with median values, no defocus, the laser on the axis and a clean
    window.
    """
    texts: Mapping[str, str] = asdict(laws or UnknownLaws())
    medians = {name: read_law(text).median for name, text in texts.items()}
    return Condition(medians["wavelength"], (0.0, 0.0), 0.0, 0.0, medians["scatter"], 0)


# --- camera parts ---------------------------------------------------------------------------------

# The parts of a recipe's camera that the protection study needs: lens, mask, sensor, light, and
# their nodes.


_NEEDED = (
    "psf[mask]",
    "pupil[mask]",
    "pupil[plain]",
    "illuminant",
    "responses",
    "read[mask]",
    "well[mask]",
)
_NO_MASK_LSR = 0.9  #: laser suppression ratio above which a mask is too weak to compare


@dataclass(frozen=True)
class ProtectionCamera:
    """Lens, mask and sensor of a recipe as values and parameters, from which PSFs with any shade
    are computed.
    """

    recipe: Recipe
    height: Tensor
    flat: Tensor
    stop: Stop
    bands: Bands  #: some bands of the recipe over the whole range, for the scene
    laser_bands: Bands  #: all bands of the recipe, for a laser that may have any wavelength
    illuminant: Tensor
    responses: Tensor
    keys: tuple[str, ...]  #: cache keys of these values

    @classmethod
    def of(cls, recipe: Recipe, store: Store, count: int) -> ProtectionCamera:
        """Return the camera of a recipe with ``count`` of its bands; raise ValueError for an
        unsuitable recipe.
        """
        _refuse_unsuitable(recipe)
        mask_wires, plain_wires = (recipe.steps[f"pupil[{arm}]"].wires for arm in ("mask", "plain"))
        names = [
            str(wire)
            for wire in (
                mask_wires["height"],
                plain_wires["height"],
                mask_wires["stop"],
                mask_wires["bands"],
            )
        ]
        names += ["illuminant", "responses"]
        result = run(recipe, store, dict.fromkeys(names))
        height, flat, stop, bands, illuminant, responses = (result.values[name] for name in names)
        # evenly spaced indices from the first band to the last
        chosen_indices = (
            torch.linspace(0, len(bands.centres) - 1, min(count, len(bands.centres))).round().long()
        )
        chosen_bands = Bands(*(values[chosen_indices] for values in bands))
        keys = tuple(result.keys[name] for name in names)
        return cls(
            recipe,
            height,
            flat,
            stop,
            chosen_bands,
            bands,
            illuminant[chosen_indices],
            responses[:, chosen_indices],
            keys,
        )

    @property
    def lens(self) -> Mapping[str, Any]:
        """Return the parameters of the recipe's PSF."""
        step = self.recipe.steps["psf[mask]"]
        if step.node.path == "flare.stray_light":
            step = self.recipe.steps[str(step.wires["psf"])]
        return step.params

    @property
    def noise(self) -> Mapping[str, float]:
        """Return the read noise and the full well of the recipe's sensor, in e-."""
        read_params, well_params = (
            self.recipe.steps[name].params for name in ("read[mask]", "well[mask]")
        )
        return {
            "read_noise": float(read_params["read_noise"]),
            "full_well": float(well_params["capacity"]),
        }

    def pixel(self, prnu: float, residual_glare: float) -> PixelNoise:
        """Return the noise of a pixel of the recipe's sensor."""
        return PixelNoise(**self.noise, prnu=prnu, residual_glare=residual_glare)

    def psf(
        self,
        masked: bool,
        diameter: float,
        bands: Bands,
        condition: Condition | None = None,
        **options: Any,
    ) -> Psf:
        """Return the PSF with or without the mask, with a stop of relative ``diameter``, under a
        condition.
        """
        # `notches` and `depth` are options of the shade; all others are parameters of the PSF
        notches = {name: options.pop(name) for name in ("notches", "depth") if name in options}
        psf: Psf = optics.psf(
            self._front(masked, diameter, bands, condition, **notches), **{**self.lens, **options}
        )
        return psf

    def laser_psf(
        self, masked: bool, diameter: float, line: Bands, condition: Condition, **options: Any
    ) -> Psf:
        """Return the PSF of a laser at the direction ``angle``, including the light scattered by
        the lens.
        """
        # `notches` and `depth` are options of the shade; all others are parameters of the PSF
        notches = {name: options.pop(name) for name in ("notches", "depth") if name in options}
        front = self._front(masked, diameter, line, condition, **notches)
        lens = {**self.lens, **options}
        sizes = {name: lens[name] for name in ("focal_length", "pixel_pitch", "angle")}
        aperture = float(self.stop.diameter)
        psf: Psf = stray_light(
            optics.psf(front, **lens),
            front,
            surfaces=condition.surfaces,
            diameter=aperture,
            **sizes,
        )
        return psf

    def _front(
        self,
        masked: bool,
        diameter: float,
        bands: Bands,
        condition: Condition | None,
        **notches: Any,
    ) -> Pupil:
        """Return the pupil with or without the mask, with a stop of relative ``diameter``.

        A condition adds defocus and a film of grease; ``notches`` are options of `doe.shade`.
        """
        pupil_step = self.recipe.steps["pupil[mask]"]
        index_step = self.recipe.steps[str(pupil_step.wires["index"])]
        height = self.height if masked else self.flat
        params = dict(pupil_step.params)
        grease_film = None
        if condition is not None:
            params["defocus"] = float(params.get("defocus", 0.0)) + condition.defocus
            grease_film = self._film(condition)
        shaded = shade(self.stop, diameter=diameter, **notches)
        front: Pupil = optics.pupil(
            height,
            index_step.node(bands, **index_step.params),
            bands,
            self.stop,
            grease_film,
            shade=shaded,
            **params,
        )
        return front

    def _film(self, condition: Condition) -> Any:
        """Return the film of grease on the window, or None for a clean window."""
        if not condition.grease:
            return None
        return dirt(
            self.stop, grease=condition.grease, rng=torch.Generator().manual_seed(condition.seed)
        )

    def laser_line(self, wavelength: float) -> Bands:
        """Return one narrow band at the wavelength of a laser."""
        unit = torch.ones(1, dtype=torch.float64)
        # centre, width of 1 nm, weight
        return Bands(unit * wavelength, unit * 1e-9, unit)

    def laser_colour(self, line: Bands) -> Tensor:
        """Return the response of each channel to a laser, relative to the most responsive channel
        (channel,).
        """
        step = self.recipe.steps["responses"]
        response: Tensor = step.node(line, **step.params)[:, 0].double()
        return response / response.max() if float(response.max()) > 0 else torch.ones_like(response)

    @property
    def nodes(self) -> tuple[Node, ...]:
        """Return the nodes whose code determines a PSF or a measure of it."""
        index_node = self.recipe.steps[str(self.recipe.steps["pupil[mask]"].wires["index"])].node
        own_nodes = (
            optics.psf,
            optics.pupil,
            shade,
            dirt,
            stray_light,
            metrics.lsr,
            metrics.heat_ratio,
            metrics.filtered_picture,
        )
        return (*own_nodes, index_node, self.recipe.steps["responses"].node)


def _refuse_unsuitable(recipe: Recipe) -> None:
    """Raise ValueError if the recipe lacks a step, or if its mask is already shaded."""
    missing = [name for name in _NEEDED if name not in recipe.steps]
    if missing:
        raise ValueError(
            f"the recipe {recipe.name} has no step {missing[0]}: study a recipe of the camera with"
            " the arms plain and mask, such as five_half_rings"
        )
    if recipe.steps["pupil[mask]"].wires.get("shade"):
        raise ValueError(
            "the mask of this recipe is shaded already: choose the mask alone, such as doe=axicon,"
            " because the study adds filters and stops itself"
        )


def refuse_no_mask(lsr: float) -> None:
    """Raise ValueError for a mask that hardly lowers the peak."""
    if lsr > _NO_MASK_LSR:
        raise ValueError(
            f"the mask of this recipe lowers the peak of a laser to {lsr:.3g} only: choose a mask,"
            " such as doe=axicon"
        )


# --- front optics ---------------------------------------------------------------------------------

# A front is a lens with or without the mask and with a stop of some diameter. Each is measured only
# once.
#
# A grey filter needs no front of its own: it scales the light of scene and laser.


_ABOUT = {"step": "study protection"}
_SOURCES = (channel_psf, picture_spectrum, detail_energy, glare_levels)


@dataclass(frozen=True)
class Front:
    """A lens with or without the mask, with a stop of relative ``diameter``, or with a notch
    filter.
    """

    masked: bool
    diameter: float = 1.0
    notch: float | None = None  #: m, centre of a notch filter
    depth: float = 0.0  #: depth of the notch

    @property
    def notches(self) -> dict[str, Any]:
        """Return the parameters of `doe.shade` for the notch filter; empty without one."""
        return {} if self.notch is None else {"notches": (self.notch,), "depth": self.depth}


@dataclass(frozen=True)
class FrontMeasures:
    """The measurements of one front under one condition."""

    spectrum: PictureSpectrum
    energy: Mapping[str, Tensor]  #: by target (channel,)
    peak: float  #: laser suppression ratio in the worst of all bands of the recipe
    #: heat of the hottest pixel relative to the clear lens in the worst band; NaN if not requested
    heat: float
    radius: Tensor  #: (ring,) cycles per pixel
    square: Tensor  #: (ring,) mean of |OTF|**2
    glare: Mapping[int, GlareLevels]  #: by side length of the field in pixels
    colour: Tensor  #: (channel,) response to the laser


@dataclass(frozen=True)
class FrontSettings:
    """The settings of the protection study that determine the measurements of a front."""

    variance: float  #: contrast variance of the scene
    up_to: float  #: cycles per pixel, highest frequency in the mean log NEQ
    size: float  #: height of the targets in pixels
    fields: tuple[int, ...]  #: side lengths of the fields in pixels
    dwell: float | None  #: s, dwell time for the heat; None: only the peak counts


class FrontBench:
    """Measures fronts of one camera, each only once, because the store keeps the results."""

    def __init__(self, camera: ProtectionCamera, store: Store, settings: FrontSettings) -> None:
        """Prepare measurements of fronts; the store keeps each under a key of camera, code and
        settings.
        """
        self.camera, self.store, self.settings = camera, store, settings
        self._psfs: dict[Front, Psf] = {}
        self._harms: dict[Front, dict[str, Tensor]] = {}
        code = Code(store.code_memo)
        files = [file_digest(Path(inspect.getfile(source))) for source in _SOURCES]
        files += [file_digest(Path(__file__)), file_digest(Path(inspect.getfile(ProtectionCamera)))]
        steps_with_params = [
            camera.recipe.steps[name]
            for name in ("psf[mask]", "pupil[mask]", "index", "responses")
            if name in camera.recipe.steps
        ]
        params = [
            {name: plain(value) for name, value in step.params.items()}
            for step in steps_with_params
        ]
        self._key = [
            camera.keys,
            [code.of(node) for node in camera.nodes],
            files,
            params,
            camera.bands.centres.tolist(),
            camera.laser_bands.centres.tolist(),
            repr(settings),
        ]

    def measure(self, front: Front, condition: Condition) -> FrontMeasures:
        """Return the measurements of a front under a condition, from the store or computed now."""
        key = digest("protection front", self._key, repr(front), condition.plain)
        measures = compute_once(
            self.store, key, dict, lambda: self._measure(front, condition), _ABOUT
        )
        return _measures(measures)

    def _measure(self, front: Front, condition: Condition) -> dict[str, Tensor]:
        """Measure a front under a condition; return tensors by name that the store can save.

        The filter assumes the PSF without the condition, while the picture has the true PSF.
        """
        camera, settings = self.camera, self.settings
        light_of_scene = camera.illuminant, camera.responses, camera.bands
        assumed_psf, true_psf = self._told_psf(front), self._psf(front, camera.bands, condition)
        true_channels = channel_psf(true_psf, *light_of_scene)
        assumed_channels = channel_psf(assumed_psf, *light_of_scene)
        spectrum = picture_spectrum(
            true_channels, assumed_channels, settings.variance, settings.up_to
        )
        radius, square = radial_contrast(true_psf, *light_of_scene)
        measures: dict[str, Tensor] = {
            f"spectrum.{name}": values for name, values in spectrum._asdict().items()
        }
        measures |= {
            f"energy.{name}": values
            for name, values in detail_energy(true_psf, *light_of_scene, settings.size).items()
        }
        measures |= {"radius": radius, "square": square, **self._harm(front)}
        return measures | self._glare(front, condition)

    def _harm(self, front: Front) -> dict[str, Tensor]:
        """Return peak and heat in the worst of all bands of the recipe, computed once.

        A mask may transmit a laser in a narrow band between the few bands of the scene.
        """
        if front not in self._harms:
            bands = self.camera.laser_bands
            # split into single bands
            split_columns = (torch.split(values, 1) for values in bands)
            single_bands = (Bands(*values) for values in zip(*split_columns, strict=True))
            peaks, heats = zip(*(self._harm_in(front, band) for band in single_bands), strict=True)
            self._harms[front] = {
                "peak": torch.stack(peaks).max(),
                "heat": torch.stack(heats).max(),
            }
        return self._harms[front]

    def _harm_in(self, front: Front, band: Bands) -> tuple[Tensor, Tensor]:
        """Return peak and heat in one band, both relative to the clear lens."""
        psf = self._psf(front, band, None)
        peak = metrics.lsr(psf).max()
        if self.settings.dwell is None:
            return peak, torch.tensor(torch.nan, dtype=torch.float64)
        clear_psf = self._psf(Front(False), band, None)
        pitch = self.camera.lens["pixel_pitch"]
        return (
            peak,
            metrics.heat_ratio(psf, clear_psf, pixel_pitch=pitch, dwell=self.settings.dwell).max(),
        )

    def _told_psf(self, front: Front) -> Psf:
        """Return the PSF that the filter assumes, without the unknown conditions, computed once."""
        if front not in self._psfs:
            self._psfs[front] = self._psf(front, self.camera.bands, None)
        return self._psfs[front]

    def _psf(self, front: Front, bands: Bands, condition: Condition | None, **options: Any) -> Psf:
        """Return the PSF of a front in ``bands``, with or without a condition."""
        return self.camera.psf(
            front.masked, front.diameter, bands, condition, **front.notches, **options
        )

    def _laser_psf(self, front: Front, line: Bands, condition: Condition, **options: Any) -> Psf:
        """Return the PSF of a laser behind a front, including the light scattered by the lens."""
        return self.camera.laser_psf(
            front.masked, front.diameter, line, condition, **front.notches, **options
        )

    def _glare(self, front: Front, condition: Condition) -> dict[str, Tensor]:
        """Return the levels of a laser's light over each field, including the light scattered by
        the lens.

        Wider fields are computed only for a laser on the axis, and only as far as the pupil
        sampling allows.
        """
        camera = self.camera
        laser_band = camera.laser_line(condition.wavelength)
        glare = {"colour": camera.laser_colour(laser_band)}
        smallest_field = min(self.settings.fields)
        spot_pixels = (
            condition.direction[0] * smallest_field,
            condition.direction[1] * smallest_field,
        )
        radians_per_pixel = camera.lens["pixel_pitch"] / camera.lens["focal_length"]
        # directions off the axis refer to the smallest field
        for side in (
            self.settings.fields if condition.direction == (0.0, 0.0) else (smallest_field,)
        ):
            shape, angle = (
                (side, side),
                (spot_pixels[0] * radians_per_pixel, spot_pixels[1] * radians_per_pixel),
            )
            try:
                laser_psf = self._laser_psf(front, laser_band, condition, shape=shape, angle=angle)
            except ValueError:  # the pupil is too coarse
                if side == smallest_field:
                    raise
                continue
            levels = glare_levels(laser_psf.intensity[0], float(laser_psf.clear_peak))
            glare |= {f"level.{side}": levels.level, f"share.{side}": levels.share}
        return glare


def _measures(stored: Mapping[str, Any]) -> FrontMeasures:
    """Return measurements from their stored form."""
    sides = [int(name.removeprefix("level.")) for name in stored if name.startswith("level.")]
    return FrontMeasures(
        PictureSpectrum(*(stored[f"spectrum.{name}"] for name in PictureSpectrum._fields)),
        {name: stored[f"energy.{name}"] for name in TARGETS},
        float(stored["peak"]),
        float(stored["heat"]),
        stored["radius"],
        stored["square"],
        {side: GlareLevels(stored[f"level.{side}"], stored[f"share.{side}"]) for side in sides},
        stored["colour"],
    )
