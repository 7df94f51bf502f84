"""What a mask design does not know for certain: laws of defocus, wavelength and direction, and how they are drawn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch

from neusee.nodes.values import Bands
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.recipe.blocks.mask_design_block import DesignError, MaskTraining

_PRIME = 1_000_003
_FAR = 3**0.5  #: standard deviations at which the outer points of a law lie

State = tuple[float, float, float, float]  #: defocus, wavelength, direction on y and on x, in standard deviations
NOMINAL: State = (0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class CameraLaws:
    """Normal laws of defocus, wavelength and direction around the values of the recipe, each independent."""

    spreads: State  #: standard deviations in waves, m, rad and rad
    defocus: Mapping[str, float]  #: the parameter of the pupil and its value in the recipe
    angle: Mapping[str, tuple[float, float]]  #: the parameter of the PSF and its value in the recipe
    seed: int

    @classmethod
    def of(cls, recipe: Recipe, settings: MaskTraining) -> CameraLaws:
        """Read the laws of the settings, and the parameters of the recipe that they move.

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
            raise DesignError(f"direction_spread: {settings.psf} has no angle: remove it, or name an optics.psf step")
        angle = {f"{settings.psf}.angle": step.params["angle"]} if direction else {}
        return cls((settings.defocus_spread, settings.wavelength_spread, direction, direction), defocus, angle,
                   settings.seed)  # fmt: skip

    @property
    def certain(self) -> bool:
        """Return True if nothing is uncertain."""
        return not any(self.spreads)

    @property
    def free(self) -> tuple[str, ...]:
        """Return the parameters of the recipe that the laws move."""
        return (*self.defocus, *self.angle)

    def values(self, state: State) -> dict[str, Any]:
        """Return the parameters of the recipe in a state."""
        defocus, _, *turns = (spread * x for spread, x in zip(self.spreads, state, strict=True))
        found: dict[str, Any] = {name: at + defocus for name, at in self.defocus.items()}
        return found | {name: tuple(a + b for a, b in zip(at, turns, strict=True)) for name, at in self.angle.items()}

    def moved(self, bands: Bands, state: State) -> Bands:
        """Return the bands with all their wavelengths moved together."""
        return bands._replace(centres=bands.centres + self.spreads[1] * state[1])

    def drawn(self, number: int) -> State:
        """Draw the state of the iteration ``number``."""
        rng = torch.Generator().manual_seed(self.seed * _PRIME - number - 1)
        defocus, wavelength, y, x = torch.randn(4, generator=rng, dtype=torch.float64).tolist()
        return defocus, wavelength, y, x

    def points(self) -> list[tuple[State, float]]:
        """Return 2 d + 1 states with their weights, for d uncertain numbers: exact for polynomials of degree 3.

        For d = 1 these are the points of Gauss-Hermite quadrature.
        """
        unknown = [place for place, spread in enumerate(self.spreads) if spread]
        found = [(NOMINAL, 1 - len(unknown) / 3)]
        for place in unknown:
            for far in (-_FAR, _FAR):
                state = [0.0] * len(self.spreads)
                state[place] = far
                found.append(((state[0], state[1], state[2], state[3]), 1 / 6))
        return found
