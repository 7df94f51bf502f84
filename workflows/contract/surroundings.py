"""The surroundings on which a result must not depend, and a process with other surroundings."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Pipe
from pathlib import Path
from typing import TYPE_CHECKING

from neusee.workflows.observation.environment_variables import OF_LANGUAGES, OF_THREADS, is_known

if TYPE_CHECKING:
    from neusee.workflows.contract.elsewhere_rule import Asked
    from neusee.workflows.contract.node_rules import Outcome


# --- surroundings ---------------------------------------------------------------------------------

# The surroundings of a call on which a result must not depend, and how a new process gets others.
#
# Nothing here imports torch: a process gets other surroundings before it imports torch.


@dataclass(frozen=True, slots=True)
class Surrounding:
    """One property of the surroundings of a call that can be changed."""

    name: str
    differs: str  #: where the result differs, such as "in another time zone"
    fix: str  #: advice to the author of the code


FOLDER = Surrounding(
    "folder",
    "in another working folder",
    'take the file as a parameter of type DataFile, or write depends=["table.csv"] for a file'
    " beside the module",
)
LOCALE = Surrounding(
    "locale",
    "in the locale {locale}",
    'write encoding="utf-8" where a text is opened, and format and sort without the module locale',
)
HASH = Surrounding(
    "hash seed",
    "with another hash seed (PYTHONHASHSEED)",
    "write sorted(...) around a set whose order counts, and hashlib in place of hash()",
)
THREADS = Surrounding(
    "threads",
    "with {threads} in place of {threads_here}",
    "compute the same for any number of threads, and sum in float64",
)
ZONE = Surrounding(
    "time zone",
    "in another time zone (TZ)",
    "compute in UTC: calendar.timegm and time.gmtime, or datetime with tzinfo=timezone.utc",
)
RANDOM = Surrounding(
    "random states",
    "with other states of the generators of torch, numpy and random",
    "draw from the argument rng, or from a generator that the node makes with a seed",
)
WORK = Surrounding(
    "order of work",
    "after other work in the process",
    "keep nothing in the module from one call to the next, and set in the node what a library"
    " remembers",
)
ERRORS = Surrounding(
    "np.seterr",
    "after another np.seterr",
    'compute within `with np.errstate(all="ignore"):`, or "raise", whichever the node means',
)
HOME = Surrounding(
    "HOME",
    "with another HOME",
    'take the file as a parameter of type DataFile, or write depends=["env:HOME"]',
)
VARIABLES = Surrounding(
    "environment variables",
    "without the {names} of the environment",
    'make the value a parameter, or write depends=["env:NAME"]',
)
MEMORY = Surrounding(
    "unset memory",
    "where new memory has other bits",
    "fill all that torch.empty or np.empty gives, or write zeros",
)
#: surroundings that only a new process of Python can change; a forked process changes the others,
#: before it imports code of the user
OF_NEW_PROCESSES = frozenset({LOCALE, HASH, THREADS, MEMORY})
ALL = (FOLDER, LOCALE, HASH, THREADS, ZONE, RANDOM, WORK, ERRORS, HOME, VARIABLES, MEMORY)

ZONE_ELSEWHERE = "NSC-13:45"  #: a zone that needs no table: 13 h 45 min ahead of UTC
#: languages with a decimal comma; Turkish first, whose i is another letter
_LANGUAGES = (
    "tr_",
    "de_",
    "fr_",
    "es_",
    "it_",
    "nl_",
    "pt_",
    "pl_",
    "sv_",
    "da_",
    "fi_",
    "nb_",
    "cs_",
    "ru_",
    "uk_",
)


@dataclass(frozen=True, slots=True)
class Settings:
    """Changes that a forked process makes before the calls."""

    folder: str  #: the working folder; empty if it stays
    variables: dict[str, str | None]  #: of the environment; None for one that is left out
    threads: int  #: of torch; 0 if they stay
    has_locale: bool  #: whether the locale of the environment is set, as by a program with a window
    has_other_states: bool
    has_other_work: bool
    has_other_errors: bool


@dataclass(frozen=True, slots=True)
class OtherSurroundings:
    """Surroundings of another process, in place of those of this one."""

    hash_seed: int
    threads: int
    threads_here: int
    locale: str  #: empty if no other is installed
    variables: tuple[str, ...]  #: that are left out

    def changed(self) -> tuple[Surrounding, ...]:
        """Return the surroundings that can be changed on this machine."""
        return tuple(surrounding for surrounding in ALL if self._can_change(surrounding))

    def differs(self, surrounding: Surrounding, variables: Sequence[str] = ()) -> str:
        """Return in which surroundings a result differs, as text; environment ``variables`` are
        named if they are the cause.
        """
        names = "variables"
        if variables:
            names = f"variable{'s' * (len(variables) > 1)} {', '.join(variables)}"
        return surrounding.differs.format(
            locale=self.locale,
            threads=self.in_threads(),
            threads_here=self.threads_here,
            names=names,
        )

    def in_threads(self) -> str:
        """Return the number of threads in words."""
        return f"{self.threads} thread{'s' * (self.threads > 1)}"

    def described(self, without_threads: bool = False) -> str:
        """Return the changed surroundings, and a note if the locale is not changed, as one text."""
        words = {
            LOCALE: f"locale ({self.locale})",
            THREADS: self.in_threads(),
            VARIABLES: (
                f"{len(self.variables)} environment variable{'s' * (len(self.variables) != 1)}"
                " left out"
            ),
        }
        changed = [
            surrounding
            for surrounding in self.changed()
            if not (without_threads and surrounding is THREADS)
        ]
        text = ", ".join(words.get(surrounding, surrounding.name) for surrounding in changed)
        return text if self.locale else f"{text}; locale not changed: no other is installed"

    def environment(
        self, changes: frozenset[Surrounding], environ: Mapping[str, str]
    ) -> dict[str, str]:
        """Return the environment variables of a new process of Python, with those of ``changes``
        that need a new process.
        """
        hash_seed = self.hash_seed + 1 if HASH in changes else self.hash_seed
        variables = {**environ, "PYTHONHASHSEED": str(hash_seed)}
        # folder of compiled programs
        variables.setdefault("XDG_CACHE_HOME", os.path.join(os.path.expanduser("~"), ".cache"))
        if LOCALE in changes:
            variables = {
                name: value for name, value in variables.items() if name not in OF_LANGUAGES
            }
            variables |= {"LC_ALL": self.locale, "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
        if THREADS in changes:
            variables |= dict.fromkeys(OF_THREADS, str(self.threads))
        if MEMORY in changes:
            variables["MALLOC_PERTURB_"] = "165"  # the C library fills allocated and freed memory
        return variables

    def settings(
        self, changes: frozenset[Surrounding], folder: Path, declared: Mapping[str, str]
    ) -> Settings:
        """Return the changes that a forked process makes; ``folder`` is an empty folder, and
        environment variables in ``declared`` are kept.
        """
        variables = dict[str, str | None]()
        if VARIABLES in changes:
            # None: left out
            variables |= dict.fromkeys(name for name in self.variables if name not in declared)
        if ZONE in changes:
            variables["TZ"] = ZONE_ELSEWHERE
        if HOME in changes:
            variables |= {
                "HOME": str(folder),
                **dict.fromkeys(("USER", "LOGNAME", "USERNAME"), "somebody"),
            }
        working_folder = str(folder) if FOLDER in changes else ""
        threads = self.threads if THREADS in changes else 0
        return Settings(
            folder=working_folder,
            variables={name: value for name, value in variables.items() if name not in declared},
            threads=threads,
            has_locale=LOCALE in changes,
            has_other_states=RANDOM in changes,
            has_other_work=WORK in changes,
            has_other_errors=ERRORS in changes,
        )

    def _can_change(self, surrounding: Surrounding) -> bool:
        """Return True if a surrounding can be changed: another locale must be installed, and this
        process must have variables to leave out.
        """
        if surrounding is LOCALE:
            return bool(self.locale)
        return surrounding is not VARIABLES or bool(self.variables)


def other_surroundings(environ: Mapping[str, str]) -> OtherSurroundings:
    """Return other surroundings than those of a process with the environment ``environ``."""
    seed_text = environ.get("PYTHONHASHSEED", "")
    threads = environ.get("OMP_NUM_THREADS", "")
    threads_here = int(threads) if threads.isdecimal() else _processors()
    hash_seed = int(seed_text) if seed_text.isdecimal() else 0
    # fewer, or more than the one of a single processor
    other_threads = 3 if threads_here == 1 else 1
    locale_here = next(
        (environ[name] for name in ("LC_ALL", "LC_CTYPE", "LANG") if environ.get(name)), "C"
    )
    return OtherSurroundings(
        hash_seed=hash_seed,
        threads=other_threads,
        threads_here=threads_here,
        locale=other_locale(locale_here, installed_locales(environ), environ),
        variables=tuple(sorted(name for name in environ if not is_known(name))),
    )


def installed_locales(environ: Mapping[str, str]) -> list[str]:
    """Return the names of the locales of this machine; none if they cannot be listed."""
    try:
        finished = subprocess.run(
            ["locale", "-a"], capture_output=True, text=True, check=False, errors="replace"
        )
        names = finished.stdout.split()
    except OSError:
        names = []
    own_folders = [Path(folder) for folder in environ.get("LOCPATH", "").split(":") if folder]
    for folder in own_folders:
        if folder.is_dir():
            names += sorted(path.name for path in folder.iterdir())
    return names


def other_locale(now: str, names: Iterable[str], environ: Mapping[str, str]) -> str:
    """Return a locale that is not ``now``, if possible one with a decimal comma and another
    encoding than UTF-8.

    The locale C, in which a text is ASCII, is the last choice. No text if there is no other.
    """

    def rank(name: str) -> tuple[int, bool, str]:
        language_rank = next(
            (number for number, prefix in enumerate(_LANGUAGES) if name.startswith(prefix)),
            len(_LANGUAGES),
        )
        # False before True: another encoding than UTF-8 first
        return language_rank, _is_utf8(name), name

    plain_locales = ("C", "POSIX")
    candidates = sorted(
        (n for n in names if n.split(".")[0] not in plain_locales and _same(n) != _same(now)),
        key=rank,
    )
    if candidates:
        return candidates[0]
    # texts are ASCII here already, so that C is no other locale
    is_ascii = (
        now in plain_locales
        and environ.get("PYTHONUTF8") == "0"
        and environ.get("PYTHONCOERCECLOCALE") == "0"
    )
    return "C" if "C" in names and not is_ascii else ""


def _processors() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _same(name: str) -> str:
    """Return the name of a locale in small letters and without hyphens, so that its spellings are
    equal.
    """
    return name.lower().replace("-", "")


def _is_utf8(name: str) -> bool:
    """Return True for a locale whose texts are UTF-8."""
    return "utf8" in _same(name)


# --- elsewhere client -----------------------------------------------------------------------------

# A process with other surroundings, seen from the process that asks it for outcomes.


LONGEST_CALL = 300.0  #: s of one call
_SCRIPT = """
import sys
sys.path[:] = sys.argv[2:]
from neusee.workflows.contract.elsewhere_rule import serve
pipe, sys.argv[1:] = int(sys.argv[1]), []
serve(pipe)
"""


class NotStartedError(RuntimeError):
    """Error for a process that ends before the first request."""


class Elsewhere:
    """A process with some of the other surroundings; it imports torch while the caller does
    other things.
    """

    def __init__(self, others: OtherSurroundings, changes: frozenset[Surrounding]) -> None:
        # the changes that need a new process; forked processes make the others
        self.others, self._process_changes = others, changes & OF_NEW_PROCESSES
        self.folder = tempfile.TemporaryDirectory(prefix="neusee-check-")
        try:
            self._start()
        except OSError as error:
            self.folder.cleanup()
            raise NotStartedError(f"a process of Python does not start: {error}") from None

    def outcomes(self, asked: Asked) -> list[Outcome]:
        """Return the outcome of each call, made in a forked process; raise `NotStartedError` if the
        process has ended.

        After a call that ends its forked process, or that does not return, the other calls are made
        in another one.
        """
        outcomes: list[Outcome] = []
        while len(outcomes) < len(asked.calls):
            outcomes += self._up_to_an_end(replace(asked, calls=asked.calls[len(outcomes) :]))
        return outcomes

    def close(self) -> None:
        """End the process and remove its folder."""
        self._end()
        self.folder.cleanup()

    def _start(self) -> None:
        """Start the process in a group of its own, so that its forked processes end with it."""
        self._pipe, other_end = Pipe()
        self._is_ready = False
        search_path = [os.path.abspath(entry) for entry in sys.path]
        no_stream = subprocess.DEVNULL
        with other_end:
            self._process = subprocess.Popen(
                [
                    sys.executable,
                    # -P: the working folder is no place of modules; -O as in this process
                    "-P",
                    *["-O"] * sys.flags.optimize,
                    "-c",
                    _SCRIPT,
                    str(other_end.fileno()),
                    *search_path,
                ],
                stdin=no_stream,
                stdout=no_stream,
                stderr=no_stream,
                env=self.others.environment(self._process_changes, os.environ),
                pass_fds=[other_end.fileno()],
                process_group=0,
            )

    def _end(self) -> None:
        """End the process and its forked processes, if they still run."""
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._pipe.close()

    def _up_to_an_end(self, asked: Asked) -> list[Outcome]:
        """Return the outcomes of the calls up to the first that ends its process or does not
        return.
        """
        try:
            if not self._is_ready:
                # the message with which the process says that its imports are done
                self._pipe.recv_bytes()
                self._is_ready = True
            self._pipe.send_bytes(pickle.dumps(asked))  # `send` would share the memory of a tensor
            return self._received(asked)
        except (EOFError, OSError):
            code = self._process.wait()
            raise NotStartedError(f"a process of Python ended, {_words(code)}") from None

    def _received(self, asked: Asked) -> list[Outcome]:
        """Return the outcomes that arrive, and one for a call that ends its process or takes too
        long.
        """
        outcomes: list[Outcome] = []
        while True:
            if not self._pipe.poll(LONGEST_CALL):
                self._end()
                self._start()
                return [*outcomes, _ended(f"does not end within {LONGEST_CALL:.0f} s")]
            answer = pickle.loads(self._pipe.recv_bytes())
            # the exit code: no more outcomes come from this fork
            if isinstance(answer, int):
                has_all = len(outcomes) == len(asked.calls)
                return (
                    outcomes
                    if has_all
                    else [*outcomes, _ended(f"ends the process, {_words(answer)}")]
                )
            outcomes.append(answer)


@contextmanager
def elsewhere(early: bool = True) -> Iterator[Callable[[], Elsewhere]]:
    """Yield a function that returns a process in which all surroundings are changed; end the
    process afterwards.

    The process starts with the ``with`` block if ``early``, so that it imports torch beside this
    process.
    """
    processes = list[Elsewhere]()

    def process() -> Elsewhere:
        if not processes:
            others = other_surroundings(os.environ)
            processes.append(Elsewhere(others, frozenset(others.changed())))
        return processes[0]

    try:
        if early:
            with suppress(NotStartedError):  # reported where the process is needed
                process()
        yield process
    finally:
        for begun_process in processes:
            begun_process.close()


def _ended(failure: str) -> Outcome:
    """Return the outcome of a call without a result."""
    from neusee.workflows.contract.node_rules import Outcome

    return Outcome(failure=failure, is_end=True)


def _words(code: int) -> str:
    """Return an exit code of a process in words."""
    return f"with {signal.Signals(-code).name}" if code < 0 else f"with exit code {code}"
