"""The loss function of a mask design: its terms, the camera's laws and the shade."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from neusee.nodes import losses
from neusee.nodes.values import Bands, Psf, Pupil, Shade, Stop, band_names
from neusee.workflows.engine.differentiable_function import as_function
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.recipe_graph import Recipe, Step, needed
from neusee.workflows.recipe.blocks.train_block import DesignError, MaskTraining, need_steps
from neusee.workflows.store.result_store import Store

# --- camera laws ----------------------------------------------------------------------------------

# Uncertainties of the camera in a mask design: distributions of defocus, wavelength and direction,
# and their sampling.


# a prime larger than any number of iterations, so that the seeds of all draws differ
_PRIME = 1_000_003
_OUTER_POINT = 3**0.5  #: distance of the outer quadrature points of a law, in standard deviations

#: defocus, wavelength, direction on y and on x, in standard deviations
State = tuple[float, float, float, float]
NOMINAL: State = (0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class CameraLaws:
    """Independent normal distributions of defocus, wavelength and direction around the values of
    the recipe.
    """

    spreads: State  #: standard deviations in waves, m, rad and rad
    defocus: Mapping[str, float]  #: the parameter of the pupil and its value in the recipe
    #: the parameter of the PSF and its value in the recipe
    angle: Mapping[str, tuple[float, float]]
    seed: int

    @classmethod
    def of(cls, recipe: Recipe, settings: MaskTraining) -> CameraLaws:
        """Return the laws of the settings, with the recipe parameters that they vary.

        Raises: `DesignError` if the PSF has no defocus or no direction that could be moved.
        """
        step, direction = recipe.steps[settings.psf], settings.direction_spread
        pupil, defocus = step.wires.get("pupil"), dict[str, float]()
        if settings.defocus_spread:
            if not isinstance(pupil, str) or "defocus" not in recipe.steps[pupil].params:
                text = f"the pupil of {settings.psf} has no defocus: remove it, or name another psf"
                raise DesignError(f"defocus_spread: {text}")
            defocus = {f"{pupil}.defocus": float(recipe.steps[pupil].params["defocus"])}
        if direction and "angle" not in step.params:
            raise DesignError(
                f"direction_spread: {settings.psf} has no angle: remove it, or name an optics.psf"
                " step"
            )
        angle = {f"{settings.psf}.angle": step.params["angle"]} if direction else {}
        return cls(
            (settings.defocus_spread, settings.wavelength_spread, direction, direction),
            defocus,
            angle,
            settings.seed,
        )

    @property
    def certain(self) -> bool:
        """Return True if no parameter is uncertain."""
        return not any(self.spreads)

    @property
    def free(self) -> tuple[str, ...]:
        """Return the recipe parameters that the laws vary."""
        return (*self.defocus, *self.angle)

    def values(self, state: State) -> dict[str, Any]:
        """Return the values of the varied recipe parameters in a state."""
        # element 1 is the wavelength, which shifts the bands in `moved`
        defocus_change, _, *angle_changes = (
            spread * x for spread, x in zip(self.spreads, state, strict=True)
        )
        params: dict[str, Any] = {
            name: nominal + defocus_change for name, nominal in self.defocus.items()
        }
        return params | {
            name: tuple(
                angle + change for angle, change in zip(nominal, angle_changes, strict=True)
            )
            for name, nominal in self.angle.items()
        }

    def moved(self, bands: Bands, state: State) -> Bands:
        """Return the bands with all wavelengths shifted as in ``state``."""
        return bands._replace(centres=bands.centres + self.spreads[1] * state[1])

    def drawn(self, number: int) -> State:
        """Draw the state of the iteration ``number``."""
        # downward, so that seeds differ from those of `Terms.drawn`
        rng = torch.Generator().manual_seed(self.seed * _PRIME - number - 1)
        defocus, wavelength, y, x = torch.randn(4, generator=rng, dtype=torch.float64).tolist()
        return defocus, wavelength, y, x

    def points(self) -> list[tuple[State, float]]:
        """Return 2 d + 1 states with their weights, a quadrature for d uncertain numbers that is
        exact for polynomials of degree 3.

        For d = 1 these are the points of Gauss-Hermite quadrature.
        """
        uncertain = [position for position, spread in enumerate(self.spreads) if spread]
        # unscented points: the centre, and sqrt(3) standard deviations up and down each axis
        points = [(NOMINAL, 1 - len(uncertain) / 3)]
        for position in uncertain:
            for distance in (-_OUTER_POINT, _OUTER_POINT):
                state = [0.0] * len(self.spreads)
                state[position] = distance
                points.append(((state[0], state[1], state[2], state[3]), 1 / 6))
        return points


# --- learnt shade ---------------------------------------------------------------------------------

# The shade in front of a mask during its design: its transmittance, and a stop that is trained with
# the mask.


@dataclass(frozen=True)
class LearntShade:
    """The shade step of a recipe, with its result as in the recipe and with its stop fully open."""

    step: str
    own: Shade
    wide: Shade
    learnt: bool

    @classmethod
    def of(
        cls, recipe: Recipe, settings: MaskTraining, store: Store | None, device: str
    ) -> LearntShade | None:
        """Return the shade in the pupil of the mask, or None if the pupil has none.

        Raises: `DesignError` if a stop is to be learnt and the pupil has no shade of `doe.shade`.
        """
        pupil = recipe.steps[settings.psf].wires.get("pupil")
        name = recipe.steps[pupil].wires.get("shade") if isinstance(pupil, str) else None
        if not isinstance(name, str) or recipe.steps[name].node.path != "doe.shade":
            if settings.learn_stop:
                text = (
                    f"the pupil of {settings.psf} has no shade whose stop could be learnt: use"
                    " doe=shaded"
                )
                raise DesignError(f"learn_stop: {text}, or remove learn_stop")
            return None
        open_shade = run(stopped(recipe, name, 1.0), store, [name], device=device)[name]
        own_shade = run(recipe, store, [name], device=device)[name]
        return cls(name, own_shade, open_shade, settings.learn_stop)

    def behind(self, stop: Tensor | None) -> Shade:
        """Return the shade with the amplitude ``stop`` in place of its own stop; unchanged for
        None.
        """
        return (
            self.own if stop is None else self.wide._replace(amplitude=self.wide.amplitude * stop)
        )

    def passed(self, stop: Tensor | None) -> Tensor:
        """Return the transmittance of the shade outside its notches."""
        passed_light = self.behind(stop).amplitude.double().square().sum()
        # over the number of samples in the fully open shade
        return passed_light / torch.count_nonzero(self.wide.amplitude)


def stopped(recipe: Recipe, shade: str, diameter: float) -> Recipe:
    """Return the recipe with another stop diameter in its shade."""
    step = recipe.steps[shade]
    changed = replace(step, params={**step.params, "diameter": diameter})
    return replace(recipe, steps={**recipe.steps, shade: changed})


# --- design terms ---------------------------------------------------------------------------------

# The loss function of a mask design and its terms, computed from the PSF of the mask.

_FREE = "not limited"


@dataclass(frozen=True)
class Fabrication:
    """The fabrication limits of a designed mask by name, such as its greatest height; None for no
    limit.
    """

    values: Mapping[str, Any]

    @classmethod
    def of(cls, recipe: Recipe, settings: MaskTraining) -> Fabrication:
        """Return the fabrication limits from the `doe.fabricate` step of the recipe and from the
        settings.
        """
        steps = (recipe.steps[name] for name in needed(recipe, [settings.psf]))
        params = next((step.params for step in steps if step.node.path == "doe.fabricate"), {})
        limits = {name: params.get(name) for name in ("levels", "max_height", "wrap_at")}
        return cls({**limits, "feature": settings.feature})

    def rows(self) -> list[tuple[str, str]]:
        """Return the name and the value of each fabrication limit as text."""
        labels = {
            "levels": "levels",
            "max_height": "greatest height",
            "wrap_at": "wrapped at one wave of",
            "feature": "least feature",
        }
        texts = {
            name: _FREE if x is None else f"{x * 1e6:.4g} um" for name, x in self.values.items()
        }
        if (levels := self.values["levels"]) is not None:
            texts["levels"] = str(levels)
        return [(labels[name], text) for name, text in texts.items()]

    def __str__(self) -> str:
        return (
            ", ".join(f"{name} {text}" for name, text in self.rows() if text != _FREE)
            or "no limits"
        )


class Terms:
    """The loss function of a mask design and its terms, for all or selected spectral bands of a
    recipe.
    """

    def __init__(
        self, recipe: Recipe, settings: MaskTraining, store: Store | None, device: str = "cpu"
    ) -> None:
        need_steps(recipe.steps, settings)
        self.settings = settings
        self.fabrication = Fabrication.of(recipe, settings)
        # exact, because cheaper steps with error bounds have no gradient
        self.recipe = replace(recipe, exact=True)
        self._bands = _bands_step(self.recipe, settings.psf)
        self.laws = CameraLaws.of(self.recipe, settings)
        self.shade = LearntShade.of(self.recipe, settings, store, device)
        self._learnt = [self.shade.step] if self.shade and self.shade.learnt else []
        free_inputs = [settings.height, self._bands, *self._learnt, *self.laws.free]
        self._function = as_function(
            self.recipe, *free_inputs, outputs=[settings.psf], store=store, device=device
        )
        colour_steps = (
            [settings.illuminant, settings.responses] if settings.weights.coloured else []
        )
        stop = self.mask_step.wires.get("stop")
        stop_steps = [stop] if isinstance(stop, str) else []
        results = run(
            self.recipe,
            store,
            [self._bands, settings.plain, *colour_steps, *stop_steps],
            device=device,
        )
        self._seen: list[Tensor] = [results[name] for name in colour_steps]
        self.bands: Bands = results[self._bands]
        self._plain: Psf = results[settings.plain]
        self._stop: Stop | None = results[stop_steps[0]] if stop_steps else None
        self.device = self._plain.intensity.device

    @property
    def mask_step(self) -> Step:
        """Return the step of the recipe whose height map is replaced by the designed mask."""
        return self.recipe.steps[self.settings.height]

    @property
    def stop(self) -> Stop:
        """Return the aperture stop on the pupil grid on which the mask is computed."""
        if self._stop is None:
            raise DesignError(
                f"height: the step {self.settings.height} has no input `stop`: name the step of a"
                " mask"
            )
        return self._stop

    def psf(
        self,
        height: Tensor,
        indices: Sequence[int] | None = None,
        state: State = NOMINAL,
        stop: Tensor | None = None,
    ) -> Psf:
        """Return the PSF of a mask from its height map, for the spectral bands ``indices`` or for
        all bands.

        ``state`` shifts the uncertain parameters, in standard deviations. ``stop`` is the amplitude
        of a trained stop.
        """
        bands = self.laws.moved(_some(self.bands, indices), state)
        values: dict[str, Any] = {
            self.settings.height: height,
            self._bands: bands,
            **self.laws.values(state),
        }
        if self.shade is not None and self._learnt:
            values[self.shade.step] = self.shade.behind(stop)
        psf: Psf = self._function(values)[self.settings.psf]
        return psf

    def pupil(self, height: Tensor) -> Pupil:
        """Return the pupil function of a mask from its height map."""
        name = self.recipe.steps[self.settings.psf].wires.get("pupil")
        if not isinstance(name, str):
            raise DesignError(
                f"psf: the step {self.settings.psf} has no input `pupil`: name an optics.psf step"
            )
        function = as_function(
            self.recipe, self.settings.height, outputs=[name], device=str(self.device)
        )
        pupil: Pupil = function({self.settings.height: height})[name]
        return pupil

    def plain(self, indices: Sequence[int] | None = None) -> Psf:
        """Return the PSF of the lens without a mask, for the spectral bands ``indices`` or for
        all bands.
        """
        psf: Psf = _some(self._plain, indices)
        return psf

    def parts(
        self,
        height: Tensor,
        indices: Sequence[int] | None = None,
        number: int | None = None,
        stop: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """Return the terms of the mask loss that have a weight above 0, by name, each as a mean
        over spectral bands.

        The uncertain parameters are drawn for iteration ``number``; for None the terms are
        expectations, by a quadrature with 2 d + 1 points for d uncertain numbers. ``stop`` is the
        amplitude of a trained stop.
        """
        points = self.laws.points() if number is None else [(self.laws.drawn(number), 1.0)]
        if self.laws.certain:
            points = [(NOMINAL, 1.0)]
        weighted_terms = [
            (self._parts(height, indices, state, stop), share) for state, share in points
        ]
        return {
            name: torch.stack([share * terms[name] for terms, share in weighted_terms]).sum()
            for name in weighted_terms[0][0]
        }

    def _parts(
        self, height: Tensor, indices: Sequence[int] | None, state: State, stop: Tensor | None
    ) -> dict[str, Tensor]:
        """Return the terms with a weight above 0, by name, in one state.

        Each term is a mean over the bands.
        """
        settings, weights, psf = (
            self.settings,
            self.settings.weights,
            self.psf(height, indices, state, stop),
        )
        band_sums = {}
        if weights.lsr:
            band_sums["lsr"] = self._suppression(psf)
        if weights.bsr:
            band_sums["bsr"] = losses.background_loss(psf)
        if weights.contrast:
            band_sums["contrast"] = losses.contrast(psf, floor=settings.floor, up_to=settings.up_to)
        terms = {name: term / len(psf.intensity) for name, term in band_sums.items()}
        if weights.wiener:  # not a sum over bands, because each channel depends on all bands
            terms["wiener"] = losses.wiener(
                psf,
                *self.seen(indices),
                noise=settings.noise_share,
                colour=settings.colour,
                up_to=settings.up_to,
            )
        for name in ("filtered_error", "information"):
            if getattr(weights, name):
                # parameters of both losses
                shared = {**self.exposure(), **self.passed(stop), "power": settings.power}
                terms[name] = getattr(losses, name)(psf, *self.seen(indices), **shared)
        return terms

    def passed(self, stop: Tensor | None = None) -> dict[str, Any]:
        """Return the transmittance of a shade in front of the mask, as a parameter for a loss."""
        return {} if self.shade is None else {"transmittance": self.shade.passed(stop)}

    def exposure(self) -> dict[str, Any]:
        """Return the common parameters of `losses.filtered_error`, `losses.information` and
        `losses.ProtectedPicture`.
        """
        settings = self.settings
        return {
            "light": settings.light,
            "read_noise": settings.read_noise,
            "veil": settings.veil,
            "limit": settings.limit,
            "contrast": settings.contrast_variance,
            "up_to": settings.up_to,
        }

    def seen(self, indices: Sequence[int] | None = None) -> tuple[Tensor, Tensor, Bands]:
        """Return illuminant, responses and bands, for the spectral bands ``indices`` or for all."""
        light, responses = (x if indices is None else x[..., list(indices)] for x in self._seen)
        return light, responses, _some(self.bands, indices)

    def _suppression(self, psf: Psf) -> Tensor:
        """Return the laser suppression loss summed over bands, limited from below by the setting
        ``enough``.
        """
        settings, count = self.settings, len(psf.intensity)
        loss: Tensor = losses.suppression_loss(psf, power=settings.power, log=settings.log)
        if settings.enough is None:
            return loss
        return loss.clamp_min(
            count * (math.log(settings.enough) if settings.log else settings.enough)
        )

    def total(self, parts: dict[str, Tensor]) -> Tensor:
        """Return the loss of a mask: the weighted sum of its terms."""
        return torch.stack(
            [getattr(self.settings.weights, name) * term for name, term in parts.items()]
        ).sum()

    def drawn(self, number: int) -> list[int] | None:
        """Return the random spectral bands of an iteration, one in each equal part of the spectrum;
        None for all.
        """
        count, all_bands = self.settings.bands, len(self.bands.centres)
        if count is None or count >= all_bands:
            return None
        rng = torch.Generator().manual_seed(self.settings.seed * _PRIME + number)
        # one random position in each of `count` equal parts
        band_positions = (torch.arange(count) + torch.rand(count, generator=rng)) * (
            all_bands / count
        )
        return [min(int(position), all_bands - 1) for position in band_positions]

    def even(self) -> list[int] | None:
        """Return the indices of evenly spaced spectral bands, or None for all bands."""
        count, all_bands = self.settings.bands, len(self.bands.centres)
        if count is None or count >= all_bands:
            return None
        return [round(float(position)) for position in torch.linspace(0, all_bands - 1, count)]


def _bands_step(recipe: Recipe, psf: str) -> str:
    """Return the name of the only `spectra.bands` step upstream of the PSF."""
    names = [
        name for name in needed(recipe, [psf]) if recipe.steps[name].node.path == "spectra.bands"
    ]
    if len(names) != 1:
        text = (
            f"{psf} depends on {len(names)} steps of spectra.bands ({', '.join(names)}), not on one"
            " step"
        )
        raise DesignError(f"psf: {text}")
    return names[0]


def _some(value: Any, indices: Sequence[int] | None) -> Any:
    """Return a PSF or another spectral value at the bands ``indices``; unchanged for None."""
    if indices is None:
        return value
    band_numbers = torch.tensor(list(indices))
    spectral_fields = {name: getattr(value, name) for name in band_names(value)}
    return value._replace(
        **{
            name: x.index_select(0, band_numbers.to(x.device))
            for name, x in spectral_fields.items()
        }
    )
