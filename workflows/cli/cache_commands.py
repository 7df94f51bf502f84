"""The commands of ``neusee cache``, and the lines that they print: ls, verify, gc, pin, unpin, why."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Annotated, Any

import typer

from neusee.workflows.cli.command_frame import MISSED, fail, say, the_store
from neusee.workflows.report.text_table import columns
from neusee.workflows.store.byte_sizes import format_size, parse_size

if TYPE_CHECKING:
    from neusee.workflows.store.derived_files import DerivedFiles
    from neusee.workflows.store.result_store import Store

cache = typer.Typer(help="List, check, remove and keep stored results.", no_args_is_help=True, rich_markup_mode=None)

Key = Annotated[str, typer.Argument(metavar="KEY", help="The first digits of a key, as `cache ls` shows them.")]


@cache.command("ls")
def ls() -> None:
    """List the stored results.

    For each result: when it was computed, its bytes and seconds, its step and the recipe that first needed it.
    """
    say(ls_lines(the_store()))


@cache.command("verify")
def verify() -> None:
    """Compare the checksum of every stored result.

    The exit code is 3 where a result is damaged.
    """
    lines, damaged = verify_lines(the_store())
    say(lines)
    if damaged:
        raise typer.Exit(MISSED)


@cache.command("gc")
def gc(
    budget: Annotated[str, typer.Option("--budget", help="Largest size of the cache, such as 20 GB.")] = "",
    dry: Annotated[bool, typer.Option("--dry-run", help="Say what would be removed, and remove nothing.")] = False,
) -> None:
    """Remove files that belong to no result, and results beyond a budget.

    Beyond the budget, the results that save the fewest seconds for their bytes go first. Pinned results stay.
    """
    try:
        say(gc_lines(the_store(), budget or None, dry))
    except ValueError as error:
        fail(f"--budget: {error}")


@cache.command("pin")
def pin(key: Key) -> None:
    """Keep a result whatever the budget is."""
    _pinned(key, True)


@cache.command("unpin")
def unpin(key: Key) -> None:
    """Allow a pinned result to be removed again."""
    _pinned(key, False)


@cache.command("why")
def why(key: Key) -> None:
    """Say what a result was computed from.

    Also says how that differs from the nearest earlier result.
    """
    from neusee.workflows.explain.why_rerun import why_key_lines

    try:
        say(why_key_lines(the_store(), key))
    except LookupError as error:
        fail(str(error.args[0]))


def _pinned(key: str, keep: bool) -> None:
    try:
        say(pin_lines(the_store(), key, keep))
    except ValueError as error:
        fail(str(error))


# --- what the commands print ------------------------------------------------------------------------------------------


def ls_lines(store: Store) -> list[str]:
    """Return a line for each result, the newest last: date, bytes, seconds, step, recipe, key, pinned or a receipt."""
    found = sorted(store.entries(), key=lambda entry: str(entry[1].get("date", "")))
    pins = store.pinned()
    rows = [_row(key, about, key in pins) for key, about in found]
    kept = [about for _, about in found if _is_kept(about)]
    last = f"{_count(len(kept), 'result')}, {format_size(sum(map(_size, kept)))}, in {store.root}"
    if len(kept) < len(found):
        last += f"; of {_count(len(found) - len(kept), 'more result')} the receipt alone"
    if store.budget is not None:
        last += f"; the budget is {format_size(store.budget)}"
    head = ["date", "bytes", "seconds", "step", "recipe", "key", ""]
    return [*(columns([head, *rows]) if rows else []), last]


def verify_lines(store: Store) -> tuple[list[str], int]:
    """Read every value and every picture; return a line for each damaged one, and their number."""
    count, size, bad = 0, 0, list[str]()
    from neusee.workflows.store.derived_files import DerivedFiles

    shelf = DerivedFiles(store)
    for found in store.check():
        about = found.about or {}
        problem = found.problem or _picture_problem(shelf, found.key, about)
        if problem:
            bad.append(f"{found.key}  {about.get('step') or '?'}  {problem}")
        elif _is_kept(about):
            count, size = count + 1, size + _size(about)
    last = f"{_count(count, 'result')}, {format_size(size)}, as written"
    if bad:
        last += f"; {len(bad)} damaged, put aside in {store.root / 'bad'}: a next run computes what it needs of them"
    return [*bad, last], len(bad)


def gc_lines(store: Store, budget: str | None = None, dry: bool = False) -> list[str]:
    """Remove files that belong to no result, and values beyond ``budget``; raise `ValueError` for a wrong budget."""
    abouts = dict(store.entries())
    swept = store.gc(None if budget is None else parse_size(budget), dry)
    rows = [[*_row(key, abouts[key], False)[1:4], key[:8]] for key in swept.evicted if key in abouts]
    went = f"{_count(len(swept.evicted), 'value')} and {_count(swept.orphans, 'file')} that belonged to no result"
    freed, left = format_size(swept.freed), format_size(swept.left)
    last = f"{went} {'would go' if dry else 'went'}: {freed}; {left} stay in {store.root}"
    refused = f"{_count(len(swept.refused), 'value')} of other users could not be removed"
    return [*(columns(rows) if rows else []), *([refused] if swept.refused else []), last]


def pin_lines(store: Store, prefix: str, pin: bool = True) -> list[str]:
    """Pin or unpin the value whose key begins with ``prefix``; raise `ValueError` where no key or several do."""
    key = _named(store, prefix, pin)
    if pin:
        store.pin(key)
    else:
        store.unpin(key)
    step = (store.about(key) or {}).get("step") or "a value that is not here"
    return [f"{'pinned' if pin else 'no longer pinned'}: {key}  {step}"]


def _named(store: Store, prefix: str, pin: bool) -> str:
    keys = store.pinned() if not pin else {key for key, about in store.entries() if _is_kept(about)}
    found = sorted(key for key in keys if key.startswith(prefix.lower()))
    if len(found) != 1:
        what = "value" if pin else "pinned value"
        few = f"these begin so: {', '.join(key[:12] for key in found[:5])}" if found else f"no {what} begins so"
        raise ValueError(f"{prefix!r} names no single {what}: {few} (`neusee cache ls` lists them)")
    return found[0]


def _picture_problem(shelf: DerivedFiles, key: str, about: dict[str, Any]) -> str:
    """Return what is wrong with the file of an entry, and put that file aside; return an empty text for a whole one."""
    name = about.get("file")
    if not name or not _is_kept(about) or shelf.find(key, os.path.basename(name)[len(key) :]) is not None:
        return ""
    problem = f"its file {name} is not what was written"
    shelf.store.put_aside(key, ValueError(problem))
    return problem


def _row(key: str, about: dict[str, Any], pinned: bool) -> list[str]:
    took, date = f"{about.get('seconds') or 0.0:.3f}", str(about.get("date") or "")[:19].replace("T", " ")
    mark = "pinned" if pinned else "" if _is_kept(about) else "receipt"
    return [date, format_size(_size(about)), took, about.get("step") or "", about.get("recipe") or "", key[:8], mark]


def _size(about: dict[str, Any]) -> int:
    """Return the bytes of a result, or of the file that it stands for."""
    size: int = about.get("file_bytes") or about.get("bytes") or 0
    return size


def _count(count: int, what: str) -> str:
    return f"{count} {what}{'s' * (count != 1)}"


def _is_kept(about: dict[str, Any]) -> bool:
    """Return True for an entry whose value is stored, and False for a receipt alone."""
    from neusee.workflows.store.metadata import is_kept

    return is_kept(about)
