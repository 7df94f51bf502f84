"""Where a module is from: what `pip install --target` put into a folder is a distribution, own
modules are not.
"""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[3]
ASK = """
from neusee.workflows.keys.module_origin import origin_of
print(*(tuple(origin_of(module, frozenset())) for module in {names}), sep="|")
"""


def asked(folder, *names):
    env = {**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{ROOT / '.src'}"}
    done = subprocess.run(
        [sys.executable, "-c", ASK.format(names=list(names))],
        env=env,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip().split("|")


def test_a_package_beside_its_metadata_counts_by_its_version_and_a_module_without_any_by_its_source(
    tmp_path,
):
    (tmp_path / "thing").mkdir()
    (tmp_path / "thing" / "__init__.py").write_text("")
    (tmp_path / "thing-1.2.dist-info").mkdir()
    (tmp_path / "thing-1.2.dist-info" / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: thing\nVersion: 1.2\n"
    )
    (tmp_path / "thing-1.2.dist-info" / "RECORD").write_text("thing/__init__.py,,\n")
    (tmp_path / "mine.py").write_text("")
    thing, inside, mine = asked(tmp_path, "thing", "thing.part", "mine")
    assert thing == inside == "('distribution', None, 'thing 1.2')"
    assert mine.startswith("('source'")


def test_a_folder_without_metadata_holds_sources(tmp_path):
    (tmp_path / "thing").mkdir()
    (tmp_path / "thing" / "__init__.py").write_text("")
    assert asked(tmp_path, "thing")[0].startswith("('source'")
