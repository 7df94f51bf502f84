"""The catalogue of extreme cases, and the recipe of each case."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import torch
from torch import Tensor

from neusee.nodes import Node
from neusee.nodes.optics import field_of_view
from neusee.nodes.sensor import photons_that_fill
from neusee.nodes.values import Pupil
from neusee.workflows.engine.node_call import call
from neusee.workflows.graph.errors import RunError
from neusee.workflows.graph.recipe_graph import Recipe, Step, in_order
from neusee.workflows.keys.cache_key import Key, digest, key_of
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.recipe.node_families import find_node

# --- extreme cases --------------------------------------------------------------------------------

# The catalogue of extreme cases: changes of a recipe's parameters, results or inputs.
#
# A case changes parameters by ``node.parameter`` (``*.exposure`` for every node), results by the
# path of their node, or the inputs of each step. The catalogue has no expected results: each result
# must agree with the node's own reference within the documented error of the node (`case_result`).


Params = Mapping[str, Any]
Expect = Literal["accurate", "dim part", "seen"]


@dataclass(frozen=True)
class Size:
    """The reduced size of a recipe: its pixels, pupil samples and bands."""

    pixels: int = 24  #: side of the scene in pixels; other shapes scale in proportion
    samples: int = 64  #: side of the pupil
    bands: int = 5


@dataclass(frozen=True)
class Case:
    """An extreme case of a recipe: changed parameters, results or inputs. Each case is one row
    of the grid.
    """

    name: str
    what: str  #: the extreme property
    group: str
    #: by ``node.parameter``: a value, or a function of the step's parameters
    params: Mapping[str, Any] = field(default_factory=dict)
    #: function that changes the result, by the start of a node's path
    values: Mapping[str, Callable[[Any], Any]] = field(default_factory=dict)
    #: function that changes each picture among the inputs of a step
    inputs: Callable[[Tensor], Tensor] | None = None
    alike: bool = False  #: whether a step that compares two pictures gets the same picture twice
    size: Size = field(default_factory=Size)
    expect: Expect = "accurate"


#: phrase about NaN in the docstring of a node, by node and case, for nodes whose result cannot show
#: NaN
_STATED = {
    ("restore.clipped", "NaN"): "so is what is not a number",
    ("metrics.light_outside", "NaN"): "have no effect, not even where they are NaN",
    ("metrics.saturated", "NaN"): "so does a pixel that is NaN",
    ("flare.stray_light", "NaN"): "have no effect, not even where they are NaN",
    ("flare.stray_shares", "NaN"): "have no effect, not even where they are NaN",
}


def stated_words(node: Node, case: str) -> str | None:
    """Return the phrase about NaN in the docstring of a node, or None if the docstring lacks it."""
    documented_words = _STATED.get((node.path, case))
    return (
        documented_words
        if documented_words is not None
        and documented_words in " ".join((node.__doc__ or "").split())
        else None
    )


def middle(value: float) -> Callable[[Tensor], Tensor]:
    """Return a function that sets the middle element of a picture to ``value``."""

    def change(x: Tensor) -> Tensor:
        changed = x.clone()
        changed[tuple(side // 2 for side in x.shape)] = value
        return changed

    return change


def _peak_of(top: float) -> Callable[[Tensor], Tensor]:
    """Return a function that scales a picture so that its largest absolute value is ``top``."""

    def change(x: Tensor) -> Tensor:
        largest = float(x.double().abs().max())
        return (x.double() * (top / largest if largest > 0 else 0.0)).to(x.dtype)

    return change


def _lamp(scene: Tensor) -> Tensor:
    """Return the scene with a lamp in the middle, a million times brighter than the rest of the
    scene.
    """
    return middle(1.0)(scene * (1e-6 / scene.max()))


def _noise(depth: float) -> Callable[[Tensor], Tensor]:
    """Return a function that replaces a height map by a random one from 0 to ``depth`` m."""

    def change(height: Tensor) -> Tensor:
        rng = torch.Generator().manual_seed(11)
        return (depth * torch.rand(height.shape, generator=rng, dtype=torch.float64)).to(
            height.dtype
        )

    return change


def _plate(height: Tensor) -> Tensor:
    """Return a random height map of 100 um on a plate of 10 mm, 8600 turns of phase at 532 nm."""
    return _noise(100e-6)(height) + 10e-3


def _steps(height: Tensor) -> Tensor:
    """Return a checkerboard height map with aliased steps of 0.9 waves at 550 nm in fused
    silica.
    """
    row, column = (torch.arange(side) for side in height.shape)
    # phase steps of 0.9 waves: 1.076 um of glass with an index of about 1.46
    return ((row[:, None] + column) % 2 * 1.076e-6).to(height.dtype)


def _opaque(pupil: Pupil) -> Pupil:
    return pupil._replace(amplitude=pupil.amplitude * 0)


def _closed(pupil: Pupil) -> Pupil:
    return _opaque(pupil)._replace(aperture=pupil.aperture * 0)


def _off_axis(share: float) -> Callable[[Params], tuple[float, float]]:
    """Return a function that computes the angle of a laser whose spot is ``share`` sensor widths
    off centre.
    """
    return lambda p: (
        # angle (y, x)
        0.0,
        share * field_of_view(p["focal_length"], p["pixel_pitch"], p["shape"])[1],
    )


def _one_photon(p: Params) -> float:
    return 1.0 / photons_that_fill(p["full_well"], p["quantum_efficiency"])


def _scaled(name: str, by: float) -> Callable[[Params], float]:
    """Return a function that computes the parameter ``name`` times ``by``."""
    return lambda p: float(p[name] * by)


_MASKS = (
    "doe.flat",
    "doe.vortex",
    "doe.axicon",
    "doe.spiral_axicon",
    "doe.cubic",
    "doe.half_rings",
    "doe.zernike",
    "doe.pixelwise",
    "doe.unet",
)


def _heights(change: Callable[[Tensor], Tensor]) -> dict[str, Callable[[Any], Any]]:
    return dict.fromkeys(_MASKS, change)


_BLACK: dict[str, Callable[[Any], Any]] = {"scene.": lambda scene: scene * 0}
_LASER, _SCENE = "optics.laser_irradiance.strength", "sensor.level.strength"

USUAL = Case("usual", "the recipe as it is, at this small size", "usual")
CASES: tuple[Case, ...] = (
    USUAL,
    Case("no laser", "a laser of strength 0", "light", {_LASER: 0.0}),
    Case("laser, black scene", "1e8 times saturation on black", "light", {_LASER: 1e8}, _BLACK),
    Case(
        "laser, full scene",
        "1e8 times saturation on a thousandfold overexposed scene",
        "light",
        {_LASER: 1e8, _SCENE: 1e3},
    ),
    Case("zero light", "no scene, no laser", "light", {_LASER: 0.0}, _BLACK),
    Case("all saturated", "a scene of 1e4 wells", "light", {_SCENE: 1e4}),
    Case(
        "one photon",
        "one photon in the brightest pixel",
        "light",
        {_LASER: 0.0, _SCENE: _one_photon},
    ),
    Case(
        "contrast 1e6",
        "one lamp; the error of the rest, relative to its brightest element",
        "light",
        values={"scene.": _lamp},
        params={_LASER: 0.0},
        expect="dim part",
    ),
    Case("exposure 1 us", "exposure 1e-6 s", "sensor", {"*.exposure": 1e-6}),
    Case("exposure 1000 s", "exposure 1e3 s", "sensor", {"*.exposure": 1e3}),
    Case(
        "well / 1e4",
        "a full well of 2.55 e-",
        "sensor",
        {"*.full_well": _scaled("full_well", 1e-4), "*.capacity": _scaled("capacity", 1e-4)},
    ),
    Case(
        "well x 1e4",
        "a full well of 2.55e8 e-",
        "sensor",
        {"*.full_well": _scaled("full_well", 1e4), "*.capacity": _scaled("capacity", 1e4)},
    ),
    Case("gain / 1e4", "a gain of 3.7e-5", "sensor", {"*.gain": _scaled("gain", 1e-4)}),
    Case("gain x 1e4", "a gain of 3.7e3", "sensor", {"*.gain": _scaled("gain", 1e4)}),
    Case(
        "400 nm",
        "all bands from 400 to 401 nm",
        "spectrum",
        {
            "spectra.bands.start": 400e-9,
            "spectra.bands.stop": 401e-9,
            "spectra.line.wavelength": 400e-9,
        },
    ),
    Case(
        "700 nm",
        "all bands from 699 to 700 nm",
        "spectrum",
        {
            "spectra.bands.start": 699e-9,
            "spectra.bands.stop": 700e-9,
            "spectra.line.wavelength": 700e-9,
        },
    ),
    Case(
        "one band",
        "one band for the scene, one for the laser",
        "spectrum",
        {"spectra.line.count": 1},
        size=Size(bands=1),
    ),
    Case("301 bands", "1 nm a band", "spectrum", size=Size(20, 24, 301)),
    Case("height 0", "a flat mask", "height", values=_heights(torch.zeros_like)),
    Case(
        "height 100 um",
        "a random height map, 80 waves deep",
        "height",
        values=_heights(_noise(100e-6)),
    ),
    Case(
        "plate",
        "a random height map, 80 waves deep, on a plate of 10 mm; "
        "the reference is the sum by definition",
        "height",
        values=_heights(_plate),
    ),
    Case("steps past pi", "0.9 wave from sample to sample", "height", values=_heights(_steps)),
    Case(
        "wrapped",
        "100 um wrapped at 550 nm",
        "height",
        {"doe.fabricate.wrap_at": 550e-9},
        _heights(_noise(100e-6)),
    ),
    Case(
        "two levels",
        "100 um wrapped at 550 nm, in two levels",
        "height",
        {"doe.fabricate.wrap_at": 550e-9, "doe.fabricate.levels": 2},
        _heights(_noise(100e-6)),
    ),
    Case("opaque pupil", "an amplitude of 0 everywhere", "pupil", values={"optics.pupil": _opaque}),
    Case("empty pupil", "an aperture of 0 everywhere", "pupil", values={"optics.pupil": _closed}),
    Case("defocus 100", "a hundred waves of defocus", "pupil", {"optics.pupil.defocus": 100.0}),
    Case(
        "laser at the edge",
        "a spot on the edge of the sensor",
        "pupil",
        {"optics.direction.angle": _off_axis(0.5)},
    ),
    Case(
        "laser beyond",
        "the spot half a sensor beyond its edge",
        "pupil",
        {"optics.direction.angle": _off_axis(1.0)},
    ),
    Case("64 pixels", "so many that restoration has to iterate", "size", size=Size(64)),
    Case("odd", "odd sides", "size", size=Size(21, 33)),
    Case("prime", "prime sides", "size", size=Size(19, 61)),
    Case("1 pixel", "one pixel", "size", size=Size(1, 16)),
    Case("1 sample", "a pupil of one sample", "size", size=Size(16, 1)),
    Case(
        "NaN",
        "one element of each picture is not a number",
        "numbers",
        inputs=middle(float("nan")),
        expect="seen",
    ),
    Case(
        "Inf",
        "one element of each picture is infinite",
        "numbers",
        inputs=middle(float("inf")),
        expect="seen",
    ),
    Case(
        "-Inf",
        "one element of each picture is minus infinity",
        "numbers",
        inputs=middle(float("-inf")),
        expect="seen",
    ),
    Case("negative", "every picture with its sign turned", "numbers", inputs=torch.neg),
    Case("denormal", "every picture scaled to 1e-40", "numbers", inputs=_peak_of(1e-40)),
    Case("huge", "every picture scaled to 1e15", "numbers", inputs=_peak_of(1e15)),
    Case("alike", "zero error: the same picture twice", "numbers", alike=True),
    Case("all zero", "zero gradient: every picture is 0", "numbers", inputs=torch.zeros_like),
    Case("float16", "every picture in float16", "types", inputs=lambda x: x.to(torch.float16)),
    Case("bfloat16", "every picture in bfloat16", "types", inputs=lambda x: x.to(torch.bfloat16)),
    Case("float64", "every picture in float64", "types", inputs=lambda x: x.to(torch.float64)),
)


# --- case recipe ----------------------------------------------------------------------------------

# The recipe of one extreme case: a small recipe with the changes of the case, and the inputs of
# each step.


# nodes that are tested with the same inputs, by node
_COMPARES: dict[str, tuple[tuple[str, dict[str, Any]], ...]] = {
    "metrics.lsr": (("losses.suppression_loss", {}), ("losses.suppression_loss", {"log": True})),
    "metrics.bsr": (("losses.background_loss", {}),),
    "metrics.mtf": (("losses.contrast", {}), ("metrics.limits", {})),
    "doe.fabricate": (("doe.smooth", {"feature": "400 um"}),),  # three samples of the small pupil
    "metrics.quality": (
        ("losses.charbonnier", {}),
        ("losses.fft_l1", {}),
        ("losses.gradient_penalty", {}),
    ),
}
#: upper limits of other parameters that make a step slow
_SMALLER = {"pixels": 256, "levels": 6, "grid": 16, "width": 4}


def with_losses(recipe: Recipe) -> dict[str, Step]:
    """Return the steps of the recipe, with extra steps for losses and related results of the same
    inputs.
    """
    steps = dict(recipe.steps)
    for name, step in recipe.steps.items():
        for path, params in _COMPARES.get(step.node.path, ()):
            node = find_node(path)
            inputs = {
                # a loss has the same inputs as the metric, in the same order
                input_name: step.wires[source]
                for input_name, source in zip(node.inputs, step.node.inputs, strict=False)
            }
            if "stop" in node.inputs:  # from the mask that this step reads
                inputs["stop"] = recipe.steps[step.sources[0]].wires["stop"]
            family, _, title = path.partition(".")
            label = (
                f"{'loss ' if family == 'losses' else ''}{title}{' log' if 'log' in params else ''}"
                f" of {name}"
            )
            steps[label] = Step(
                label, node, node.params(**params).model_dump(), inputs, step.mark, {}
            )
    return steps


def with_size(steps: Mapping[str, Step], size: Size) -> dict[str, Step]:
    """Reduce pixels, pupil samples and spectral bands of the steps at constant pupil diameters."""
    longest_sides = [
        max(step.params["shape"]) for step in steps.values() if step.params.get("shape")
    ]
    scale = size.pixels / max(longest_sides, default=size.pixels)
    return {name: replace(step, params=_smaller(step, size, scale)) for name, step in steps.items()}


def _smaller(step: Step, size: Size, scale: float) -> dict[str, Any]:
    """Return the parameters of a step at reduced size; ``scale`` is the factor for pixels.

    The pitch grows as the number of samples falls, so that the pupil diameter stays.
    """
    params = dict(step.params)
    if params.get("shape"):
        params["shape"] = tuple(max(1, round(side * scale)) for side in params["shape"])
    if "samples" in params:
        params["pitch"] = params["pitch"] and params["pitch"] * params["samples"] / size.samples
        params["samples"] = size.samples
    if step.node.path == "spectra.bands":
        params["count"] = size.bands
    if step.node.path == "doe.pixelwise":
        # its samples do not fit the small pupil: a random height map of its depth takes its place
        params["file"] = None
    if params.get("angle"):
        # the direction stays on the smaller sensor
        params["angle"] = tuple(component * min(scale, 1.0) for component in params["angle"])
    return params | (_limited(params) if step.node.random else {})


def _limited(params: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters of a random node that are lowered for a quick test."""
    return {name: min(limit, params[name]) for name, limit in _SMALLER.items() if name in params}


def with_parameters(steps: Mapping[str, Step], case: Case) -> dict[str, Step]:
    """Return the steps with the parameter values of an extreme case."""
    return {name: replace(step, params=_changed(step, case)) for name, step in steps.items()}


def _changed(step: Step, case: Case) -> dict[str, Any]:
    """Return the parameters of a step with the values of a case, which have the names ``*.name`` or
    ``node.name``.
    """
    params = dict(step.params)
    for name in step.params:
        for path in (f"*.{name}", f"{step.node.path}.{name}"):
            is_number = isinstance(params[name], int | float)  # not a range, as of a prior
            if path in case.params and (is_number or path[0] != "*"):
                value_or_function = case.params[path]
                params[name] = (
                    value_or_function(step.params)
                    if callable(value_or_function)
                    else value_or_function
                )
    return params


@dataclass
class CaseRecipe:
    """The recipe of one extreme case; each result is computed when it is first needed."""

    recipe: Recipe
    case: Case
    steps: dict[str, Step]
    keys: dict[str, Key] = field(default_factory=dict)
    values: dict[str, Any] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)  #: why a step gave no result, by step
    #: the recipe of the usual case, for results that this case does not change
    usual: CaseRecipe | None = None

    @classmethod
    def of(
        cls, recipe: Recipe, case: Case, code: Code, usual: CaseRecipe | None = None
    ) -> CaseRecipe:
        """Return the recipe of an extreme case with the store key of each step; changed results get
        other keys.
        """
        steps = with_parameters(with_size(with_losses(recipe), case.size), case)
        chain = cls(recipe, case, steps, usual=usual)
        for name in in_order({n: step.sources for n, step in steps.items()}, steps):
            key, _ = key_of(steps[name], chain.keys, recipe.seed, code)
            # a result changed by the case gets a key of its own
            chain.keys[name] = digest(key, case.name) if _put(steps[name], case) else key
        return chain

    def inputs(self, name: str) -> list[Any]:
        """Return the inputs of a step; raise `LookupError` if an earlier step gave no result."""
        return [self._gathered(self.steps[name].wires.get(i)) for i in self.steps[name].node.inputs]

    def _gathered(self, wire: Any) -> Any:
        """Return the value at an input: one result, a list of results, or None if it is not
        connected.
        """
        if wire is None or isinstance(wire, str):
            return wire and self._value(wire)
        return [self._value(name) for name in wire]

    def _value(self, step: str) -> Any:
        """Return the result of a step, computed if needed; raise `LookupError` if there is none."""
        for name in in_order(
            {step_name: any_step.sources for step_name, any_step in self.steps.items()},
            [step],
        ):
            if name not in self.values and name not in self.refused:
                self._compute(name)
        if step not in self.values:
            raise LookupError(step)
        return self.values[step]

    def _compute(self, name: str) -> None:
        """Compute one step whose inputs are known, and keep its result or the reason why there is
        none.
        """
        step, usual_recipe = self.steps[name], self.usual
        if usual_recipe and usual_recipe.keys[name] == self.keys[name]:
            try:
                self.values[name] = usual_recipe._value(name)
            except LookupError:
                self.refused[name] = usual_recipe.refused[name]
            return
        if any(source in self.refused for source in step.sources):
            self.refused[name] = "an earlier step gave no result"
            return
        inputs = self.inputs(name)
        try:
            with torch.no_grad():
                value = call(step, inputs, step.params, self.recipe.seed, "cpu")
        except RunError as error:
            self.refused[name] = str(error.cause)
            if not step.node.path.startswith("spectra.lift"):
                return
            # use a grey cube, so that later steps can be tested
            value = inputs[0].mean(0).expand(len(inputs[1].centres), -1, -1).clone()
            del self.refused[name]
        change = _put(step, self.case)
        self.values[name] = change(value) if change else value


def _put(step: Step, case: Case) -> Any:
    """Return the function by which a case changes the result of a step, or None."""
    return next(
        (change for path, change in case.values.items() if step.node.path.startswith(path)), None
    )


def unchanged_steps(chain: CaseRecipe, usual: CaseRecipe) -> Iterator[str]:
    """Yield the steps whose inputs and parameters are the same in an extreme case as in the usual
    case.
    """
    if chain.case is usual.case or chain.case.inputs or chain.case.alike:
        return
    for name, step in chain.steps.items():
        keys_here, usual_keys = (
            [case_recipe.keys[source] for source in step.sources] for case_recipe in (chain, usual)
        )
        if step.params == usual.steps[name].params and keys_here == usual_keys:
            yield name
