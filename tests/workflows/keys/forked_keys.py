"""Keys of own nodes in new processes: one that has the program at hand forks for each folder, so
that a test can afford many.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[3]
#: prints for each folder that is given the key of its node, or the last line of its error; each is
#: made in a fork, which is as new as the process is
KEYS = """
import json
import os
import sys
import traceback
from pathlib import Path
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.recipe.node_families import import_own

for folder in sys.argv[1:]:
    child = os.fork()
    if child:
        os.waitpid(child, 0)
        continue
    sys.path.insert(0, folder)
    os.chdir(folder)
    try:
        value = import_own("mine.py", Path.cwd()).value
        said = Code(Path("code.json")).of(value)
    except BaseException as error:
        said = traceback.format_exception_only(error)[-1].strip().splitlines()[-1]
    print(json.dumps(said), flush=True)
    os._exit(0)
"""


def told(*folders: Path, seed: str = "1") -> list[str]:
    """Return the key of the node ``value`` of ``mine.py`` in each folder, or the last line of its
    error; all have the hash seed ``seed``.
    """
    env = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([*map(str, folders), str(ROOT / ".src")]),
        "PYTHONDONTWRITEBYTECODE": "1",
        "PYTHONHASHSEED": seed,
    }
    words = [sys.executable, "-c", KEYS, *map(str, folders)]
    done = subprocess.run(words, env=env, cwd=folders[0], capture_output=True, text=True)
    found = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(found) == len(folders), done.stderr
    return found
