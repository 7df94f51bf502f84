"""Optimisation of a mask, by gradients (Adam) or by differential evolution."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from neusee.nodes.doe import (
    PARAMETRISATIONS,
    Drawn,
    LearntStop,
    Modes,
    Pixels,
    Polynomials,
    Rings,
    Streak,
    Written,
    half_rings,
    read_height_map,
    wave_height,
)
from neusee.nodes.values import Stop
from neusee.workflows.recipe.blocks.train_block import DesignError, MaskTraining, half_cosine
from neusee.workflows.training.design_terms import Terms
from neusee.workflows.training.resumable_loop import CheckpointClock, Progress, StateFile

# --- learnt mask ----------------------------------------------------------------------------------

# The mask found by an optimisation, in the form that both optimisers return.


@dataclass
class LearntMask:
    """The best mask found by an optimisation, with its parameters and the losses at all
    iterations.
    """

    height: Callable[[Stop], Tensor]
    loss: float
    numbers: dict[str, Any]  #: the parameters, if the mask has few parameters
    history: list[dict[str, float]]
    diameter: float | None = None  #: diameter of a learnt stop relative to the lens


# --- gradient descent -----------------------------------------------------------------------------

# Optimisation of a mask by gradients (Adam), which can continue after an interruption.


_APART = 7919  #: difference of the seeds of successive starts


def shape_of(terms: Terms, start: int) -> nn.Module:
    """Return a trainable mask with the random initial parameters of optimisation number
    ``start``.
    """
    settings = terms.settings
    shape = _free(terms, torch.Generator().manual_seed(settings.seed + _APART * start))
    if settings.feature is not None:
        shape = Written(shape, settings.feature)
    return Stopped(shape) if settings.learn_stop else shape


class Stopped(nn.Module):
    """A trainable mask in a round stop whose diameter is trained too."""

    def __init__(self, shape: nn.Module) -> None:
        super().__init__()
        self.shape, self.round = shape, LearntStop()

    def forward(self, stop: Stop) -> Tensor:
        """Return the height map (v, u) on the pupil grid of ``stop``."""
        height: Tensor = self.shape(stop)
        return height


def _free(terms: Terms, rng: torch.Generator) -> nn.Module:
    """Return a trainable mask of the kind in the settings, with random initial parameters."""
    settings, step = terms.settings, terms.mask_step
    if settings.kind == "recipe_mask":
        if step.node.path not in PARAMETRISATIONS:
            raise DesignError(
                f"kind: the step {step.name} ({step.node.path}) has no trainable parameters"
            )
        return PARAMETRISATIONS[step.node.path](terms.stop, step.params, rng)
    if settings.kind == "pixelwise":
        return Pixels(settings.grid, settings.max_height, settings.scale, rng, _start(settings))
    if settings.kind == "zernike":
        return Modes(settings.modes, settings.waves, settings.wavelength, settings.material, rng)
    shape_arguments = (settings.degree, settings.waves, settings.wavelength, settings.material, rng)
    if settings.kind == "polynomial":
        return Polynomials(*shape_arguments)
    if settings.kind == "streak":
        return Streak(*shape_arguments)
    if settings.kind == "rings":
        return Rings(
            settings.rings,
            settings.sided,
            settings.noise,
            settings.wavelength,
            settings.material,
            rng,
        )
    return Drawn(settings.width, settings.grid, settings.max_height, rng)


def _start(settings: MaskTraining) -> Tensor | None:
    """Return the height map from which the optimisation of a pixelwise mask starts, or None if no
    file is set.
    """
    if settings.start is None:
        return None
    # a file with grey levels is scaled to max_height; one in metres may be deeper
    height = read_height_map(settings.start, settings.max_height)
    if (deepest := float(height.max())) > settings.max_height:
        raise DesignError(
            f"start: mask {settings.start.name} is {deepest * 1e6:.3g} um deep: set a larger"
            " max_height"
        )
    return height


def rate(settings: MaskTraining, number: int) -> float:
    """Return the learning rate of a mask optimisation at iteration ``number``, counted from 0."""
    progress_share = number / settings.iterations
    if settings.schedule == "step":
        # halved after each fifth of the iterations
        return settings.rate * 0.5 ** math.floor(5 * progress_share)
    return settings.rate * half_cosine(math.pi * progress_share)


def descend(terms: Terms, file: StateFile, progress: Progress) -> LearntMask:
    # Optimise a mask by gradient descent from several starts, and return the one with the lowest
    # loss on all bands. The checkpoint contains the number of the present start, the history, and
    # the best mask so far.
    state, settings = (
        file.read(strict=False) or {"start": 0, "history": [], "best": None},
        terms.settings,
    )
    if state["start"] or "shape" in state:
        progress(
            f"continues from start {state['start'] + 1}, iteration {state.get('iteration', 0)}"
        )
    # each start has other random parameters
    for start in range(state["start"], settings.starts):
        shape = shape_of(terms, start).to(terms.device)
        _one_start(terms, shape, start, state, file, progress)
        with torch.no_grad():
            loss = float(terms.total(_parts(terms, shape)))
        progress(f"start {start + 1} of {settings.starts}: {loss:.5g} on all bands")
        if not math.isfinite(loss):
            raise DesignError(
                f"start {start + 1}: the loss on all bands is NaN or infinite: lower the learning"
                " rate"
            )
        if state["best"] is None or loss < state["best"]["loss"]:
            state["best"] = {"loss": loss, "start": start, "shape": deepcopy(shape.state_dict())}
        # remove the entries of this start
        for name in ("shape", "adam", "iteration"):
            state.pop(name, None)
        state["start"] = start + 1
        file.write(state)
    best = shape_of(terms, state["best"]["start"])
    best.load_state_dict(state["best"]["shape"])
    diameter = float(best.round.diameter().detach()) if isinstance(best, Stopped) else None
    return LearntMask(
        best, state["best"]["loss"], _parameters_by_name(best), state["history"], diameter
    )


def _one_start(
    terms: Terms,
    shape: nn.Module,
    start: int,
    state: dict[str, Any],
    file: StateFile,
    progress: Progress,
) -> None:
    """Optimise a mask by Adam from one set of initial parameters, with a checkpoint every
    ``save_every`` iterations, and earlier if two minutes of work could be lost.
    """
    settings, clock = terms.settings, CheckpointClock()
    adam = torch.optim.Adam(shape.parameters(), lr=settings.rate)
    # continue an interrupted start
    if "shape" in state:
        shape.load_state_dict(state["shape"])
        adam.load_state_dict(state["adam"])
    for number in range(state.get("iteration", 0), settings.iterations):
        for group in adam.param_groups:
            group["lr"] = rate(settings, number)
        row = _step(terms, shape, adam, start, number)
        state["history"].append(row)
        clock.end_iteration()
        is_at_interval = (number + 1) % settings.save_every == 0
        if is_at_interval:
            progress(f"{number + 1}/{settings.iterations}  {_losses_line(row)}")
        if is_at_interval or clock.is_due:
            state |= {
                "shape": shape.state_dict(),
                "adam": adam.state_dict(),
                "iteration": number + 1,
            }
            file.write(state)
            clock.restart()


def _step(
    terms: Terms, shape: nn.Module, adam: torch.optim.Adam, start: int, number: int
) -> dict[str, float]:
    """Compute the loss of one iteration, update the mask, and return the row of the history."""
    adam.zero_grad()
    terms_by_name = _parts(terms, shape, terms.drawn(number), number)
    loss = terms.total(terms_by_name)
    row = {"start": start, "iteration": number, "loss": float(loss.detach())}
    row |= {name: float(term.detach()) for name, term in terms_by_name.items()}
    if not math.isfinite(row["loss"]):
        raise DesignError(
            f"start {start + 1}, iteration {number}: the loss is NaN or infinite"
            f" ({_losses_line(row)})"
        )
    loss.backward()  # type: ignore[no-untyped-call]
    for name, parameter in shape.named_parameters():
        if parameter.grad is not None and not bool(parameter.grad.isfinite().all()):
            text = f"the gradient of {name} is NaN or infinite; {_losses_line(row)}"
            raise DesignError(f"start {start + 1}, iteration {number}: {text}")
    adam.step()
    return row


def _parts(
    terms: Terms, shape: nn.Module, bands: Sequence[int] | None = None, number: int | None = None
) -> dict[str, Tensor]:
    """Return the loss terms of a trainable mask, with its stop if the stop is trained."""
    stop = shape.round(terms.stop) if isinstance(shape, Stopped) else None
    return terms.parts(shape(terms.stop), bands, number, stop)


def _losses_line(row: dict[str, float]) -> str:
    return ", ".join(
        f"{name} {value:.5g}" for name, value in row.items() if name not in ("start", "iteration")
    )


def _parameters_by_name(shape: nn.Module) -> dict[str, Any]:
    """Return the parameters of a mask as lists by name, except matrices and vectors of more than
    1000 numbers.
    """
    innermost: Any = shape
    while isinstance(innermost, (Stopped, Written)):
        innermost = innermost.shape
    state = {} if isinstance(innermost, Drawn) else innermost.state_dict()
    return {name: x.tolist() for name, x in state.items() if x.numel() <= 1000 and x.dim() == 1}


# --- differential evolution -----------------------------------------------------------------------

# Optimisation of a mask of half-rings by differential evolution, which can continue after an
# interruption.


#: parameters of a hand-designed mask of half-rings
_USUAL = (12.0, 18.0, 24.0, 30.0, 36.0, 1.0, 0.0)


def half_ring_height(genes: Any, settings: MaskTraining) -> Callable[[Stop], Tensor]:
    """Return the function that computes the height map of a mask of half-rings from its parameter
    vector ``genes``.
    """
    *slopes, side, orientation = (float(gene) for gene in genes)
    # a continuous parameter encodes a choice of two
    ring_parameters = {"waves": tuple(slopes), "alternate": side >= 0.5, "orientation": orientation}

    def height(stop: Stop) -> Tensor:
        height_map: Tensor = half_rings(
            stop, **ring_parameters, wavelength=settings.wavelength, material=settings.material
        )
        return height_map

    return height if settings.feature is None else Written(height, settings.feature)


class _LossOfGenes:
    """The loss of a mask of half-rings as a function of its parameter vector (genes).

    When an interrupted optimisation continues, stored losses are returned without computing them
    again.
    """

    def __init__(self, terms: Terms, state: StateFile, progress: Progress) -> None:
        self.terms, self.state = terms, state
        self.known: list[float] = list(state.read(strict=False).get("values", []))
        self.asked, self.chosen = 0, terms.even()  # None: all bands
        self.clock = CheckpointClock()
        if self.known:
            progress(f"continues after {len(self.known)} masks")

    def __call__(self, genes: Any) -> float:
        # a continued optimiser first requests the losses that the interrupted run has computed
        if self.asked == len(self.known):
            with torch.no_grad():
                height = half_ring_height(genes, self.terms.settings)(self.terms.stop)
                loss = float(
                    self.terms.total(self.terms.parts(height.to(self.terms.device), self.chosen))
                )
            if not math.isfinite(loss):
                slopes = [float(gene) for gene in genes[:-2]]
                raise DesignError(
                    f"mask number {self.asked}: the loss at slopes {slopes} is NaN or infinite"
                )
            self.known.append(loss)
            self.clock.end_iteration()
            is_at_interval = len(self.known) % (self.terms.settings.save_every * 10) == 0
            if is_at_interval or self.clock.is_due:
                self.state.write({"values": self.known})
                self.clock.restart()
        self.asked += 1
        return self.known[self.asked - 1]


def evolve(terms: Terms, state: StateFile, progress: Progress) -> LearntMask:
    # Optimise a mask of five half-rings by differential evolution from several starts, and return
    # the one with the lowest loss.
    import numpy as np

    settings = terms.settings
    # steeper slopes would alias on the grid of the pupil
    if (steepest := _steepest(terms)) < settings.slopes[1]:
        progress(
            f"slopes above {steepest:.3g} waves are too steep for the samples of the pupil: use"
            " more samples"
        )
    loss, history = _LossOfGenes(terms, state, progress), list[dict[str, float]]()
    populations: list[tuple[float, Any]] = []
    # five slopes, the choice of a side, the orientation
    bounds = np.array([settings.slopes] * 5 + [(0.0, 1.0), (0.0, math.pi)])
    for start in range(settings.starts):
        lowest_loss, best_genes = _population(loss, bounds, start, history, progress)
        shown_slopes = [round(float(x), 2) for x in best_genes[:5]]
        progress(
            f"start {start + 1} of {settings.starts}: {lowest_loss:.5g}, slopes {shown_slopes}"
        )
        populations.append((lowest_loss, best_genes))
    state.write({"values": loss.known})
    lowest_loss, best_genes = min(populations, key=lambda pair: pair[0])
    *waves, side, orientation = (float(x) for x in best_genes)
    ring_parameters = {"waves": waves, "alternate": side >= 0.5, "orientation": orientation}
    return LearntMask(half_ring_height(best_genes, settings), lowest_loss, ring_parameters, history)


def _population(
    loss: _LossOfGenes, bounds: Any, start: int, history: list[dict[str, float]], progress: Progress
) -> tuple[float, Any]:
    """Optimise a mask of half-rings by differential evolution, and return the lowest loss and the
    best parameter vector.

    A row for each generation is appended to ``history``.
    """
    import numpy as np
    from scipy.optimize import differential_evolution, minimize

    settings = loss.terms.settings
    rng, first_loss, loss.chosen = (
        np.random.default_rng((settings.seed, start)),
        loss.asked,
        loss.terms.even(),
    )
    low_bounds, high_bounds = bounds.T

    def note_generation(genes: Any, convergence: float) -> None:
        generation = sum(row["start"] == start for row in history)
        history.append(
            {
                "start": start,
                "iteration": generation,
                "loss": min(loss.known[first_loss : loss.asked]),
            }
        )
        if (generation + 1) % settings.save_every == 0:
            progress(
                f"generation {generation + 1} of {settings.iterations}: {history[-1]['loss']:.5g}"
            )

    try:
        optimum = differential_evolution(
            loss,
            bounds,
            maxiter=settings.iterations,
            # uniform within the bounds
            init=low_bounds
            + rng.random((settings.population, len(low_bounds))) * (high_bounds - low_bounds),
            seed=rng,
            polish=False,
            tol=0.0,
            callback=note_generation,
            x0=_USUAL if _holds_usual(settings) else None,
        )
        # on all bands, because a slope change of a tenth of a wave changes the peak
        if settings.polish:
            loss.chosen = None
            # initial simplex: the optimum, and steps of a hundredth of the range along each axis
            simplex = optimum.x + np.concatenate(
                [np.zeros((1, len(low_bounds))), 0.01 * np.diag(high_bounds - low_bounds)]
            )
            options = {
                "maxfev": settings.polish,
                "initial_simplex": np.clip(simplex, low_bounds, high_bounds),
            }
            optimum = minimize(
                loss, optimum.x, method="Nelder-Mead", bounds=bounds, options=options
            )
    except RuntimeError as error:  # scipy raises this for any error of the loss
        raise error.__cause__ if isinstance(error.__cause__, DesignError) else error from None
    return float(optimum.fun), optimum.x


def _steepest(terms: Terms) -> float:
    """Return the steepest mask slope in waves at the rim that the pupil grid can sample (Nyquist
    limit).
    """
    material, wavelength = terms.settings.material, terms.settings.wavelength
    phase_ratio = wave_height(material, wavelength) / wave_height(
        material, float(terms.bands.centres.min())
    )
    # at most half a wave between samples at the shortest wavelength
    return float(terms.stop.diameter / (4 * terms.stop.pitch * phase_ratio))


def _holds_usual(settings: MaskTraining) -> bool:
    """Return True if the allowed range of slopes includes those of the hand-designed mask."""
    return settings.slopes[0] <= min(_USUAL[:5]) and settings.slopes[1] >= max(_USUAL[:5])
