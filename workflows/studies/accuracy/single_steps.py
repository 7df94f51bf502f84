"""Work and precision of single steps: the forms that a node has, against its reference.

Every step that takes more than a hundredth of the time and whose node has a reference is tried on its own
inputs. Where the reference would take too long on them, all forms are tried on the middle of the
pictures and on fewer bands, and the page says so.
"""

from __future__ import annotations

import re
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from statistics import median
from typing import Any, Literal, get_args, get_origin

import torch
from torch import Tensor

from neusee.nodes import Node
from neusee.nodes.values import BAND_FIELDS, Channels, LowRankCube, Psf
from neusee.workflows.engine.provenance import machine
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.recipe_graph import Recipe, Step, needed
from neusee.workflows.graph.run_error import RunError
from neusee.workflows.keys.cache_key import digest, key_of, stream_seed
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.keys.engine_digest import engine
from neusee.workflows.store.memo import compute_once
from neusee.workflows.store.result_store import Store
from neusee.workflows.store.serialization import each_tensor, tensors_in
from neusee.workflows.tolerance.error_norm import error_of

Cut = tuple[int, int]  #: the longest side, and the most bands; 0 for all
SHARE = 0.01  #: of the time, below which a step does not matter
_ITEM = re.compile(r"\[.*?\]")
_CUTS: Sequence[Cut] = ((32, 2), (64, 2), (128, 3), (256, 3), (512, 3), (1024, 3), (0, 3), (0, 0))
_GROWTH = 16.0  #: how much longer the reference may take from one cut to the next, as a direct convolution does
USED, _PRECISION = "as used", "precision"
_WINDOWS = (0.75, 0.5, 0.25)  #: of the side of a PSF
_ALLOWANCES = (1e3, 1e2, 1e1, 1e-1, 1e-2, 1e-3)  #: times what a step that chooses its own form is allowed
_LONG_ENOUGH, _TIMES = 0.5, 5  #: s, times: a form is called again until one of them is reached


@dataclass(frozen=True)
class Form:
    """One way to compute a step."""

    line: str  #: what is changed
    label: str  #: to what
    error: float
    seconds: float


@dataclass(frozen=True)
class StepMeasurement:
    """The forms of a step with their errors and times; plain values, so that the store can keep them."""

    forms: list[dict[str, Any]] = field(default_factory=list)
    reference: float = 0.0  #: s
    cut_inputs: str = ""  #: what it was tried on; empty: on all
    refused: str = ""


@dataclass(frozen=True)
class StepTried:
    """A step that matters, and its measurement or the reason why it was not tried."""

    step: str  #: the slowest of its items
    node: str
    share: float  #: of the time, with all its items
    found: StepMeasurement

    @property
    def forms(self) -> list[Form]:
        return [Form(**form) for form in self.found.forms]


def steps_that_matter(recipe: Recipe, seconds: Mapping[str, float]) -> list[tuple[str, float]]:
    """Return the slowest item of each step that takes more than `SHARE` of the time, and the share of all its items."""
    items: dict[str, list[str]] = defaultdict(list)
    for name in seconds:
        if name in recipe.steps:
            items[_ITEM.sub("", name)].append(name)
    whole = sum(seconds.values()) or 1.0
    found = [(max(names, key=seconds.__getitem__), sum(seconds[n] for n in names) / whole) for names in items.values()]
    return sorted((f for f in found if f[1] > SHARE), key=lambda f: -f[1])


def try_step(recipe: Recipe, name: str, share: float, store: Store, patience: float) -> StepTried:
    """Return the forms of a step of ``recipe``, from the store or tried now.

    ``patience`` is the longest time in seconds that the reference of the step may take.
    """
    step = recipe.steps[name]
    if step.node.hooks.reference is None:
        return StepTried(name, step.node.path, share, StepMeasurement(refused="its node has no reference"))
    key, about = _key(recipe, name, patience, store), {"step": f"study accuracy: {name}"}
    found = compute_once(store, key, StepMeasurement, lambda: _try_forms(recipe, step, store, patience), about)
    return StepTried(name, step.node.path, share, found)


def _key(recipe: Recipe, name: str, patience: float, store: Store) -> str:
    keys: dict[str, str] = {}
    code = Code(store.code_memo)
    for before in needed(recipe, (name,)):
        keys[before], _ = key_of(recipe.steps[before], keys, recipe.seed, code)
    return digest("accuracy of a step", keys[name], patience, engine("studies.accuracy.single_steps"), machine())


def _try_forms(recipe: Recipe, step: Step, store: Store, patience: float) -> StepMeasurement:
    try:
        values = run(replace(recipe, exact=True), store, step.sources).values
    except RunError as error:
        return StepMeasurement(refused=f"its inputs: {error.cause}")
    inputs = [_gathered(step.wires.get(name), values) for name in step.node.inputs]
    with torch.no_grad():
        afforded = _largest(step, inputs, recipe.seed, patience)
        if afforded is None:
            return StepMeasurement(refused="its reference runs neither on its inputs in time nor on a part of them")
        size, truth, seconds = afforded
        part = cut_inputs(step.node, inputs, size)
        forms = [asdict(form) for form in _forms(step, part, truth, recipe.seed)]
    whole = all(a.shape == b.shape for a, b in zip(tensors_in(inputs), tensors_in(part), strict=True))
    return StepMeasurement(forms, seconds, "" if whole else _words_of(step.node, size))


def _gathered(wire: str | tuple[str, ...] | None, values: Mapping[str, Any]) -> Any:
    return wire and (values[wire] if isinstance(wire, str) else [values[name] for name in wire])


def _largest(step: Step, inputs: list[Any], seed: int, patience: float) -> tuple[Cut, Any, float] | None:
    """Return the largest part of the inputs on which the reference is within the patience, its result and seconds."""
    best: tuple[Cut, Any, float] | None = None
    assert step.node.hooks.reference is not None
    for size in _CUTS:
        if best is not None and best[2] * _GROWTH > patience:
            break
        part = cut_inputs(step.node, inputs, size)
        try:
            truth, seconds = _time_once(lambda part=part: _call(step, step.node.hooks.reference, part, seed))  # type: ignore[misc]
        except Exception:  # a part of a picture may be no input for it: a larger one may
            continue
        best = (size, truth, seconds)
    return best


def _forms(step: Step, inputs: list[Any], truth: Any, seed: int) -> Iterator[Form]:
    """Yield every way to compute the step whose result can be compared with that of the reference."""
    for (line, label), way in _ways(step, inputs, seed).items():
        try:
            value, seconds = _median_time(way)
            yield Form(line, label, error_of(_compared_value(value), _compared_value(truth)), seconds)
        except (ValueError, RuntimeError):  # another shape, or a dtype that the form does not take
            continue


def _ways(step: Step, inputs: list[Any], seed: int) -> dict[tuple[str, str], Callable[[], Any]]:
    """Return calls of the step: as used, in each other precision, allowance and window, and left out."""
    node = step.node
    ways: dict[tuple[str, str], Callable[[], Any]] = {(USED, ""): lambda: _call(step, node, inputs, seed)}
    for word in _others(step, "precision"):
        ways[_PRECISION, word] = partial(_call, step, node, inputs, seed, precision=word)
    if "precision" not in step.params and any(x.dtype == torch.float32 for x in tensors_in(inputs)):
        double = each_tensor(lambda x: x.double() if x.dtype == torch.float32 else x, inputs)
        ways[_PRECISION, "double"] = partial(_call, step, node, double, seed)
    for factor in _ALLOWANCES if "within" in step.params else ():
        within = step.params["within"] * factor
        ways["error it may choose", f"{within:.0e}".replace("e-0", "e-")] = partial(
            _call, step, node, inputs, seed, within=within
        )
    for share in _WINDOWS if any(isinstance(x, Psf) for x in inputs) else ():
        smaller = [_inner(x, share) if isinstance(x, Psf) else x for x in inputs]
        ways["window of the PSF", f"{share:g}"] = partial(_call, step, node, smaller, seed)
    if node.hooks.skip_bound is not None:
        ways["left out", ""] = lambda: inputs[0]
    return ways


def _inner(psf: Psf, share: float) -> Psf:
    """Return the middle of a PSF; its centre stays at N // 2."""
    x = psf.intensity
    for axis in (-2, -1):
        size = x.shape[axis]
        kept = max(1, round(share * size))
        x = x.narrow(axis, size // 2 - kept // 2, kept)
    return psf._replace(intensity=x)


def _compared_value(value: Any) -> Any:
    """Return the values to compare: the cube of a mixture, the sums of channels."""
    if isinstance(value, LowRankCube):
        return torch.einsum("bk,kyx->byx", value.basis.to(value.planes), value.planes)
    return (value.planes, value.flux) if isinstance(value, Channels) else value


def _others(step: Step, parameter: str) -> tuple[str, ...]:
    hint = step.node.hints.get(parameter)
    words = get_args(hint) if get_origin(hint) is Literal else ()
    return tuple(w for w in words if w != step.params.get(parameter))


def _call(step: Step, form: Any, inputs: list[Any], seed: int, **other: Any) -> Any:
    rng = {"rng": torch.Generator().manual_seed(stream_seed(seed, step.name))} if step.node.random else {}
    return form(*inputs, **{**step.params, **other}, **rng)


def _time_once(way: Callable[[], Any]) -> tuple[Any, float]:
    began = time.perf_counter()
    value = way()
    return value, time.perf_counter() - began


def _median_time(way: Callable[[], Any]) -> tuple[Any, float]:
    """Return the result, and the median time of some calls after the first one, which computes tables."""
    value, seconds = _time_once(way)
    times = [] if seconds < _LONG_ENOUGH else [seconds]
    while len(times) < _TIMES and sum(times) < _LONG_ENOUGH:
        times.append(_time_once(way)[1])
    return value, median(times)


# --- smaller inputs, on which the slow reference can be afforded ------------------------------------------------------


def cut_inputs(node: Node, inputs: list[Any], size: Cut) -> list[Any]:
    """Return ``inputs`` with no picture wider and no more bands than ``size``, where the node names the band axis."""
    side, bands = size
    found = []
    for name, value in zip(node.inputs, inputs, strict=True):
        axis = (node.bands or {}).get(name)
        fewer = value if axis is None or not bands else _fewer(value, axis, bands)
        found.append(each_tensor(lambda x: _middle(x, side), fewer) if side else fewer)
    return found


def _words_of(node: Node, size: Cut) -> str:
    """Return the cut in words; an empty text where nothing is cut."""
    side, bands = size
    fewer = bands and (node.bands or {}).keys() - {"return"}
    parts = [f"the middle {side} × {side}"] * bool(side) + [f"{bands} bands"] * bool(fewer)
    return " and ".join(parts)


def _middle(x: Tensor, side: int) -> Tensor:
    for axis in (-2, -1) if x.ndim >= 2 and min(x.shape[-2:]) > side else ():
        x = x.narrow(axis, x.shape[axis] // 2 - side // 2, side)
    return x


def _fewer(value: Any, axis: int, bands: int) -> Any:
    """Return bands that are spread evenly over all bands."""
    if isinstance(value, Tensor):
        count = value.shape[axis]
        if count <= bands:
            return value
        places = value.new_tensor([round((i + 0.5) * count / bands - 0.5) for i in range(bands)]).long()
        return value.index_select(axis, places)
    fields = BAND_FIELDS.get(type(value), ())
    return value._replace(**{name: _fewer(getattr(value, name), axis, bands) for name in fields}) if fields else value
