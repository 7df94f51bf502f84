"""Scenes of an evaluation: part of a photograph, the direction of a laser and the seed of the noise, by number."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from torch import Tensor

from neusee.nodes import ParameterError
from neusee.nodes.scene import choose_photograph, crop_photograph, list_photographs
from neusee.workflows.engine.node_call import call
from neusee.workflows.engine.runner import run
from neusee.workflows.evaluation.pipelines import BEAM, CASES, NONE, Refused
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import digest, file_digest, key_of, stream_seed
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.recipe.distributions.uncertain_inputs import Inputs
from neusee.workflows.store.result_store import Store

_PHOTOGRAPH = "scene.photograph"


@dataclass(frozen=True)
class Scene:
    """One scene; what it holds is read when it is first needed."""

    number: int
    seed: int  #: of noise and direction: those of a run of the recipe with this seed
    case: str  #: its laser
    source: _Source

    @property
    def name(self) -> str:
        """The photograph, from the folder that was given."""
        return self.source.name(self.number)

    @cached_property
    def picture(self) -> Tensor:
        """Linear sRGB (3, y, x)."""
        return self.source.picture(self.number)

    def key(self, code: Code) -> str:
        """What decides the picture."""
        return self.source.key(self.number, code)

    def drawn(self, inputs: Inputs) -> dict[str, float]:
        """What the recipe has a law for, in SI: the same whatever the mask, the restorer and the laser."""
        import numpy as np

        z = [np.random.default_rng([self.seed, stream_seed(0, name)]).standard_normal() for name in inputs.names]
        return dict(zip(inputs.names, map(float, inputs.at(np.array([z]))[0]), strict=True))

    def angle(self, recipe: Recipe) -> tuple[float, float]:
        """Direction cosines (y, x) of the laser, drawn as the paper draws them."""
        step = recipe.steps[f"direction[{BEAM}]"]
        drawn = call(step, [], step.params, self.seed, "cpu")
        return float(drawn[0]), float(drawn[1])


@dataclass(frozen=True)
class _Source:
    """Where pictures come from: photographs, or the one scene of the recipe."""

    recipe: Recipe
    store: Store
    root: Path | None
    paths: Sequence[Path]
    shape: tuple[int, int]

    def name(self, number: int) -> str:
        if not self.paths:
            return self.recipe.steps["scene"].node.path
        path = choose_photograph(self.paths, self.recipe.seed, number)
        return path.relative_to(self.root).as_posix() if self.root else path.name

    def picture(self, number: int) -> Tensor:
        if not self.paths:
            return self._own
        path = choose_photograph(self.paths, self.recipe.seed, number)
        try:
            return crop_photograph(path, self.shape, self.recipe.seed, number)
        except (ParameterError, OSError, ValueError, SyntaxError) as error:
            raise Refused(f"{path}: {error}: take it away; all other points are kept") from error

    @cached_property
    def _own(self) -> Tensor:
        found: Tensor = run(self.recipe, self.store, ("scene",))["scene"]
        return found

    def key(self, number: int, code: Code) -> str:
        if not self.paths:
            step = self.recipe.steps["scene"]
            return digest("own scene", key_of(step, {}, self.recipe.seed, code)[0])
        path = choose_photograph(self.paths, self.recipe.seed, number)
        own = code.digest(crop_photograph.__module__)
        return digest("photograph", own, file_digest(path), list(self.shape), self.recipe.seed, number)


def scenes(
    recipe: Recipe, store: Store, root: Path | None, count: int, cases: Sequence[str] = tuple(CASES)
) -> tuple[list[Scene], list[tuple[Path, str]]]:
    """So many scenes, the cases in turn, and the photographs that cannot be read."""
    broken: list[tuple[Path, str]] = []
    own = recipe.steps["scene"]
    shape = _shape(recipe)
    paths: Sequence[Path] = [own.params["file"]] if own.node.path == _PHOTOGRAPH else []
    if root is not None:
        if not root.is_dir():
            raise Refused(f"--data {root}: no such folder")
        paths, broken = list_photographs(root)
        if not paths:
            said = f"; {broken[0][0].name}: {broken[0][1]}" if broken else ""
            raise Refused(f"--data {root}: no photograph that can be read, PNG or JPEG{said}")
    source = _Source(recipe, store, root, paths, shape)
    return [Scene(i, recipe.seed + i, cases[i % len(cases)], source) for i in range(count)], broken


def _shape(recipe: Recipe) -> tuple[int, int]:
    """The size of the scene that a recipe asks for, as its step says."""
    shape = recipe.steps["scene"].params.get("shape")
    if shape is None and recipe.steps["scene"].node.path == _PHOTOGRAPH:
        raise Refused("scene.shape: say the size that is cut of every photograph, such as [768, 768]")
    if shape is None:
        raise Refused("the recipe's scene has no shape: write one, such as scene.shape=[768, 768]")
    return int(shape[0]), int(shape[1])


def with_case(scene: Scene, case: str) -> Scene:
    """The same scene and direction behind another laser."""
    return replace(scene, case=case)


__all__ = ["NONE", "Scene", "scenes", "with_case"]
