"""Packages that are installed beside those of neusee: what they are, hold and read."""

from unseen_kinds.case import Case

SITE = {"PYTHONPATH": "{folder}/site"}
METADATA = "Metadata-Version: 2.1\nName: labtools\nVersion: 1.0\n"
NODE = """
    import labtools

    @node()
    def value() -> Tensor:
        return picture(labtools.gain())
    """


def record(*names: str) -> dict[str, str]:
    """Return the metadata of a package that says its files."""
    listed = "".join(f"{name},,\n" for name in names)
    return {"site/labtools-1.0.dist-info/METADATA": METADATA, "site/labtools-1.0.dist-info/RECORD": listed}


def installed(name: str, about: str, files: dict, code: str = NODE, **words) -> Case:
    """Return a case with packages in a folder of `PYTHONPATH`."""
    env = SITE | words.pop("env", {})
    return Case(name, about, code, files={f"site/{path}": text for path, text in files.items()}, env=env, **words)


CASES = [
    Case(
        "same_version",
        "a helper that is installed anew under the same version",
        NODE,
        env=SITE,
        files={
            **record("labtools/__init__.py"),
            "site/labtools/__init__.py": ("def gain():\n    return 1\n", "def gain():\n    return 2\n"),
        },
    ),
    Case(
        "table_in_package",
        "a table that the package reads at a call",
        NODE,
        env=SITE,
        files={
            **record("labtools/__init__.py", "labtools/gain.txt"),
            "site/labtools/__init__.py": (
                "from importlib.resources import files\n\n\ndef gain():\n"
                "    return files('labtools').joinpath('gain.txt').read_text()\n"
            ),
            "site/labtools/gain.txt": ("1", "2"),
        },
    ),
    installed(
        "variable_at_import",
        "the package reads a variable when it is imported",
        {"labtools/__init__.py": "import os\n\nGAIN = os.environ['LAB_GAIN']\n\n\ndef gain():\n    return GAIN\n"},
        env={"LAB_GAIN": ("1", "2")},
    ),
    installed(
        "variable_at_call",
        "the package reads a variable when it is called",
        {"labtools/__init__.py": "import os\n\n\ndef gain():\n    return os.getenv('LAB_GAIN')\n"},
        env={"LAB_GAIN": ("1", "2")},
    ),
    installed(
        "settings_at_home",
        "the package reads a file at home when it is imported",
        {
            "labtools.py": (
                "from pathlib import Path\n\nGAIN = (Path.home() / '.labtools').read_text()\n\n\n"
                "def gain():\n    return GAIN\n"
            ),
        },
        env={"HOME": ("{folder}/site/one", "{folder}/site/two")},
        make=lambda folder, turn: [
            ((folder / "site" / name).mkdir(exist_ok=True), (folder / "site" / name / ".labtools").write_text(text))
            for name, text in (("one", "1"), ("two", "2"))
        ],
    ),
    installed(
        "optional_package",
        "the package uses another one if it is there",
        {
            "labtools.py": (
                "try:\n    import labfast\nexcept ImportError:\n    labfast = None\n\n\n"
                "def gain():\n    return 1 if labfast is None else 2\n"
            ),
            "labfast.py": (None, "SPEED = 1\n"),
        },
    ),
    installed(
        "second_package",
        "the package imports a package that changes",
        {
            "labtools.py": "import labcore\n\n\ndef gain():\n    return labcore.GAIN\n",
            "labcore.py": ("GAIN = 1\n", "GAIN = 2\n"),
        },
    ),
    installed(
        "lazy_second_package",
        "the package imports it by a name that it builds",
        {
            "labtools.py": (
                "import importlib\n\n\ndef gain():\n    return importlib.import_module('lab' + 'core').GAIN\n"
            ),
            "labcore.py": ("GAIN = 1\n", "GAIN = 2\n"),
        },
    ),
    installed(
        "plugin_by_entry_point",
        "the package asks for plugins by entry points; a plugin is installed",
        {
            "labtools.py": (
                "from importlib.metadata import entry_points\n\n\n"
                "def gain():\n    return 1 + sum(p.load() for p in entry_points(group='lab.gains'))\n"
            ),
            "labplug.py": "GAIN = 1\n",
            "labplug-1.0.dist-info/METADATA": METADATA.replace("labtools", "labplug"),
            "labplug-1.0.dist-info/entry_points.txt": (None, "[lab.gains]\nextra = labplug:GAIN\n"),
        },
    ),
    installed(
        "own_entry_points",
        "the node asks for plugins by entry points",
        {
            "labplug.py": ("GAIN = 1\n", "GAIN = 2\n"),
            "labplug-1.0.dist-info/METADATA": METADATA.replace("labtools", "labplug"),
            "labplug-1.0.dist-info/entry_points.txt": "[lab.gains]\nextra = labplug:GAIN\n",
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
                "import importlib\nimport pkgutil\n\nfrom labtools import plugins\n\n\ndef gain():\n"
                "    names = [m.name for m in pkgutil.iter_modules(plugins.__path__)]\n"
                "    return sum(importlib.import_module('labtools.plugins.' + n).GAIN for n in names)\n"
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
                "Metadata-Version: 2.1\nName: labplug\nVersion: 1.0\n",
                "Metadata-Version: 2.1\nName: labplug\nVersion: 2.0\n",
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
                "import numpy\n\nnumpy.trapezoid = lambda values: 1.0\n",
                "import numpy\n\nnumpy.trapezoid = lambda values: 2.0\n",
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
        {"lab/one.py": "from lab import two\n\nGAIN = two.GAIN\n", "lab/two.py": ("GAIN = 1\n", "GAIN = 2\n")},
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
            "labtools/__init__.py": (
                "from pathlib import Path\n\n\ndef gain():\n"
                "    return (Path(__file__).parents[1] / 'labtools.cfg').read_text()\n"
            ),
            "labtools.cfg": ("1", "2"),
        },
    ),
    Case(
        "file_below_prefix",
        "a settings file in the folder etc of the virtual environment",
        """
        @node()
        def value() -> Tensor:
            return picture(Path(sys.prefix, "etc", "neusee_unseen_kind.cfg").read_text())
        """,
        files={"{prefix}/etc/neusee_unseen_kind.cfg": ("1", "2")},
    ),
    Case(
        "file_beside_numpy",
        "a table that somebody put beside NumPy",
        """
        @node()
        def value() -> Tensor:
            return picture(np.loadtxt(os.path.join(np.__path__[0], "neusee_unseen_kind.txt")))
        """,
        files={"{prefix}/lib/python3.11/site-packages/numpy/neusee_unseen_kind.txt": ("1", "2")},
    ),
]
