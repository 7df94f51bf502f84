"""The options of the jobs that SLURM starts for a run, as the command line states them: ``queue=gpu``, ``cores=4``."""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

from neusee.workflows.graph.diagnostics import nearest
from neusee.workflows.store.byte_sizes import parse_size

_COMMANDS = ("sbatch", "scancel")
N = TypeVar("N", int, float)
_TIME = re.compile(r"(\d+-)?\d+(:\d+){0,2}")  #: of SLURM: minutes, hours:minutes:seconds, or days-hours:minutes:seconds


@dataclass(frozen=True)
class SlurmOptions:
    """What one job of SLURM asks for; a text that is empty leaves the default of the site."""

    queue: str = ""  #: partition
    account: str = ""
    cores: int = 0  #: processors of a job, and threads of its worker; 0: as many as this program computes with
    memory: str = "8 GB"  #: of a job; the worker is ended at 95 % of it
    walltime: str = ""  #: such as 02:00:00; without it half an hour
    wait: float = 5.0  #: minutes until the first job has to start
    interface: str = ""  #: network between scheduler and workers, such as ib0
    python: str = ""  #: program of the workers; without it the one that runs this program
    logs: str = "slurm_logs"  #: folder
    directive: tuple[str, ...] = ()  #: further lines of #SBATCH, such as --gres=gpu:1
    prologue: tuple[str, ...] = ()  #: commands before the worker, such as module load cuda

    @classmethod
    def read(cls, words: Sequence[str]) -> SlurmOptions:
        """Return the options in words such as ``queue=gpu``; raise ValueError for a word that is none."""
        found = cls()
        for word in words:
            name, sign, value = word.partition("=")
            known = {field.name: getattr(found, field.name) for field in fields(cls)}
            if not sign or name not in known:
                hint = nearest(name, known) or f"write one of {', '.join(known)}"
                raise ValueError(f"{word}: write NAME=VALUE, such as queue=gpu; {hint}")
            found = replace(found, **{name: _value(name, value, known[name])})
        return found


def missing_command() -> str:
    """Return the name of the first command of SLURM that this machine lacks, or an empty text."""
    return next((name for name in _COMMANDS if not shutil.which(name)), "")


def _value(name: str, text: str, before: Any) -> Any:
    """Return the value of an option; raise ValueError for one that SLURM cannot read."""
    if isinstance(before, tuple):
        return (*before, text)
    try:
        if name == "memory":
            parse_size(text)
        if isinstance(before, int):
            return _at_least_one(int(text))
        if isinstance(before, float):
            return _at_least_one(float(text.removesuffix("min").strip()) * 60) / 60
    except ValueError:
        raise ValueError(f"{name}={text}: must be {_KINDS[name]}") from None
    if name == "walltime" and not _TIME.fullmatch(text):
        raise ValueError(f"{name}={text}: must be a time of SLURM, such as 02:00:00")
    if "\n" in text or not text:
        raise ValueError(f"{name}={text!r}: must be one line of text")
    return text


_KINDS = {"memory": 'a size such as "16 GB"', "cores": "a whole number of at least 1", "wait": "minutes, such as 30"}


def _at_least_one(number: N) -> N:
    if not number >= 1:
        raise ValueError
    return number
