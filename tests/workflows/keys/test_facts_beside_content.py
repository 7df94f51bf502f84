"""Times and rights of files, comments and numbers of lines: no key covers them, so code that
reads them is refused.
"""

import pytest

from neusee.workflows.keys.source_summary import summarise
from neusee.workflows.keys.user_code import refusal, uncovered

STAMP = {
    "time": "def f(file):\n    return file.stat().st_mtime",
    "time in ns": "import os\ndef f(file):\n    return os.stat(file).st_mtime_ns",
    "time by os.path": "import os\ndef f(file):\n    return os.path.getmtime(file)",
    "time by a name": "from os.path import getctime as age\ndef f(file):\n    return age(file)",
    "time by getattr": "def f(file):\n    return getattr(file.stat(), 'st_' + 'mtime')",
    "time by attrgetter": "from operator import attrgetter\nAGE = attrgetter('st_atime')",
    "time by place": "def f(file):\n    return file.stat()[8]",
    "time by a constant": (
        "import stat\ndef f(file):\n    about = file.stat()\n    return about[stat.ST_MTIME]"
    ),
    "all": "import os\ndef f(file):\n    return tuple(os.stat(file))",
    "a row": "import os\ndef f(file):\n    mode, *rest = os.stat(file)\n    return mode",
    "a text": "def f(file):\n    return f'{file.stat()}'",
    "rights": "def f(file):\n    return file.stat().st_mode",
    "access": "import os\ndef f(file):\n    return os.access(file, os.W_OK)",
    "owner": "from pathlib import Path\ndef f(file: Path):\n    return file.owner()",
    "group": "from neusee.nodes import DataFile\ndef f(file: DataFile):\n    return file.group()",
    "attribute": "import os\ndef f(file):\n    return os.getxattr(file, 'user.gain')",
    "same": "def f(file, other):\n    return file.samefile(other)",
    "member of an archive": "def f(info):\n    return info.date_time",
    "another file system": "def f(system, file):\n    return system.info(file)['mtime']",
    "header of an archive": "def f(archive, file):\n    return archive.gettarinfo(file).mode",
    "link": "def f(file):\n    return file.is_symlink()",
}
SOURCE = {
    "comments": "import inspect\nimport helper\ndef f():\n    return inspect.getcomments(helper)",
    "source": "import inspect\nimport helper\ndef f():\n    return inspect.findsource(helper)",
    "stack": "import inspect\ndef f():\n    return inspect.stack()[0].lineno",
    "line": "import helper\ndef f():\n    return helper.gain.__code__.co_firstlineno",
    "line by attrgetter": (
        "from operator import attrgetter\nLINE = attrgetter('__code__.co_firstlineno')"
    ),
    "frame": "import sys\ndef f():\n    return sys._getframe().f_lineno",
    "traceback": "import traceback\ndef f():\n    return traceback.extract_stack()[-1].lineno",
    "words": "import tokenize\ndef f(file):\n    return tokenize.open(file)",
}
FREE = {
    "size": "import os\ndef f(file):\n    return os.stat(file).st_size + file.stat()[6]",
    "size by a name": "def f(file):\n    about = file.stat()\n    return about.st_size",
    "stack of arrays": "import numpy as np\ndef f(x):\n    return np.stack(x)",
    "group of a match": "import re\ndef f(text):\n    return re.match('a', text).group()",
    "owner of a camera": "def f(camera):\n    return camera.owner",
    "a message": (
        "import traceback\nimport logging\ndef f():\n    logging.info(traceback.format_exc())"
    ),
    "a sentence": "def f():\n    raise ValueError('the field st_mtime is missing')",
    "tree of a formula": "import ast\ndef f(text):\n    return ast.parse(text)",
}
DOCUMENTS = {
    "getattr": "def f(x):\n    return getattr(x, '__do' + 'c__')",
    "attrgetter": "from operator import attrgetter\nREAD = attrgetter('__do' 'c__')",
    "a text in a text": "from operator import attrgetter\nREAD = attrgetter('fn.__doc__')",
    "join": "def f(x):\n    return getattr(x, ''.join(['__doc', '__']))",
    "vars": "def f(x):\n    return vars(x)",
    "any name": "def f(x, name):\n    return getattr(x, name)",
    "table": "def f(x):\n    return list(x.__dict__.values())",
    "members": "import inspect\ndef f(x):\n    return inspect.getmembers(x)",
}


def found(code, kind, own=True):
    return [item for item in summarise(code.encode(), own=own).constructs if item.kind == kind]


@pytest.mark.parametrize("kind", STAMP)
def test_a_fact_beside_the_content_of_a_file_is_found(kind):
    assert found(STAMP[kind], "stamp")
    assert not found(STAMP[kind], "stamp", own=False)


@pytest.mark.parametrize("kind", SOURCE)
def test_comments_and_lines_are_found(kind):
    assert found(SOURCE[kind], "source")


@pytest.mark.parametrize("kind", FREE)
def test_what_no_such_fact_decides_is_not(kind):
    assert not found(FREE[kind], "stamp")
    assert not found(FREE[kind], "source")


def test_a_refusal_has_the_place_and_what_to_write(tmp_path):
    (age,), (line,) = found(STAMP["time"], "stamp"), found(SOURCE["line"], "source")
    said = refusal(age, tmp_path / "own.py")
    assert "own.py:2: st_mtime: times, rights and marks of a file are not its content" in said
    assert 'depends=["unaffected:st_mtime"]' in said
    assert uncovered([age], ["unaffected:st_mtime"]) is None
    assert uncovered([age], ["table.csv"]) == age
    assert 'depends=["helper.py"]' in refusal(line, tmp_path / "own.py")
    assert uncovered([line], ["helper.py"]) is None


@pytest.mark.parametrize("kind", DOCUMENTS)
def test_code_that_may_read_docstrings_is_found(kind):
    assert summarise(DOCUMENTS[kind].encode(), own=True).documents


def test_named_attributes_are_no_docstrings():
    code = (
        "from operator import attrgetter\nGET = attrgetter('gain')\ndef f(x):\n    return"
        " getattr(x, 'gain')"
    )
    assert not summarise(code.encode(), own=True).documents
