"""Error against run time, of settings of a recipe and of variants of single steps.

A point is a setting of the recipe, with the time of a cold run and the errors of the outputs. A
variant of a step is the step as used, in another precision, with another allowed error, with a
smaller window of the PSF, or left out. If the reference takes too long, all variants are measured
on the middle of the pictures and on fewer bands.
"""

from __future__ import annotations

import os
import re
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from statistics import median
from typing import Any

import torch
from torch import Tensor

from neusee.nodes import Node
from neusee.nodes.values import Channels, LowRankCube, Psf, band_names
from neusee.workflows.engine.provenance import machine
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.errors import RunError
from neusee.workflows.graph.recipe_graph import Event, Recipe, Step, needed
from neusee.workflows.keys.cache_key import digest, key_of, stream_seed
from neusee.workflows.keys.code_digest import Code, engine
from neusee.workflows.report.contents import keep_variants
from neusee.workflows.store.result_store import Store, compute_once
from neusee.workflows.store.serialization import each_tensor, tensors_in
from neusee.workflows.studies.recipe_knobs import allowed_words
from neusee.workflows.studies.run_study import cold, key_parts, run_cold
from neusee.workflows.tolerance.cheaper_steps import with_substitutions
from neusee.workflows.tolerance.error_norm import error_of

# --- work precision points ------------------------------------------------------------------------

# Points of a diagram of error against run time: the time of a cold run and the errors of the
# outputs.


TIMES = 3  #: cold runs of a point, of which the median time is used
_QUICK_SECONDS = 5.0  #: s; a recipe that takes longer is run once
_STORED_AS = {"step": "study accuracy"}


@dataclass(frozen=True)
class Trial:
    """A setting to measure: a changed recipe, or the reason why the setting is impossible."""

    line: str  #: the parameter that is varied
    label: str
    recipe: Recipe | None
    refused: str = ""
    value: float | None = None  #: the tolerance, for settings of the tolerance
    own: bool = False  #: whether the recipe itself has this setting

    @property
    def name(self) -> str:
        """Return the parameter and its value as text."""
        return f"{self.line} {self.label}".strip()


@dataclass(frozen=True)
class PointMeasurement:
    """Errors of the outputs and run times of a recipe, in types that the store can save."""

    errors: dict[str, list[float]] = field(default_factory=dict)  #: by output, one for each seed
    seconds: list[float] = field(default_factory=list)  #: of the engine, one for each cold run
    computing: float = 0.0  #: s, time within the steps of the first cold run
    load: float = 0.0  #: runnable processes for each core before the run, this process included
    #: largest error that the engine states for the outputs; None if one is unknown
    bound: float | None = None
    steps: dict[str, float] = field(default_factory=dict)  #: s by step, in the first cold run
    refused: str = ""


@dataclass(frozen=True)
class WorkPrecisionPoint:
    """A point in a diagram of error against run time: a setting and its measurement."""

    trial: Trial
    found: PointMeasurement

    @property
    def seconds(self) -> float:
        return median(self.found.seconds) if self.found.seconds else float("inf")

    @property
    def by_seed(self) -> list[float]:
        """Return the largest error over all outputs for each random seed."""
        return [max(column) for column in zip(*self.found.errors.values(), strict=True)]

    @property
    def error(self) -> float:
        """Return the largest error over all outputs, the median over the random seeds."""
        return median(self.by_seed) if self.by_seed else float("inf")

    @property
    def most(self) -> float:
        """Return the largest error over all outputs and random seeds; this one must be within the
        tolerance.
        """
        return max(self.by_seed, default=float("inf"))

    @property
    def sound(self) -> bool:
        """Return True if the recipe ran and its outputs were compared with the reference."""
        return bool(self.found.errors and self.found.seconds)


class PointCache:
    """A cache of measured points: a recipe is compared with the reference only once."""

    def __init__(self, reference: Recipe, store: Store, seeds: int, device: str = "cpu") -> None:
        """Prepare measurements against ``reference``, with ``seeds`` seeds of the noise (one
        without noise).
        """
        self.reference, self.store, self.device = reference, store, device
        has_noise = any(
            reference.steps[name].node.random for name in needed(reference, reference.outputs)
        )
        self.seeds = seeds if has_noise else 1
        self._truth: dict[int, dict[str, Any]] = {}
        self._code = Code(store.code_memo)
        self._warm = False

    def point(self, trial: Trial) -> WorkPrecisionPoint:
        """Return the errors and run times of a setting, from the store or measured now."""
        recipe = trial.recipe
        if recipe is None:
            return WorkPrecisionPoint(trial, PointMeasurement(refused=trial.refused))
        key = self.key(recipe)
        measurement = compute_once(
            self.store, key, PointMeasurement, lambda: self._measure(recipe), _STORED_AS
        )
        return WorkPrecisionPoint(trial, measurement)

    def time_again(self, point: WorkPrecisionPoint, number: int) -> WorkPrecisionPoint:
        """Return a measurement with the time of cold run ``number`` added; unchanged if the first
        run was slow.
        """
        recipe, seconds = point.trial.recipe, point.found.seconds
        if recipe is None or not seconds or seconds[0] >= _QUICK_SECONDS:
            return point
        timed = compute_once(
            self.store,
            digest(self.key(recipe), number),
            list,
            lambda: [self._time(recipe)],
            _STORED_AS,
        )
        return WorkPrecisionPoint(point.trial, replace(point.found, seconds=[*seconds, *timed]))

    def _time(self, recipe: Recipe) -> float:
        self._warm_up(recipe)
        return run_cold(recipe, self.store, self.device).seconds

    def key(self, recipe: Recipe) -> str:
        """Return the store key of a measurement: a digest of recipe, reference, engine, seeds,
        device and machine.
        """
        recipe_and_reference = [
            key_parts(compared, self._code, self.device) for compared in (recipe, self.reference)
        ]
        return digest(
            "accuracy", recipe_and_reference, self.seeds, self.device, engine(), machine()
        )

    def truth(self, seed: int) -> dict[str, Any]:
        """Return the outputs of the reference for the noise seed ``seed``, from the store or
        computed now.
        """
        if seed not in self._truth:
            recipe = replace(self.reference, seed=self.reference.seed + seed)
            result = run(recipe, self.store, device=self.device)
            self._truth[seed] = result.values
            # after computing most of the steps, the process has imported their libraries
            self._warm |= (
                sum(done.state == "run" for done in result.done.values()) > len(result.done) / 2
            )
        return self._truth[seed]

    def _measure(self, recipe: Recipe) -> PointMeasurement:
        """Run a recipe cold, compare its outputs with the reference, and return errors
        and times.
        """
        load_per_core = (
            os.getloadavg()[0] / (os.cpu_count() or 1) if hasattr(os, "getloadavg") else 0.0
        )
        seconds_by_step: dict[str, float] = {}

        def watch(event: Event) -> None:
            if event.done is not None and event.done.state == "run":  # again if the engine retries
                seconds_by_step[event.step] = (
                    seconds_by_step.get(event.step, 0.0) + event.done.seconds
                )

        try:
            self._warm_up(recipe)
            with cold(self.store) as store:
                result = run(recipe, store, watch=watch, device=self.device)
                errors = self._errors(recipe, result.values, store)
        except RunError as error:
            return PointMeasurement(refused=f"{error.step}: {error.cause}")
        return PointMeasurement(
            errors,
            [result.seconds],
            sum(seconds_by_step.values()),
            load_per_core,
            result.proof.worst_stated(result.values),
            seconds_by_step,
        )

    def _warm_up(self, recipe: Recipe) -> None:
        """Run the recipe once untimed, because the first run of a process imports libraries and
        reads code.
        """
        self.truth(0)
        for step in with_substitutions(recipe, recipe.outputs).steps.values():
            # store the digests of the code beforehand, so that they are not timed
            self._code.digest(step.node.fn.__module__)
        self._code.save()
        if not self._warm:
            run_cold(recipe, self.store, self.device)
            self._warm = True

    def _errors(
        self, recipe: Recipe, values: Mapping[str, Any], store: Store
    ) -> dict[str, list[float]]:
        """Return the errors of each output for all seeds; outputs with another shape than the
        reference are omitted.
        """
        # the same noise in recipe and reference
        by_output = compare_outputs(values, self.truth(0))
        for seed in range(1, self.seeds):
            other_seed = run(replace(recipe, seed=recipe.seed + seed), store, device=self.device)
            for name, errors in compare_outputs(other_seed.values, self.truth(seed)).items():
                by_output[name] += errors
        return by_output


def compare_outputs(values: Mapping[str, Any], truth: Mapping[str, Any]) -> dict[str, list[float]]:
    """Return the error of each output by name; outputs with another shape than the reference are
    omitted.
    """
    errors: dict[str, list[float]] = {}
    for name, value in values.items():
        # an output of another shape cannot be compared
        with suppress(ValueError):
            errors[name] = [error_of(value, truth[name])]
    return errors


# --- pareto line ----------------------------------------------------------------------------------

# The Pareto front of error and run time, and the engine's choices compared with the fastest
# settings.


Points = Sequence[WorkPrecisionPoint]


@dataclass(frozen=True)
class ToleranceChoice:
    """The engine's choice for a tolerance, and the fastest measured setting within the
    tolerance.
    """

    tolerance: float
    chosen: WorkPrecisionPoint
    cheapest: WorkPrecisionPoint | None  #: None where no point is within the tolerance

    @property
    def held(self) -> bool:
        """Return True if the error of the engine's choice is within the tolerance."""
        return self.chosen.most <= self.tolerance

    @property
    def ratio(self) -> float | None:
        """Return the ratio of the run time of the engine's choice to that of the fastest
        setting.
        """
        return None if self.cheapest is None else self.chosen.seconds / self.cheapest.seconds


def pareto_front(points: Points) -> list[WorkPrecisionPoint]:
    """Return the Pareto front: settings that no other setting beats in both run time and error, the
    fastest first.
    """
    front: list[WorkPrecisionPoint] = []
    for point in sorted(points, key=lambda p: (p.seconds, p.most)):
        # sorted by run time: a point on the front is more accurate than all before it
        if not front or point.most < front[-1].most:
            front.append(point)
    return front


def cheapest(points: Points, tolerance: float) -> WorkPrecisionPoint | None:
    """Return the fastest setting whose largest error is within ``tolerance``, or None."""
    return min((p for p in points if p.most <= tolerance), key=lambda p: p.seconds, default=None)


def median_ratio(choices: Iterable[ToleranceChoice]) -> float | None:
    """Return the median over all tolerances of the ratio of the engine's run time to the fastest
    run time.
    """
    ratios = [choice.ratio for choice in choices if choice.ratio is not None]
    return median(ratios) if ratios else None


# --- single steps ---------------------------------------------------------------------------------

# Run time and error of variants of single steps, compared with a reference.


Cut = tuple[int, int]  #: (longest side in pixels, largest number of bands); 0 for no limit
SHARE = 0.01  #: steps with a smaller share of the run time are not measured
_ITEM = re.compile(r"\[.*?\]")
_CUTS: Sequence[Cut] = ((32, 2), (64, 2), (128, 3), (256, 3), (512, 3), (1024, 3), (0, 3), (0, 0))
#: expected growth of the reference's run time from one cut to the next, as for a direct convolution
_GROWTH = 16.0
USED, _PRECISION = "as used", "precision"
_WINDOWS = (0.75, 0.5, 0.25)  #: shares of the side of a PSF
#: factors on the allowed error ``within`` of a step
_ALLOWANCES = (1e3, 1e2, 1e1, 1e-1, 1e-2, 1e-3)
#: a variant is called until this total time in s, or this number of calls, is reached
_LONG_ENOUGH, _CALLS = 0.5, 5


@dataclass(frozen=True)
class Variant:
    """One way to compute a step, with the resulting error and run time."""

    line: str  #: the property that is changed
    label: str  #: the new value of the property
    error: float
    seconds: float


@dataclass(frozen=True)
class StepMeasurement:
    """The errors and run times of a step's variants, in types that the store can save."""

    variants: list[dict[str, Any]] = field(default_factory=list)
    reference: float = 0.0  #: s
    #: description of the part of the inputs that was used; empty for the whole inputs
    cut_inputs: str = ""
    refused: str = ""


@dataclass(frozen=True)
class StepTried:
    """A step with a large share of the run time, and its measurement or the reason why there is
    none.
    """

    step: str  #: the slowest repetition of the step
    node: str
    share: float  #: share of the run time of all repetitions of the step together
    found: StepMeasurement

    @property
    def variants(self) -> list[Variant]:
        return [Variant(**variant) for variant in self.found.variants]


def steps_that_matter(recipe: Recipe, seconds: Mapping[str, float]) -> list[tuple[str, float]]:
    """Return (slowest repetition, share of run time) of each step with more than `SHARE` of the run
    time.
    """
    items_of_step: dict[str, list[str]] = defaultdict(list)
    for name in seconds:
        if name in recipe.steps:
            # group by names without their repetition in brackets
            items_of_step[_ITEM.sub("", name)].append(name)
    total = sum(seconds.values()) or 1.0
    shares = [
        (max(names, key=seconds.__getitem__), sum(seconds[item] for item in names) / total)
        for names in items_of_step.values()
    ]
    return sorted(
        (slowest_and_share for slowest_and_share in shares if slowest_and_share[1] > SHARE),
        key=lambda f: -f[1],
    )


def try_step(recipe: Recipe, name: str, share: float, store: Store, patience: float) -> StepTried:
    """Measure the variants of a step on inputs so small that the reference takes at most about
    ``patience`` s.
    """
    step = recipe.steps[name]
    if step.node.hooks.reference is None:
        return StepTried(
            name, step.node.path, share, StepMeasurement(refused="the node has no reference")
        )
    key = _key(recipe, name, patience, store)
    compute = partial(_measure, recipe, step, store, patience)
    measurement = compute_once(
        store, key, StepMeasurement, compute, {"step": f"study accuracy: {name}"}
    )
    keep_variants(
        recipe, name, [tuple(variant.values()) for variant in measurement.variants], store
    )
    return StepTried(name, step.node.path, share, measurement)


def _key(recipe: Recipe, name: str, patience: float, store: Store) -> str:
    """Return the store key of a step's measurement, from its inputs, its code, ``patience`` and the
    machine.
    """
    keys: dict[str, str] = {}
    code = Code(store.code_memo)
    for source_name in needed(recipe, (name,)):
        keys[source_name], _ = key_of(recipe.steps[source_name], keys, recipe.seed, code)
    return digest(
        "accuracy of a step",
        keys[name],
        patience,
        engine("studies.work_precision"),
        machine(),
    )


def _measure(recipe: Recipe, step: Step, store: Store, patience: float) -> StepMeasurement:
    """Return errors and run times of a step's variants, or why they cannot be measured."""
    try:
        input_values = run(replace(recipe, exact=True), store, step.sources).values
    except RunError as error:
        return StepMeasurement(refused=f"the inputs could not be computed: {error.cause}")
    inputs = [_gathered(step.wires.get(name), input_values) for name in step.node.inputs]
    with torch.no_grad():
        afforded = _largest(step, inputs, recipe.seed, patience)
        if afforded is None:
            return StepMeasurement(
                refused="the reference fails on the inputs and on every part of the inputs"
            )
        size, truth, seconds = afforded
        small_inputs = cut_inputs(step.node, inputs, size)
        variants = [
            asdict(variant) for variant in _variants(step, small_inputs, truth, recipe.seed)
        ]
    # True if no input was cut
    complete = all(
        whole_tensor.shape == cut_tensor.shape
        for whole_tensor, cut_tensor in zip(
            tensors_in(inputs), tensors_in(small_inputs), strict=True
        )
    )
    return StepMeasurement(variants, seconds, "" if complete else _cut_text(step.node, size))


def _gathered(wire: str | tuple[str, ...] | None, values: Mapping[str, Any]) -> Any:
    """Return the value at an input: one result, a list of results, or None if it is not
    connected.
    """
    return wire and (values[wire] if isinstance(wire, str) else [values[name] for name in wire])


def _largest(
    step: Step, inputs: list[Any], seed: int, patience: float
) -> tuple[Cut, Any, float] | None:
    """Return the largest input size for which the reference takes at most about ``patience`` s,
    with the result and the time.
    """
    largest_measured: tuple[Cut, Any, float] | None = None
    for size in _CUTS:
        # stop if the next cut would take too long; an entry is (size, result, seconds)
        if largest_measured is not None and largest_measured[2] * _GROWTH > patience:
            break
        small_inputs = cut_inputs(step.node, inputs, size)
        try:
            largest_measured = (
                size,
                *_time_once(partial(_call, step, step.node.hooks.reference, small_inputs, seed)),
            )
        except Exception:  # a small part of a picture may be no valid input; a larger part may be
            continue
    return largest_measured


def _variants(step: Step, inputs: list[Any], truth: Any, seed: int) -> Iterator[Variant]:
    """Yield each variant of a step; variants that fail or whose result has another shape than
    ``truth`` are omitted.
    """
    for (line, label), compute in _calls(step, inputs, seed).items():
        # raised for another shape, or for a dtype that the variant does not accept
        with suppress(ValueError, RuntimeError):
            result, seconds = _median_time(compute)
            yield Variant(
                line, label, error_of(_compared_value(result), _compared_value(truth)), seconds
            )


def _calls(step: Step, inputs: list[Any], seed: int) -> dict[tuple[str, str], Callable[[], Any]]:
    """Return functions that compute the variants of a step, by (changed property, new value)."""
    node = step.node
    calls: dict[tuple[str, str], Callable[[], Any]] = {
        (USED, ""): partial(_call, step, node, inputs, seed)
    }
    for precision in _other_precisions(step):
        calls[_PRECISION, precision] = partial(_call, step, node, inputs, seed, precision=precision)
    if "precision" not in step.params and any(map(_is_single, tensors_in(inputs))):
        double_inputs = each_tensor(lambda x: x.double() if _is_single(x) else x, inputs)
        calls[_PRECISION, "double"] = partial(_call, step, node, double_inputs, seed)
    for factor in _ALLOWANCES if "within" in step.params else ():
        within = step.params["within"] * factor
        # 1e-03 as 1e-3
        label = f"{within:.0e}".replace("e-0", "e-")
        calls["allowed error", label] = partial(_call, step, node, inputs, seed, within=within)
    for share, smaller_inputs in _smaller_windows(inputs):
        calls["window of the PSF", f"{share:g}"] = partial(_call, step, node, smaller_inputs, seed)
    if node.hooks.skip_bound is not None:
        calls["left out", ""] = lambda: inputs[0]
    return calls


def _other_precisions(step: Step) -> list[str]:
    """Return the precisions that a step could have instead of its own; empty without this
    parameter.
    """
    own_precision = step.params.get("precision")
    return (
        []
        if own_precision is None
        else [word for word in allowed_words(step, "precision") if word != own_precision]
    )


def _is_single(x: Tensor) -> bool:
    return x.dtype == torch.float32


def _smaller_windows(inputs: list[Any]) -> Iterator[tuple[float, list[Any]]]:
    """Yield (share, inputs) with each PSF cropped to a share of its window; nothing
    without a PSF.
    """
    if any(isinstance(value, Psf) for value in inputs):
        for share in _WINDOWS:
            yield (
                share,
                [_inner(value, share) if isinstance(value, Psf) else value for value in inputs],
            )


def _inner(psf: Psf, share: float) -> Psf:
    """Return a PSF cropped to ``share`` of each side; its centre stays at index N // 2."""
    intensity = psf.intensity
    for axis in (-2, -1):
        intensity = _centred(intensity, axis, max(1, round(share * intensity.shape[axis])))
    return psf._replace(intensity=intensity)


def _centred(x: Tensor, axis: int, count: int) -> Tensor:
    return x.narrow(axis, x.shape[axis] // 2 - count // 2, count)


def _compared_value(value: Any) -> Any:
    """Return the tensors of a step's result to compare, for example all bands of a low-rank
    spectral cube.
    """
    if isinstance(value, LowRankCube):
        return torch.einsum("bk,kyx->byx", value.basis.to(value.planes), value.planes)
    return value.planes if isinstance(value, Channels) else value


def _call(step: Step, function: Any, inputs: list[Any], seed: int, **other: Any) -> Any:
    """Call ``function`` with the inputs and parameters of a step, some replaced by ``other``; a
    random step gets the same random numbers as in a run.
    """
    rng = (
        {"rng": torch.Generator().manual_seed(stream_seed(seed, step.name))}
        if step.node.random
        else {}
    )
    return function(*inputs, **{**step.params, **other}, **rng)


def _time_once(compute: Callable[[], Any]) -> tuple[Any, float]:
    began = time.perf_counter()
    value = compute()
    return value, time.perf_counter() - began


def _median_time(compute: Callable[[], Any]) -> tuple[Any, float]:
    """Call a function several times; return its result and the median run time, without a short
    first call.
    """
    value, seconds = _time_once(compute)
    # ignore a short first call, which may import or compile
    times = [] if seconds < _LONG_ENOUGH else [seconds]
    while len(times) < _CALLS and sum(times) < _LONG_ENOUGH:
        times.append(_time_once(compute)[1])
    return value, median(times)


def cut_inputs(node: Node, inputs: list[Any], size: Cut) -> list[Any]:
    """Crop each picture in ``inputs`` to its middle, and keep fewer spectral bands if the node
    names the band axis.
    """
    side, bands = size
    smaller_inputs = []
    for name, value in zip(node.inputs, inputs, strict=True):
        axis = (node.bands or {}).get(name)
        fewer_bands = value if axis is None or not bands else _fewer_bands(value, axis, bands)
        smaller_inputs.append(
            each_tensor(lambda x: _middle(x, side), fewer_bands) if side else fewer_bands
        )
    return smaller_inputs


def _cut_text(node: Node, size: Cut) -> str:
    """Return as text which part of the inputs is used, such as ``the middle 64 x 64 and 3
    bands``.
    """
    side, bands = size
    takes_bands = bands and (node.bands or {}).keys() - {"return"}
    # a list times False is empty
    parts = [f"the middle {side} × {side}"] * bool(side) + [f"{bands} bands"] * bool(takes_bands)
    return " and ".join(parts)


def _middle(x: Tensor, side: int) -> Tensor:
    """Return the central ``side`` x ``side`` pixels of a picture; smaller and other tensors
    unchanged.
    """
    for axis in (-2, -1) if x.ndim >= 2 and min(x.shape[-2:]) > side else ():
        x = _centred(x, axis, side)
    return x


def _fewer_bands(value: Any, axis: int, bands: int) -> Any:
    """Return ``value`` with only ``bands`` of its spectral bands, evenly spaced."""
    if isinstance(value, Tensor):
        count = value.shape[axis]
        if count <= bands:
            return value
        # the central band of each of ``bands`` equal parts
        indices = value.new_tensor(
            [round((number + 0.5) * count / bands - 0.5) for number in range(bands)]
        ).long()
        return value.index_select(axis, indices)
    fields = {name: getattr(value, name) for name in band_names(value)}
    return (
        value._replace(**{n: _fewer_bands(tensor, axis, bands) for n, tensor in fields.items()})
        if fields
        else value
    )
