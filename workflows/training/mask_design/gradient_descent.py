"""Optimisation of a mask by gradients (Adam), which can continue after an interruption."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import deepcopy
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
    read_height_map,
)
from neusee.nodes.values import Stop
from neusee.workflows.recipe.blocks.mask_design_block import DesignError, MaskTraining, half_cosine
from neusee.workflows.training.loop.checkpoint import StateFile
from neusee.workflows.training.loop.resumable_loop import Progress
from neusee.workflows.training.mask_design.design_terms import Terms
from neusee.workflows.training.mask_design.learnt_mask import LearntMask

_APART = 7919  #: difference of the seeds of successive starts


def shape_of(terms: Terms, start: int) -> nn.Module:
    """Return a trainable mask with the random initial parameters of the optimisation number ``start``."""
    settings = terms.settings
    shape = _free(terms, torch.Generator().manual_seed(settings.seed + _APART * start))
    if settings.feature is not None:
        shape = Written(shape, settings.feature)
    return Stopped(shape) if settings.learn_stop else shape


class Stopped(nn.Module):
    """A trainable mask in a round stop whose diameter is learnt too."""

    def __init__(self, shape: nn.Module) -> None:
        super().__init__()
        self.shape, self.round = shape, LearntStop()

    def forward(self, stop: Stop) -> Tensor:
        """Return the height map (v, u) on the pupil grid of ``stop``."""
        height: Tensor = self.shape(stop)
        return height


def _free(terms: Terms, rng: torch.Generator) -> nn.Module:
    settings, step = terms.settings, terms.mask_step
    if settings.kind == "recipe_mask":
        if step.node.path not in PARAMETRISATIONS:
            raise DesignError(f"kind: the step {step.name} ({step.node.path}) has no trainable parameters")
        return PARAMETRISATIONS[step.node.path](terms.stop, step.params, rng)
    if settings.kind == "pixelwise":
        return Pixels(settings.grid, settings.max_height, settings.scale, rng, _start(settings))
    if settings.kind == "zernike":
        return Modes(settings.modes, settings.waves, settings.wavelength, settings.material, rng)
    few = (settings.degree, settings.waves, settings.wavelength, settings.material, rng)
    if settings.kind == "polynomial":
        return Polynomials(*few)
    if settings.kind == "streak":
        return Streak(*few)
    if settings.kind == "rings":
        return Rings(settings.rings, settings.sided, settings.noise, settings.wavelength, settings.material, rng)
    return Drawn(settings.width, settings.grid, settings.max_height, rng)


def _start(settings: MaskTraining) -> Tensor | None:
    """Read the height map from which the optimisation of a pixelwise mask begins, or return None if no file is set."""
    if settings.start is None:
        return None
    height = read_height_map(settings.start, settings.max_height)
    if (deepest := float(height.max())) > settings.max_height:
        raise DesignError(f"start: mask {settings.start.name} is {deepest * 1e6:.3g} um deep: set a larger max_height")
    return height


def rate(settings: MaskTraining, number: int) -> float:
    """Return the learning rate of a mask optimisation at iteration ``number``, counted from 0."""
    done = number / settings.iterations
    if settings.schedule == "step":
        return settings.rate * 0.5 ** math.floor(5 * done)
    return settings.rate * half_cosine(math.pi * done)


def descend(terms: Terms, file: StateFile, progress: Progress) -> LearntMask:
    state, settings = file.read(strict=False) or {"start": 0, "history": [], "best": None}, terms.settings
    if state["start"] or "shape" in state:
        progress(f"continues from start {state['start'] + 1}, iteration {state.get('iteration', 0)}")
    for start in range(state["start"], settings.starts):
        shape = shape_of(terms, start).to(terms.device)
        _one_start(terms, shape, start, state, file, progress)
        with torch.no_grad():
            loss = float(terms.total(_parts(terms, shape)))
        progress(f"start {start + 1} of {settings.starts}: {loss:.5g} on all bands")
        if not math.isfinite(loss):
            raise DesignError(f"start {start + 1}: the loss on all bands is NaN or infinite: lower the learning rate")
        if state["best"] is None or loss < state["best"]["loss"]:
            state["best"] = {"loss": loss, "start": start, "shape": deepcopy(shape.state_dict())}
        for name in ("shape", "adam", "iteration"):
            state.pop(name, None)
        state["start"] = start + 1
        file.write(state)
    best = shape_of(terms, state["best"]["start"])
    best.load_state_dict(state["best"]["shape"])
    diameter = float(best.round.diameter().detach()) if isinstance(best, Stopped) else None
    return LearntMask(best, state["best"]["loss"], _few(best), state["history"], diameter)


def _one_start(
    terms: Terms, shape: nn.Module, start: int, state: dict[str, Any], file: StateFile, progress: Progress
) -> None:
    """Optimise a mask by Adam from one set of initial parameters, with a checkpoint every ``save_every`` iterations."""
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
            progress(f"{number + 1}/{settings.iterations}  {_losses_line(row)}")
            state |= {"shape": shape.state_dict(), "adam": adam.state_dict(), "iteration": number + 1}
            file.write(state)


def _step(terms: Terms, shape: nn.Module, adam: torch.optim.Adam, start: int, number: int) -> dict[str, float]:
    adam.zero_grad()
    parts = _parts(terms, shape, terms.drawn(number), number)
    loss = terms.total(parts)
    row = {"start": start, "iteration": number, "loss": float(loss.detach())}
    row |= {name: float(term.detach()) for name, term in parts.items()}
    if not math.isfinite(row["loss"]):
        raise DesignError(f"start {start + 1}, iteration {number}: the loss is NaN or infinite ({_losses_line(row)})")
    loss.backward()  # type: ignore[no-untyped-call]
    for name, parameter in shape.named_parameters():
        if parameter.grad is not None and not bool(parameter.grad.isfinite().all()):
            text = f"the gradient of {name} is NaN or infinite; {_losses_line(row)}"
            raise DesignError(f"start {start + 1}, iteration {number}: {text}")
    adam.step()
    return row


def _parts(
    terms: Terms, shape: nn.Module, chosen: Sequence[int] | None = None, number: int | None = None
) -> dict[str, Tensor]:
    """Return the terms of the loss of a trainable mask, in its stop if this is learnt."""
    stop = shape.round(terms.stop) if isinstance(shape, Stopped) else None
    return terms.parts(shape(terms.stop), chosen, number, stop)


def _losses_line(row: dict[str, float]) -> str:
    return ", ".join(f"{name} {value:.5g}" for name, value in row.items() if name not in ("start", "iteration"))


def _few(shape: nn.Module) -> dict[str, Any]:
    """Return the parameters of a mask as lists by name, without matrices and vectors of more than 1000 numbers."""
    inner: Any = shape
    while isinstance(inner, (Stopped, Written)):
        inner = inner.shape
    state = {} if isinstance(inner, Drawn) else inner.state_dict()
    return {name: x.tolist() for name, x in state.items() if x.numel() <= 1000 and x.dim() == 1}
