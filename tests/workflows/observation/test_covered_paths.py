"""What is covered without a word."""

import os
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import neusee.nodes.optics
from neusee.nodes import cpp_library
from neusee.workflows.observation import covered_paths


@pytest.mark.parametrize(
    "path", [np.__file__, torch.__file__, os.__file__, neusee.nodes.optics.__file__, sys.executable]
)
def test_the_program_and_python_with_its_packages_are_installed(path):
    assert covered_paths.is_installed(os.path.realpath(path)) or covered_paths.is_of_system(
        os.path.realpath(path)
    )


def test_a_file_of_a_user_is_not_installed(tmp_path):
    for path in (
        tmp_path / "gain.csv",
        Path(__file__),
        Path.home() / "gain.csv",
        "/srv/gain.csv",
        "/usr/src/app/gain.csv",
    ):
        assert not covered_paths.is_installed(str(path))
        assert not covered_paths.is_of_system(str(path))


def test_a_virtual_environment_in_the_folder_of_a_project_does_not_cover_the_project(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    covered_paths.program.cache_clear()
    try:
        assert covered_paths.is_installed(str(tmp_path / "lib" / "python3" / "x.py"))
        assert not covered_paths.is_installed(str(tmp_path / "gain.csv"))
    finally:
        covered_paths.program.cache_clear()


def test_a_folder_that_pip_filled_is_installed(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "thing-1.2.dist-info").mkdir()
    assert covered_paths.is_installed(str(tmp_path / "thing.py"))


def test_chance_is_no_part_of_the_system():
    assert covered_paths.is_of_system("/dev/null")
    assert covered_paths.is_of_system("/proc/cpuinfo")
    for path in ("/dev/urandom", "/proc/sys/kernel/random/uuid", "/dev/shm/gain", "/dev/video0"):
        assert not covered_paths.is_of_system(path)


def test_the_compiled_code_of_the_program_is_a_cache(monkeypatch, tmp_path):
    for home in (None, str(tmp_path)):
        monkeypatch.setenv("XDG_CACHE_HOME", home) if home else monkeypatch.delenv(
            "XDG_CACHE_HOME", raising=False
        )
        assert os.path.realpath(cpp_library.folder()) in covered_paths.caches()


def test_libraries_are_searched_where_the_loader_was_told_to(monkeypatch, tmp_path):
    monkeypatch.setenv("LD_LIBRARY_PATH", f"{tmp_path}:")
    assert covered_paths.is_of_system(str(tmp_path / "libgain.so.1"))
    assert not covered_paths.is_of_system(str(tmp_path / "gain.csv"))
    assert not covered_paths.is_of_system("/srv/libgain.so")
