"""How a mask is learnt: by Adam, or by differential evolution; a stopped design goes on from its state."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from neusee.nodes.doe import (
    PARAMETRISATIONS,
    Drawn,
    Modes,
    Pixels,
    Rings,
    Written,
    half_rings,
    read_height_map,
    wave_height,
)
from neusee.nodes.values import Stop
from neusee.workflows.recipe.blocks.mask_design_block import DesignError, MaskTraining, half_cosine
from neusee.workflows.training.loop.checkpoint import StateFile
from neusee.workflows.training.loop.resumable_loop import Progress
from neusee.workflows.training.mask_design.design_terms import Terms

_APART = 7919  #: between the streams of two starts
_USUAL = (12.0, 18.0, 24.0, 30.0, 36.0, 1.0, 0.0)  #: genes of the half-rings that nobody optimised


@dataclass
class LearntMask:
    """The best mask, and the losses on the way to it."""

    height: Callable[[Stop], Tensor]
    loss: float
    numbers: dict[str, Any]  #: of a mask that has few
    history: list[dict[str, float]] = field(default_factory=list)


def learn(terms: Terms, state: StateFile, progress: Progress) -> LearntMask:
    """Design a mask; on the CPU the same settings give the same bits, however often the design was stopped."""
    learner = _evolve if terms.settings.kind == "five_half_rings" else _descend
    return learner(terms, state, progress)


# --- by gradients -----------------------------------------------------------------------------------------------------


def shape_of(terms: Terms, start: int) -> nn.Module:
    """Return the mask with its trainable parameters as they are at the beginning of a start."""
    settings = terms.settings
    shape = _free(terms, torch.Generator().manual_seed(settings.seed + _APART * start))
    return shape if settings.feature is None else Written(shape, settings.feature)


def _free(terms: Terms, rng: torch.Generator) -> nn.Module:
    settings, step = terms.settings, terms.mask_step
    if settings.kind == "recipe_mask":
        if step.node.path not in PARAMETRISATIONS:
            raise DesignError(f"kind: {step.name} is {step.node.path}, whose samples are not learnt")
        return PARAMETRISATIONS[step.node.path](terms.stop, step.params, rng)
    if settings.kind == "pixelwise":
        return Pixels(settings.grid, settings.max_height, settings.scale, rng, _start(settings))
    if settings.kind == "zernike":
        return Modes(settings.modes, settings.waves, settings.wavelength, settings.material, rng)
    if settings.kind == "rings":
        return Rings(settings.rings, settings.sided, settings.noise, settings.wavelength, settings.material, rng)
    return Drawn(settings.width, settings.grid, settings.max_height, rng)


def _start(settings: MaskTraining) -> Tensor | None:
    """Return the height map from which pixels start."""
    if settings.start is None:
        return None
    height = read_height_map(settings.start, settings.max_height)
    if float(height.max()) > settings.max_height:
        deep, most = f"{float(height.max()) * 1e6:.3g} um", f"{settings.max_height * 1e6:.3g} um"
        raise DesignError(f"start: {settings.start.name} is {deep} deep: set max_height to more than {most}")
    return height


def rate(settings: MaskTraining, number: int) -> float:
    """Return the learning rate of an iteration, counted from 0."""
    done = number / settings.iterations
    if settings.schedule == "step":
        return settings.rate * 0.5 ** math.floor(5 * done)
    return settings.rate * half_cosine(math.pi * done)


def _descend(terms: Terms, file: StateFile, progress: Progress) -> LearntMask:
    state, settings = file.read(strict=False) or {"start": 0, "history": [], "best": None}, terms.settings
    if state["start"] or "shape" in state:
        progress(f"going on from start {state['start'] + 1}, iteration {state.get('iteration', 0)}")
    for start in range(state["start"], settings.starts):
        shape = shape_of(terms, start).to(terms.device)
        _one_start(terms, shape, start, state, file, progress)
        with torch.no_grad():
            loss = float(terms.total(terms.parts(shape(terms.stop))))
        progress(f"start {start + 1} of {settings.starts}: {loss:.5g} on all bands")
        if not math.isfinite(loss):
            raise DesignError(f"start {start + 1}: the loss on all bands is not finite: lower the learning rate")
        if state["best"] is None or loss < state["best"]["loss"]:
            state["best"] = {"loss": loss, "start": start, "shape": _copied(shape.state_dict())}
        for name in ("shape", "adam", "iteration"):
            state.pop(name, None)
        state["start"] = start + 1
        file.write(state)
    best = shape_of(terms, state["best"]["start"])
    best.load_state_dict(state["best"]["shape"])
    return LearntMask(best, state["best"]["loss"], _few(best), state["history"])


def _one_start(
    terms: Terms, shape: nn.Module, start: int, state: dict[str, Any], file: StateFile, progress: Progress
) -> None:
    """Learn one start to its last iteration; ``state`` takes up its history, and its weights as often as is kept."""
    settings = terms.settings
    adam = torch.optim.Adam(shape.parameters(), lr=settings.rate)
    if "shape" in state:
        shape.load_state_dict(state["shape"])
        adam.load_state_dict(state["adam"])
    for number in range(state.get("iteration", 0), settings.iterations):
        for group in adam.param_groups:
            group["lr"] = rate(settings, number)
        row = _step(terms, shape, adam, start, number)
        state["history"].append(row)
        if (number + 1) % settings.save_every == 0:
            progress(f"{number + 1}/{settings.iterations}  " + _losses_line(row))
            state |= {"shape": _copied(shape.state_dict()), "adam": adam.state_dict(), "iteration": number + 1}
            file.write(state)


def _step(terms: Terms, shape: nn.Module, adam: torch.optim.Adam, start: int, number: int) -> dict[str, float]:
    adam.zero_grad()
    parts = terms.parts(shape(terms.stop), terms.drawn(number))
    loss = terms.total(parts)
    row = {"start": start, "iteration": number, "loss": float(loss.detach())}
    row |= {name: float(term.detach()) for name, term in parts.items()}
    if not math.isfinite(row["loss"]):
        raise DesignError(f"start {start + 1}, iteration {number}: the loss is not finite ({_losses_line(row)})")
    loss.backward()  # type: ignore[no-untyped-call]
    for name, parameter in shape.named_parameters():
        if parameter.grad is not None and not bool(parameter.grad.isfinite().all()):
            raise DesignError(
                f"start {start + 1}, iteration {number}: the gradient of {name} is not finite; {_losses_line(row)}"
            )
    adam.step()
    return row


def _losses_line(row: dict[str, float]) -> str:
    return ", ".join(f"{name} {value:.5g}" for name, value in row.items() if name not in ("start", "iteration"))


def _copied(state: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: value.detach().cpu().clone() for name, value in state.items()}


def _few(shape: nn.Module) -> dict[str, Any]:
    """Return the parameters of a mask that are few enough for a table."""
    inner: Any = shape.shape if isinstance(shape, Written) else shape
    return {name: x.tolist() for name, x in inner.state_dict().items() if x.numel() <= 1000 and x.dim() == 1
            and not isinstance(inner, Drawn)}  # fmt: skip


# --- by differential evolution ----------------------------------------------------------------------------------------


def half_ring_height(genes: Any, settings: MaskTraining) -> Callable[[Stop], Tensor]:
    """Return the height map of five slopes, the side of every second ring and the orientation."""
    *slopes, side, turn = (float(gene) for gene in genes)
    given = {"waves": tuple(slopes), "alternate": side >= 0.5, "orientation": turn}

    def height(stop: Stop) -> Tensor:
        made: Tensor = half_rings(stop, **given, wavelength=settings.wavelength, material=settings.material)
        return made

    return height if settings.feature is None else Written(height, settings.feature)


class _LossOfGenes:
    """The loss of a set of genes; what was asked before an interruption is answered from the state."""

    def __init__(self, terms: Terms, state: StateFile, progress: Progress) -> None:
        self.terms, self.state = terms, state
        self.known: list[float] = list(state.read(strict=False).get("values", []))
        self.asked, self.chosen = 0, terms.even()  # None: all bands
        if self.known:
            progress(f"going on after {len(self.known)} masks")

    def __call__(self, genes: Any) -> float:
        if self.asked == len(self.known):
            with torch.no_grad():
                height = half_ring_height(genes, self.terms.settings)(self.terms.stop)
                loss = float(self.terms.total(self.terms.parts(height.to(self.terms.device), self.chosen)))
            if not math.isfinite(loss):
                raise DesignError(f"mask {self.asked}: the loss of slopes {list(genes[:-2])} is not finite")
            self.known.append(loss)
            if len(self.known) % (self.terms.settings.save_every * 10) == 0:
                self.state.write({"values": self.known})
        self.asked += 1
        return self.known[self.asked - 1]


def _evolve(terms: Terms, state: StateFile, progress: Progress) -> LearntMask:
    import numpy as np

    settings = terms.settings
    if (most := _steepest(terms)) < settings.slopes[1]:
        progress(f"slopes: those above {most:.3g} waves are too steep for the pupil's samples: take more of them")
    loss, history = _LossOfGenes(terms, state, progress), list[dict[str, float]]()
    best: tuple[float, Any] = (math.inf, None)
    bounds = np.array([settings.slopes] * 5 + [(0.0, 1.0), (0.0, math.pi)])
    for start in range(settings.starts):
        found = _population(loss, bounds, start, history, progress)
        slopes = [round(float(x), 2) for x in found[1][:5]]
        progress(f"start {start + 1} of {settings.starts}: {found[0]:.5g}, slopes {slopes}")
        best = min(best, found, key=lambda pair: pair[0])
    state.write({"values": loss.known})
    *waves, side, turn = (float(x) for x in best[1])
    numbers = {"waves": waves, "alternate": side >= 0.5, "orientation": turn}
    return LearntMask(half_ring_height(best[1], settings), best[0], numbers, history)


def _population(
    loss: _LossOfGenes, bounds: Any, start: int, history: list[dict[str, float]], progress: Progress
) -> tuple[float, Any]:
    """Return the least loss that one population finds, and its genes; ``history`` takes up each generation."""
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
        if settings.polish:  # the peak depends on the slopes to a tenth of a wave, and few bands suit few slopes
            loss.chosen = None
            simplex = found.x + np.concatenate([np.zeros((1, len(low))), 0.01 * np.diag(high - low)])
            fine = {"maxfev": settings.polish, "initial_simplex": np.clip(simplex, low, high)}
            found = minimize(loss, found.x, method="Nelder-Mead", bounds=bounds, options=fine)
    except RuntimeError as error:  # scipy takes a refusal for a fault of its own call
        raise error.__cause__ if isinstance(error.__cause__, DesignError) else error from None
    return float(found.fun), found.x


def _steepest(terms: Terms) -> float:
    """Return the slope, in waves at the rim, that turns half a wave a sample in the first band: Nyquist's limit."""
    material, wavelength = terms.settings.material, terms.settings.wavelength
    turned = wave_height(material, wavelength) / wave_height(material, float(terms.bands.centres.min()))
    return float(terms.stop.diameter / (4 * terms.stop.pitch * turned))


def _holds_usual(settings: MaskTraining) -> bool:
    """Return True if the slopes that nobody optimised are among those that are tried."""
    return settings.slopes[0] <= min(_USUAL[:5]) and settings.slopes[1] >= max(_USUAL[:5])
