"""Tables on a terminal of 80 characters."""

from __future__ import annotations

import sys

from neusee.workflows.cli.command_frame import terminal_width


def test_what_is_written_to_a_file_has_no_width(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr(sys.stdout, "isatty", lambda: False, raising=False)
    assert terminal_width() is None
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    assert terminal_width() == 80
