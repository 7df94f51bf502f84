"""Learning a relief: Adam on the terms, or differential evolution on the same; an interrupted one goes on."""

from __future__ import annotations

import io
import math
import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
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
from neusee.nodes.optics import Stop
from neusee.workflows.graph.recipe_graph import Step
from neusee.workflows.recipe.blocks.mask_design_block import DesignError, MaskTraining
from neusee.workflows.training.mask_design.design_terms import Terms

Tell = Callable[[str], None]
_APART = 7919  #: between the streams of two starts
_USUAL = (12.0, 18.0, 24.0, 30.0, 36.0, 1.0, 0.0)  #: genes of the half-rings that nobody optimised


@dataclass
class Learnt:
    """The best relief, and the way to it."""

    height: Callable[[Stop], Tensor]
    loss: float
    numbers: dict[str, Any]  #: of a mask that has few
    history: list[dict[str, float]] = field(default_factory=list)


class Kept:
    """What an unfinished design has come to: one file, replaced whole."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def read(self) -> dict[str, Any]:
        """What is kept; nothing where that is absent or damaged, so that the design begins again."""
        with suppress(OSError, RuntimeError, EOFError, ValueError, KeyError):
            found: dict[str, Any] = torch.load(self.path, weights_only=True)
            return found
        return {}

    def write(self, state: dict[str, Any]) -> None:
        """Replace it, so that a killed process leaves the old or the new."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        content, part = io.BytesIO(), self.path.with_name(f"{self.path.name}.{os.getpid()}")
        torch.save(state, content)
        with part.open("wb") as file:
            file.write(content.getvalue())
            file.flush()
            os.fsync(file.fileno())
        part.replace(self.path)


def learn(terms: Terms, how: MaskTraining, kept: Kept, tell: Tell) -> Learnt:
    """Design a relief; on the CPU the same bits for the same settings, however often it was stopped."""
    return _evolve(terms, how, kept, tell) if how.kind == "five_half_rings" else _descend(terms, how, kept, tell)


# --- by gradients -----------------------------------------------------------------------------------------------------


def shape_of(how: MaskTraining, start: int, step: Step) -> nn.Module:
    """The numbers to learn, as they are at a start; ``step`` is that of the relief."""
    shape = _free(how, torch.Generator().manual_seed(how.seed + _APART * start), step)
    return shape if how.feature is None else Written(shape, how.feature)


def _free(how: MaskTraining, rng: torch.Generator, step: Step) -> nn.Module:
    if how.kind == "recipe_mask":
        if step.node.path not in PARAMETRISATIONS:
            raise DesignError(f"kind: {step.name} is {step.node.path}, whose samples are not learnt")
        return PARAMETRISATIONS[step.node.path](step.params, rng)
    if how.kind == "pixelwise":
        return Pixels(how.grid, how.max_height, how.scale, rng, _start(how))
    if how.kind == "zernike":
        return Modes(how.modes, how.waves, how.wavelength, how.material, rng)
    if how.kind == "rings":
        return Rings(how.rings, how.sided, how.noise, how.wavelength, how.material, rng)
    return Drawn(how.width, how.grid, how.max_height, rng)


def _start(how: MaskTraining) -> Tensor | None:
    """The relief that pixels start from."""
    if how.start is None:
        return None
    height = read_height_map(how.start, how.max_height)
    if float(height.max()) > how.max_height:
        deep, most = f"{float(height.max()) * 1e6:.3g} um", f"{how.max_height * 1e6:.3g} um"
        raise DesignError(f"start: {how.start.name} is {deep} deep: set max_height to more than {most}")
    return height


def rate(how: MaskTraining, number: int) -> float:
    """The learning rate of an iteration, from 0."""
    done = number / how.iterations
    if how.schedule == "step":
        return how.rate * 0.5 ** math.floor(5 * done)
    return how.rate * 0.5 * (1 + math.cos(math.pi * done))


def _descend(terms: Terms, how: MaskTraining, kept: Kept, tell: Tell) -> Learnt:
    state = kept.read() or {"start": 0, "history": [], "best": None}
    if state["start"] or "shape" in state:
        tell(f"going on from start {state['start'] + 1}, iteration {state.get('iteration', 0)}")
    for start in range(state["start"], how.starts):
        shape = shape_of(how, start, terms.mask_step).to(terms.device)
        _one_start(terms, how, shape, start, state, kept, tell)
        with torch.no_grad():
            loss = float(terms.total(terms.parts(shape(terms.stop))))
        tell(f"start {start + 1} of {how.starts}: {loss:.5g} on all bands")
        if not math.isfinite(loss):
            raise DesignError(f"start {start + 1}: the loss on all bands is not finite: lower the learning rate")
        if state["best"] is None or loss < state["best"]["loss"]:
            state["best"] = {"loss": loss, "start": start, "shape": _copied(shape.state_dict())}
        for name in ("shape", "adam", "iteration"):
            state.pop(name, None)
        state["start"] = start + 1
        kept.write(state)
    best = shape_of(how, state["best"]["start"], terms.mask_step)
    best.load_state_dict(state["best"]["shape"])
    return Learnt(best, state["best"]["loss"], _few(best), state["history"])


def _one_start(
    terms: Terms, how: MaskTraining, shape: nn.Module, start: int, state: dict[str, Any], kept: Kept, tell: Tell
) -> None:
    adam = torch.optim.Adam(shape.parameters(), lr=how.rate)
    if "shape" in state:
        shape.load_state_dict(state["shape"])
        adam.load_state_dict(state["adam"])
    for number in range(state.get("iteration", 0), how.iterations):
        for group in adam.param_groups:
            group["lr"] = rate(how, number)
        row = _step(terms, shape, adam, start, number)
        state["history"].append(row)
        if (number + 1) % how.save_every == 0:
            tell(f"{number + 1}/{how.iterations}  " + _said(row))
            state |= {"shape": _copied(shape.state_dict()), "adam": adam.state_dict(), "iteration": number + 1}
            kept.write(state)


def _step(terms: Terms, shape: nn.Module, adam: torch.optim.Adam, start: int, number: int) -> dict[str, float]:
    adam.zero_grad()
    parts = terms.parts(shape(terms.stop), terms.drawn(number))
    loss = terms.total(parts)
    row = {"start": start, "iteration": number, "loss": float(loss.detach())}
    row |= {name: float(term.detach()) for name, term in parts.items()}
    if not math.isfinite(row["loss"]):
        raise DesignError(f"start {start + 1}, iteration {number}: the loss is not finite ({_said(row)})")
    loss.backward()  # type: ignore[no-untyped-call]
    for name, parameter in shape.named_parameters():
        if parameter.grad is not None and not bool(parameter.grad.isfinite().all()):
            raise DesignError(
                f"start {start + 1}, iteration {number}: the gradient of {name} is not finite; {_said(row)}"
            )
    adam.step()
    return row


def _said(row: dict[str, float]) -> str:
    return ", ".join(f"{name} {value:.5g}" for name, value in row.items() if name not in ("start", "iteration"))


def _copied(state: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: value.detach().cpu().clone() for name, value in state.items()}


def _few(shape: nn.Module) -> dict[str, Any]:
    """The numbers of a mask that a table can hold."""
    inner: Any = shape.shape if isinstance(shape, Written) else shape
    return {name: x.tolist() for name, x in inner.state_dict().items() if x.numel() <= 1000 and x.dim() == 1
            and not isinstance(inner, Drawn)}  # fmt: skip


# --- by differential evolution ----------------------------------------------------------------------------------------


def half_ring_height(genes: Any, how: MaskTraining) -> Callable[[Stop], Tensor]:
    """The relief of five slopes, the side of every second ring and the orientation."""
    *slopes, side, turn = (float(gene) for gene in genes)
    given = {"waves": tuple(slopes), "alternate": side >= 0.5, "orientation": turn}

    def height(grid: Stop) -> Tensor:
        made: Tensor = half_rings(
            **given, samples=grid.samples, pitch=grid.pitch, diameter=grid.diameter, aperture="clipped",
            wavelength=how.wavelength, material=how.material,
        )  # fmt: skip
        return made

    return height if how.feature is None else Written(height, how.feature)


class _Judge:
    """The loss of a set of genes; what was asked before an interruption is answered from memory."""

    def __init__(self, terms: Terms, how: MaskTraining, kept: Kept, tell: Tell) -> None:
        self.terms, self.how, self.kept, self.tell = terms, how, kept, tell
        self.known: list[float] = list(kept.read().get("values", []))
        self.asked, self.chosen = 0, terms.even()  # None: all bands
        if self.known:
            tell(f"going on after {len(self.known)} masks")

    def __call__(self, genes: Any) -> float:
        if self.asked == len(self.known):
            with torch.no_grad():
                height = half_ring_height(genes, self.how)(self.terms.stop)
                loss = float(self.terms.total(self.terms.parts(height.to(self.terms.device), self.chosen)))
            if not math.isfinite(loss):
                raise DesignError(f"mask {self.asked}: the loss of slopes {list(genes[:-2])} is not finite")
            self.known.append(loss)
            if len(self.known) % (self.how.save_every * 10) == 0:
                self.kept.write({"values": self.known})
        self.asked += 1
        return self.known[self.asked - 1]


def _evolve(terms: Terms, how: MaskTraining, kept: Kept, tell: Tell) -> Learnt:
    import numpy as np

    if (most := _steepest(terms, how)) < how.slopes[1]:
        tell(f"slopes: those above {most:.3g} waves are too steep for the pupil's samples: take more of them")
    judge, history = _Judge(terms, how, kept, tell), list[dict[str, float]]()
    best: tuple[float, Any] = (math.inf, None)
    bounds = np.array([how.slopes] * 5 + [(0.0, 1.0), (0.0, math.pi)])
    for start in range(how.starts):
        found = _population(judge, how, bounds, start, history, tell)
        tell(f"start {start + 1} of {how.starts}: {found[0]:.5g}, slopes {[round(float(x), 2) for x in found[1][:5]]}")
        best = min(best, found, key=lambda pair: pair[0])
    kept.write({"values": judge.known})
    *slopes, side, turn = (float(x) for x in best[1])
    numbers = {"waves": slopes, "alternate": side >= 0.5, "orientation": turn}
    return Learnt(half_ring_height(best[1], how), best[0], numbers, history)


def _population(
    judge: _Judge, how: MaskTraining, bounds: Any, start: int, history: list[dict[str, float]], tell: Tell
) -> tuple[float, Any]:
    import numpy as np
    from scipy.optimize import differential_evolution, minimize

    rng, first, judge.chosen = np.random.default_rng((how.seed, start)), judge.asked, judge.terms.even()
    low, high = bounds.T

    def told(genes: Any, convergence: float) -> None:
        number = sum(row["start"] == start for row in history)
        history.append({"start": start, "iteration": number, "loss": min(judge.known[first : judge.asked])})
        if (number + 1) % how.save_every == 0:
            tell(f"generation {number + 1} of {how.iterations}: {history[-1]['loss']:.5g}")

    try:
        found = differential_evolution(
            judge,
            bounds,
            maxiter=how.iterations,
            init=low + rng.random((how.population, len(low))) * (high - low),
            seed=rng,
            polish=False,
            tol=0.0,
            callback=told,
            x0=_USUAL if _holds(how) else None,
        )
        if how.polish:  # the peak hangs on the slopes to a tenth of a wave, and what suits few bands suits these alone
            judge.chosen = None
            simplex = found.x + np.concatenate([np.zeros((1, len(low))), 0.01 * np.diag(high - low)])
            fine = {"maxfev": how.polish, "initial_simplex": np.clip(simplex, low, high)}
            found = minimize(judge, found.x, method="Nelder-Mead", bounds=bounds, options=fine)
    except RuntimeError as error:  # scipy takes a refusal for a fault of its own call
        raise error.__cause__ if isinstance(error.__cause__, DesignError) else error from None
    return float(found.fun), found.x


def _steepest(terms: Terms, how: MaskTraining) -> float:
    """The slope, in waves at the rim, that turns half a wave a sample in the first band: Nyquist's limit."""
    turned = wave_height(how.material, how.wavelength) / wave_height(how.material, float(terms.bands.centres.min()))
    return terms.stop.diameter / (4 * terms.stop.pitch * turned)


def _holds(how: MaskTraining) -> bool:
    """Whether the slopes that nobody optimised are among those that are tried."""
    return how.slopes[0] <= min(_USUAL[:5]) and how.slopes[1] >= max(_USUAL[:5])
