"""Messages for invalid values of parameters and settings, which say in terms of a recipe what to
write.
"""

from __future__ import annotations

import os
import re

from pydantic_core import ErrorDetails

from neusee.nodes.units import in_words, read_written
from neusee.workflows.graph.errors import nearest
from neusee.workflows.recipe.text.yaml_values import Value

#: words of a limit, by the name that a model gives to the limit
_LIMITS = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most"}


_LONG_NUMBER = 1e9  #: limit above which a message writes a number with a power of ten


def message_of(error: ErrorDetails, value: Value) -> str:
    """Return the message for an error of a model, which says what to write in place of
    ``value``.
    """
    if error["type"] == "missing" and isinstance(error["loc"][-1], str):
        return f"lacks {error['loc'][-1]}"
    if error["type"] == "extra_forbidden":
        return "has no meaning here"
    if error["type"] == "missing":
        # a list that is too short lacks its value at this index
        return f"must have at least {int(error['loc'][-1]) + 1} values"
    if limit := _limit_in_unit(error, value):
        return limit
    text = _in_plain_words(error["msg"].removeprefix("Value error, "))
    if error["type"] == "literal_error":
        options = re.findall(r"'([^']*)'", error.get("ctx", {}).get("expected", ""))
        hint = nearest(os.path.basename(str(error["input"])), options)
        text += f"; {hint}" if hint.startswith("did you mean") else ""
    return text[:1].lower() + text[1:]


def _in_plain_words(text: str) -> str:
    """Return the text of an error without the words of a programmer, such as input, tuple and
    dictionary.
    """
    text = re.sub(
        r"^Input should be (a valid |valid )?",
        lambda m: "must be a " if m[1] == "a valid " else "must be ",
        text,
    )
    text = re.sub(r"^must be a (?=[aeiou])", "must be an ", text)
    text = text.replace("must be a tuple", "must be a list, such as [1, 2]").replace(
        "a dictionary", "a mapping"
    )
    text = text.replace(
        "must be an integer, got a number with a fractional part", "must be a whole number"
    )
    text = re.sub(r"must be an integer, unable to parse .*", "must be a whole number", text)
    return re.sub(r"must be a number, unable to parse .*", "must be a number", text)


def _limit_in_unit(error: ErrorDetails, value: Value) -> str:
    """Return the message for a value beyond its limit, with the limit in the unit that the user
    wrote, or "" for any other error.
    """
    name = _limit_name(error)
    if name is None:
        return ""
    limit = error["ctx"][name]
    # a number without a unit: the usual message would print a large limit with all its digits
    if not isinstance(value.data, str):
        return f"must be {_LIMITS[name]} {limit:g}" if abs(limit) > _LONG_NUMBER else ""
    try:
        _, unit, _ = read_written(value.data)
    except ValueError:
        return ""
    # the sign is wrong, which matters more than a tiny least value
    if name == "ge" and limit > 0 and _is_at_most_zero(error["input"]):
        return "must be greater than 0"
    return f"must be {_LIMITS[name]} {in_words(limit, unit)}" if unit and limit else ""


def _limit_name(error: ErrorDetails) -> str | None:
    """Return the name that a model gives to the limit of an error, or None for another error."""
    return next((name for name in _LIMITS if name in error.get("ctx", {})), None)


def _is_at_most_zero(number: object) -> bool:
    return isinstance(number, int | float) and number <= 0
