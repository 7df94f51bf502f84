"""Parameters of nodes: the model that validates their values, and file parameters."""

from __future__ import annotations

from itertools import chain
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationInfo, field_validator

from neusee.nodes.units import IsFile, files_of

# --- parameter model ------------------------------------------------------------------------------

# The model that validates parameters from a recipe and refuses unknown names, numbers that are not
# finite, and booleans in place of numbers.


class ParameterModel(BaseModel):
    """Base class of the models that validate values in a recipe.

    It refuses unknown names, numbers that are infinite or NaN, and true or false in place of a
    number.
    """

    model_config = ConfigDict(
        extra="forbid", frozen=True, arbitrary_types_allowed=True, allow_inf_nan=False
    )

    @field_validator("*", mode="before")
    @classmethod
    def _is_no_truth_value(cls, value: Any, info: ValidationInfo) -> Any:
        """Refuse true and false unless the type of the field allows them; pydantic would convert
        them to 1 and 0.
        """
        field = cls.model_fields[str(info.field_name)]
        truth = _first_truth(value)
        if truth is not None and not _takes_truth(field.annotation):
            raise ValueError(f"{str(truth).lower()} is not a value here: write a number or a text")
        return value


def _takes_truth(hint: Any) -> bool:
    """Return True if a type allows a boolean at any depth, or any value."""
    if hint in (bool, Any, object) or isinstance(hint, bool):
        return True
    if isinstance(hint, type) and issubclass(hint, BaseModel):
        return True  # a nested model validates its own values
    return any(_takes_truth(argument) for argument in get_args(hint))


def _first_truth(value: Any) -> bool | None:
    """Return the first boolean in a value, or in its lists and mappings, or None."""
    if isinstance(value, bool):
        return value
    if isinstance(value, dict):
        value = list(value.values())
    if not isinstance(value, list | tuple):
        return None
    return next((truth for truth in map(_first_truth, value) if truth is not None), None)


# --- file parameters ------------------------------------------------------------------------------

# File parameters of nodes: their recognition, and the conversion of texts to paths in Python calls.


def is_file(hint: Any) -> bool:
    """Return True if a parameter's type annotation contains `IsFile` at any depth, so that the
    parameter is a path.
    """
    extras = getattr(hint, "__metadata__", ())
    return any(isinstance(extra, IsFile) for extra in extras) or any(map(is_file, get_args(hint)))


def texts_of(hint: Any) -> list[Any]:
    """Return the texts that a parameter accepts other than paths, such as names of known
    cameras.
    """
    if get_origin(hint) is Literal:
        return list(get_args(hint))
    return list(chain.from_iterable(texts_of(argument) for argument in get_args(hint)))


def as_paths(hint: Any, value: Any) -> Any:
    """Convert a text to a path, or a text or list to a tuple of paths; return other values
    unchanged.

    Args:
        hint: the annotation of a parameter that `is_file`; a text that the annotation names stays a
            text
    """
    if isinstance(value, str) and value in texts_of(hint):
        return value
    if _is_several(hint):
        return tuple(files_of(value)) if isinstance(value, str | list) else value
    return Path(value) if isinstance(value, str) else value


def _is_several(hint: Any) -> bool:
    """Return True if a parameter's type is a tuple of paths."""
    return get_origin(hint) is tuple or any(map(_is_several, get_args(hint)))
