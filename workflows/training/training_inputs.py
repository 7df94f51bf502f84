"""The inputs of a training: photographs, files, code and settings, whose digest is a part of the
name of its folder.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from neusee.nodes.own_modules import Architecture
from neusee.nodes.restore import network as network_node
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.code_digest import Code, outline
from neusee.workflows.recipe.blocks.train_block import KEY, Network, Training
from neusee.workflows.training.held_out import Split
from neusee.workflows.training.loop.recorded_inputs import (
    CAMERA,
    CameraInputs,
    RecordedFile,
    RecordedInputs,
)
from neusee.workflows.training.mask_design.design_run import design_inputs
from neusee.workflows.training.training_iteration import WarmStart

#: settings that change no weight
_WITHOUT_EFFECT = {"tensorboard", "keep_pool", "export", "keep", "show"}
#: recorded by what they name
_BY_CONTENT = {"photographs", "start", "cameras", "mismatch", "network", "mask"}
_OF_VALIDATION = {"held_out", "held_out_pictures", "validate_every", "patience"}
#: nodes that an iteration calls itself
_COMPUTE = ("losses", "metrics", "restore", "doe", "scene", "resampling")
_LOOPS = (
    "training_iteration",
    "training_pictures",
    "camera_mismatch",
    "held_out",
    "loop/resumable_loop",
)  #: files of the program that decide the pictures and the steps of the optimisers


def inputs_of(
    recipe: Recipe, settings: Training, parts: Split, start: WarmStart | None, code: Code
) -> RecordedInputs:
    """Return everything that can change a trained network or mask.

    Raises ValueError with place and fix for code of the user that reads what cannot be followed.
    """
    camera = _cameras(recipe, settings, code)
    design = design_inputs(recipe, settings.design, code) if settings.learn is not None else None
    files = dict(design.files) if design else {}
    if start is not None:
        files[f"{KEY}.start"] = RecordedFile(start.file.name, start.digest)
    return RecordedInputs(
        kind="training",
        recipe=recipe.name,
        settings={
            **camera.settings,
            **_settings(settings, parts),
            **(design.settings if design else {}),
        },
        steps={**camera.steps, **(design.steps if design else {})},
        laws={**camera.laws, **(design.laws if design else {})},
        code={**_code(settings.network, code), **(design.code if design else {})},
        files=files,
        photographs=recorded(parts.trained.paths),
        held_out=recorded(parts.held_out),
    )


def recorded(paths: Sequence[Path]) -> tuple[RecordedFile, ...]:
    """Return names and digests of files; a file is read once in a process."""
    return tuple(map(RecordedFile.of, paths))


def _cameras(recipe: Recipe, settings: Training, code: Code) -> CameraInputs:
    """Return what the camera of a training and its further cameras contribute."""
    joined = _camera(recipe, settings, code)
    for number, camera in enumerate(recipe.cameras, 2):
        joined = joined.joined(_camera(camera, settings, code).named(f"{CAMERA}{number}: "))
    return joined


def _camera(recipe: Recipe, settings: Training, code: Code) -> CameraInputs:
    """Return what a camera contributes.

    The scene step does not count, because the training itself makes the scenes; its shape does.
    """
    read_steps = (settings.picture, settings.truth, settings.psf, settings.light, settings.learn)
    outputs = [name for name in read_steps if name is not None and name in recipe.steps]
    camera = CameraInputs.of(recipe, outputs, code, computed=(settings.scene,))
    scene = recipe.steps.get(settings.scene)
    scene_shape = list(scene.params.get("shape") or ()) if scene else []
    return CameraInputs(
        {**camera.settings, f"{settings.scene}.shape": scene_shape}, camera.steps, camera.laws
    )


def _settings(settings: Training, parts: Split) -> dict[str, Any]:
    """Return the settings of the block by path, without those of files and of the mask design."""
    excluded = _WITHOUT_EFFECT | _BY_CONTENT | (set() if parts.held_out else _OF_VALIDATION)
    train_settings = settings.model_dump(mode="json", exclude=excluded)
    train_settings["network"] = network_settings(settings.network)
    return dict(_flat(train_settings, KEY))


def network_settings(network: Network) -> dict[str, Any]:
    """Return the settings of a network; a class of the user is its name, with its arguments."""
    if network.architecture is None:
        return {"kind": network.kind, "width": network.width, **network.options}
    return {
        "class": str(network.architecture),
        **network.model_dump(include={"parameters", "multiple"}),
    }


def _flat(block: Mapping[str, Any], path: str) -> list[tuple[str, Any]]:
    """Return the single values of a nested mapping, each with its path.

    An empty mapping counts as a value.
    """
    flat_settings: list[tuple[str, Any]] = []
    for name, value in block.items():
        inner_path = f"{path}.{name}"
        flat_settings += (
            _flat(value, inner_path) if isinstance(value, dict) and value else [(inner_path, value)]
        )
    return flat_settings


def _code(network: Network, code: Code) -> dict[str, str]:
    """Return digests of the code that no step of the recipe names: losses, networks, and the
    loop itself.
    """
    digests = {f"neusee.nodes.{name}": code.digest(f"neusee.nodes.{name}") for name in _COMPUTE}
    folder = Path(__file__).parent
    for name in _LOOPS:
        digests[f"neusee/workflows/training/{name}.py"] = outline(
            (folder / f"{name}.py").read_bytes()
        ).digest
    if network.architecture is not None:
        digests[f"the network {network.architecture}"] = code_of_class(network.architecture, code)
    return digests


def code_of_class(architecture: Architecture, code: Code) -> str:
    """Return the digest of the code of a network class and of what it imports; refuse what
    cannot be followed.
    """
    network = architecture.network
    try:
        return code.of(network_node, ((network.__module__, network.__qualname__),))
    except LookupError as error:
        raise ValueError(f"{KEY}.network.architecture {architecture}: {error.args[0]}") from error
