"""The model that checks parameters from a recipe: unknown names, numbers that are not finite, true in place of 1."""

from __future__ import annotations

from typing import Any, get_args

from pydantic import BaseModel, ConfigDict, ValidationInfo, field_validator


class ParameterModel(BaseModel):
    """Base class of models that check values of a recipe.

    An unknown name is a mistake, and so are a number that is infinite or NaN, and true or false in place of a number.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True, allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _is_no_truth_value(cls, value: Any, info: ValidationInfo) -> Any:
        """Refuse true and false where the type of the field has no truth value: 1 and 0 are other statements."""
        field = cls.model_fields[str(info.field_name)]
        if not _takes_truth(field.annotation) and _has_truth(value):
            raise ValueError(f"{str(_first_truth(value)).lower()} is not a value here: write a number or a text")
        return value


def _takes_truth(hint: Any) -> bool:
    """Return True if a type may hold true or false at any depth, or anything at all."""
    if hint in (bool, Any, object) or isinstance(hint, bool):
        return True
    if isinstance(hint, type) and issubclass(hint, BaseModel):
        return True  # a model checks its own values
    return any(_takes_truth(part) for part in get_args(hint))


def _has_truth(value: Any) -> bool:
    return _first_truth(value) is not None


def _first_truth(value: Any) -> bool | None:
    """Return the first true or false in a value or in its lists and mappings, or None."""
    if isinstance(value, bool):
        return value
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, list | tuple) else ()
    return next((truth for truth in map(_first_truth, parts) if truth is not None), None)
