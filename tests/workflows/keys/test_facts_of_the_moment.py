"""Clocks, addresses and numbers of the machine are refused in own code, by whatever library they
are read.
"""

import pytest

from neusee.workflows.keys.source_summary import summarise

MOMENT = {
    "pandas": "import pandas as pd\ndef f():\n    return pd.Timestamp.now().second",
    "a class that is imported": (
        "from pandas import Timestamp\ndef f():\n    return Timestamp.utcnow()"
    ),
    "numpy": "import numpy as np\ndef f():\n    return np.datetime64('now')",
    "numpy, a day": "import numpy as np\ndef f():\n    return np.datetime64('to' + 'day')",
    "astropy": "from astropy.time import Time\ndef f():\n    return Time.now().mjd",
    "e-mail": "from email.utils import formatdate\ndef f():\n    return len(formatdate())",
    "timer": "from timeit import default_timer as tick\ndef f():\n    return tick()",
    "torch": "from torch.utils.benchmark import Timer\ndef f():\n    return Timer('1').timeit(1)",
    "getattr": "import time\ndef f():\n    return getattr(time, 'time')()",
    "getattr in parts": "import time\ndef f():\n    return getattr(time, 'ti' + 'me')()",
    "getattr by a name": "import os\ndef f(name):\n    return getattr(os, name)",
    "variable": "import os\ndef f():\n    return getattr(os, 'envi' + 'ron')['GAIN']",
    "address": "def f(x):\n    return x.data_ptr()",
    "thread": "import threading\ndef f():\n    return threading.get_native_id()",
    "processors": "import os\ndef f():\n    return len(os.sched_getaffinity(0))",
    "priority": "import os\ndef f():\n    return os.nice(0)",
    "terminal": "import shutil\ndef f():\n    return shutil.get_terminal_size().columns",
    "folder of temporary files": "import tempfile\ndef f():\n    return len(tempfile.gettempdir())",
    "level of a log": (
        "import logging\ndef f():\n    return logging.getLogger('lab').isEnabledFor(logging.INFO)"
    ),
    "record of a log": "import logging\ndef f():\n    return logging.makeLogRecord({}).created",
    "flags": "import sys\ndef f():\n    return sys.flags.dev_mode",
    "words of the command": "import sys\ndef f():\n    return len(sys.orig_argv)",
    "variables of the system": "import posix\ndef f():\n    return posix.environ[b'GAIN']",
    "program": "from shutil import which\ndef f():\n    return which('git')",
}
FREE = {
    "a column": "def f(row):\n    return row['now']",
    "a name of its own": "def f(today):\n    return 2 * today",
    "a date": "import numpy as np\ndef f():\n    return np.datetime64('2026-01-01')",
    "a function by its name": "import torch\ndef f(x, name):\n    return getattr(torch, name)(x)",
    "mathematics by its name": "import math\ndef f(x, name):\n    return getattr(math, name)(x)",
    "a path": "import os\ndef f(file):\n    return getattr(os.path, 'basename')(file)",
}


def found(code, own=True):
    return [
        item
        for item in summarise(code.encode(), own=own).constructs
        if item.kind in ("state", "env")
    ]


@pytest.mark.parametrize("fact", MOMENT)
def test_a_fact_of_the_moment_is_found_in_own_code(fact):
    assert found(MOMENT[fact])


@pytest.mark.parametrize("code", FREE)
def test_what_the_key_covers_is_free(code):
    assert not found(FREE[code])
