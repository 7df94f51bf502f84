"""Division of the bands and pictures of a training among processes."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, get_args

import torch
from torch import Tensor

from neusee.nodes import spectra
from neusee.nodes.sensor import channel_sums
from neusee.nodes.values import Bands, Channels, LowRankCube
from neusee.workflows.engine.differentiable_function import Theta, as_function
from neusee.workflows.engine.node_call import band_tensors, call, taken, with_band_tensors
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.recipe_graph import Recipe, Step, in_order, needed
from neusee.workflows.store.result_store import Store
from neusee.workflows.store.serialization import each_tensor, tensors_in
from neusee.workflows.tolerance.cheaper_steps import Asked, asked_of
from neusee.workflows.training.process_mesh import (
    ALONE,
    Mesh,
    MeshError,
    Sum,
    gathered,
    gathered_back,
    own_bands,
)
from neusee.workflows.training.process_mesh import Bands as Swapped

# --- band shards ----------------------------------------------------------------------------------

# Division of the spectral bands of a training among processes, up to the first step that needs all
# bands.
#
# Each process computes its own bands of every step that works band by band, with the same bits as a
# single process. The first step that does not work band by band needs all bands: every process
# gathers the bands of the mask's PSF, and the bands of a picture are sent to its process. If later
# steps read only sums over bands, only the sums are sent.


Port = Swapped | Sum


@dataclass(frozen=True)
class Shards:
    """The steps of a recipe whose spectral bands are divided among processes, and later steps
    that need all bands.
    """

    recipe: Recipe
    mesh: Mesh = ALONE
    count: int = 0  #: bands of the scene
    steps: frozenset[str] = frozenset()  #: steps of which each process computes its own bands
    behind: frozenset[str] = frozenset()  #: later steps, which need all bands
    #: weights of sums over bands, by image that is summed
    rows: Mapping[str, Tensor] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        recipe: Recipe,
        psf: str,
        outputs: Sequence[str],
        live: Collection[str],
        store: Store,
        mesh: Mesh,
    ) -> Shards:
        """Divide the spectral bands of a recipe among the processes; raise MeshError if there are
        too few bands.

        Only the steps ``live``, which are computed in each training iteration, are divided.
        """
        if mesh.band == 1:
            return cls(recipe)
        spectral = _sampled(recipe, psf)
        count = _count(recipe, psf, spectral, store, mesh)
        steps, behind = set[str](), set[str]()
        for name in needed(recipe, outputs):
            if name not in live:
                continue
            sources = set(recipe.steps[name].sources)
            if not sources & behind and _by_band(recipe, name, spectral):
                steps.add(name)
            elif sources & (behind | steps):
                behind.add(name)
        summed_alone = {}
        for name in sorted(steps):
            asked = _asked(recipe, name, outputs, behind, live)
            if asked:
                summed_alone[name] = asked
        rows = {name: _rows(recipe, asked, store) for name, asked in summed_alone.items()}
        return cls(recipe, mesh, count, frozenset(steps), frozenset(behind), rows)

    @property
    def own(self) -> list[int]:
        """Return the indices of the spectral bands that this process computes."""
        return own_bands(self.mesh, self.count)

    def call(
        self, step: Step, inputs: Sequence[Any], params: Mapping[str, Any], seed: int, device: str
    ) -> Any:
        """Compute a step and return its result; a divided step computes the spectral bands of
        this process alone.
        """
        if step.name in self.steps:
            undivided = [
                name for name in step.node.inputs if step.wires.get(name) not in self.steps
            ]
            inputs = taken(step, inputs, self.own, undivided)
        return call(step, inputs, params, seed, device)

    def gathered(self, name: str, value: Any) -> Any:
        """Return the result of a step with the spectral bands of all processes."""
        axis = self.axis(name)
        return with_band_tensors(
            value, [gathered(self.mesh, x, axis, self.count) for x in band_tensors(value)]
        )

    def axis(self, name: str) -> int:
        """Return the index of the tensor axis of the spectral bands in the result of a step."""
        bands = self.recipe.steps[name].node.bands
        assert bands is not None
        return bands["return"]

    def sent(self, name: str, value: Any) -> list[Tensor]:
        """Return the tensors of a step's result that this process sends to the process that
        completes the picture.
        """
        if name not in self.rows:
            return band_tensors(value)
        return [channel_sums(value, self.rows[name][:, self.own]).planes]

    def ports(self, name: str, sent: Sequence[Tensor]) -> list[Port]:
        """Return an exchange object for each tensor of ``sent``, which exchanges spectral bands
        or sums over bands.
        """
        if name in self.rows:
            return [Sum(self.mesh)]
        return [Swapped(self.mesh, self.axis(name), self.count) for _ in sent]

    def received(self, name: str, like: Any, tensors: Sequence[Tensor]) -> Any:
        """Assemble the result of a step with all spectral bands from the tensors that other
        processes sent.
        """
        if name not in self.rows:
            return with_band_tensors(like, tensors)
        exact = self.rows[name].new_zeros(())
        return Channels(tensors[0], self.rows[name], exact, largest=exact)


def _sampled(recipe: Recipe, name: str) -> set[str]:
    """Return the steps that define the spectral bands on which the step ``name`` depends."""
    return {n for n in needed(recipe, [name]) if recipe.steps[n].node.hints["return"] is Bands}


def _by_band(recipe: Recipe, name: str, spectral: set[str]) -> bool:
    """Return True if a step computes each band of the steps ``spectral`` independently of the
    other bands.
    """
    node = recipe.steps[name].node
    return (
        node.bands is not None and _sampled(recipe, name) == spectral and not _mixed(recipe, name)
    )


def _mixed(recipe: Recipe, name: str) -> bool:
    """Return True if the result of a step is a low-rank cube, whose components mix all spectral
    bands.
    """
    while (kind := recipe.steps[name].node.hints["return"]) is not LowRankCube:
        step = recipe.steps[name]
        wires = (step.wires.get(name) for name in step.node.accepts_low_rank)
        through = next((wire for wire in wires if isinstance(wire, str)), None)
        if through is None or LowRankCube not in get_args(kind):
            return False
        name = through
    return True


def _count(recipe: Recipe, psf: str, spectral: set[str], store: Store, mesh: Mesh) -> int:
    step = recipe.steps[psf]
    if not _by_band(recipe, psf, spectral) or len(spectral) != 1:
        raise MeshError(
            f"{step.mark}: {psf} ({step.node.path}) computes all bands together, which --mesh"
            f" {mesh} cannot divide: write --mesh {mesh.size}x1"
        )
    (bands,) = spectral
    count = len(run(recipe, store, [bands]).values[bands].centres)
    if mesh.band > count:
        raise MeshError(
            f"{recipe.steps[bands].mark}: {bands} has only {count} bands for {mesh.band} processes:"
            f" write --mesh with a band axis of at most {count} instead of --mesh {mesh}"
        )
    return count


def _asked(
    recipe: Recipe,
    name: str,
    outputs: Sequence[str],
    behind: Collection[str],
    live: Collection[str],
) -> Asked | None:
    """Return the sums over spectral bands that later steps read from an image, or None if they
    read other values.
    """
    asked = None if name in outputs else asked_of(recipe, name, outputs)
    still = asked is not None and asked.bands not in live and asked.responses not in live
    return asked if asked is not None and still and set(behind).issuperset(asked.readers) else None


def _rows(recipe: Recipe, asked: Asked, store: Store) -> Tensor:
    results = run(recipe, store, [asked.bands, asked.responses]).values
    rows: Tensor = spectra.rows(results[asked.bands], results[asked.responses], well=asked.well)
    return rows


# --- shared graph ---------------------------------------------------------------------------------

# Results that depend on the mask but on no picture, computed once for all pictures of a training
# iteration.


@dataclass(frozen=True)
class Shared:
    """Results that depend on the mask but on no picture, with detached copies that add up
    gradients of all pictures.
    """

    made: Mapping[str, Any]  #: results with their autograd graph, at the bands of this process
    values: Mapping[str, Any]  #: detached copies
    gathered: Mapping[str, Any] = field(default_factory=dict)  #: copies with all bands
    shards: Shards | None = None

    @classmethod
    def of(
        cls, made: Mapping[str, Any], shards: Shards | None = None, gathered: Sequence[str] = ()
    ) -> Shared:
        """Detach results from the autograd graph, and gather all spectral bands of the results
        named in ``gathered``.
        """
        leaves: dict[str, Any] = each_tensor(leaf, dict(made))  # two results may be one tensor
        if shards is None or not leaves:
            return cls(made, leaves)
        every = {
            name: _alike(shards.gathered(name, leaves[name]), leaves[name]) for name in gathered
        }
        return cls(made, leaves, every, shards)

    @property
    def seen(self) -> Mapping[str, Any]:
        """Return the detached copies that later steps read; those in ``whole`` have all spectral
        bands.
        """
        return {**self.values, **self.gathered}

    def back(self) -> None:
        """Propagate the accumulated gradients from the detached copies to the mask."""
        for name, value in self.gathered.items():
            for own, copy in zip(tensors_in(self.values[name]), tensors_in(value), strict=True):
                self._to_own(name, own, copy)
        pairs = zip(tensors_in(dict(self.made)), tensors_in(dict(self.values)), strict=True)
        roots = [(x, leaf.grad) for x, leaf in pairs if x.requires_grad and leaf.grad is not None]
        if roots:
            torch.autograd.backward([x for x, _ in roots], [grad for _, grad in roots])

    def _to_own(self, name: str, own: Tensor, copy: Tensor) -> None:
        """Sum a gradient over all processes, and keep the part for the spectral bands of this
        process.
        """
        if not own.requires_grad:
            return
        assert self.shards is not None
        grad = torch.zeros_like(copy) if copy.grad is None else copy.grad
        total = gathered_back(self.shards.mesh, grad, self.shards.axis(name), self.shards.count)
        own.grad = total if own.grad is None else own.grad + total


def leaf(x: Tensor) -> Tensor:
    """Return a detached copy of a tensor, with the same ``requires_grad``."""
    return x.detach().requires_grad_(x.requires_grad)


def _alike(value: Any, like: Any) -> Any:
    """Set ``requires_grad`` of the tensors in ``value`` as in ``like``, and return ``value``."""
    for x, y in zip(tensors_in(value), tensors_in(like), strict=True):
        x.requires_grad_(y.requires_grad)
    return value


# --- picture rounds -------------------------------------------------------------------------------

# Computation of training pictures by several processes, where each process computes some of the
# spectral bands.
#
# Every process computes its bands of every picture. Then the process that owns a picture receives
# all bands, or sums over the bands, and computes all later steps. Gradients return to all
# processes.


class Pictures:
    """The steps for each training picture: first steps divided by spectral band among processes,
    later steps in one.
    """

    def __init__(
        self,
        recipe: Recipe,
        free: Sequence[str],
        outputs: Sequence[str],
        redraw: Collection[str],
        shards: Shards,
        run: Mapping[str, Any],
    ) -> None:
        self.shards = shards
        inner = shards.steps.difference(free)
        read = set[str]()
        for name in _live(recipe, free, outputs):
            if name not in shards.steps:
                read.update(recipe.steps[name].sources)
        self._cut = sorted(inner & (read | set(outputs)))
        within = _used(recipe, [*free, *self._cut], outputs) if self._cut else free
        self._end = as_function(recipe, *within, outputs=outputs, redraw=redraw, **run)
        if self.by_band:
            first = _used(recipe, free, self._cut)
            self._start = as_function(
                recipe, *first, outputs=self._cut, redraw=redraw, caller=shards.call, **run
            )

    def alone(self, theta: Theta, seed: int) -> dict[str, Any]:
        """Compute a training picture in this process alone, and return the outputs of the
        recipe.
        """
        return self._end(_only(theta, self._end.free), seed)

    @property
    def by_band(self) -> bool:
        """Return True if the spectral bands of each training picture are divided among the
        processes.
        """
        return bool(self._cut)

    @contextmanager
    def together(
        self, shared: Shared, drawn: Mapping[int, tuple[Theta, int]], mine: int | None
    ) -> Iterator[dict[str, Any]]:
        """Compute this process's spectral bands of all pictures, and yield the outputs of the
        picture ``mine``, if any.

        When the ``with`` block ends, the gradients return to the processes that sent the bands.
        """
        start = self._start
        begun = [
            start(_only({**shared.values, **theta}, start.free), seed)
            for theta, seed in drawn.values()
        ]
        cut = _Cut(begun, self._cut, self.shards)
        if mine is None:
            yield {}
        else:
            theta, seed = drawn[mine]
            yield self.alone({**shared.seen, **theta, **cut.values}, seed)
        cut.back()


class _Cut:
    """The intermediate results of several training pictures, sent to the process that completes
    each picture.
    """

    def __init__(
        self, begun: Sequence[Mapping[str, Any]], names: Sequence[str], shards: Shards
    ) -> None:
        #: exchange, sent tensors, received tensor
        self._sent: list[tuple[Port, tuple[Tensor, ...], Tensor]] = []
        self.values: dict[str, Any] = {}
        for name in names:
            parts = [shards.sent(name, results[name]) for results in begun]
            leaves = []
            for port, tensors in zip(
                shards.ports(name, parts[0]), zip(*parts, strict=True), strict=True
            ):
                leaves.append(port.there(tensors).requires_grad_(tensors[0].requires_grad))
                self._sent.append((port, tensors, leaves[-1]))
            self.values[name] = shards.received(name, begun[0][name], leaves)

    def back(self) -> None:
        """Send the gradients of each picture back to the processes that computed the spectral bands
        of the picture.

        A process without a picture sends zeros.
        """
        roots: list[Tensor] = []
        grads: list[Tensor] = []
        for port, sent, leaf in self._sent:
            if leaf.requires_grad:
                own_grads = port.back(torch.zeros_like(leaf) if leaf.grad is None else leaf.grad)
                roots += sent
                grads += own_grads[: len(sent)]
        if roots:
            torch.autograd.backward(roots, grads)


def _live(recipe: Recipe, computed: Sequence[str], outputs: Sequence[str]) -> list[str]:
    sources = {
        name: () if name in computed else step.sources for name, step in recipe.steps.items()
    }
    return in_order(sources, outputs)


def _used(recipe: Recipe, free: Sequence[str], outputs: Sequence[str]) -> list[str]:
    """Return the steps and parameters from the list ``free`` on which an output of the recipe
    depends.
    """
    live = set(_live(recipe, free, outputs))
    return [
        name for name in free if (name if name in recipe.steps else name.rpartition(".")[0]) in live
    ]


def _only(theta: Theta, free: Sequence[str]) -> dict[str, Any]:
    return {name: theta[name] for name in free}
