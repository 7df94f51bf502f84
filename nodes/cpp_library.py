"""C++ sources, compiled on first use for the processor of the machine and then reused.

The sources need only a compiler, no headers of torch or Python. They compile in seconds, and a
library works with any version of both. A library is compiled in a temporary folder and moved by an
atomic rename: two processes that compile at the same time both get a valid library, and a killed
process leaves no lock behind. The variable ``CXX`` names the compiler. Its options come last and
take precedence: ``CXX="g++ -march=x86-64-v3"`` compiles for AVX2. If it names no program, torch
does the computation.
"""

import ctypes
import functools
import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
import warnings
from pathlib import Path

#: fused multiply-add (FMA) changes a result only within rounding, and only where a source allows
#: it; each module declares its own sources
__depends__ = (
    "_vector.h",
    "unaffected:file",
    "unaffected:CXX",
    "unaffected:XDG_CACHE_HOME",
    "unaffected:HOME",
    "unaffected:ctypes",
    "unaffected:subprocess",
    "unaffected:platform",
    "unaffected:pathlib.Path.home",
)
FLAGS = (
    *("-std=c++17", "-O3", "-march=native", "-fopenmp", "-fPIC", "-shared", "-w"),
    *("-fno-math-errno", "-fno-trapping-math"),
)
#: with FUSED, compilers may fuse a product and a sum, which rounds once instead of twice
FUSED, UNFUSED = "-ffp-contract=fast", "-ffp-contract=off"
#: header file of all sources, which sets the width of a vector
VECTOR = Path(__file__).with_name("_vector.h")


class NoCompilerError(RuntimeError):
    """Raised if a C++ source cannot be compiled on this machine; the message gives the reason in
    one line.
    """


def folder() -> Path:
    """Return the folder of the compiled libraries: ``$XDG_CACHE_HOME/neusee/build``, else
    ``~/.cache/neusee/build``.

    The folder must outlive the process, so that libraries are reused. It holds no results, and no
    result depends on it.
    """
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "neusee" / "build"


def _processor() -> str:
    """Return a text that identifies the processor; it is part of the name of a library, since
    different machines may share a home folder.
    """
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    facts = [_first_line(lines, word) for word in ("model name", "flags", "Features")]
    return "\n".join([platform.platform(), platform.machine(), platform.processor(), *facts])


def _first_line(lines: list[str], word: str) -> str:
    """Return the first of the lines that begins with ``word``, or an empty text."""
    return next((line for line in lines if line.startswith(word)), "")


def _compiler() -> str:
    """Return the command of the C++ compiler; raise `NoCompilerError` if there is none."""
    compiler = (
        os.environ.get("CXX")
        or shutil.which("g++")
        or shutil.which("c++")
        or shutil.which("clang++")
    )
    if compiler is None:
        raise NoCompilerError("no C++ compiler is installed: install g++, or set CXX to a compiler")
    return compiler


def _first_error(process: subprocess.CompletedProcess[str]) -> str:
    """Return the first line of a compiler's output that contains "error", or its exit status."""
    for line in process.stderr.splitlines():
        if "error" in line:
            return line.strip()
    return f"exit status {process.returncode}"


def _compile(code: Path, rounding: str, where: Path) -> None:
    """Compile the C++ source to the file ``where``; raise `NoCompilerError` if that fails."""
    compiler = _compiler()
    try:
        where.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=where.parent) as temporary_folder:
            library = Path(temporary_folder) / where.name
            compiler_words = compiler.split()
            own_options = [word for word in compiler_words if word.startswith("-")]
            command = [
                *compiler_words,
                *FLAGS,
                rounding,
                *own_options,
                str(code),
                "-o",
                str(library),
            ]
            process = subprocess.run(
                command, capture_output=True, text=True, timeout=300, check=False
            )
            if process.returncode:
                raise NoCompilerError(f"{compiler} failed: {_first_error(process)}")
            # atomic, so that another process never reads an incomplete library
            os.replace(library, where)
    except (OSError, subprocess.SubprocessError) as error:
        raise NoCompilerError(f"{compiler} could not be run: {error}") from error


@functools.cache
def _library(
    sources: tuple[Path, ...], rounding: str, compiler: str | None, *homes: str | None
) -> ctypes.CDLL | NoCompilerError:
    """Return the compiled library, or the error if compilation failed; for each compiler and each
    of the ``homes``, which decide the folder, it is tried only once.
    """
    build = folder()
    texts = [source.read_text(encoding="utf-8") for source in (*sources, VECTOR)]
    words = [*texts, *FLAGS, rounding, compiler or "", _processor()]
    digest = hashlib.sha256(chr(0).join(words).encode()).hexdigest()[:32]
    name = f"{sources[0].stem.strip('_')}_{digest}.so"
    try:
        if not (build / name).is_file():
            _compile(sources[0], rounding, build / name)
        return ctypes.CDLL(str(build / name))
    except NoCompilerError as error:
        return error
    except OSError as error:
        return NoCompilerError(f"{build / name} cannot be loaded: {error}")


def load(*sources: Path, rounding: str = FUSED) -> ctypes.CDLL:
    """Return the library of the first source, compiled if necessary; the other sources are headers
    that it includes.

    With the rounding `UNFUSED`, a source without operations across vector lanes gives bit-identical
    results for every vector width and every compiler. Raises `NoCompilerError` if the source cannot
    be compiled.
    """
    # three names are looked up in each call; the path of the folder is made only once from them
    homes = os.environ.get("XDG_CACHE_HOME"), os.environ.get("HOME")
    library = _library(sources, rounding, os.environ.get("CXX"), *homes)
    if isinstance(library, NoCompilerError):
        raise library
    return library


def compiled(task: str, *sources: Path, rounding: str = FUSED) -> bool:
    """Return True if the library of ``task`` is available, after compilation if necessary;
    otherwise warn once and return False.
    """
    try:
        load(*sources, rounding=rounding)
    except NoCompilerError as error:
        _say_once(task, str(error))
        return False
    return True


@functools.cache
def _say_once(task: str, why: str) -> None:
    """Warn once for each task that its C++ source is not compiled and torch is used, which is
    slower.
    """
    text = f"the C++ of the {task} is not compiled and torch computes the {task} more slowly: {why}"
    warnings.warn(text, stacklevel=5)
