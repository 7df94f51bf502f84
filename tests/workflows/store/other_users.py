"""Processes of other real users, who need no account; a test that starts them needs root."""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

from tests.workflows.forked_commands import Commands

GROUP = 60_001
FIRST, SECOND, STRANGER = 60_011, 60_012, 60_013  #: numbers of users; no account is needed
#: what a user must read, and what the home folder of root may hide
NEEDED = tuple(
    dict.fromkeys(map(os.path.realpath, (sys.base_prefix, sys.prefix, Path(__file__).parents[3])))
)


def hidden_above(path):
    """The highest folder above a path that other users may not enter, or None."""
    above = [path, *map(str, Path(path).parents)]
    return next((folder for folder in reversed(above) if not os.stat(folder).st_mode & 0o001), None)


def opened(place):
    """Lines of a shell that, in a mount namespace of their own, let every user enter what Python
    needs.
    """
    lines, known = ["set -e", "mount --make-rprivate /"], {}
    for path in NEEDED:
        top = hidden_above(path)
        if top is None:
            continue
        if top not in known:
            known[top] = f"{place}/real-{len(known)}"
            lines += [
                f"mkdir {known[top]}",
                f"mount --bind {top} {known[top]}",
                f"mount -t tmpfs -o mode=755 none {top}",
            ]
        lines += shown_again(path, top, known[top])
    return lines


def shown_again(path, top, real):
    """Lines that show ``path`` below the empty folder ``top``, whose own content is at ``real``.

    A bound folder keeps its mode: where it is ``path`` itself that others may not enter, as a
    folder of `mktemp` is, what it holds is bound entry by entry.
    """
    if path != top:
        inside = os.path.relpath(path, top)
        return [f"mkdir -p {path}", f"mount --bind {real}/{inside} {path}"]
    lines = []
    for name in os.listdir(top):
        entry = f"{top}/{name}"
        if os.path.islink(entry):
            lines.append(f"ln -s {os.readlink(entry)} {entry}")
            continue
        make = "mkdir" if os.path.isdir(entry) else "touch"
        lines += [f"{make} {entry}", f"mount --bind {real}/{name} {entry}"]
    return lines


#: what the processes of other users import, before they are those of others
IMPORTS = (
    "neusee.workflows",
    "neusee.workflows.engine.runner",
    "neusee.workflows.store.remote_store",
    "tests.workflows.store.whole_cache",
    *(f"neusee.nodes.{family}" for family in ("doe", "flare", "laser", "optics", "scene")),
    *(f"neusee.nodes.{family}" for family in ("sensor", "spectra", "restore", "metrics")),
)


def forks_of_users(place):
    """A server of commands whose processes may become users, in a mount namespace of its own."""
    script = "; ".join([*opened(tempfile.mkdtemp(dir=place)), 'exec "$@"'])
    above = [str(Path(__file__).parents[3]), os.environ.get("PYTHONPATH", "")]
    return Commands(
        imports=IMPORTS,
        prefix=["unshare", "--mount", "sh", "-c", script, "sh"],
        variables={"PYTHONDONTWRITEBYTECODE": "1", "PYTHONPATH": os.pathsep.join(above)},
    )


def who(user, groups=(GROUP,), umask=0o022):
    """What a process needs to become a user."""
    return {"number": user, "groups": list(groups), "umask": umask}
