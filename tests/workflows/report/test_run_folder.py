"""The folder of a run: what a killed one leaves behind is swept, what another writes is not."""

import os
import time

import pytest

from neusee.workflows.report.run_folder import new_run


def test_an_abandoned_folder_is_swept_and_a_young_one_is_not(tmp_path):
    old, young = tmp_path / ".2026-01-01_a_0.1.part", tmp_path / ".2026-01-01_b_0.2.part"
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


def failing(root):
    with new_run(root, "r", "k" * 8) as folder:
        folder.write("a.txt", "a")
        raise RuntimeError


def test_a_run_that_fails_leaves_nothing(tmp_path):
    with pytest.raises(RuntimeError):
        failing(tmp_path)
    assert list(tmp_path.iterdir()) == []
