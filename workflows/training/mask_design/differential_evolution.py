"""Optimisation of a mask of half-rings by differential evolution, which can continue after an interruption."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from neusee.nodes.doe import Written, half_rings, wave_height
from neusee.nodes.values import Stop
from neusee.workflows.recipe.blocks.mask_design_block import DesignError, MaskTraining
from neusee.workflows.training.loop.checkpoint import StateFile
from neusee.workflows.training.loop.resumable_loop import Progress
from neusee.workflows.training.mask_design.design_terms import Terms
from neusee.workflows.training.mask_design.learnt_mask import LearntMask

_USUAL = (12.0, 18.0, 24.0, 30.0, 36.0, 1.0, 0.0)  #: parameters of a hand-designed mask of half-rings


def half_ring_height(genes: Any, settings: MaskTraining) -> Callable[[Stop], Tensor]:
    """Return a function that computes the height map of a mask of half-rings from a vector of its parameters."""
    *slopes, side, turn = (float(gene) for gene in genes)
    given = {"waves": tuple(slopes), "alternate": side >= 0.5, "orientation": turn}

    def height(stop: Stop) -> Tensor:
        made: Tensor = half_rings(stop, **given, wavelength=settings.wavelength, material=settings.material)
        return made

    return height if settings.feature is None else Written(height, settings.feature)


class _LossOfGenes:
    """The loss of a mask of half-rings as a function of its parameter vector (genes).

    When an interrupted optimisation continues, the stored losses are returned without computation.
    """

    def __init__(self, terms: Terms, state: StateFile, progress: Progress) -> None:
        self.terms, self.state = terms, state
        self.known: list[float] = list(state.read(strict=False).get("values", []))
        self.asked, self.chosen = 0, terms.even()  # None: all bands
        if self.known:
            progress(f"continues after {len(self.known)} masks")

    def __call__(self, genes: Any) -> float:
        if self.asked == len(self.known):
            with torch.no_grad():
                height = half_ring_height(genes, self.terms.settings)(self.terms.stop)
                loss = float(self.terms.total(self.terms.parts(height.to(self.terms.device), self.chosen)))
            if not math.isfinite(loss):
                slopes = [float(gene) for gene in genes[:-2]]
                raise DesignError(f"mask number {self.asked}: the loss at slopes {slopes} is NaN or infinite")
            self.known.append(loss)
            if len(self.known) % (self.terms.settings.save_every * 10) == 0:
                self.state.write({"values": self.known})
        self.asked += 1
        return self.known[self.asked - 1]


def evolve(terms: Terms, state: StateFile, progress: Progress) -> LearntMask:
    import numpy as np

    settings = terms.settings
    if (most := _steepest(terms)) < settings.slopes[1]:
        progress(f"slopes above {most:.3g} waves are too steep for the samples of the pupil: use more samples")
    loss, history = _LossOfGenes(terms, state, progress), list[dict[str, float]]()
    populations: list[tuple[float, Any]] = []
    bounds = np.array([settings.slopes] * 5 + [(0.0, 1.0), (0.0, math.pi)])
    for start in range(settings.starts):
        least, genes = _population(loss, bounds, start, history, progress)
        slopes = [round(float(x), 2) for x in genes[:5]]
        progress(f"start {start + 1} of {settings.starts}: {least:.5g}, slopes {slopes}")
        populations.append((least, genes))
    state.write({"values": loss.known})
    least, genes = min(populations, key=lambda pair: pair[0])
    *waves, side, turn = (float(x) for x in genes)
    numbers = {"waves": waves, "alternate": side >= 0.5, "orientation": turn}
    return LearntMask(half_ring_height(genes, settings), least, numbers, history)


def _population(
    loss: _LossOfGenes, bounds: Any, start: int, history: list[dict[str, float]], progress: Progress
) -> tuple[float, Any]:
    """Optimise a mask of half-rings by differential evolution; return the lowest loss and the best parameter vector.

    ``history`` gets a row for each generation.
    """
    import numpy as np
    from scipy.optimize import differential_evolution, minimize

    settings = loss.terms.settings
    rng, first, loss.chosen = np.random.default_rng((settings.seed, start)), loss.asked, loss.terms.even()
    low, high = bounds.T

    def note_generation(genes: Any, convergence: float) -> None:
        number = sum(row["start"] == start for row in history)
        history.append({"start": start, "iteration": number, "loss": min(loss.known[first : loss.asked])})
        if (number + 1) % settings.save_every == 0:
            progress(f"generation {number + 1} of {settings.iterations}: {history[-1]['loss']:.5g}")

    try:
        found = differential_evolution(
            loss,
            bounds,
            maxiter=settings.iterations,
            init=low + rng.random((settings.population, len(low))) * (high - low),
            seed=rng,
            polish=False,
            tol=0.0,
            callback=note_generation,
            x0=_USUAL if _holds_usual(settings) else None,
        )
        if settings.polish:  # on all bands, because a tenth of a wave changes the peak
            loss.chosen = None
            simplex = found.x + np.concatenate([np.zeros((1, len(low))), 0.01 * np.diag(high - low)])
            fine = {"maxfev": settings.polish, "initial_simplex": np.clip(simplex, low, high)}
            found = minimize(loss, found.x, method="Nelder-Mead", bounds=bounds, options=fine)
    except RuntimeError as error:  # scipy raises this for any error of the loss
        raise error.__cause__ if isinstance(error.__cause__, DesignError) else error from None
    return float(found.fun), found.x


def _steepest(terms: Terms) -> float:
    """Return the steepest mask slope that the pupil grid can sample (Nyquist limit), in waves at the rim."""
    material, wavelength = terms.settings.material, terms.settings.wavelength
    turned = wave_height(material, wavelength) / wave_height(material, float(terms.bands.centres.min()))
    return float(terms.stop.diameter / (4 * terms.stop.pitch * turned))


def _holds_usual(settings: MaskTraining) -> bool:
    """Return True if the allowed range of mask slopes includes the slopes of the hand-designed mask."""
    return settings.slopes[0] <= min(_USUAL[:5]) and settings.slopes[1] >= max(_USUAL[:5])
