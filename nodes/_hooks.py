"""Hooks: the functions that are attached to a node, such as bounds of its error and checks of its result."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from neusee.nodes._error_bound import ErrorBound


@dataclass(frozen=True, slots=True)
class Check:
    """One finding about the result of a node, such as ``Check("phase step 0.31 turn < 0.5", True)``."""

    text: str
    ok: bool = True


@dataclass(slots=True)
class Hooks:
    """The functions attached to a node (hooks), such as ``check``, which ``@digitize.check`` attaches."""

    #: slow float64 form: same arguments, same result within ``rtol``
    reference: Callable[..., Any] | None = None
    #: (`TensorStats` of each input, *, parameters): bound of ``max |with - without| / max |with|`` if the step is left
    #: out and its first input is used instead; for a random node, in root mean square over the noise
    skip_bound: Callable[..., float] | None = None
    #: (`TensorStats` of the first input, *, parameters): the factor by which the root mean square of one draw of the
    #: noise exceeds `skip_bound` in one of 10 000 draws
    skip_draw: Callable[..., float] | None = None
    #: True if `skip_bound` is an estimate and no bound, for which a recipe with ``estimates: false`` omits nothing
    skip_estimated: bool = False
    #: (`TensorStats` of the first input, *, parameters): the scale of `skip_bound`, such as the full well, because a
    #: later step cuts off larger values
    skip_scale: Callable[..., float] | None = None
    #: (`TensorStats` of each input, None for an absent input, *, parameters): bound of the result's largest element;
    #: where the bound is 0, the step and the steps that only feed this step are left out
    zero_bound: Callable[..., float] | None = None
    #: (`ErrorBound` of each input, *, result: TensorStats, parameters): the error that errors of the inputs cause in
    #: the result; both errors are upper bounds in root mean square; a list input has a list, an absent input None; an
    #: `ErrorBound` in place of a number also tells the error of the largest element; without this hook the inputs must
    #: satisfy the tolerance themselves, because the error of the result is not known
    propagate_error: Callable[..., float | ErrorBound] | None = None
    #: (the same arguments): the error that one of 10 000 draws of the noise exceeds, where `propagate_error` gives that
    #: of all draws; a run states it and does not hold it to the tolerance
    propagate_draw: Callable[..., float] | None = None
    #: (the same arguments): the error of the result from errors like noise (`ErrorBound.scattered`, here as ``rms``);
    #: without this hook `propagate_error` holds for these errors too
    propagate_scattered: Callable[..., float] | None = None
    #: (rms error of the result as `propagate_error` gives it, *, result: TensorStats, parameters): the rms error with
    #: what rounding to whole numbers adds; an estimate, which a run states and does not hold to the tolerance
    rounding_error: Callable[..., float] | None = None
    #: True if `propagate_error` or `approximation_error` gives an estimate and no bound, which a recipe with
    #: ``estimates: false`` does not use
    estimated: bool = False
    #: (result): the error of a cheaper form relative to its largest element, in root mean square and for the largest
    #: element alone; both include the cheaper forms of the inputs, and not what was left out of the inputs
    approximation_error: Callable[[Any], tuple[float, float]] | None = None
    #: (parameters): True if the result is the same for every band
    band_invariant: Callable[[Mapping[str, Any]], bool] | None = None
    #: (*, parameters): notes for the user, before anything runs; may raise `ParameterError`; an argument with the name
    #: of an input receives what is known of that input before the run, as ``shape`` gives it, else None
    preflight: Callable[..., Sequence[str]] | None = None
    #: (result, *inputs, **parameters): findings, once after computing
    check: Callable[..., Sequence[Check]] | None = None
    #: (what is known of each input, None where nothing is, **parameters): what is known of the result before the run:
    #: tensors on the device ``meta``, which have a shape and a type but no values; a tensor of few numbers may have
    #: values. A rule that fails, such as one that needs an unknown input, leaves the result unknown
    shape: Callable[..., Any] | None = None
    #: (`TensorStats` of each input, *, parameters): least and largest element of the result as a plan expects them
    #: before the run, no bound; an input of which nothing is known raises LookupError where it is read
    expected_range: Callable[..., tuple[float, float]] | None = None
    #: (): the arguments of one small call by name, on which `neusee check` tries the node
    example: Callable[[], Mapping[str, Any]] | None = None
    #: (result, *inputs, **parameters), all as for ``shape``: bytes of memory during the run beside inputs and result,
    #: and number of operations, both up to a constant factor, which is measured
    work: Callable[..., tuple[float, float]] | None = None
