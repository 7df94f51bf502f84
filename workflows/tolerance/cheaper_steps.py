"""Cheaper substitutes for steps, used where the error in the outputs stays below the tolerance.

The sensor sums bands into a few channels before any random step. Where the steps after an image
read only such sums, the sums are convolved instead of the bands. The substitutes are added beside
the full steps, and only the inputs of the later steps change. A value requested by name is
therefore always computed in full.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from neusee.nodes import optics, spectra
from neusee.workflows.graph.recipe_graph import (
    METRIC_TOLERANCE,
    Recipe,
    Step,
    Substitution,
    Wire,
    needed,
    ordered,
)
from neusee.workflows.tolerance.error_propagation import expected_excess, unbounded_steps
from neusee.workflows.tolerance.skip_decision import CHANNELS, without_nothing

if TYPE_CHECKING:
    from neusee.nodes import Node

ESTIMATED = 0.22  #: share of the tolerance for the estimated error of PSFs of few bands
#: share of the tolerance for the channels of an image if there is such an estimate, instead of
#: `CHANNELS`
BESIDE = 0.08
#: tolerance below which no error bound of sums over bands can be proved, because rounding alone
#: contributes 1.4e-6
_SMALLEST_TOLERANCE = 2e-5
#: factor of safety of the tolerance scale, relative to the largest scale that would suffice
_SAFE = 0.8
_EXPECTED_SHARE = 0.5  #: expected ratio of the error of a cheaper step to its limit
_MOST_PLANS = 4  #: greatest number of plans, each with smaller limits
#: share of the tolerance for a low-rank cube, rounded to a power of ten so that the cube seldom
#: changes
_MIXTURE = 0.1


def with_substitutions(
    recipe: Recipe, outputs: Iterable[str], pinned: Collection[str] = ()
) -> Recipe:
    """Return ``recipe`` with cheaper steps in place of full steps; an exact recipe is returned
    unchanged.

    The errors of ``outputs`` stay within the tolerance. An image whose scene depends on
    a step in ``pinned`` stays in full, because a cube that is being optimised has no low-rank form
    yet. Where well or converter are expected to cut off so much light that the errors exceed the
    tolerance, the steps get smaller limits (`Recipe.tolerance_scale`). A second call changes
    nothing.
    """
    outputs = frozenset(outputs)
    plan, has_substitutions = (
        _substituted(recipe, outputs, pinned),
        any(substitution.within for substitution in recipe.substitutions),
    )
    # a recipe that already has cheaper steps is not changed
    for _ in range(0 if has_substitutions else _MOST_PLANS):
        if not any(substitution.within for substitution in plan.substitutions):
            break
        if (excess := expected_excess(plan, sorted(outputs), _EXPECTED_SHARE)) <= 1.0:
            break
        tolerance_scale = plan.tolerance_scale * _SAFE / excess if math.isfinite(excess) else 0.0
        plan = _substituted(
            replace(plan.unsubstituted or recipe, tolerance_scale=tolerance_scale), outputs, pinned
        )
    return plan


def stricter_scale(recipe: Recipe, over: float) -> float:
    """Return the tolerance scale for a second attempt, after a run of ``recipe`` whose error was
    ``over`` times the tolerance.

    The limits of low-rank cubes are powers of ten. The scale is so small that these limits become
    smaller too, because the cube may have caused the error.
    """
    image_names = [
        substitution.step
        for substitution in recipe.substitutions
        if substitution.within and substitution.step in recipe.steps
    ]
    cube_limits = [
        recipe.allowed(name) * _MIXTURE for name in image_names if recipe.allowed(name) > 0
    ]
    # smallest ratio of the next lower power of ten to a limit
    next_power = min((_power_of_ten(limit) / limit for limit in cube_limits), default=1.0)
    # 0.99 gives a value just below the power of ten, so that the limit drops to the next power
    return recipe.tolerance_scale * min(_SAFE / over, 0.99 * next_power)


def _power_of_ten(limit: float) -> float:
    """Return the largest power of ten that is at most ``limit``."""
    power: float = 10.0 ** math.floor(math.log10(limit))
    return power


def _substituted(recipe: Recipe, outputs: frozenset[str], pinned: Collection[str]) -> Recipe:
    """Return ``recipe`` with cheaper steps whose errors are within the limits of
    `Recipe.allowed`.
    """
    if recipe.exact:
        return recipe
    recipe = without_nothing(recipe, needed(recipe, sorted(outputs)))
    order = needed(recipe, sorted(outputs))
    recipe = _limited(recipe, order)
    images = [
        recipe.steps[name]
        for name in order
        if recipe.steps[name].node.channel_sum_form is not None and name not in outputs
    ]
    if not images or recipe.tolerance * recipe.tolerance_scale <= _SMALLEST_TOLERANCE:
        return recipe
    pinned_and_later = _dependent(recipe, order, pinned)
    cheaper = _Draft(recipe, outputs, _readers(recipe, order), frozenset(pinned_and_later))
    for image in images:
        if image.name not in pinned and image.wires.get("radiance") not in pinned_and_later:
            cheaper.collapse(image)
    recipe = cheaper.finished()
    # cheaper steps may change which steps have no error bound
    return _limited(recipe, needed(recipe, sorted(outputs)))


def _limited(recipe: Recipe, order: Sequence[str]) -> Recipe:
    """Mark in the recipe the steps whose errors have no bound, if the tolerance exceeds
    `METRIC_TOLERANCE`.
    """
    steps = (
        unbounded_steps(recipe, order) if recipe.tolerance > METRIC_TOLERANCE else frozenset[str]()
    )
    return recipe if steps == recipe.unbounded else replace(recipe, unbounded=steps)


def _dependent(recipe: Recipe, order: Iterable[str], pinned: Collection[str]) -> set[str]:
    """Return the steps in ``pinned`` and all steps that depend on a step in ``pinned``."""
    dependent = set(pinned)
    for name in order:
        if not dependent.isdisjoint(recipe.steps[name].sources):
            dependent.add(name)
    return dependent


def _readers(recipe: Recipe, order: Iterable[str]) -> dict[str, list[str]]:
    """Return for each step the names of the steps that read its result."""
    readers = defaultdict[str, list[str]](list)
    for name in order:
        for source in dict.fromkeys(recipe.steps[name].sources):
            readers[source].append(name)
    return readers


@dataclass
class _Draft:
    """A recipe in which cheaper steps are replacing some steps."""

    recipe: Recipe
    wanted: frozenset[str]
    readers: Mapping[str, list[str]]
    #: steps whose results change while a value is optimised
    dependent: frozenset[str] = frozenset()
    added: dict[str, Step] = field(default_factory=dict)
    rewired: dict[str, Step] = field(default_factory=dict)
    substitutions: list[Substitution] = field(default_factory=list)

    def collapse(self, image: Step) -> None:
        """Add a step that computes sums over the bands of an image, if no later step needs
        single bands.
        """
        readers = [
            self.rewired.get(name, self.recipe.steps[name])
            for name in self.readers.get(image.name, ())
        ]
        node, radiance = image.node.channel_sum_form, image.wires.get("radiance")
        weights = self.spectral(image.name, readers)
        if node is None or weights is None or not isinstance(radiance, str):
            return
        name, error_limit = f"{image.name}.channels", self.recipe.allowed(image.name)
        cube_step, rows_step = self._mixture(radiance, image), self._rows(*weights, readers, image)
        # True if a later step scales the scene by its brightest pixel
        largest = any(reader.node.hooks.band_invariant is not None for reader in readers)
        wires = {
            "radiance": cube_step,
            "rows": rows_step,
            **self._few_bands(image, cube_step, rows_step, largest),
        }
        # with an estimate for few bands, the channels get a smaller share
        error_limit *= BESIDE if "few" in wires else CHANNELS
        self._add(
            name, node, wires, {**image.params, "within": error_limit, "largest": largest}, image
        )
        for reader in readers:
            new_wires = {
                input_name: _exchanged(wire, image.name, name)
                for input_name, wire in reader.wires.items()
            }
            self.rewired[reader.name] = replace(reader, wires=new_wires)
        self.substitutions.append(
            Substitution(image.name, name, error_limit, "only sums over its bands are needed")
        )

    def spectral(self, image: str, readers: Sequence[Step]) -> tuple[str, str] | None:
        """Return the steps that provide the wavelength bands and the camera responses for all
        ``readers``.

        Return None if a step in ``readers`` needs single bands, or if the steps read different
        bands or responses.
        """
        bands_and_responses = {
            (reader.wires.get("bands"), reader.wires.get("responses"))
            for reader in readers
            if "responses" in reader.node.inputs
        }
        if len(bands_and_responses) != 1 or not all(
            self._sums(reader, image) for reader in readers
        ):
            return None
        bands, responses = bands_and_responses.pop()
        return (bands, responses) if isinstance(bands, str) and isinstance(responses, str) else None

    def finished(self) -> Recipe:
        """Return the recipe with the cheaper steps and with changed connections."""
        if not self.substitutions:
            return self.recipe
        steps = {**self.recipe.steps, **self.added, **self.rewired}
        order = ordered({name: step.sources for name, step in steps.items()}, steps)
        steps, unsubstituted = (
            {name: steps[name] for name in order},
            self.recipe.unsubstituted or self.recipe,
        )
        substitutions = (*self.recipe.substitutions, *self.substitutions)
        return replace(
            self.recipe, steps=steps, substitutions=substitutions, unsubstituted=unsubstituted
        )

    def _sums(self, reader: Step, image: str) -> bool:
        """Return True if the step ``reader`` needs only sums over wavelength bands of an image."""
        node, band_invariant = reader.node, reader.node.hooks.band_invariant
        inputs_read = {
            input_name
            for input_name, wire in reader.wires.items()
            if image == wire or (isinstance(wire, tuple) and image in wire)
        }
        if not inputs_read <= set(node.accepts_channel_sums) or (
            band_invariant and not band_invariant(reader.params)
        ):
            return False
        # these inputs must be equal in all bands
        return all(
            self._even(reader.wires.get(input_name)) for input_name in node.needs_band_invariant
        )

    def _even(self, wire: Wire) -> bool:
        """Return True if an input is unconnected, or if the connected node states that its result
        is equal in all bands.
        """
        if not isinstance(wire, str):
            return wire is None
        step = self.recipe.steps[wire]
        return step.node.hooks.band_invariant is not None and step.node.hooks.band_invariant(
            step.params
        )

    def _few_bands(self, image: Step, cube: str, rows: str, largest: bool) -> dict[str, Wire]:
        """Add steps that compute the PSF of an image at only a few bands, provided that no other
        step reads this PSF; return the connections of the image's inputs.
        """
        name = image.wires.get("psf")
        step = self.recipe.steps[name] if isinstance(name, str) else None
        if step is None or step.node is not optics.psf or not self._only(step.name, image.name):
            return {"psf": name}
        lens_params = {
            param: step.params[param]
            for param in ("focal_length", "pixel_pitch", "pixel", "sensor")
        }
        inputs = {"pupil": step.wires["pupil"], "radiance": cube, "rows": rows}
        error_limit = self.recipe.allowed(image.name) * ESTIMATED
        params = {
            **lens_params,
            "shape": step.params["shape"],
            "within": error_limit,
            "largest": largest,
        }
        # choose the bands that suffice
        choice_step = self._add(f"{name}.choice", optics.few_bands, inputs, params, step)
        pupil_step = self._add(
            f"{name}.pupil",
            optics.pupil_of_bands,
            {"pupil": inputs["pupil"], "few": choice_step},
            {},
            step,
        )
        # compute the PSF at these bands
        few_psf = self._add(f"{name}.few", step.node, {"pupil": pupil_step}, step.params, step)
        # estimate the error of these PSFs in the run
        check_inputs = {"few": choice_step, "psf": few_psf, **inputs}
        checked_name = self._add(
            f"{name}.checked", optics.few_bands_checked, check_inputs, lens_params, step
        )
        self.substitutions.append(
            Substitution(
                step.name, checked_name, error_limit, "PSFs of few bands are enough for the image"
            )
        )
        return {"psf": few_psf, "few": checked_name}

    def _only(self, psf: str, image: str) -> bool:
        """Return True if only ``image`` reads a PSF, the PSF is on the axis, and estimates of its
        error are allowed.
        """
        if not self.recipe.estimates or psf in self.wanted or psf in self.dependent:
            return False
        step = self.recipe.steps[psf]
        is_off_axis = step.wires.get("direction") is not None or any(step.params["angle"])
        return self.readers.get(psf) == [image] and not is_off_axis

    def _rows(self, bands: str, responses: str, readers: list[Step], image: Step) -> str:
        """Add a step that computes the weight of each wavelength band in each channel sum;
        return the step's name.
        """
        counts_electrons = _well(readers)
        name, wires = (
            f"{responses}.{'wells' if counts_electrons else 'rows'}",
            {"bands": bands, "responses": responses},
        )
        return self._add(name, spectra.rows, wires, {"well": counts_electrons}, image)

    def _mixture(self, name: str, image: Step) -> str:
        """Add steps that compute the spectral cube ``name`` in low-rank form; return the name of
        the last added step.

        The conversion to low rank comes as early as the nodes allow.
        """
        step, new_name = self.recipe.steps[name], f"{name}.mixture"
        # an input that the node accepts in low-rank form: then the conversion comes before this
        # node
        low_rank_input = next(
            (
                input_name
                for input_name in step.node.accepts_low_rank
                if isinstance(step.wires.get(input_name), str)
            ),
            None,
        )
        if low_rank_input is not None and name not in self.wanted:
            wires = {
                **step.wires,
                low_rank_input: self._mixture(str(step.wires[low_rank_input]), image),
            }
            return self._add(new_name, step.node, wires, step.params, step)
        error_limit = {"within": _power_of_ten(self.recipe.allowed(image.name) * _MIXTURE)}
        if step.node.low_rank_form is not None and name not in self.wanted:
            return self._add(
                new_name, step.node.low_rank_form, step.wires, {**step.params, **error_limit}, step
            )
        return self._add(new_name, spectra.compress, {"cube": name}, error_limit, step)

    def _add(
        self,
        name: str,
        node: Node,
        wires: Mapping[str, Wire],
        params: Mapping[str, Any],
        like: Step,
    ) -> str:
        """Add a step with the recipe location and the device of the step ``like``; return the
        name of the new step.
        """
        self.added[name] = Step(name, node, params, wires, like.mark, {}, like.device)
        return name


def _well(readers: Iterable[Step]) -> bool:
    """Return True if a step reads bands but no responses, like a step that computes the electrons
    in a pixel.
    """
    return any(
        "bands" in reader.node.inputs and "responses" not in reader.node.inputs
        for reader in readers
    )


def _exchanged(wire: Wire, old: str, new: str) -> Wire:
    """Return the connection of an input with the step ``new`` in place of ``old``."""
    if isinstance(wire, tuple):
        return tuple(new if name == old else name for name in wire)
    return new if wire == old else wire
