"""Graph of a checked recipe: its steps, their connections and order, and their records."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import chain
from typing import TYPE_CHECKING, Any, Literal

from neusee.nodes import Check, Node, TensorStats
from neusee.workflows.graph.errors import Location, nearest
from neusee.workflows.graph.final_values import Config, Setting

if TYPE_CHECKING:
    from neusee.nodes.calibrate import Traceability
    from neusee.workflows.recipe.blocks.safety_block import Safety
    from neusee.workflows.recipe.blocks.settings_block import EvaluateSettings
    from neusee.workflows.recipe.blocks.train_block import LiftTraining, Training
    from neusee.workflows.recipe.distributions.nominal_values import Uncertain


# --- step record ----------------------------------------------------------------------------------

# Records of the steps of a run: the state of each step with its reason, and the device, time and
# memory.


State = Literal["run", "cached", "left out", "not needed"]


@dataclass(frozen=True, slots=True)
class StepRecord:
    """Record of one step in a run: its state, the reason for this state, its time, memory and
    checks.
    """

    step: str
    state: State  #: ``not needed``: no step that ran needed this step
    why: str
    seconds: float
    key: str  #: cache key of the result
    facts: TensorStats | None = None
    checks: tuple[Check, ...] = ()
    device: str = "cpu"
    bytes: int = 0
    bound: float | None = None  #: upper bound of the change of the result if the step is omitted
    began: float = 0.0  #: start time of the step in s after the start of the run
    lane: str = ""  #: device or worker of the executor that computed the step
    peak: int | None = None  #: peak memory in bytes beyond the memory in use before the step
    predicted: float | None = None  #: time in s predicted from earlier runs
    #: of a cheaper step: rms and maximum, relative to the largest element
    error: tuple[float, float] | None = None
    predicted_peak: float | None = None  #: predicted peak memory in bytes, as ``peak``
    kept: bool = True  #: whether the value is in the store


@dataclass(frozen=True, slots=True)
class Event:
    """Start or end of a step during a run, reported to a live display; ``done`` is None at the
    start.
    """

    step: str
    done: StepRecord | None


# --- recipe graph ---------------------------------------------------------------------------------

# Graph of a checked recipe: its steps, the connections between the steps, and the order in which
# the steps run.


__all__ = [
    "Config",
    "Expectation",
    "Recipe",
    "Setting",
    "Step",
    "Substitution",
    "Wire",
    "in_order",
    "needed",
]

#: one step, the steps of all items, or no step for an optional input
Wire = str | tuple[str, ...] | None


def names_in(wire: Wire) -> tuple[str, ...]:
    """Return the names of the steps to which an input is connected."""
    return (wire,) if isinstance(wire, str) else wire or ()


@dataclass(frozen=True, slots=True)
class Step:
    """One step of a recipe: a node (a function), its validated parameters and the steps that
    compute its inputs.
    """

    name: str  #: ``psf[mask]``, ``spot[mask,green]``
    node: Node
    params: Mapping[str, Any]  #: validated, in SI, with the node's defaults
    wires: Mapping[str, Wire]  #: by input, in the node's order
    mark: Location
    param_marks: Mapping[str, Location]  #: location of each given value
    #: requested device: ``cpu``, ``gpu``, ``cuda:1``; empty if any; never part of a key
    device: str = ""
    cached: bool = True  #: False for ``cache: false``: computed in each run, and never stored
    #: names of all steps whose results are inputs of this step, in the order of the inputs
    sources: tuple[str, ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        names = chain.from_iterable(map(names_in, self.wires.values()))
        object.__setattr__(self, "sources", tuple(names))


@dataclass(frozen=True, slots=True)
class Substitution:
    """Replacement of a step by a cheaper step, with an upper bound on the error of the result."""

    step: str  #: the full step
    instead: str  #: the step that is computed
    within: float  #: upper bound on the error, relative to the largest element of the result
    why: str


@dataclass(frozen=True, slots=True)
class Expectation:
    """Number that a recipe expects in the result of ``step`` at the indices ``at``, with a
    relative tolerance.
    """

    name: str
    step: str
    at: tuple[int | str, ...]  #: indices, or the name of a field of a named tuple
    value: float
    rtol: float
    mark: Location


_COPIES = 8  #: copies of a step that a message lists
#: largest error of an input of a metric, because a metric may depend on a small difference
METRIC_TOLERANCE = 1e-3


@dataclass(frozen=True, slots=True, repr=False)
class Recipe:
    """Checked recipe, in which all steps, values and connections of steps are valid and no step
    has run yet.
    """

    name: str
    title: str
    seed: int
    tolerance: float
    outputs: tuple[str, ...]
    steps: Mapping[str, Step]
    expect: tuple[Expectation, ...] = ()
    config: Config = field(default_factory=Config)
    notes: tuple[str, ...] = ()
    #: location of the null, by the name of a step that is null
    absent: Mapping[str, str] = field(default_factory=dict)
    exact: bool = False  #: whether every step is computed in full at any tolerance
    #: whether errors that are estimated, not proved, may count towards the tolerance
    estimates: bool = True
    #: cheaper steps in place of full steps; empty after loading
    substitutions: tuple[Substitution, ...] = ()
    tolerance_scale: float = 1.0  #: fraction of the tolerance in use; below 1 after a failed proof
    #: the recipe before substitutions, if any
    unsubstituted: Recipe | None = field(default=None, compare=False)
    #: distributions for the study of uncertainty
    uncertain: Uncertain | None = field(default=None, compare=False)
    #: settings of the training of a network
    training: Training | None = field(default=None, compare=False)
    #: one recipe for each camera of `train.cameras`
    cameras: tuple[Recipe, ...] = field(default=(), compare=False)
    #: settings of the training of a lift
    lifting: LiftTraining | None = field(default=None, compare=False)
    #: settings of the estimate of damage and dazzle
    safety: Safety | None = field(default=None, compare=False)
    #: settings of an evaluation
    evaluation: EvaluateSettings | None = field(default=None, compare=False)
    #: what the laboratory states of its light
    traceability: Traceability | None = field(default=None, compare=False)
    #: data files, True for half; None: all
    exports: Mapping[str, bool] | None = field(default=None, compare=False)
    #: steps whose errors reach a node without an error bound
    unbounded: frozenset[str] = frozenset()

    def limit(self, step: str) -> float:
        """Return the largest relative error allowed in the result of a step.

        This is the tolerance of the recipe, or at most `METRIC_TOLERANCE` if a later node has no
        error bound.
        """
        return min(self.tolerance, METRIC_TOLERANCE) if step in self.unbounded else self.tolerance

    def allowed(self, step: str) -> float:
        """Return the total relative error that omitted and approximated steps may cause in the
        result of ``step``.
        """
        return self.limit(step) * self.tolerance_scale

    def __repr__(self) -> str:
        return f"<recipe {self.name}: {len(self.steps)} steps -> {', '.join(self.outputs)}>"


def copies_of(recipe: Recipe, names: Iterable[str]) -> set[str]:
    """Return the steps ``names``; a name without items, such as ``psf``, stands for all copies.

    Raises `ValueError` for a name that no step has.
    """
    copies = set[str]()
    for name in names:
        copies_of_name = {step for step in recipe.steps if name in (step, step.partition("[")[0])}
        if not copies_of_name:
            raise ValueError(unknown_step(name, recipe.steps))
        copies |= copies_of_name
    return copies


def by_family(names: Iterable[str]) -> dict[str, list[str]]:
    """Group names of steps by the part before the bracket: ``psf[plain]`` and ``psf[mask]``
    belong to ``psf``.
    """
    groups: dict[str, list[str]] = {}
    for name in names:
        groups.setdefault(name.partition("[")[0], []).append(name)
    return groups


def needed(recipe: Recipe, outputs: Iterable[str]) -> list[str]:
    """Return the names of the steps that must run to compute the steps ``outputs``, in
    topological order.
    """
    return ordered({name: step.sources for name, step in recipe.steps.items()}, outputs)


def ordered(sources: Mapping[str, tuple[str, ...]], names: Iterable[str]) -> list[str]:
    """Return the steps ``names`` and their sources in topological order, as `in_order` does;
    cached, because the points of a sweep share few graphs.

    ``sources`` has the steps that each step reads.
    """
    return list(_ordered(tuple(sources), tuple(sources.values()), tuple(names)))


@lru_cache(32)
def _ordered(
    steps: tuple[str, ...], sources: tuple[tuple[str, ...], ...], names: tuple[str, ...]
) -> tuple[str, ...]:
    """Return the result of `ordered`, for arguments that are hashable."""
    return tuple(in_order(dict(zip(steps, sources, strict=True)), names))


def nodes_of(recipe: Recipe, outputs: Iterable[str]) -> list[str]:
    """Return the paths of the nodes that must run to compute the steps ``outputs``, each once."""
    return list(dict.fromkeys(recipe.steps[name].node.path for name in needed(recipe, outputs)))


def dependents(
    recipe: Recipe, roots: Iterable[str], order: Iterable[str] | None = None
) -> set[str]:
    """Return the names of the steps ``roots`` and of all steps that depend on them, directly or
    indirectly.

    ``order`` lists the steps to consider, in topological order; by default, all steps of the
    recipe.
    """
    names = set(roots)
    for name in needed(recipe, recipe.steps) if order is None else order:
        if not names.isdisjoint(recipe.steps[name].sources):
            names.add(name)
    return names


def in_order(sources: Mapping[str, Iterable[str]], names: Iterable[str]) -> list[str]:
    """Return the steps ``names`` and all steps that they depend on, in topological order; the
    graph has no cycle.
    """
    # as an ordered set
    order: dict[str, None] = {}
    # depth-first search: each step with its sources still to visit
    stack = [(name, iter(sources[name])) for name in reversed(list(names))]
    while stack:
        name, sources_left = stack[-1]
        next_source = next((source for source in sources_left if source not in order), None)
        if next_source is not None:
            stack.append((next_source, iter(sources[next_source])))
            continue
        order.setdefault(name)
        stack.pop()
    return list(order)


def unknown_step(name: str, steps: Collection[str]) -> str:
    """Return the error message for an unknown step name, which suggests names such as
    ``psf[mask]``.
    """
    copies = sorted(step for step in steps if step.startswith(f"{name}["))
    if not copies:
        return f"no step {name!r}; {nearest(name, steps)}"
    remainder = f" and {len(copies) - _COPIES} more" if len(copies) > _COPIES else ""
    return f"no output {name}: this recipe has {', '.join(copies[:_COPIES])}{remainder}"


# --- told copies ----------------------------------------------------------------------------------

# Copies of the steps that describe optics and laser to a restorer, so that the camera may differ
# from the assumptions of the restorer.
#
# The camera keeps its steps. The copies have the prefix ``told_``, and the restorer reads these in
# place of the camera's.


TOLD = "told_"  #: prefix of the copies
#: inputs of a restorer that describe the optics and the laser
KNOWLEDGE = ("psf", "glare", "nearby")
#: step of the frame behind the mask: the camera is before it, the processing of the user after it
FRAME = "raw[mask]"


def knowers(recipe: Recipe, steps: Iterable[str]) -> list[str]:
    """Return those of the steps with an input that describes optics or lasers."""
    return [name for name in steps if any(recipe.steps[name].wires.get(key) for key in KNOWLEDGE)]


def known(recipe: Recipe, readers: Iterable[str]) -> list[str]:
    """Return the steps whose results describe optics and lasers to the steps ``readers``."""
    names: list[str] = []
    for reader in readers:
        wires = recipe.steps[reader].wires
        for key in KNOWLEDGE:
            names += names_in(wires.get(key))
    return names


def with_copies(
    recipe: Recipe, readers: Iterable[str], copied: Collection[str], change: Callable[[Step], Step]
) -> Recipe:
    """Return the recipe with changed copies of the steps ``copied``, which the ``readers`` read in
    place of the originals.
    """
    steps = dict(recipe.steps)
    for name in copied:
        step = change(recipe.steps[name])
        wires = {key: _told(wire, copied) for key, wire in step.wires.items()}
        steps[TOLD + name] = replace(step, name=TOLD + name, wires=wires)
    for name in readers:
        step = recipe.steps[name]
        wires = {
            key: _told(wire, copied) if key in KNOWLEDGE else wire
            for key, wire in step.wires.items()
        }
        steps[name] = replace(step, wires=wires)
    return replace(recipe, steps=steps)


def _told(wire: Wire, copied: Collection[str]) -> Wire:
    """Return a connection to the copies of those steps that have one."""
    if isinstance(wire, str):
        return TOLD + wire if wire in copied else wire
    return None if wire is None else tuple(TOLD + name if name in copied else name for name in wire)
