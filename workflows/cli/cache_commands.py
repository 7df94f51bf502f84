"""The commands of ``neusee cache``: ls, verify, gc, pin, unpin and why, and the lines that they
print.
"""

from __future__ import annotations

import itertools
import os
from typing import TYPE_CHECKING, Annotated, Any

import typer

from neusee.workflows.answers import stored_answer
from neusee.workflows.cli import lazy_imports as lazy
from neusee.workflows.cli.command_frame import failing, say, the_store
from neusee.workflows.cli.commands_and_exit_codes import MISSED
from neusee.workflows.report.terminal_text import columns
from neusee.workflows.store.cache_settings import format_size, parse_size
from neusee.workflows.store.derived_files import DerivedFiles
from neusee.workflows.store.metadata import is_kept

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from neusee.workflows.store.result_store import Store

_PAGE = 50  #: results that `ls` shows
_HEAD = ("date", "bytes", "seconds", "step", "recipe", "key", "")

cache = typer.Typer(
    help="List, check, remove and keep stored results.", no_args_is_help=True, rich_markup_mode=None
)

Key = Annotated[
    str, typer.Argument(metavar="KEY", help="The first digits of a key, as `cache ls` shows them.")
]


@cache.command("ls")
def ls(
    every: Annotated[
        bool, typer.Option("--all", help="List every stored result, the newest last.")
    ] = False,
) -> None:
    """List the newest stored results.

    For each result: when it was computed, its bytes and seconds, its step and the recipe that first
    needed it.
    """
    for line in ls_lines(the_store(), every):
        print(line)


@cache.command("verify")
def verify() -> None:
    """Verify the checksum of every stored result.

    The exit code is 3 if a result is damaged.
    """
    lines, damaged = verify_lines(the_store())
    say(lines)
    if damaged:
        raise typer.Exit(MISSED)


@cache.command("gc")
def gc(
    budget: Annotated[
        str, typer.Option("--budget", help="Largest size of the cache, such as 20 GB.")
    ] = "",
    dry: Annotated[
        bool, typer.Option("--dry-run", help="Say what would be removed, and remove nothing.")
    ] = False,
) -> None:
    """Remove files that belong to no stored result, and results beyond a budget.

    Beyond the budget, the results that save the fewest seconds for each byte are removed first.
    Pinned results stay.
    """
    with failing(ValueError, before="--budget: "):
        say(gc_lines(the_store(), budget or None, dry))


@cache.command("pin")
def pin(key: Key) -> None:
    """Keep a stored result even if the cache exceeds its budget."""
    with failing(ValueError):
        say(pin_lines(the_store(), key))


@cache.command("unpin")
def unpin(key: Key) -> None:
    """Unpin a stored result, so that `cache gc` may remove the result."""
    with failing(ValueError):
        say(pin_lines(the_store(), key, pin=False))


@cache.command("why")
def why(key: Key) -> None:
    """Print the origin of a stored result.

    Also print the differences from the nearest earlier result.
    """
    with failing(LookupError):
        say(lazy.stored_origin.why_key_lines(the_store(), key))


# --- what the commands print ----------------------------------------------------------------------


def ls_lines(store: Store, every: bool = False) -> Iterator[str]:
    """Yield a line for each cached result with its date, bytes, seconds, step, recipe and key, the
    newest last.

    Without ``every``, these are the newest 50. For a long journal, the number and bytes of the
    results are taken from the journal, so that the time does not grow with each result. Only one
    short text for each result is held in memory.
    """
    pins = store.pinned()
    if every or not store.journal.is_long():
        rows, values, size = _every_row(store, pins)
        receipts, origin_of_totals = len(rows) - values, ""
    else:
        rows = _newest_rows(store, pins)
        values, size, receipts = store.journal.totals()
        origin_of_totals = " by the journal"
    shown_rows = rows if every else rows[-_PAGE:]
    yield from _aligned(shown_rows)
    if values + receipts > len(shown_rows):
        yield f"the newest {len(shown_rows)}; `neusee cache ls --all` lists all"
    last_line = (
        f"{_count(values, 'result')}, {format_size(size)}{origin_of_totals}, in {store.root}"
    )
    if receipts:
        last_line += f"; of {_count(receipts, 'more result')} the receipt alone"
    last_line += _answers_text(stored_answer.answers(store.disk))
    if store.budget is not None:
        last_line += f"; the budget is {format_size(store.budget)}"
    yield last_line


def _every_row(store: Store, pins: set[str]) -> tuple[list[str], int, int]:
    """Return the row of each result in order of time, the number of stored values and their
    bytes.
    """
    rows, values, size = list[str](), 0, 0
    for key, metadata in store.entries():
        # one text a row, because many results must fit into memory
        rows.append("\0".join(_row(key, metadata, key in pins)))
        if is_kept(metadata):
            values, size = values + 1, size + _size(metadata)
    return sorted(rows, key=_row_date), values, size


def _newest_rows(store: Store, pins: set[str]) -> list[str]:
    """Return the rows of the newest results of the journal that still have metadata, in order of
    time.
    """
    newest_keys = dict.fromkeys(row["key"] for row in reversed(store.journal.latest()))
    entries = ((key, store.about(key)) for key in newest_keys)
    newest_entries = itertools.islice(
        ((key, metadata) for key, metadata in entries if metadata is not None), _PAGE
    )
    return sorted(
        ("\0".join(_row(key, metadata, key in pins)) for key, metadata in newest_entries),
        key=_row_date,
    )


def _row_date(row: str) -> str:
    """Return the date of a row, which is its first cell; dates as text sort by time."""
    return row[: row.index("\0")]


def _aligned(rows: Sequence[str]) -> Iterator[str]:
    """Yield the head of the table and its rows in columns, or nothing without a row."""
    widths = [*map(len, _HEAD)]
    for row in rows:
        widths = [*map(max, widths, map(len, row.split("\0")))]
    for line in ("\0".join(_HEAD), *rows) if rows else ():
        yield "  ".join(
            f"{cell:<{width}}" for cell, width in zip(line.split("\0"), widths, strict=True)
        ).rstrip()


def verify_lines(store: Store) -> tuple[list[str], int]:
    """Read every result in the cache; return a line for each damaged result, and the number of
    damaged results.
    """
    files = DerivedFiles(store)
    sizes, damaged_lines = list[int](), list[str]()
    for entry in store.check():
        metadata = entry.about or {}
        problem = entry.problem or _picture_problem(files, entry.key, metadata)
        if problem:
            damaged_lines.append(f"{entry.key}  {metadata.get('step') or '?'}  {problem}")
        elif is_kept(metadata):
            sizes.append(_size(metadata))
    answers, broken_answers = stored_answer.check(store.disk)
    damaged_lines += [
        f"{answer.name}  the answer of a command, which is not what was written"
        for answer in broken_answers
    ]
    last_line = (
        f"{_count(len(sizes), 'result')}, {format_size(sum(sizes))}{_answers_text(answers)}, as"
        " written"
    )
    if damaged_lines:
        last_line += (
            f"; {len(damaged_lines)} damaged, put aside in {store.root / 'bad'}: the next run"
            " computes those it needs"
        )
    return [*damaged_lines, last_line], len(damaged_lines)


def gc_lines(store: Store, budget: str | None = None, dry: bool = False) -> list[str]:
    """Remove files that belong to no cached result, and cached values beyond ``budget``; return the
    lines to print.

    Raises `ValueError` for a budget that is not a size.
    """
    limit = None if budget is None else parse_size(budget)
    swept = store.gc(limit, dry)
    is_full = limit is not None and _is_beyond(store, swept.left, limit)
    # stored answers are removed too if removing values alone does not reach the budget
    old_answers = stored_answer.sweep(store.disk, dry, everything=is_full)
    # the metadata of the removed values
    removed_metadata = ((key, store.about(key)) for key in swept.evicted)
    # bytes, seconds and step of the removed value, and the first digits of its key
    rows = [
        [*_row(key, metadata, False)[1:4], key[:8]]
        for key, metadata in removed_metadata
        if metadata is not None
    ]
    removed_text = (
        f"{_count(len(swept.evicted), 'value')} and {_count(swept.orphans, 'file')} that belonged"
        " to no result"
    )
    freed_text, left_text = format_size(swept.freed), format_size(swept.left)
    verb = "would go" if dry else "went"
    last_line = f"{removed_text} {verb}: {freed_text}; {left_text} stay in {store.root}"
    lines = list(columns(rows)) if rows else []
    if swept.refused:
        lines.append(f"{_count(len(swept.refused), 'value')} of other users could not be removed")
    if old_answers:
        lines.append(f"{_answers_text(old_answers)[2:]} {verb}")
    return [*lines, last_line]


def _is_beyond(store: Store, left: int, budget: int) -> bool:
    """Return True if the values that are left and the stored answers need more than a budget."""
    return left + sum(map(_bytes, stored_answer.answers(store.disk))) > budget


def pin_lines(store: Store, prefix: str, pin: bool = True) -> list[str]:
    """Pin or unpin the cached value whose key begins with ``prefix``; raise `ValueError` for no
    or several matches.
    """
    if pin:
        keys = {key for key, metadata in store.entries() if is_kept(metadata)}
        key = _only_key(keys, prefix, "value")
        store.pin(key)
    else:
        key = _only_key(store.pinned(), prefix, "pinned value")
        store.unpin(key)
    step = (store.about(key) or {}).get("step") or "a value that is not here"
    return [f"{'pinned' if pin else 'no longer pinned'}: {key}  {step}"]


def _only_key(keys: Iterable[str], prefix: str, noun: str) -> str:
    """Return the key that begins with ``prefix``; raise `ValueError` for no or several matches."""
    matching_keys = sorted(key for key in keys if key.startswith(prefix.lower()))
    if len(matching_keys) == 1:
        return matching_keys[0]
    matches = (
        f"it matches {', '.join(key[:12] for key in matching_keys[:5])}"
        if matching_keys
        else "it matches no key"
    )
    raise ValueError(
        f"{prefix!r} must be the start of the key of one {noun}: {matches} (`neusee cache ls` lists"
        " keys)"
    )


def _picture_problem(files: DerivedFiles, key: str, about: dict[str, Any]) -> str:
    """Check the file of a stored picture; if the file is damaged, move the file away and return
    the problem as text.
    """
    name = about.get("file")
    if (
        not name
        or not is_kept(about)
        or files.find(key, os.path.basename(name)[len(key) :]) is not None
    ):
        return ""
    problem = f"its file {name} is not what was written"
    files.store.put_aside(key, ValueError(problem))
    return problem


def _row(key: str, about: dict[str, Any], pinned: bool) -> list[str]:
    """Return the cells of a stored result in the order of `_HEAD`."""
    seconds_text = f"{about.get('seconds') or 0.0:.3f}"
    # to the second, without the time zone
    date = str(about.get("date") or "")[:19].replace("T", " ")
    mark = "" if is_kept(about) else "receipt"
    if pinned:
        mark = "pinned"
    return [
        date,
        format_size(_size(about)),
        seconds_text,
        about.get("step") or "",
        about.get("recipe") or "",
        key[:8],
        mark,
    ]


def _size(about: dict[str, Any]) -> int:
    """Return the size in bytes of a cached result, or of a stored picture."""
    size: int = about.get("file_bytes") or about.get("bytes") or 0
    return size


def _answers_text(answers: Sequence[stored_answer.Kept]) -> str:
    """Return how many stored answers there are and their bytes, after a comma, or an empty text
    without answers.
    """
    size = format_size(sum(map(_bytes, answers)))
    return f", {_count(len(answers), 'answer')} of commands of {size}" if answers else ""


def _bytes(answer: stored_answer.Kept) -> int:
    return answer.size


def _count(count: int, noun: str) -> str:
    return f"{count} {noun}{'s' * (count != 1)}"
