"""The second run of the default recipe: from the cache, and hardly slower than its largest
import.
"""

from __future__ import annotations

import subprocess
import sys
import time

import pytest


@pytest.mark.slow
@pytest.mark.alone
def test_a_cached_first_light_draws_nothing_and_starts_like_a_bare_torch(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NEUSEE_CACHE", str(tmp_path / "cache"))
    cached = (
        "import sys\nfrom neusee.workflows.cli.app import main\n"
        "try: main(['run', '--quiet'])\nexcept SystemExit as end: assert not end.code\n"
        "heavy = {'matplotlib', 'kornia', 'colour', 'OpenEXR', 'scipy'} & set(sys.modules)\n"
        "assert len(sys.argv) == 1 or not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", cached], check=True)
    subprocess.run([sys.executable, "-c", cached, "light"], check=True)
    ours, bare = (_fastest(code) for code in (cached, "import torch"))
    assert ours <= 1.5 * bare
    assert len([p for p in (tmp_path / "runs").iterdir() if p.is_dir() and not p.is_symlink()]) == 7


def _fastest(code: str) -> float:
    seconds = []
    for _ in range(5):
        began = time.perf_counter()
        subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
        seconds.append(time.perf_counter() - began)
    return min(seconds)
