"""A height map read from a file, or a smooth random height map at which a training starts."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import ParameterError, node
from neusee.nodes.doe._height_from_phase import height_checks
from neusee.nodes.input_files import once_per_version, refuse_large_array
from neusee.nodes.optics._phase_screen import screen
from neusee.nodes.optics._pupil_grid import grid_of
from neusee.nodes.units import DataFile, PositiveLength
from neusee.nodes.values import Stop

if TYPE_CHECKING:
    from PIL.Image import Image

_GREYS = {"L": 255, "I;16": 65535, "I;16B": 65535, "I": 65535}  #: the level of white in each mode of a grey picture
Scale = Annotated[float, Field(gt=0, le=1)]  #: share of the pupil's diameter


def _header(file: Path) -> tuple[int, ...]:
    """Return the shape of the height map in a file without reading the heights."""
    from safetensors import SafetensorError

    try:
        return _shape_in(file)
    except ParameterError:
        raise
    except (SafetensorError, OSError, ValueError, EOFError) as error:
        raise ParameterError("file", f"{file.name} cannot be read as a height map: {error}") from error


def _shape_in(file: Path) -> tuple[int, ...]:
    if file.suffix == ".npy":
        import numpy as np

        head = np.load(file, mmap_mode="r", allow_pickle=False)
        _refuse_other_than_numbers(file, str(head.dtype), head.dtype.kind in "fiu")
        return tuple(head.shape)
    if file.suffix == ".safetensors":
        from safetensors import safe_open

        with safe_open(file, framework="pt") as tensors:
            heights = tensors.get_slice(_name(file, list(tensors.keys())))
            kind = str(heights.get_dtype())
            _refuse_other_than_numbers(file, kind, kind.startswith(("F", "BF", "I", "U")))
            return tuple(heights.get_shape())
    if file.suffix == ".png":
        with _levels(file) as picture:
            return picture.height, picture.width
    raise ParameterError("file", f"{file.name}: a height map is read from .npy, .safetensors or grey .png")


def _refuse_other_than_numbers(file: Path, kind: str, real: bool) -> None:
    """Raise ParameterError for values that are not real numbers, such as complex ones, before their part is dropped."""
    if not real:
        text = f"{file.name} holds values of type {kind}: save the heights as real numbers, in m"
        raise ParameterError("file", text)


def _levels(file: Path) -> "Image":
    """Open a greyscale picture file; raise ParameterError for a picture that is not greyscale."""
    from PIL import Image

    picture = Image.open(file)
    if picture.mode not in _GREYS:
        picture.close()
        raise ParameterError(
            "file", f"{file.name} is {picture.mode}, not grey: store one grey level per sample, in 8 or 16 bits"
        )
    return picture


def _name(file: Path, names: list[str]) -> str:
    if "height" in names or len(names) == 1:
        return "height" if "height" in names else names[0]
    found = ", ".join(sorted(names)) or "nothing"
    raise ParameterError("file", f"{file.name} holds {found}: name the tensor of the height map 'height'")


def read_height_map(file: Path, depth: float) -> Tensor:
    """Read a height map in m from a file; ``depth`` is the height of white in a picture."""
    import numpy as np

    if file.suffix == ".png":
        with _levels(file) as picture:
            levels = torch.from_numpy(np.asarray(picture, dtype=np.float64))
            return (levels * (depth / _GREYS[picture.mode])).to(torch.float32)
    if file.suffix == ".npy":
        return torch.from_numpy(np.load(file, allow_pickle=False)).to(torch.float32)
    from safetensors.torch import load_file

    tensors = load_file(file)
    return tensors[_name(file, list(tensors))].to(torch.float32)


@node()
def pixelwise(
    stop: Stop,
    *,
    file: DataFile | None = None,
    depth: PositiveLength = 1.2e-6,
    scale: Scale = 0.1,
    rng: torch.Generator,
) -> Tensor:
    """Read a height map from ``file``, or return a smooth random height map between 0 and ``depth``.

    The features of the random height map are ``scale`` diameters wide. It is a start for training: a flat height map
    is a saddle point, where the suppression has no gradient.

    Shapes: stop -> (v, u).
    Units:  m; a .png holds grey levels, of which white is ``depth``.
    Error:  exact.
    Raises: ParameterError for a file without a height map, or of another shape than the pupil grid; ValueError for a
            height that is negative or not finite.
    Source: by definition.
    """
    if file is None:
        noise = screen(grid_of(stop), scale, rng)
        return (depth * torch.sigmoid(1.5 * noise)).to(torch.float32)
    _fits(file, _header(file), stop)
    height = read_height_map(file, depth)
    if not bool(torch.isfinite(height).all()) or float(height.min()) < 0:
        low = float(height.min())
        raise ValueError(f"{file.name}: lowest height {low:.3g} m, but every height must be finite and at least 0")
    return height


def _fits(file: Path, shape: tuple[int, ...], stop: Stop) -> None:
    samples = int(stop.samples)
    if shape != (samples, samples):
        fix = f"resample the height map, or set samples to {shape[-1] if shape else 1}"
        raise ParameterError("file", f"{file.name} is {shape}, not the pupil grid ({samples}, {samples}): {fix}")


@pixelwise.preflight
def _(*, stop: Stop | None, file: Path | None, **_: Any) -> list[str]:
    if file is not None:
        shape = _header(file)
        refuse_large_array(file, shape)
        if stop is not None:
            _fits(file, shape, stop)
        if problem := _wrong_heights(file):
            raise ParameterError("file", problem)
    return []


@once_per_version
def _wrong_heights(file: Path) -> str:
    """Return a message for a file whose heights cannot be read or are negative or not finite, else an empty text."""
    try:
        height = read_height_map(file, 1.0)
    except (OSError, ValueError, SyntaxError) as error:
        return f"{file.name} cannot be read as a height map: {error}"
    low = float(height.min())
    if bool(torch.isfinite(height).all()) and low >= 0:
        return ""
    return f"{file.name}: lowest height {low:.3g} m, but every height must be finite and at least 0"


pixelwise.check(height_checks)
