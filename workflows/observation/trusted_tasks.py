"""Threads and processes whose calls need no record, because the program, or an installed package, makes them.

The observed process says so itself, in order with its calls: it asks for rights to a file that nobody can have, and the
call stops.
"""

from __future__ import annotations

from neusee.workflows.observation.stopped_task import Task

#: marks in place of the rights that ``access`` asks for: whose calls follow. The kernel refuses them.
TRUSTED, UNTRUSTED, CHILD = 0x6E650001, 0x6E650002, 0x6E650003
MARKS = (TRUSTED, UNTRUSTED, CHILD)


class TrustedTasks:
    """Threads that import an installed package, and child processes that the program or such a thread starts."""

    def __init__(self, process: int) -> None:
        self._process = process  #: that is observed
        self._children = 0  #: child processes that the program is about to start
        self._of_thread: dict[int, bool] = {}
        self._of_process: dict[int, bool] = {}

    def mark(self, thread: int, mark: int) -> None:
        """Take note of a mark that the observed process made."""
        if mark == CHILD:
            self._children += 1
        else:
            self._of_thread[thread] = mark == TRUSTED

    def holds(self, task: Task) -> bool:
        """Return True if the calls of a task need no record."""
        if task.thread not in self._of_thread:
            process = task.status("Tgid")
            self._of_thread[task.thread] = process != self._process and self._child(process)
        return self._of_thread[task.thread]

    def _child(self, process: int) -> bool:
        if process not in self._of_process:
            parent = Task(process).status("PPid")
            trusted = self._of_process.get(parent, False)
            if parent == self._process:
                trusted = self._children > 0 or any(self._of_thread.values())
                self._children -= self._children > 0
            self._of_process[process] = trusted
        return self._of_process[process]
