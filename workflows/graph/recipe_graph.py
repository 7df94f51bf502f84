"""The graph of a checked recipe: steps, their wires and the order in which they run."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from neusee.nodes import Node
from neusee.workflows.graph.diagnostics import Location, nearest
from neusee.workflows.graph.final_values import Config, Setting

if TYPE_CHECKING:
    from neusee.workflows.engine.runner import Result
    from neusee.workflows.engine.step_job import Executor
    from neusee.workflows.graph.step_record import Event
    from neusee.workflows.recipe.blocks.train_block import Training
    from neusee.workflows.recipe.blocks.train_lift_block import LiftTraining
    from neusee.workflows.recipe.distributions.nominal_values import Uncertain
    from neusee.workflows.store.result_store import Store

__all__ = ["Config", "Expectation", "Recipe", "Setting", "Step", "Substitution", "Wire", "in_order", "needed"]

Wire = str | tuple[str, ...] | None  #: one step, the steps of all items, or an optional input that is absent


@dataclass(frozen=True, slots=True)
class Step:
    """One step of the graph: a node, its validated parameters and the steps that feed the node."""

    name: str  #: ``psf[mask]``, ``spot[mask,green]``
    node: Node
    params: Mapping[str, Any]  #: validated, in SI, with the node's defaults
    wires: Mapping[str, Wire]  #: by input, in the node's order
    mark: Location
    param_marks: Mapping[str, Location]  #: location of each given value
    device: str = ""  #: requested device: ``cpu``, ``gpu``, ``cuda:1``; empty if any; never part of a key

    @property
    def sources(self) -> tuple[str, ...]:
        """Return every step that feeds this one, in the order of the inputs."""
        return tuple(name for wire in self.wires.values() for name in _names(wire))


def _names(wire: Wire) -> tuple[str, ...]:
    return () if wire is None else (wire,) if isinstance(wire, str) else wire


@dataclass(frozen=True, slots=True)
class Substitution:
    """A cheaper step that replaces a full step."""

    step: str  #: the full step
    instead: str  #: the step that is computed
    within: float  #: upper bound on the error, relative to the largest element of the result
    why: str


@dataclass(frozen=True, slots=True)
class Expectation:
    """A number that the recipe promises: ``step`` at ``at`` is ``value`` within ``rtol``."""

    name: str
    step: str
    at: tuple[int | str, ...]  #: indices, or the name of a field of a named tuple
    value: float
    rtol: float
    mark: Location


_ARMS = 8  #: arms of a step that a message names
METRIC_TOLERANCE = 1e-3  #: error limit for inputs of figures of merit, which may depend on a small difference


@dataclass(frozen=True, slots=True, repr=False)
class Recipe:
    """A recipe with checked values, wires and files; no step has run yet."""

    name: str
    title: str
    seed: int
    tolerance: float
    outputs: tuple[str, ...]
    steps: Mapping[str, Step]
    expect: tuple[Expectation, ...] = ()
    config: Config = field(default_factory=Config)
    notes: tuple[str, ...] = ()
    absent: Mapping[str, str] = field(default_factory=dict)  #: step that is null -> location of the null
    exact: bool = False  #: compute every step in full, whatever the tolerance allows
    substitutions: tuple[Substitution, ...] = ()  #: cheaper steps in place of full steps; empty when read
    tolerance_scale: float = 1.0  #: share of the tolerance in use; below 1 after a failed proof
    unsubstituted: Recipe | None = field(default=None, compare=False)  #: the recipe before substitutions, if any
    uncertain: Uncertain | None = field(default=None, compare=False)  #: distributions for the study of uncertainty
    training: Training | None = field(default=None, compare=False)  #: training of a network
    lifting: LiftTraining | None = field(default=None, compare=False)  #: training of a lift
    unbounded: frozenset[str] = frozenset()  #: steps whose errors reach a node without an error bound

    def limit(self, step: str) -> float:
        """Return the error allowed for a step: the tolerance, at most `METRIC_TOLERANCE` where nothing bounds it."""
        return min(self.tolerance, METRIC_TOLERANCE) if step in self.unbounded else self.tolerance

    def allowed(self, step: str) -> float:
        """Return the total error that omissions and approximations up to a step may cause."""
        return self.limit(step) * self.tolerance_scale

    def run(
        self,
        store: Store | None = None,
        outputs: Iterable[str] | None = None,
        watch: Callable[[Event], None] | None = None,
        device: str = "cpu",
        executor: Executor | None = None,
        memory: int | None = None,
    ) -> Result:
        """Run the recipe; see `neusee.workflows.run`. Several threads may call this at once, on one store."""
        from neusee.workflows.engine.runner import run

        return run(self, store, outputs, watch, device, executor, memory)

    def __repr__(self) -> str:
        return f"<recipe {self.name}: {len(self.steps)} steps -> {', '.join(self.outputs)}>"

    def _repr_html_(self) -> str:
        from neusee.workflows.report.notebook import recipe_html

        return recipe_html(self)


def needed(recipe: Recipe, outputs: Iterable[str]) -> list[str]:
    """Return the steps that ``outputs`` need, each after its sources."""
    return in_order({name: step.sources for name, step in recipe.steps.items()}, outputs)


def in_order(sources: Mapping[str, Iterable[str]], wanted: Iterable[str]) -> list[str]:
    """Return names after their sources, without recursion; the graph must have no cycle."""
    order: dict[str, None] = {}
    stack = [(name, iter(sources[name])) for name in reversed(list(wanted))]
    while stack:
        name, rest = stack[-1]
        below = next((s for s in rest if s not in order), None)
        if below is not None:
            stack.append((below, iter(sources[below])))
            continue
        order.setdefault(name)
        stack.pop()
    return list(order)


def unknown_step(name: str, steps: Collection[str]) -> str:
    """Return a message for a missing step ``name``, with the step's arms or the nearest name."""
    arms = sorted(step for step in steps if step.startswith(f"{name}["))
    if not arms:
        return f"no step {name!r}; {nearest(name, steps)}"
    more = f" and {len(arms) - _ARMS} more" if len(arms) > _ARMS else ""
    return f"no output {name}: this recipe has {', '.join(arms[:_ARMS])}{more}"


def kept_promises(recipe: Recipe, written: Recipe) -> Recipe:
    """Return ``recipe`` with those expected numbers whose steps are unchanged from ``written``."""
    same = {name for name in recipe.steps if _alike(recipe, written, name)}
    for name in in_order({n: s.sources for n, s in recipe.steps.items()}, recipe.steps):
        if not same.issuperset(recipe.steps[name].sources):
            same.discard(name)
    lost = [e for e in recipe.expect if e in written.expect and e.step not in same]
    if not lost:
        return recipe
    note = f"not compared, because your changes affect these numbers: {', '.join(e.name for e in lost)}"
    kept = tuple(e for e in recipe.expect if e not in lost)
    return replace(recipe, expect=kept, notes=(*recipe.notes, note))


def _alike(recipe: Recipe, written: Recipe, name: str) -> bool:
    one, other = recipe.steps[name], written.steps.get(name)
    seeded = one.node.random and recipe.seed != written.seed
    return (
        other is not None
        and not seeded
        and (one.node, one.params, one.wires) == (other.node, other.params, other.wires)
    )
