"""File of a stored answer in the folder answers/ of the cache, its check and its removal."""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple

from neusee.workflows.answers.witnesses import NOTHING, StoredResults, Witnesses, checked
from neusee.workflows.keys.sealed_files import NotRead, seal_file, unseal_file
from neusee.workflows.store.shared_folder import Disk, below, read_file

# --- stored answer --------------------------------------------------------------------------------

# File of a stored answer in the folder ``answers/`` of the cache: sealed as every file there, and
# never half written.
#
# The first line is the seal, which names the answer; the second line is a JSON object; then follow
# the files of the folder of results. An answer that is damaged, of another format or without the
# signature that is asked for is missing.


FOLDER, SUFFIX = "answers", ".answer"
#: kinds of answers: with the files of a folder, and with what a run shows
AS_KEPT, RUN = "as kept", "run"
MOST = 32 << 20  #: bytes of the largest answer that is kept
_LABEL = re.compile(r"\w[\w.-]*")
_FILE = re.compile(r"\w[\w.-]*(/\w[\w.-]*)*")


@dataclass(frozen=True)
class Answer:
    """What a command printed and wrote, and what must be as it was for the answer to be right."""

    state: str  #: digest of the installed program
    witnesses: Witnesses
    text: str  #: of the terminal, with a mark in place of the path of the page
    as_json: bool  #: whether the text is JSON
    out: str  #: folder in which the command makes its folder of results
    label: str  #: recipe and kind in the name of this folder
    #: of the result, in the name of this folder; empty for a command that writes no folder
    key: str
    files: Mapping[str, bytes]  #: of this folder by name, with marks in place of date and seconds
    stored: StoredResults = NOTHING  #: what of the cache the answer rests on
    kind: str = AS_KEPT  #: how the folder is written again
    memory: int = 0  #: bytes that must be free


def answer_path(disk: Disk, name: str) -> str:
    """Return the path of the answer ``name``."""
    return f"{disk.folder}/{FOLDER}/{name[:2]}/{name}{SUFFIX}"


def read_answer(disk: Disk, name: str) -> Answer | None:
    """Return the answer ``name``, or None if it is missing, damaged, of another format or not
    signed.
    """
    path = answer_path(disk, name)
    try:
        return unpacked(name, read_file(path, MOST))
    except NotRead:
        return None
    except OSError:
        return None
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        disk.put_aside(path)
        return None


def write_answer(disk: Disk, name: str, answer: Answer) -> bool:
    """Write the answer ``name`` under a temporary name and rename it; return False for one that is
    too large.

    Raises `OSError` if the folder cannot be written.
    """
    content, path = packed(name, answer), answer_path(disk, name)
    if len(content) > MOST:
        return False
    with disk.temporary(f"{name[:8]}{SUFFIX}") as (temporary, file):
        file.write(content)
        file.flush()
        disk.make_folder(f"{disk.folder}/{FOLDER}")
        disk.share(temporary)
        disk.rename(temporary, path)
    return True


def used(disk: Disk, name: str) -> None:
    """Note that an answer was used, so that it stays longer than others."""
    with suppress(OSError):
        os.utime(answer_path(disk, name), follow_symlinks=False)


def packed(name: str, answer: Answer) -> bytes:
    """Return the content of the file of an answer."""
    fields = {
        key: value
        for key, value in vars(answer).items()
        if key not in ("files", "witnesses", "stored")
    }
    sizes = [[file, len(content)] for file, content in answer.files.items()]
    foundations = {"witnesses": answer.witnesses._asdict(), "stored": answer.stored._asdict()}
    head_line = json.dumps({**fields, **foundations, "files": sizes}).encode()
    content = b"".join([head_line, b"\n", *answer.files.values()])
    return seal_file("answer", f"{FOLDER}/{name}", content) + b"\n" + content


def unpacked(name: str, raw: bytes) -> Answer:
    """Return the answer in the content of a file.

    Raises `NotRead` for another format version or a missing signature, and `ValueError`,
    `TypeError`, `KeyError` or `AttributeError` for any other content.
    """
    seal, _, content = raw.partition(b"\n")
    head_line, _, file_bytes = unseal_file("answer", f"{FOLDER}/{name}", seal, content).partition(
        b"\n"
    )
    fields: dict[str, Any] = json.loads(head_line)
    files, offset = {}, 0
    for file, size in fields.pop("files"):
        # abs: a wrong answer must not read backwards
        files[_checked(_FILE, file)] = file_bytes[offset : offset + abs(size)]
        offset += abs(size)
    if offset != len(file_bytes):
        raise ValueError("the files of the answer are not as long as it says")
    witnesses = Witnesses(**fields.pop("witnesses"))
    stored = checked(fields.pop("stored"))
    for file in stored.taken:
        _checked(_FILE, file)
    answer = Answer(**fields, witnesses=witnesses, files=files, stored=stored)
    if answer.key or answer.label:
        _checked(_LABEL, answer.label)
        _checked(_LABEL, answer.key)
    _refuse_other_types(answer)
    return answer


def _refuse_other_types(answer: Answer) -> None:
    """Raise ValueError if a field of an answer is not of its type."""
    files, absent_paths, recipes, listed_folders = answer.witnesses
    texts = [answer.state, answer.text, answer.out, answer.label, answer.key, answer.kind]
    for mapping in (files, recipes, listed_folders):
        texts += [*mapping, *mapping.values()]
    if type(answer.memory) is not int:
        raise ValueError("a field of the answer is not of its type")
    if not isinstance(absent_paths, list) or not all(
        isinstance(text, str) for text in [*texts, *absent_paths]
    ):
        raise ValueError("a field of the answer is not of its type")


def _checked(form: re.Pattern[str], text: str) -> str:
    """Return a text that has a form; raise `ValueError` for any other text."""
    if not form.fullmatch(text):
        raise ValueError(f"{text!r} is no name of a file in a folder of results")
    return text


# --- answer upkeep --------------------------------------------------------------------------------

# Number and size of the stored answers, the check of all of them, and the removal of old ones.


COUNT, BYTES = 200, 64 << 20  #: of answers that stay when a new one is written
_WEEK = 7 * 86400.0  #: s without use after which `neusee cache gc` removes an answer


class Kept(NamedTuple):
    """A stored answer: its name, its bytes and when it was last used (s)."""

    name: str
    path: str
    size: int
    used: float


def answers(disk: Disk) -> list[Kept]:
    """Return all stored answers, the one that was used last first."""
    return sorted(_found(disk), key=lambda answer: (-answer.used, answer.name))


def _found(disk: Disk) -> Iterator[Kept]:
    """Yield the stored answers, in no order."""
    for entry in below(f"{disk.folder}/{FOLDER}"):
        with suppress(OSError):
            file_status = entry.stat(follow_symlinks=False)
            yield Kept(
                entry.name.removesuffix(SUFFIX),
                entry.path,
                file_status.st_size,
                file_status.st_mtime,
            )


def make_room(disk: Disk, budget: int | None = None) -> None:
    """Remove the answers that were not used for longest, until at most `COUNT` of them and `BYTES`
    are left.

    With a ``budget`` of the store in bytes, at most a twentieth of it is left.
    """
    total_bytes, limit = 0, BYTES if budget is None else min(BYTES, budget // 20)
    for number, answer in enumerate(answers(disk)):
        total_bytes += answer.size
        if number >= COUNT or total_bytes > limit:
            _remove(disk, answer)


def sweep(disk: Disk, dry: bool = False, everything: bool = False) -> list[Kept]:
    """Remove the answers that nobody used for a week, or ``everything``, or only list them if
    ``dry``; return them.
    """
    old_answers = [
        answer for answer in answers(disk) if everything or time.time() - answer.used > _WEEK
    ]
    return old_answers if dry else [answer for answer in old_answers if _remove(disk, answer)]


def check(disk: Disk) -> tuple[list[Kept], list[Kept]]:
    """Return the answers that are as written, and those that are not, which are moved to the
    folder ``bad/``.
    """
    undamaged, damaged = [], []
    for answer in answers(disk):
        is_readable = read_answer(disk, answer.name) is not None
        # one of another format or without a signature stays where it is
        if is_readable or os.path.lexists(answer.path):
            undamaged.append(answer)
        else:
            damaged.append(answer)
    return undamaged, damaged


def _remove(disk: Disk, answer: Kept) -> bool:
    """Remove an answer; return False if it cannot be removed."""
    try:
        disk.unlink(answer.path)
    except OSError:
        return False
    return True
