"""Division of the spectral bands of a training among processes, up to the first step that needs all bands.

Each process computes its own bands of every step that works band by band, with the same bits as a single process. The
first step that does not work band by band needs all bands: every process gathers the bands of the mask's PSF, and the
bands of a picture are sent to its process. If later steps read only sums over bands, only the sums are sent.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, get_args

from torch import Tensor

from neusee.nodes import spectra
from neusee.nodes.sensor import channel_sums
from neusee.nodes.values import Bands, Channels, LowRankCube
from neusee.workflows.engine.band_results import band_tensors, taken, with_band_tensors
from neusee.workflows.engine.node_call import call
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.recipe_graph import Recipe, Step, needed
from neusee.workflows.store.result_store import Store
from neusee.workflows.tolerance.cheaper_steps import Asked, asked_of
from neusee.workflows.training.parallel.collectives import Bands as Swapped
from neusee.workflows.training.parallel.collectives import Sum, gathered, own_bands
from neusee.workflows.training.parallel.process_mesh import ALONE, Mesh, MeshError

Port = Swapped | Sum


@dataclass(frozen=True)
class Shards:
    """The steps of a recipe whose spectral bands are divided among processes, and later steps that need all bands."""

    recipe: Recipe
    mesh: Mesh = ALONE
    count: int = 0  #: bands of the scene
    steps: frozenset[str] = frozenset()  #: steps of which each process computes its own bands
    behind: frozenset[str] = frozenset()  #: later steps, which need all bands
    rows: Mapping[str, Tensor] = field(default_factory=dict)  #: weights of sums over bands, by image that is summed

    @classmethod
    def of(
        cls, recipe: Recipe, psf: str, outputs: Sequence[str], live: Collection[str], store: Store, mesh: Mesh
    ) -> Shards:
        """Divide the spectral bands of a recipe among the processes; raise MeshError if there are too few bands.

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
        summed_alone = {n: asked for n in sorted(steps) if (asked := _asked(recipe, n, outputs, behind, live))}
        rows = {name: _rows(recipe, asked, store) for name, asked in summed_alone.items()}
        return cls(recipe, mesh, count, frozenset(steps), frozenset(behind), rows)

    @property
    def own(self) -> list[int]:
        """Return the indices of the spectral bands that this process computes."""
        return own_bands(self.mesh, self.count)

    def call(self, step: Step, inputs: Sequence[Any], params: Mapping[str, Any], seed: int, device: str) -> Any:
        """Compute a step and return its result; a divided step computes the spectral bands of this process alone."""
        if step.name in self.steps:
            whole = [name for name in step.node.inputs if step.wires.get(name) not in self.steps]
            inputs = taken(step, inputs, self.own, whole)
        return call(step, inputs, params, seed, device)

    def gathered(self, name: str, value: Any) -> Any:
        """Return the result of a step with the spectral bands of all processes."""
        axis = self.axis(name)
        return with_band_tensors(value, [gathered(self.mesh, x, axis, self.count) for x in band_tensors(value)])

    def axis(self, name: str) -> int:
        """Return the index of the tensor axis of the spectral bands in the result of a step."""
        bands = self.recipe.steps[name].node.bands
        assert bands is not None
        return bands["return"]

    def sent(self, name: str, value: Any) -> list[Tensor]:
        """Return the tensors of a step's result that this process sends to the process that completes the picture."""
        if name not in self.rows:
            return band_tensors(value)
        return [channel_sums(value, self.rows[name][:, self.own]).planes]

    def ports(self, name: str, sent: Sequence[Tensor]) -> list[Port]:
        """Return an exchange object for each tensor of ``sent``, which exchanges spectral bands or sums over bands."""
        if name in self.rows:
            return [Sum(self.mesh)]
        return [Swapped(self.mesh, self.axis(name), self.count) for _ in sent]

    def received(self, name: str, like: Any, found: Sequence[Tensor]) -> Any:
        """Assemble the result of a step with all spectral bands from the tensors that other processes sent."""
        if name not in self.rows:
            return with_band_tensors(like, found)
        exact = self.rows[name].new_zeros(())
        return Channels(found[0], self.rows[name], exact, largest=exact)


def _sampled(recipe: Recipe, name: str) -> set[str]:
    """Return the steps that define the spectral bands on which the step ``name`` depends."""
    return {n for n in needed(recipe, [name]) if recipe.steps[n].node.hints["return"] is Bands}


def _by_band(recipe: Recipe, name: str, spectral: set[str]) -> bool:
    """Return True if a step computes each band of the steps ``spectral`` independently of the other bands."""
    node = recipe.steps[name].node
    return node.bands is not None and _sampled(recipe, name) == spectral and not _mixed(recipe, name)


def _mixed(recipe: Recipe, name: str) -> bool:
    """Return True if the result of a step is a low-rank cube, whose components mix all spectral bands."""
    while (kind := recipe.steps[name].node.hints["return"]) is not LowRankCube:
        step = recipe.steps[name]
        through = next((w for i in step.node.accepts_low_rank if isinstance(w := step.wires.get(i), str)), None)
        if through is None or LowRankCube not in get_args(kind):
            return False
        name = through
    return True


def _count(recipe: Recipe, psf: str, spectral: set[str], store: Store, mesh: Mesh) -> int:
    step = recipe.steps[psf]
    if not _by_band(recipe, psf, spectral) or len(spectral) != 1:
        raise MeshError(
            f"{step.mark}: {psf} ({step.node.path}) computes all bands together, which --mesh {mesh} cannot divide: "
            f"write --mesh {mesh.size}x1"
        )
    (bands,) = spectral
    count = len(run(recipe, store, [bands]).values[bands].centres)
    if mesh.band > count:
        raise MeshError(
            f"{recipe.steps[bands].mark}: {bands} has only {count} bands for {mesh.band} processes: "
            f"write --mesh with a band axis of at most {count} instead of --mesh {mesh}"
        )
    return count


def _asked(
    recipe: Recipe, name: str, outputs: Sequence[str], behind: Collection[str], live: Collection[str]
) -> Asked | None:
    """Return the sums over spectral bands that later steps read from an image, or None if they read other values."""
    asked = None if name in outputs else asked_of(recipe, name, outputs)
    still = asked is not None and asked.bands not in live and asked.responses not in live
    return asked if asked is not None and still and set(behind).issuperset(asked.readers) else None


def _rows(recipe: Recipe, asked: Asked, store: Store) -> Tensor:
    found = run(recipe, store, [asked.bands, asked.responses]).values
    rows: Tensor = spectra.rows(found[asked.bands], found[asked.responses], well=asked.well)
    return rows
