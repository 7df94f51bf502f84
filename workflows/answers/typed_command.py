"""Name of a stored answer: the digest of the command as typed and of the process in which it runs."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence

from neusee.workflows.keys.cache_key import digest

#: variables of a login or a terminal window that no program of this house reads; the working folder counts by itself,
#: and the secret of the cache by the signature of each answer
IGNORED = frozenset(
    {
        "NEUSEE_CACHE_SECRET",
        "OLDPWD",
        "PWD",
        "SHLVL",
        "SSH_AUTH_SOCK",
        "SSH_CLIENT",
        "SSH_CONNECTION",
        "SSH_TTY",
        "TERM_SESSION_ID",
        "TMUX",
        "TMUX_PANE",
        "WINDOWID",
        "XDG_SESSION_ID",
        "_",
    }
)


def command_name(words: Sequence[str], terminal: Sequence[object]) -> str:
    """Return the name of the answer to a command; ``terminal`` says how wide the terminal is and what it shows.

    The name depends on the words, the working folder, all variables of the environment but `IGNORED`, the terminal,
    Python with its options and search path, and the machine. Answers of another form have other names.
    """
    python = [sys.version, sys.executable, list(sys.flags), list(sys.warnoptions), dict(sys._xoptions), sys.path]
    place = [os.getcwd(), sorted(_decisive(os.environ).items()), list(os.uname()), os.cpu_count()]
    return digest("answer 2", list(words), list(terminal), python, place)


def _decisive(variables: Mapping[str, str]) -> dict[str, str]:
    return {name: value for name, value in variables.items() if name not in IGNORED}
