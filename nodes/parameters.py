"""Parameters of nodes: the model that checks their values, and those that are files."""

from __future__ import annotations

from itertools import chain
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationInfo, field_validator

from neusee.nodes.units import IsFile, files_of

# --- parameter model ------------------------------------------------------------------------------

# The model that checks parameters from a recipe: unknown names, numbers that are not finite, true
# in place of 1.


class ParameterModel(BaseModel):
    """Base class of models that check values of a recipe.

    An unknown name is a mistake, and so are a number that is infinite or NaN, and true or false in
    place of a number.
    """

    model_config = ConfigDict(
        extra="forbid", frozen=True, arbitrary_types_allowed=True, allow_inf_nan=False
    )

    @field_validator("*", mode="before")
    @classmethod
    def _is_no_truth_value(cls, value: Any, info: ValidationInfo) -> Any:
        """Refuse true and false where the type of the field has no truth value: 1 and 0 are
        other statements.
        """
        field = cls.model_fields[str(info.field_name)]
        truth = _first_truth(value)
        if truth is not None and not _takes_truth(field.annotation):
            raise ValueError(f"{str(truth).lower()} is not a value here: write a number or a text")
        return value


def _takes_truth(hint: Any) -> bool:
    """Return True if a type may hold true or false at any depth, or anything at all."""
    if hint in (bool, Any, object) or isinstance(hint, bool):
        return True
    if isinstance(hint, type) and issubclass(hint, BaseModel):
        return True  # a model checks its own values
    return any(_takes_truth(argument) for argument in get_args(hint))


def _first_truth(value: Any) -> bool | None:
    """Return the first true or false in a value or in its lists and mappings, or None."""
    if isinstance(value, bool):
        return value
    if isinstance(value, dict):
        value = list(value.values())
    if not isinstance(value, list | tuple):
        return None
    return next((truth for truth in map(_first_truth, value) if truth is not None), None)


# --- file parameters ------------------------------------------------------------------------------

# Parameters of nodes that are files: which they are, and the paths that a caller in Python writes
# as texts.


def is_file(hint: Any) -> bool:
    """Return True if a parameter's type annotation contains `IsFile` at any depth, so that the
    parameter is a path.
    """
    extras = getattr(hint, "__metadata__", ())
    return any(isinstance(extra, IsFile) for extra in extras) or any(map(is_file, get_args(hint)))


def texts_of(hint: Any) -> list[Any]:
    """Return the texts that a parameter takes beside a path, such as the names of known cameras."""
    if get_origin(hint) is Literal:
        return list(get_args(hint))
    return list(chain.from_iterable(texts_of(argument) for argument in get_args(hint)))


def as_paths(hint: Any, value: Any) -> Any:
    """Return a path or paths for a text or a list of texts, and every other value as it is.

    Args: hint: the annotation of a parameter that `is_file`; a text that the annotation names stays
            a text.
    """
    if isinstance(value, str) and value in texts_of(hint):
        return value
    if _is_several(hint):
        return tuple(files_of(value)) if isinstance(value, str | list) else value
    return Path(value) if isinstance(value, str) else value


def _is_several(hint: Any) -> bool:
    """Return True if a parameter takes a tuple of paths."""
    return get_origin(hint) is tuple or any(map(_is_several, get_args(hint)))
