"""Lists and ranges that are written as text, such as ``1,2,3`` and ``linspace(450 nm, 650 nm, 5)``.

Commas in quotes or brackets do not separate values, so that ``[1, 2]`` is one value. Numbers of a range are computed
exactly: ``range(0, 1, 0.1)`` has the value 0.3, not 0.30000000000000004.
"""

from __future__ import annotations

import difflib
import math
import re
from decimal import Decimal, localcontext
from fractions import Fraction

MOST = 100_000  #: values of one axis, and points of one sweep

_QUOTED = r"""(?:^|(?<=[\s,:(\[{]))(?:"(?:[^"\\]|\\.)*"|'(?:[^']|'')*')"""
_TOKEN = re.compile(rf"{_QUOTED}|.", re.DOTALL)
_PAIRS = {"(": ")", "[": "]", "{": "}"}
_CALL = re.compile(r"\s*([A-Za-z]\w*)\s*\((.*)\)\s*", re.DOTALL)
_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\d\s.].*)?")
_EXACT = 10**15  #: smaller whole numbers are written without a decimal point


def split(text: str) -> list[str]:
    """Split a text at the commas outside of quotes and brackets; raise `ValueError` for an unclosed bracket."""
    parts, waiting = [""], list[str]()
    for token in _TOKEN.findall(text):
        if token == "," and not waiting:
            parts.append("")
            continue
        parts[-1] += token
        if token in _PAIRS:
            waiting.append(_PAIRS[token])
        elif waiting and token == waiting[-1]:
            waiting.pop()
    if waiting:
        raise ValueError(f"a bracket is not closed: {waiting[-1]} is missing")
    return parts


def values_of(text: str) -> list[str]:
    """Return the values of a list or a range as YAML texts; raise `ValueError` if the text is malformed."""
    parts = split(text)
    if len(parts) > 1 and not all(part.strip() for part in parts):
        raise ValueError("a value is missing before or after a comma")
    return [value for part in parts for value in _spanned(part)]


def spans(text: str) -> bool:
    """Return True if a text is a range, such as ``range(4)``."""
    return _function(text) is not None


def _spanned(text: str) -> list[str]:
    """Return the values of a range such as ``range(4)``, or else the text itself as the only value."""
    function = _function(text)
    if function is None:
        return [text.strip()]
    name, arguments = function
    try:
        return _FUNCTIONS[name]([part.strip() for part in split(arguments)] if arguments.strip() else [])
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


def _function(text: str) -> tuple[str, str] | None:
    """Return the name and the arguments of a range such as ``range(4)``, or None if the text is not a range.

    Raises `ValueError` if the name is misspelt.
    """
    match = _CALL.fullmatch(text)
    if match is None or match[1] in _FUNCTIONS:
        return match and (match[1], match[2])
    close = difflib.get_close_matches(match[1].lower(), _FUNCTIONS, 1, 0.7)
    if close:
        raise ValueError(f"there is no range function {match[1]}; did you mean {close[0]}?")
    return None


def _range(arguments: list[str]) -> list[str]:
    if not 1 <= len(arguments) <= 3:
        raise ValueError("write range(stop), range(start, stop) or range(start, stop, step)")
    numbers, unit = _numbers(arguments)
    start, stop = (Fraction(0), numbers[0]) if len(numbers) == 1 else (numbers[0], numbers[1])
    step = numbers[2] if len(numbers) == 3 else Fraction(1)
    if step == 0:
        raise ValueError("the step of a range must not be 0")
    count = _count(math.ceil((stop - start) / step))
    return [_written(start + i * step, unit) for i in range(count)]


def _linspace(arguments: list[str]) -> list[str]:
    (start, stop), unit, count = _ends(arguments, "linspace(450 nm, 650 nm, 5)")
    step = (stop - start) / max(count - 1, 1)
    return [_written(start + i * step, unit) for i in range(count)]


def _logspace(arguments: list[str]) -> list[str]:
    (start, stop), unit, count = _ends(arguments, "logspace(1e2, 1e6, 5)")
    if start <= 0 or stop <= 0:
        raise ValueError("the first and the last value of a logarithmic range must be positive")
    with localcontext(prec=50):
        low, high = (Decimal(x.numerator) / Decimal(x.denominator) for x in (start, stop))
        step = (high / low).ln() / max(count - 1, 1)
        inner = [Fraction(low * (step * i).exp()) for i in range(count)]
    ends = [start, *inner[1:-1], stop][:count]
    return [_written(x, unit) for x in ends]


_FUNCTIONS = {"range": _range, "linspace": _linspace, "logspace": _logspace}


def _ends(arguments: list[str], example: str) -> tuple[list[Fraction], str, int]:
    """Return the first and the last value of a range, their common unit, and the number of values."""
    if len(arguments) != 3:
        raise ValueError(f"write the first value, the last value and the number of values: {example}")
    numbers, unit = _numbers(arguments[:2])
    if not re.fullmatch(r"\+?\d{1,9}", arguments[2]):
        raise ValueError(f"the number of values must be a whole number of at least 1, not {arguments[2] or 'nothing'}")
    return numbers, unit, _count(int(arguments[2]))


def _count(count: int) -> int:
    if count < 1:
        raise ValueError("the range is empty: change its first value, its last value or the number of values")
    if count > MOST:
        raise ValueError(f"the range has {count if count < _EXACT else 'too many'} values: an axis has at most {MOST}")
    return count


def _numbers(texts: list[str]) -> tuple[list[Fraction], str]:
    """Return the numbers in ``texts`` as exact fractions, and their common unit."""
    matches = [_NUMBER.fullmatch(text) for text in texts]
    for text, match in zip(texts, matches, strict=True):
        if match is None or not math.isfinite(float(match[1])):
            raise ValueError(f"{text or 'nothing'} is not a number")
    units = [(match[2] or "").strip() for match in matches if match]
    if len(set(units)) > 1:
        several = ", ".join(unit or "none" for unit in dict.fromkeys(units))
        raise ValueError(f"write all numbers in the same unit instead of {several}")
    return [Fraction(repr(float(match[1]))) for match in matches if match], units[0]


def _written(number: Fraction, unit: str) -> str:
    value = float(number)
    whole = value.is_integer() and abs(value) < _EXACT
    return f"{int(value) if whole else value!r} {unit}".strip()
