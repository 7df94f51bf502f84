"""Simulated training pictures in the store, so that a later training with the same pictures begins at once.

The key of a picture is made of the keys of its steps with the values that were drawn for it, of the scene itself and
of the noise. So a picture of another optics, sensor, laser, distribution or code has another key.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from torch import Tensor

from neusee.workflows.engine.node_call import place
from neusee.workflows.graph.recipe_graph import Recipe, needed
from neusee.workflows.keys.cache_key import device_kind, digest, is_private, key_of
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.keys.engine_digest import engine
from neusee.workflows.recipe.blocks.train_block import Training
from neusee.workflows.store.memo import compute_once
from neusee.workflows.store.result_store import Store

_ABOUT = {"step": "training picture"}
_CODE = ("training.stored_pool", "training.training_pictures")


class StoredPool:
    """The pictures of a pool behind a fixed mask, each in the store under a key of its own."""

    def __init__(self, recipe: Recipe, settings: Training, outputs: Sequence[str], store: Store, device: str) -> None:
        self.recipe, self.settings, self.store, self.device = recipe, settings, store, device
        self._outputs = tuple(outputs)
        self._order = [name for name in needed(recipe, self._outputs) if name != settings.scene]
        self._code = Code(store.code_memo)
        self._resize = self._code.digest("neusee.nodes.bicubic_resize")
        self.read, self.computed = 0, 0  #: pictures that came from the store, and pictures that were simulated

    def picture(
        self, scene: Tensor, given: Mapping[str, Any], noise: int, compute: Callable[[], dict[str, Tensor]]
    ) -> dict[str, Tensor]:
        """Return the tensors of a picture from the store, or compute and store them before the next picture."""
        key = self._key(scene, given, noise)
        computed: list[bool] = []

        def simulated() -> dict[str, Tensor]:
            computed.append(True)
            return compute()

        kept: dict[str, Tensor] = (
            simulated() if is_private(key) else compute_once(self.store, key, dict, simulated, _ABOUT)
        )
        self.computed, self.read = self.computed + bool(computed), self.read + (not computed)
        return {name: x.to(self.device) for name, x in kept.items()}

    def _key(self, scene: Tensor, given: Mapping[str, Any], noise: int) -> str:
        settings, recipe = self.settings, self.recipe
        pixels = scene.detach().cpu().contiguous()
        keys = {settings.scene: hashlib.sha256(pixels.numpy().tobytes()).hexdigest()}
        drawn: dict[str, dict[str, Any]] = {}
        for reader, value in given.items():
            reads, _, param = reader.rpartition(".")
            drawn.setdefault(reads, {})[param] = value
        for name in self._order:
            step = recipe.steps[name]
            step = replace(step, params={**step.params, **drawn.get(name, {})})
            keys[name], _ = key_of(step, keys, recipe.seed, self._code, place(step, self.device))
        own = [keys[name] for name in self._outputs]
        if private := next(filter(is_private, own), None):
            return private
        cut = [settings.size, settings.patch, settings.patches, settings.precision, self._resize]
        within = [list(pixels.shape), noise, recipe.tolerance, recipe.exact, recipe.estimates, device_kind(self.device)]
        return digest("training picture", engine(*_CODE), own, cut, within)
