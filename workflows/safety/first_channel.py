"""The colour channel that a laser saturates first, from the responses that a step of the recipe computes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from neusee.nodes.sensor import line_saturation
from neusee.nodes.values import Bands
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.diagnostics import Diagnostic, RecipeError
from neusee.workflows.graph.recipe_graph import Recipe, Step, unknown_step
from neusee.workflows.recipe.blocks.safety_block import Safety
from neusee.workflows.recipe.blocks.sensor_facts import LaserChannels
from neusee.workflows.store.result_store import Store

_SETTING = "sensor.responses"
_LINE, _RESPONSES = "spectra.line", "spectra.responses"  #: nodes of the two steps
_UNSEEN = 1e-3  #: relative response below which no channel counts as seeing a laser


def with_channels(recipe: Recipe, safety: Safety, store: Store | None) -> Safety:
    """Return the settings with the channels of the sensor at the laser, where the settings name a step of responses.

    Raises `RecipeError` for a step that does not exist or is of another node.
    """
    named = safety.settings.sensor.responses
    if named is None:
        return safety
    step = _step(recipe, safety, named)
    line = recipe.steps[str(step.wires["bands"])]
    if line.node.path != _LINE:
        raise _refused(safety, f"the step {step.name} is not of a laser line: name a step that reads one")
    result = run(recipe, store, [step.name])
    largest = float(result[step.name].max())
    return replace(safety, channels=LaserChannels(line, step, largest, str(result.keys[step.name])))


def _step(recipe: Recipe, safety: Safety, named: str) -> Step:
    """Return the step of responses, completed by the laser if the step has a copy for each laser."""
    name = next((each for each in (named, f"{named}[{safety.name}]") if each in recipe.steps), None)
    if name is None:
        raise _refused(safety, unknown_step(named, recipe.steps))
    step = recipe.steps[name]
    if step.node.path != _RESPONSES:
        raise _refused(safety, f"the step {name} is of the node {step.node.path}: name a step of {_RESPONSES}")
    return step


def _refused(safety: Safety, text: str) -> RecipeError:
    value = safety.values[_SETTING]
    return RecipeError([Diagnostic(value.mark, value.name, text)])


def sees(channels: LaserChannels | None) -> bool:
    """Return True unless the responses are known and no channel sees the laser."""
    return channels is None or channels.largest >= _UNSEEN


def channel_saturation(
    channels: LaserChannels, wavelength: float, electrons: float, sensor: Mapping[str, float]
) -> float:
    """Return the irradiance in W/m2 at which the channel that saturates first is full, for a laser of a wavelength.

    ``sensor`` has the quantum efficiency, the pixel pitch and the exposure.
    """
    line: Bands = channels.line.node(**{**channels.line.params, "wavelength": wavelength})
    params = {**channels.responses.params}
    if params.get("quantum_efficiency") is not None:  # what an absolute table is relative to
        params["quantum_efficiency"] = sensor["quantum_efficiency"]
    return line_saturation(line, channels.responses.node(line, **params), electrons=electrons, **sensor)
