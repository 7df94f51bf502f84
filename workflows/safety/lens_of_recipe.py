"""The lens of an estimate against the lens of the recipe's steps: what masks and spots are computed for."""

from __future__ import annotations

import math
from collections.abc import Iterator

from neusee.workflows.engine.runner import run
from neusee.workflows.graph.diagnostics import Diagnostic, RecipeError
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.recipe.blocks.safety_block import Safety
from neusee.workflows.safety.damage_pattern import step_of
from neusee.workflows.store.result_store import Store

_SAME = 1e-6  #: relative difference of two lengths that counts as rounding


def refuse_other_lens(recipe: Recipe, safety: Safety, store: Store | None) -> None:
    """Raise `RecipeError` where the steps of the recipe have another lens than the estimate, or a smaller stop.

    The stop is the step that the settings name, and each stop on which a named step depends.
    """
    lens = safety.settings.lens
    problems = [*_other_focal_length(recipe, safety)]
    for name in dict.fromkeys([*_named_stop(recipe, safety), *_upstream(recipe, safety, "optics.stop")]):
        stop = run(recipe, store, [name])[name]
        span = float(stop.samples * stop.pitch)
        passed = f"{min(float(stop.diameter), span) * 1e3:.4g} mm"
        if float(stop.diameter) > span * (1 + _SAME):
            text = f"the step {name} clips its disc to a square of {passed}, and an estimate is of a round lens"
            problems.append(_problem(safety, "lens.diameter", f"{text}: choose reading.aperture=stretched"))
        elif not math.isclose(float(stop.diameter), lens.diameter, rel_tol=_SAME):
            text = f"the stop of the recipe ({name}) has {passed}, and the lens of the estimate"
            fix = "write one diameter in both; reading.aperture=stretched keeps that of the recipe"
            problems.append(_problem(safety, "lens.diameter", f"{text} {lens.diameter * 1e3:.4g} mm: {fix}"))
    stop_of_protection = safety.settings.protection.stop
    if stop_of_protection is not None and stop_of_protection > lens.diameter * (1 + _SAME):
        wider = f"a stop of {stop_of_protection * 1e3:.4g} mm is wider than the lens of {lens.diameter * 1e3:.4g} mm"
        problems.append(_problem(safety, "protection.stop", f"{wider} and stops nothing: give a smaller one"))
    if problems:
        raise RecipeError(problems)


def _named_stop(recipe: Recipe, safety: Safety) -> Iterator[str]:
    """Yield the step of the stop that the settings name."""
    if safety.settings.lens.stop is not None:
        yield step_of(recipe, safety, "lens.stop", safety.settings.lens.stop, "")


def _other_focal_length(recipe: Recipe, safety: Safety) -> Iterator[Diagnostic]:
    """Yield the mistake of a named step whose PSF has another focal length than the lens of the estimate."""
    focal_length = safety.settings.lens.focal_length
    for name in _upstream(recipe, safety, "optics.psf"):
        other = recipe.steps[name].params["focal_length"]
        if not math.isclose(other, focal_length, rel_tol=_SAME):
            text = f"the step {name} has {other * 1e3:.4g} mm, and the lens of the estimate {focal_length * 1e3:.4g} mm"
            yield _problem(safety, "lens.focal_length", f"{text}: write one focal length in both")
            return


def _upstream(recipe: Recipe, safety: Safety, node: str) -> list[str]:
    """Return the steps of a node on which the steps that the settings of the protection name depend."""
    waiting, seen = list(_named_steps(recipe, safety)), set[str]()
    while waiting:
        name = waiting.pop()
        if name not in seen:
            seen.add(name)
            waiting += recipe.steps[name].sources
    return sorted(name for name in seen if recipe.steps[name].node.path == node)


def _named_steps(recipe: Recipe, safety: Safety) -> Iterator[str]:
    """Yield each step that the settings of the protection name."""
    protection = safety.settings.protection
    if protection.mask is not None:
        yield step_of(recipe, safety, "protection.mask", protection.mask, "mask")
    for block, spots in (("spots", protection.spots), ("pixels", protection.pixels)):
        for arm, step in spots:
            if step is not None and (arm, protection.mask) != ("mask", None):
                yield step_of(recipe, safety, f"protection.{block}.{arm}", step, arm)


def _problem(safety: Safety, setting: str, text: str) -> Diagnostic:
    """Return a mistake at the place where a setting is written."""
    value = safety.values[setting]
    return Diagnostic(value.mark, value.name, text)
