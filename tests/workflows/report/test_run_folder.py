"""The folder of a run: what a killed one leaves behind is swept, what another writes is not."""

import os
import subprocess
import sys
import time

import pytest

from neusee.workflows.report.run_folder import new_run


def test_an_abandoned_folder_is_swept_and_a_young_one_is_not(tmp_path):
    ended = subprocess.Popen([sys.executable, "-S", "-c", ""])
    ended.wait()
    old, young = (
        tmp_path / f".2026-01-01_a_0.{ended.pid}.part",
        tmp_path / f".2026-01-01_b_0.{ended.pid}.part",
    )
    for part in (old, young):
        (part / "figures").mkdir(parents=True)
        (part / "figures" / "x.png").write_bytes(b"x")
    long_ago = time.time() - 7200
    for path in (old / "figures" / "x.png", old / "figures", old, young / "figures", young):
        os.utime(path, (long_ago, long_ago))
    with new_run(tmp_path, "r", "k" * 8) as folder:
        folder.write("a.txt", "a")
    assert not old.exists()
    assert young.exists()
    assert (tmp_path / "latest" / "a.txt").read_text() == "a"


def test_a_folder_that_a_process_writes_stays_whatever_the_clock_says(tmp_path):
    with new_run(tmp_path, "r", "k" * 8) as folder:
        folder.write("a.txt", "a")
        for path in (folder.path / "a.txt", folder.path):
            os.utime(path, (0, 0))  # as if written before the clock was set
        with new_run(tmp_path, "other", "k" * 8) as other:
            other.write("b.txt", "b")
    assert sorted(path.name[11:] for path in tmp_path.glob("2*")) == [
        "other_kkkkkkkk",
        "r_kkkkkkkk",
    ]


def failing(root):
    with new_run(root, "r", "k" * 8) as folder:
        folder.write("a.txt", "a")
        raise RuntimeError


def test_a_run_that_fails_leaves_nothing(tmp_path):
    with pytest.raises(RuntimeError):
        failing(tmp_path)
    assert list(tmp_path.iterdir()) == []
