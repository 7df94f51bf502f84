"""Variables of the process, read in other ways than `os.environ`."""

import os
from pathlib import Path

from unseen_kinds.case import Case

GAIN = {"LAB_GAIN": ("1", "2")}


def _tool(folder: Path, turn: int) -> None:
    (folder / "bin").mkdir(exist_ok=True)
    (folder / "bin" / "labtool").touch(0o755)


def variable(name: str, about: str, code: str, env=GAIN, **words) -> Case:
    """Return a case with a variable that changes."""
    return Case(name, about, code, env=env, **words)


CASES = [
    variable(
        "bytes",
        "os.environb",
        """
        @node()
        def value() -> Tensor:
            return picture(os.environb[b"LAB_GAIN"])
        """,
    ),
    variable(
        "getattr_of_os",
        "getattr(os, 'environ')",
        """
        @node()
        def value() -> Tensor:
            return picture(getattr(os, "env" + "iron")["LAB_GAIN"])
        """,
    ),
    variable(
        "posix",
        "the module below os",
        """
        import posix

        @node()
        def value() -> Tensor:
            return picture(posix.environ[b"LAB_GAIN"])
        """,
    ),
    variable(
        "shell",
        "a shell prints it",
        """
        import subprocess

        @node()
        def value() -> Tensor:
            return picture(subprocess.getoutput("echo $LAB_GAIN"))
        """,
    ),
    variable(
        "proc",
        "/proc/self/environ",
        """
        @node()
        def value() -> Tensor:
            text = Path("/proc", "self", "environ").read_bytes()
            return picture(dict(entry.split(b"=", 1) for entry in text.split(b"\\0") if entry)[b"LAB_GAIN"])
        """,
    ),
    variable(
        "libc",
        "getenv of the C library",
        """
        from ctypes import PyDLL, c_char_p

        @node()
        def value() -> Tensor:
            getenv = PyDLL(None).getenv
            getenv.restype = c_char_p
            return picture(getenv(b"LAB_GAIN"))
        """,
    ),
    variable(
        "home",
        "a settings file at home",
        """
        @node()
        def value() -> Tensor:
            return picture((Path.home() / ".labrc").read_text())
        """,
        env={"HOME": ("{folder}/one", "{folder}/two")},
        files={"one/.labrc": "1", "two/.labrc": "2"},
    ),
    variable(
        "expanduser",
        "a path with a tilde",
        """
        @node()
        def value(*, table: str = "~/lab.txt") -> Tensor:
            return picture(np.loadtxt(os.path.expanduser(table)))
        """,
        env={"HOME": ("{folder}/one", "{folder}/two")},
        files={"one/lab.txt": "1", "two/lab.txt": "2"},
    ),
    variable(
        "length_of_home",
        "the home folder itself",
        """
        @node()
        def value() -> Tensor:
            return picture(len(str(Path.home())))
        """,
        env={"HOME": ("/a", "/ab")},
    ),
    variable(
        "temporary_folder",
        "where temporary files go",
        """
        import tempfile

        @node()
        def value() -> Tensor:
            return picture(len(tempfile.gettempdir()))
        """,
        env={"TMPDIR": ("/tmp", "/var/tmp")},
    ),
    variable(
        "which_program",
        "which program the path finds",
        """
        import shutil

        @node()
        def value() -> Tensor:
            return picture(shutil.which("labtool") is not None)
        """,
        env={"PATH": (os.environ["PATH"], os.environ["PATH"] + ":{folder}/bin")},
        make=_tool,
    ),
    variable(
        "user_name",
        "getpass.getuser",
        """
        import getpass

        @node()
        def value() -> Tensor:
            return picture(len(getpass.getuser()))
        """,
        env={"LOGNAME": ("ann", "sophia")},
    ),
    variable(
        "terminal_width",
        "the width of the terminal",
        """
        import shutil

        @node()
        def value() -> Tensor:
            return picture(shutil.get_terminal_size().columns)
        """,
        env={"COLUMNS": ("90", "100")},
    ),
    variable(
        "configuration_folder",
        "platformdirs and XDG_CONFIG_HOME",
        """
        import platformdirs

        @node()
        def value() -> Tensor:
            return picture((Path(platformdirs.user_config_dir("lab")) / "gain").read_text())
        """,
        env={"XDG_CONFIG_HOME": ("{folder}/one", "{folder}/two")},
        files={"one/lab/gain": "1", "two/lab/gain": "2"},
    ),
    variable(
        "matplotlibrc",
        "a matplotlibrc of the user",
        """
        import matplotlib

        @node()
        def value() -> Tensor:
            return picture(matplotlib.rcParams["savefig.pad_inches"])
        """,
        env={"MATPLOTLIBRC": ("{folder}/one", "{folder}/two")},
        files={
            "one/matplotlibrc": "savefig.pad_inches: 1\n",
            "two/matplotlibrc": "savefig.pad_inches: 2\n",
        },
    ),
    variable(
        "dask_variable",
        "dask reads its settings from variables",
        """
        import dask

        @node()
        def value() -> Tensor:
            return picture(dask.config.get("lab.gain"))
        """,
        env={"DASK_LAB__GAIN": ("1", "2")},
    ),
    variable(
        "dask_file",
        "dask reads its settings from a file at home",
        """
        import dask.config

        @node()
        def value() -> Tensor:
            return picture(dask.config.get("lab.gain"))
        """,
        env={"DASK_CONFIG": "{folder}/dask"},
        files={"dask/lab.yaml": ("lab: {gain: 1}\n", "lab: {gain: 2}\n")},
    ),
    variable(
        "colour_variable",
        "colour takes its float type from a variable",
        """
        import colour

        @node()
        def value() -> Tensor:
            return picture(colour.utilities.as_float([1.0]).dtype.itemsize)
        """,
        env={"COLOUR_SCIENCE__DEFAULT_FLOAT_DTYPE": (None, "float32")},
    ),
    variable(
        "scipy_variable",
        "SciPy changes with SCIPY_ARRAY_API what its functions take",
        """
        import scipy.special

        @node()
        def value() -> Tensor:
            try:
                scipy.special.erf(np.ma.masked_array([1.0], [True]))
            except TypeError:
                return picture(2)
            return picture(1)
        """,
        env={"SCIPY_ARRAY_API": (None, "1")},
    ),
    variable(
        "proxies",
        "urllib reads the proxies",
        """
        from urllib.request import getproxies

        @node()
        def value() -> Tensor:
            return picture(len(getproxies()))
        """,
        env={"http_proxy": (None, "http://lab:1")},
    ),
    variable(
        "path_of_python",
        "the length of sys.path",
        """
        @node()
        def value() -> Tensor:
            return picture(len(sys.path))
        """,
        env={"PYTHONPATH": ("{folder}/one", "{folder}/one:{folder}/two")},
    ),
    variable(
        "optional_import",
        "try: import fast",
        """
        try:
            import labfast
        except ImportError:
            labfast = None

        @node()
        def value() -> Tensor:
            return picture(labfast is not None)
        """,
        env={"PYTHONPATH": "{folder}/site"},
        files={"site/labfast.py": (None, "SPEED = 2\n"), "site/other.py": ""},
    ),
    variable(
        "spec_of_optional",
        "importlib.util.find_spec",
        """
        from importlib.util import find_spec

        @node()
        def value() -> Tensor:
            return picture(find_spec("labfast") is not None)
        """,
        env={"PYTHONPATH": "{folder}/site"},
        files={"site/labfast.py": (None, "SPEED = 2\n"), "site/other.py": ""},
    ),
    variable(
        "variable_at_import",
        "a constant of the module, by a helper that takes the mapping as an argument",
        """
        def setting(variables, name):
            return float(variables[name])

        GAIN = setting(vars(os)["environ"], "LAB_GAIN")

        @node()
        def value() -> Tensor:
            return picture(GAIN)
        """,
    ),
    variable(
        "flags_of_python",
        "sys.flags and -X options",
        """
        @node()
        def value() -> Tensor:
            return picture(sys.flags.dev_mode + sys.flags.utf8_mode + bool(sys.warnoptions))
        """,
        env={"PYTHONWARNINGS": (None, "ignore")},
    ),
    variable(
        "template",
        "a template that is filled from all variables",
        """
        from string import Template

        @node()
        def value(*, text: str = "$LAB_GAIN") -> Tensor:
            return picture(Template(text).substitute(**__import__("os").environ))
        """,
    ),
    variable(
        "astropy_configuration",
        "astropy reads its configuration folder",
        """
        from astropy.utils.data import conf

        @node()
        def value() -> Tensor:
            return picture(conf.remote_timeout)
        """,
        env={"XDG_CONFIG_HOME": ("{folder}/one", "{folder}/two"), "ASTROPY_CONFIG_DIR": None},
        files={
            "one/astropy/astropy.cfg": "[utils.data]\nremote_timeout = 1\n",
            "two/astropy/astropy.cfg": "[utils.data]\nremote_timeout = 2\n",
        },
    ),
    variable(
        "click_option",
        "a little command line in the node takes its default from a variable",
        """
        import click

        @click.command()
        @click.option("--gain", envvar="LAB_GAIN", type=float)
        def gain(gain):
            return gain

        @node()
        def value() -> Tensor:
            return picture(gain.main([], standalone_mode=False))
        """,
    ),
]
