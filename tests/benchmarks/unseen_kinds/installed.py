"""Packages that are installed beside those of neusee: what they are, hold and read."""

from unseen_kinds.case import Case
from unseen_kinds.machine import table

SITE = {"PYTHONPATH": "{folder}/site"}
METADATA = """
Metadata-Version: 2.1
Name: labtools
Version: 1.0
"""
NODE = """
    import labtools

    @node()
    def value() -> Tensor:
        return picture(labtools.gain())
    """


def record(*names: str) -> dict[str, str]:
    """Return the metadata of a package that says its files."""
    listed = "".join(f"{name},,\n" for name in names)
    return {
        "site/labtools-1.0.dist-info/METADATA": METADATA,
        "site/labtools-1.0.dist-info/RECORD": listed,
    }


def installed(name: str, about: str, files: dict, code: str = NODE, **words) -> Case:
    """Return a case with packages in a folder of `PYTHONPATH`."""
    env = SITE | words.pop("env", {})
    return Case(
        name,
        about,
        code,
        files={f"site/{path}": text for path, text in files.items()},
        env=env,
        **words,
    )


CASES = [
    Case(
        "same_version",
        "a helper that is installed anew under the same version",
        NODE,
        env=SITE,
        files={
            **record("labtools/__init__.py"),
            "site/labtools/__init__.py": (
                """
def gain():
    return 1
""",
                """
def gain():
    return 2
""",
            ),
        },
    ),
    Case(
        "table_in_package",
        "a table that the package reads at a call",
        NODE,
        env=SITE,
        files={
            **record("labtools/__init__.py", "labtools/gain.txt"),
            "site/labtools/__init__.py": """
from importlib.resources import files


def gain():
"""
            "    return files('labtools').joinpath('gain.txt').read_text()\n",
            "site/labtools/gain.txt": ("1", "2"),
        },
    ),
    installed(
        "variable_at_import",
        "the package reads a variable when it is imported",
        {
            "labtools/__init__.py": (
                """
import os

GAIN = os.environ['LAB_GAIN']


def gain():
    return GAIN
"""
            )
        },
        env={"LAB_GAIN": ("1", "2")},
    ),
    installed(
        "variable_at_call",
        "the package reads a variable when it is called",
        {
            "labtools/__init__.py": (
                """
import os


def gain():
    return os.getenv('LAB_GAIN')
"""
            )
        },
        env={"LAB_GAIN": ("1", "2")},
    ),
    installed(
        "settings_at_home",
        "the package reads a file at home when it is imported",
        {
            "labtools.py": (
                """
from pathlib import Path

GAIN = (Path.home() / '.labtools').read_text()
"""
                """
def gain():
    return GAIN
"""
            ),
        },
        env={"HOME": ("{folder}/site/one", "{folder}/site/two")},
        make=lambda folder, turn: [
            (
                (folder / "site" / name).mkdir(exist_ok=True),
                (folder / "site" / name / ".labtools").write_text(text),
            )
            for name, text in (("one", "1"), ("two", "2"))
        ],
    ),
    installed(
        "optional_package",
        "the package uses another one if it is there",
        {
            "labtools.py": (
                """
try:
    import labfast
except ImportError:
    labfast = None
"""
                """
def gain():
    return 1 if labfast is None else 2
"""
            ),
            "labfast.py": (None, "SPEED = 1\n"),
        },
    ),
    installed(
        "second_package",
        "the package imports a package that changes",
        {
            "labtools.py": (
                """
import labcore


def gain():
    return labcore.GAIN
"""
            ),
            "labcore.py": ("GAIN = 1\n", "GAIN = 2\n"),
        },
    ),
    installed(
        "lazy_second_package",
        "the package imports it by a name that it builds",
        {
            "labtools.py": (
                """
import importlib


def gain():
    return importlib.import_module('lab' + 'core').GAIN
"""
            ),
            "labcore.py": ("GAIN = 1\n", "GAIN = 2\n"),
        },
    ),
    installed(
        "plugin_by_entry_point",
        "the package asks for plugins by entry points; a plugin is installed",
        {
            "labtools.py": (
                """
from importlib.metadata import entry_points
"""
                """
def gain():
    return 1 + sum(p.load() for p in entry_points(group='lab.gains'))
"""
            ),
            "labplug.py": "GAIN = 1\n",
            "labplug-1.0.dist-info/METADATA": METADATA.replace("labtools", "labplug"),
            "labplug-1.0.dist-info/entry_points.txt": (
                None,
                """
[lab.gains]
extra = labplug:GAIN
""",
            ),
        },
    ),
    installed(
        "own_entry_points",
        "the node asks for plugins by entry points",
        {
            "labplug.py": ("GAIN = 1\n", "GAIN = 2\n"),
            "labplug-1.0.dist-info/METADATA": METADATA.replace("labtools", "labplug"),
            "labplug-1.0.dist-info/entry_points.txt": (
                """
[lab.gains]
extra = labplug:GAIN
"""
            ),
        },
        """
        from importlib.metadata import entry_points

        @node()
        def value() -> Tensor:
            return picture(sum(plugin.load() for plugin in entry_points(group="lab.gains")))
        """,
    ),
    installed(
        "modules_of_a_folder",
        "the package loads all modules of its folder of plugins",
        {
            "labtools/__init__.py": (
                """
import importlib
import pkgutil

from labtools import plugins


def gain():
"""
                "    names = [m.name for m in pkgutil.iter_modules(plugins.__path__)]\n"
                "    return sum(importlib.import_module('labtools.plugins.' + n).GAIN for n in"
                " names)\n"
            ),
            "labtools/plugins/__init__.py": "",
            "labtools/plugins/one.py": "GAIN = 1\n",
            "labtools/plugins/two.py": (None, "GAIN = 1\n"),
        },
    ),
    installed(
        "version_as_a_number",
        "the version of a package that nobody imports",
        {
            "labplug.py": "",
            "labplug-1.0.dist-info/METADATA": (
                """
Metadata-Version: 2.1
Name: labplug
Version: 1.0
""",
                """
Metadata-Version: 2.1
Name: labplug
Version: 2.0
""",
            ),
        },
        """
        from importlib.metadata import version

        @node()
        def value() -> Tensor:
            return picture(version("labplug"))
        """,
    ),
    installed(
        "sitecustomize",
        "sitecustomize patches NumPy",
        {
            "sitecustomize.py": (
                """
import numpy

numpy.trapezoid = lambda values: 1.0
""",
                """
import numpy

numpy.trapezoid = lambda values: 2.0
""",
            )
        },
        """
        @node()
        def value() -> Tensor:
            return picture(np.trapezoid([1.0, 1.0]))
        """,
    ),
    installed(
        "data_of_package",
        "pkgutil.get_data for a package that only has data",
        {"labdata/__init__.py": "", "labdata/gain.txt": ("1", "2")},
        """
        import pkgutil

        @node()
        def value() -> Tensor:
            return picture(pkgutil.get_data("labdata", "gain.txt"))
        """,
    ),
    installed(
        "namespace_package",
        "a namespace package whose second part changes",
        {
            "lab/one.py": (
                """
from lab import two

GAIN = two.GAIN
"""
            ),
            "lab/two.py": ("GAIN = 1\n", "GAIN = 2\n"),
        },
        """
        from lab.one import GAIN

        @node()
        def value() -> Tensor:
            return picture(GAIN)
        """,
    ),
    installed(
        "typing_stub_beside",
        "the package reads a settings file beside its folder",
        {
            "labtools/__init__.py": """
from pathlib import Path


def gain():
"""
            "    return (Path(__file__).parents[1] / 'labtools.cfg').read_text()\n",
            "labtools.cfg": ("1", "2"),
        },
    ),
    table(
        "file_below_prefix",
        "a settings file in the virtual environment",
        "{prefix}/etc/neusee_unseen_kind.cfg",
    ),
    table(
        "file_beside_numpy",
        "a table that somebody put beside NumPy",
        "{prefix}/lib/python3.11/site-packages/numpy/neusee_unseen_kind.txt",
    ),
]
