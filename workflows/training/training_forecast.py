"""Forecast of a training before its first iteration: iterations, hours of processor time, memory.

An iteration that was measured on this processor is the basis; before that, the forecast is a guess
from the laws of the steps of the camera and of the network.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from statistics import median, quantiles

import torch

from neusee.nodes.restore import (
    FFTMamba,
    Informed,
    NAFNet,
    UNet,
    Unrolled,
    critics,
    own_network,
)
from neusee.nodes.spectra import start_mst_plus_plus
from neusee.workflows.engine.cost_model import (
    Estimate,
    Range,
    TrainingLaw,
    pace,
    sizes_of,
    training_laws,
)
from neusee.workflows.engine.placement_inputs import past_costs
from neusee.workflows.engine.processor_speed import processor
from neusee.workflows.engine.provenance import timestamp
from neusee.workflows.explain.run_forecast import Forecast, wrapped_text
from neusee.workflows.graph.recipe_graph import Recipe, dependents, needed
from neusee.workflows.keys.cache_key import Key, digest
from neusee.workflows.recipe.blocks.train_block import POSED, LiftTraining, Stage, Training
from neusee.workflows.store.cache_settings import format_size
from neusee.workflows.store.result_store import Store
from neusee.workflows.tolerance.cheaper_steps import with_substitutions

#: time of a pass forward and back through a step, relative to the pass forward
_BOTH_WAYS = 3.0
#: passes of a critic over a picture in an iteration: one for the network, and two with a penalty
_CRITIC_PASSES = 4.0
#: a critic for the full and one for half the resolution
_TWO_SCALES = 1.25
#: a restoration is the forward third of a pass
_FORWARD = 1 / 3
#: range of the time of an iteration about a guess
_GUESS = Range(0.4, 2.5)
_MOST_MEASURED = 200  #: number of newest iterations that count


@dataclass(frozen=True)
class Seconds:
    """A predicted time in s of the processor, with its range."""

    expected: float = 0.0
    least: float = 0.0
    most: float = 0.0

    def __add__(self, other: Seconds) -> Seconds:
        return Seconds(
            self.expected + other.expected, self.least + other.least, self.most + other.most
        )

    def times(self, factor: float) -> Seconds:
        """Return the time of a number of repetitions."""
        return Seconds(self.expected * factor, self.least * factor, self.most * factor)

    def within(self, span: Range) -> Seconds:
        """Return the time with another range, that of a guess."""
        return Seconds(self.expected, self.expected * span.least, self.expected * span.most)

    @classmethod
    def of(cls, costs: Iterable[Estimate]) -> Seconds:
        """Return the time of steps on the CPU, one after another."""
        total = cls()
        for cost in costs:
            seconds, spread = cost.seconds["cpu"], cost.spread[1]
            total += cls(seconds, seconds * spread.least, seconds * spread.most)
        return total


@dataclass(frozen=True)
class StageForecast:
    """The predicted time of a stage, from measured iterations or from laws."""

    number: int
    iterations: int
    batch: int
    seconds: Seconds
    measured: int  #: number of iterations that were measured; 0 for a guess


# --- measured iterations --------------------------------------------------------------------------


class IterationTimes:
    """The processor times of the iterations of a training, which a later forecast reads."""

    def __init__(self, recipe: Recipe, settings: Training, store: Store) -> None:
        self._recipe, self._settings, self._store = recipe, settings, store
        self._seconds: dict[tuple[int, bool], list[float]] = {}

    def add(self, number: int, iteration: int, seconds: float) -> None:
        """Add the time of an iteration of a stage."""
        times = self._seconds.setdefault((number, simulates(self._settings, number, iteration)), [])
        times.append(seconds)
        del times[:-_MOST_MEASURED]

    def keep(self) -> None:
        """Write the times to the store, once for each kind of iteration; the first ones stay."""
        for (number, is_new), times in self._seconds.items():
            key = iteration_key(self._recipe, self._settings, number, is_new)
            about = {"step": f"training iteration, stage {number}", "recipe": self._recipe.name}
            here = processor()
            costs = {
                "seconds": median(times),
                "bytes": 0,
                "device": "cpu",
                "date": timestamp(),
                "processor_seconds": median(times),
                "processor": here.name,
                "threads": here.threads,
                # of the iterations: their number, and the tenth and the ninetieth percentile
                "facts": dict(zip(("count", "least", "most"), _summary(times), strict=True)),
            }
            self._store.put_receipt(key, about | costs)


def _summary(times: Sequence[float]) -> tuple[int, float, float]:
    if len(times) < 2:
        return len(times), times[0], times[0]
    tenths = quantiles(times, n=10, method="inclusive")
    return len(times), tenths[0], tenths[-1]


def simulates(settings: Training, number: int, iteration: int) -> bool:
    """Return True if an iteration simulates its pictures: all but those of a pool that is full."""
    if number != 2 or settings.pool is None:
        return True
    return iteration * settings.stages[number].batch < settings.pool


def iteration_key(recipe: Recipe, settings: Training, number: int, is_new: bool) -> Key:
    """Return the key of the times of an iteration: a digest of all that decides its time."""
    recipe, order, _ = _steps(recipe, settings, number)
    sizes = sizes_of(recipe, order)
    steps = [[name, recipe.steps[name].node.path, *map(float, sizes[name][:4])] for name in order]
    stage = settings.stages[number].model_dump(mode="json", exclude={"iterations"})
    names = ("network", "critics", "size", "patch", "patches", "precision", "average")
    texts = [f"{name}={getattr(settings, name)!r}" for name in names]
    cameras = len(recipe.cameras)
    here = list(processor())
    return digest("training iteration", here, number, is_new, steps, stage, texts, cameras)


def _measured(
    recipe: Recipe, settings: Training, store: Store, number: int, is_new: bool
) -> tuple[Seconds, int] | None:
    """Return the time of an iteration that an earlier training measured, and their number."""
    about = store.about(iteration_key(recipe, settings, number, is_new))
    facts = (about or {}).get("facts") or {}
    numbers = [(about or {}).get("processor_seconds"), facts.get("least"), facts.get("most")]
    if not about or not all(isinstance(x, int | float) and x >= 0 for x in numbers):
        return None
    return Seconds(*map(float, numbers)), int(facts.get("count") or 1)  # type: ignore[arg-type]


# --- laws -----------------------------------------------------------------------------------------


def _steps(recipe: Recipe, settings: Training, number: int) -> tuple[Recipe, list[str], set[str]]:
    """Return the recipe as a stage of the training computes it, the steps of a picture and of the
    mask in order, and those of them that differ between pictures.
    """
    stage = settings.stages[number]
    light = (settings.light,) if stage.bsr else ()
    outputs = (settings.picture, settings.truth, settings.psf, *light)
    learnt = {settings.learn} if settings.learn and number == 1 else set[str]()
    recipe = with_substitutions(replace(recipe, estimates=False), outputs, learnt)
    order = needed(recipe, outputs)
    psf_steps = set(needed(recipe, [settings.psf]))
    random_steps = {name for name in order if recipe.steps[name].node.random} - psf_steps
    # each picture has a laser of its own
    lasers = {n for n in order if recipe.steps[n].node.path == "optics.laser_irradiance"}
    per_picture = dependents(recipe, {settings.scene, *random_steps, *lasers}, order)
    return recipe, order, per_picture - psf_steps


@dataclass(frozen=True)
class Camera:
    """The predicted costs of the camera of a stage, from the laws of its steps."""

    picture: Seconds  #: of the steps of one picture, forward
    mask: Seconds  #: of the steps that change with the mask alone, forward; 0 for a fixed mask
    picture_bytes: float  #: results of the steps of one picture
    mask_bytes: float
    pixels: float  #: of the input of the network

    @classmethod
    def of(cls, recipe: Recipe, settings: Training, number: int, store: Store) -> Camera:
        """Return the costs of the camera of a recipe."""
        recipe, order, per_picture = _steps(recipe, settings, number)
        estimates = _step_costs(recipe, order, store)
        learns = settings.learn is not None and number == 1
        behind_mask = dependents(recipe, {str(settings.learn)}, order) if learns else set[str]()
        pictures = [estimates[name] for name in order if name in per_picture]
        masks = [estimates[name] for name in order if name in behind_mask - per_picture]
        return cls(
            Seconds.of(pictures),
            Seconds.of(masks),
            sum(cost.bytes for cost in pictures),
            sum(cost.bytes for cost in masks),
            _pixels(settings, estimates[settings.picture].bytes),
        )


def _step_costs(recipe: Recipe, order: Sequence[str], store: Store) -> dict[str, Estimate]:
    """Return the costs of steps that run again and again, without those of loading libraries."""
    costs = past_costs(store, sizes_of(recipe, order))
    return {name: costs.of(recipe.steps[name], ["cpu"]) for name in order}


def _pixels(settings: Training, picture_bytes: float) -> float:
    """Return the number of pixels of one input of the network."""
    if settings.patch is not None:
        return float(settings.patch[0] * settings.patch[1] * settings.patches)
    if settings.size is not None:
        return float(settings.size[0] * settings.size[1])
    # three colours of 4 bytes
    return picture_bytes / 12


def _guess_range() -> Range:
    """Return the range of a guess, which is wider on a processor other than that of the laws."""
    other = pace().range
    return Range(_GUESS.least * other.least, _GUESS.most * other.most)


def _network_law(settings: Training) -> tuple[TrainingLaw, int]:
    """Return the law of the network of a training, and how often it is passed.

    A class of the user, and a network that goes on from a filter, count as a NAFNet.
    """
    laws, network = training_laws(), settings.network
    if network.architecture is not None:
        return laws["nafnet"], 1
    if network.kind in POSED:
        return laws["nafnet"], network.steps if network.kind == "unrolled" else 1
    return laws[network.kind], 1


def _guessed_iteration(camera: Camera, settings: Training, stage: Stage, is_new: bool) -> Seconds:
    """Return the time of an iteration by the laws of its parts."""
    learns = camera.mask_bytes > 0
    network, passes = _network_law(settings)
    seconds = passes * network.time(settings.network.width, camera.pixels)
    if stage.adversarial:
        critic = training_laws()["critic"].time(settings.critics.width, camera.pixels)
        seconds += _CRITIC_PASSES * _TWO_SCALES * critic
    picture = camera.picture.times(_BOTH_WAYS if learns else 1.0) if is_new else Seconds()
    one = (picture + Seconds(seconds, seconds, seconds)).times(stage.batch)
    return (one + camera.mask.times(_BOTH_WAYS)).within(_guess_range())


def stage_forecast(
    recipe: Recipe, settings: Training, number: int, store: Store
) -> tuple[StageForecast, Camera]:
    """Return the forecast of a stage, with the costs of its camera."""
    stage = settings.stages[number]
    camera = Camera.of(recipe, settings, number, store)
    new_count = stage.iterations
    if number == 2 and settings.pool is not None:
        new_count = min(stage.iterations, -(-settings.pool // stage.batch))
    total, measured_count = Seconds(), 0
    for is_new, count in ((True, new_count), (False, stage.iterations - new_count)):
        if not count:
            continue
        measured = _measured(recipe, settings, store, number, is_new)
        measured_count += measured[1] if measured else 0
        iteration = measured[0] if measured else _guessed_iteration(camera, settings, stage, is_new)
        total += iteration.times(count)
    total += _validations(camera, settings, stage)
    return StageForecast(number, stage.iterations, stage.batch, total, measured_count), camera


def _validations(camera: Camera, settings: Training, stage: Stage) -> Seconds:
    """Return the time of restoring the held-out photographs, whose number is at most that of the
    settings.
    """
    if settings.photographs is None or settings.held_out is None:
        return Seconds()
    count = -(-stage.iterations // settings.validate_every) * settings.held_out_pictures
    network, passes = _network_law(settings)
    restored = _FORWARD * passes * network.time(settings.network.width, camera.pixels)
    seconds = count * restored
    return Seconds(seconds, 0.0, seconds) + camera.picture.times(settings.held_out_pictures)


# --- memory ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Memory:
    """The predicted memory (bytes) of a training, beside that of the program."""

    parameters: float
    gradients_and_optimiser: float
    activations: float  #: of one picture, because pictures pass one at a time on a CPU

    @property
    def total(self) -> float:
        """Return the sum of all parts."""
        return self.parameters + self.gradients_and_optimiser + self.activations


def memory_of(settings: Training, cameras: Mapping[int, Camera]) -> Memory:
    """Return the memory of a training: parameters with their average, gradients with the two
    moments of Adam, and what an iteration keeps for its way back.
    """
    network_bytes = _bytes_of(_network(settings))
    critic_bytes = sum(map(_bytes_of, critics(torch.Generator(), settings.critics.width)))
    trained = network_bytes + critic_bytes
    law, passes = _network_law(settings)
    activations = [
        passes * law.saved_bytes(settings.network.width, camera.pixels)
        + _TWO_SCALES * training_laws()["critic"].saved_bytes(settings.critics.width, camera.pixels)
        + (_BOTH_WAYS if camera.mask_bytes else 1.0) * camera.picture_bytes
        + _BOTH_WAYS * camera.mask_bytes
        for camera in cameras.values()
    ]
    average = network_bytes if settings.average else 0.0
    return Memory(trained + average, 3.0 * trained, max(activations, default=0.0))


def _network(settings: Training) -> torch.nn.Module:
    """Return the network of a training without values, or that of the user's class."""
    network = settings.network
    if network.architecture is not None:
        return own_network(network.architecture, network.parameters, network.multiple)
    with torch.device("meta"):
        if network.kind == "fft_mamba":
            return FFTMamba(network.width, **network.options)
        if network.kind == "unrolled":
            return Unrolled(network.width, network.steps)
        kinds = {"unet": UNet, "nafnet": NAFNet, "informed": Informed}
        built: torch.nn.Module = kinds[network.kind](network.width)
        return built


def _bytes_of(module: torch.nn.Module) -> float:
    return float(sum(parameter.nbytes for parameter in module.parameters()))


# --- forecast -------------------------------------------------------------------------------------


def forecast_training(recipe: Recipe, store: Store) -> Forecast:
    """Return the forecast of the training of a recipe, with its lines for a reader.

    Raises ValueError for a recipe without a training.
    """
    if recipe.lifting is not None:
        return _lift_forecast(recipe, recipe.lifting, store)
    settings = recipe.training
    if settings is None:
        raise ValueError(f"{recipe.name} has no block `train`")
    stages, cameras = list[StageForecast](), dict[int, Camera]()
    for number in settings.learnt:
        stage, cameras[number] = stage_forecast(recipe, settings, number, store)
        stages.append(stage)
    return _forecast(stages, memory_of(settings, cameras))


def _lift_forecast(recipe: Recipe, settings: LiftTraining, store: Store) -> Forecast:
    """Return the forecast of the training of a lift, whose pictures of a batch pass together."""
    outputs = (settings.picture, settings.cube)
    order = needed(recipe, outputs)
    random_steps = {name for name in order if recipe.steps[name].node.random}
    estimates = _step_costs(recipe, order, store)
    per_picture = dependents(recipe, random_steps, order)
    law, pixels = training_laws()["mst_plus_plus"], estimates[settings.picture].bytes / 12
    seconds = law.time(1, pixels)
    one = Seconds.of(estimates[name] for name in order if name in per_picture)
    iteration = (
        (one + Seconds(seconds, seconds, seconds)).times(settings.batch).within(_guess_range())
    )
    total = iteration.times(settings.iterations)
    parameters = _bytes_of(start_mst_plus_plus(torch.Generator()))
    average = parameters if settings.ema_decay else 0.0
    saved = settings.batch * law.saved_bytes(1, pixels)
    memory = Memory(parameters + average, 3.0 * parameters, saved)
    return _forecast([StageForecast(0, settings.iterations, settings.batch, total, 0)], memory)


def _forecast(stages: Sequence[StageForecast], memory: Memory) -> Forecast:
    """Return the lines of a forecast, and its totals as values for JSON."""
    total = sum((stage.seconds for stage in stages), Seconds())
    is_guess = not all(stage.measured for stage in stages)
    totals = {
        "iterations": sum(stage.iterations for stage in stages),
        "seconds": asdict(total),
        "memory": {**asdict(memory), "total": memory.total},
        "guess": is_guess,
    }
    wrapped_lines = list[str]()
    for line in _lines(stages, total, memory, is_guess):
        wrapped_lines += wrapped_text(line)
    return Forecast(wrapped_lines, [asdict(stage) for stage in stages], totals, False)


def _lines(
    stages: Sequence[StageForecast], total: Seconds, memory: Memory, is_guess: bool
) -> list[str]:
    """Return the lines of a forecast: its stages, their sum, the memory, and what a guess rests
    on.
    """
    lines = [_stage_line(stage) for stage in stages]
    if len(stages) > 1:
        lines.append(f"both stages: {_duration(total)} of processor time")
    lines.append(
        f"memory beside the program: {format_size(memory.total)}"
        f" (parameters {format_size(memory.parameters)}, gradients and optimiser"
        f" {format_size(memory.gradients_and_optimiser)}, one iteration"
        f" {format_size(memory.activations)})"
    )
    if is_guess:
        lines.append(
            "a guess: from laws of the camera's steps and of the network, before an iteration was"
            " measured on this processor"
        )
    return lines


def _stage_line(stage: StageForecast) -> str:
    name = f"stage {stage.number}" if stage.number else "lift"
    source = f", by {stage.measured} measured iterations" if stage.measured else ", a guess"
    return (
        f"{name}: {stage.iterations} iterations of"
        f" {stage.batch} {'picture' if stage.batch == 1 else 'pictures'},"
        f" {_duration(stage.seconds)}{source}"
    )


def _duration(seconds: Seconds) -> str:
    """Return a time as text with its range, in hours, minutes or seconds."""
    units = (("h", 3600.0), ("min", 60.0), ("s", 1.0))
    unit, size = next(pair for pair in units if seconds.expected >= 2 * pair[1] or pair[1] == 1.0)
    values = (x / size for x in (seconds.expected, seconds.least, seconds.most))
    expected, least, most = (f"{x:.2g}" if x < 10 else f"{x:.0f}" for x in values)
    return f"about {expected} {unit} ({least} to {most})"
