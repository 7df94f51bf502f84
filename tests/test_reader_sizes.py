"""Every reader of a file states its size: which memory it needs is known before anything is
allocated.

A function that calls a reader of a library, or opens a file, must call one of `STATES` as well, or
stand in `NO_SIZE` with the reason why the file cannot be one of a stranger.
"""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = sorted([*ROOT.glob("nodes/**/*.py"), *ROOT.glob("workflows/**/*.py")])

#: functions that compare the bytes of a file with the memory that is left, or read a file that they
#: have compared
STATES = re.compile(
    r"(needs|picture_needs|pages_need|tiff_needs|exr_needs|npy_needs|npz_needs|archive_needs|safetensors_need|"
    r"mat_needs|fits_needs|hdf5_needs|bytes_of|text_of|lines_of|head_of|opened)"
)
#: functions of libraries that read a file of pictures, arrays or tables, by the end of what is
#: called
READERS = re.compile(
    r"(.*\.)?(load_file|safe_open|loadmat|whosmat|HDFBackend|ZipFile|read_image_\w+|fromfile|memmap|loadtxt|"
    r"genfromtxt|imread|imopen|read_csv|read_excel|read_table|open_dataset|open_dataarray|open_mfdataset|from_netcdf|"
    r"load_dataset|read_bytes|read_text|DictReader|safe_load|TiffFile|RawImage|read_json)|"
    r"(np|numpy|torch|torch\.export|torch\.jit|torch\.package|pickle|joblib|marshal|scipy\.io|iio|imageio)\.load|"
    r"(Image|PIL\.Image|fits|os|io|codecs|gzip|bz2|lzma|tarfile|wave|iio|imageio|shelve|webp)\.open|open|"
    r"OpenEXR\.\w*File|h5py\.File|csv\.reader|\w+\.open|(self\.)?\w*path\w*\.open|(np\.)?lib\.format\.read_array"
)
#: the last parts of these names
LAST = re.compile(
    r"(load|open|File|InputFile|reader|load_file|safe_open|loadmat|whosmat|HDFBackend|ZipFile|read_\w+|fromfile|memmap|"
    r"loadtxt|genfromtxt|im\w+|open_\w+|from_netcdf|load_dataset|DictReader|safe_load|TiffFile|RawImage)"
)
WRITES = re.compile(r"[wxa][bt+]*")

#: functions that need state no size, each with the reason: the file is one of the program, or of
#: the system
SYSTEM = "the system answers in a few kilobytes"
SOURCE = "source code that is installed, or that the user runs"
PACKAGED = "a file of the package"
OWN = "a file that this function has just written"
WRITTEN = "it writes, and reads nothing"
HEADER = "the header alone; what reads the numbers states their size"
CHECKED = "the caller has compared all that the archive holds"
STORE = (
    "a file of the cache, opened without waiting, whose length its record states or whose kind has"
    " a limit"
)
OPENS = "it opens the file for others, without waiting for a pipe"
DIGEST = "a digest, in pieces of a few kilobytes, opened without waiting"
NO_SIZE = {
    "nodes/cpp_library.py:_library": SOURCE,
    "nodes/cpp_library.py:_processor": SYSTEM,
    "nodes/calibrate/_frame_files.py:_header_of_fits": HEADER,
    "nodes/calibrate/_frame_files.py:fits_header": HEADER,
    "nodes/calibrate/_frame_files.py:fits_image": HEADER,
    "nodes/input_files.py:free_memory": SYSTEM,
    "nodes/input_files.py:opened": OPENS,
    "nodes/own_modules.py:_imported_tops": SOURCE,
    "nodes/restore/networks/_network_files.py:_check_member": CHECKED,
    "nodes/restore/networks/_network_files.py:_checked": CHECKED,
    "nodes/restore/networks/_network_files.py:exported_network": CHECKED,
    "workflows/answers/repeated_command.py:_devices": SYSTEM,
    "workflows/answers/repeated_command.py:program_state": SOURCE,
    "workflows/answers/witnesses.py:_digest_of_results": DIGEST,
    "workflows/answers/witnesses.py:file_digest": DIGEST,
    "workflows/calibration/emcee_sampler.py:_write": OWN,
    "workflows/engine/step_process.py:_called": (
        "a file in memory that the fork of this function has just written"
    ),
    "workflows/calibration/emcee_sampler.py:_write_draws": WRITTEN,
    "workflows/cli/catalogue.py:_uses": PACKAGED,
    "workflows/cli/catalogue.py:glossary_lines": PACKAGED,
    "workflows/cli/handbook_command.py:handbook": WRITTEN,
    "workflows/cli/handbook_reference.py:uses_of_nodes": PACKAGED,
    "workflows/cli/project_commands.py:_write_start": PACKAGED,
    "workflows/engine/cost_model.py:_file": PACKAGED,
    "workflows/engine/machine_resources.py:_free_memory": SYSTEM,
    "workflows/engine/machine_resources.py:_reclaimable": SYSTEM,
    "workflows/engine/machine_resources.py:resident": SYSTEM,
    "workflows/engine/machine_resources.py:process_memory": SYSTEM,
    "workflows/engine/machine_resources.py:there_is": SYSTEM,
    "workflows/engine/machine_resources.py:free_processors": SYSTEM,
    "workflows/engine/processor_speed.py:_model": SYSTEM,
    "workflows/observation/system_calls.py:memory": SYSTEM,
    "workflows/observation/system_calls.py:status": SYSTEM,
    "workflows/explain/change_causes.py:_lines": SOURCE,
    "workflows/frames/frame_folder.py:_read_folder": "read_table of frames, whose lines `csv_rows` reads",
    "workflows/handbook/site_build.py:read_pages": PACKAGED,
    "workflows/keys/module_digest.py:module": SOURCE,
    "workflows/keys/code_digest.py:engine": SOURCE,
    "workflows/keys/module_digest.py:_edited": SOURCE,
    "workflows/keys/module_digest.py:source_of": SOURCE,
    "workflows/keys/module_origin.py:_text": SOURCE,
    "workflows/keys/loaded_state.py:workflows_digest": SOURCE,
    "workflows/keys/sealed_files.py:opened": OPENS,
    "workflows/recipe/remembered_checks.py:edition_of_code": SOURCE,
    "workflows/recipe/text/other_spellings.py:module": PACKAGED,
    "workflows/report/contents.py:module": PACKAGED,
    "workflows/report/run_crate.py:_samples": PACKAGED,
    "workflows/report/data_exports.py:exr": WRITTEN,
    "workflows/report/paper_readings.py:module": PACKAGED,
    "workflows/report/run_folder.py:compiled": PACKAGED,
    "workflows/simulation/simulate_recipe.py:_write": OWN,
    "workflows/store/derived_files.py:_digest": DIGEST,
    "workflows/store/cache_settings.py:_is_checkout": SOURCE,
    "workflows/store/journal.py:_newest_lines": STORE,
    "workflows/store/journal.py:_opened": OPENS,
    "workflows/store/journal.py:_read_new_lines": STORE,
    "workflows/store/journal.py:totals": STORE,
    "workflows/store/lease.py:_state_of_lease": STORE,
    "workflows/store/eviction.py:pin": WRITTEN,
    "workflows/store/shared_folder.py:_process": SYSTEM,
    "workflows/store/shared_folder.py:host": SYSTEM,
    "workflows/store/remote_store.py:_fetched": OWN,
    "workflows/store/serialization.py:read": STORE,
    "workflows/store/shared_folder.py:_abandoned": STORE,
    "workflows/store/shared_folder.py:_lock_file": WRITTEN,
    "workflows/store/shared_folder.py:_opened_folder": OPENS,
    "workflows/store/shared_folder.py:append": WRITTEN,
    "workflows/store/shared_folder.py:open_now": OPENS,
    "workflows/store/shared_folder.py:read_file": STORE,
    "workflows/store/payload.py:_read_new_lines": STORE,
    "workflows/training/lift_training.py:lift_inputs": SOURCE,
    "workflows/training/design_run.py:design_inputs": SOURCE,
    "workflows/training/run_training.py:_code": SOURCE,
    "workflows/training/training_page.py:write_page": OWN,
}

# --- what a file says -----------------------------------------------------------------------------


def functions(tree):
    """Every innermost function with its name and all that stands in it; what stands outside is
    in ``module``.
    """
    inner = {ast.FunctionDef, ast.AsyncFunctionDef}
    found = []

    def walk(item, name, items):
        for child in ast.iter_child_nodes(item):
            if type(child) in inner:
                own = []
                label = child.name if child.name != "_" else ast.unparse(child.decorator_list[0])
                found.append((label, own))
                walk(child, label, own)
            else:
                items.append(child)
                walk(child, name, items)

    top = []
    found.append(("module", top))
    walk(tree, "module", top)
    return found


def reads(items):
    """The readers in a function: what is called, and what is only named, such as a function of a
    table of readers.
    """
    calls = {id(item.func): item for item in items if isinstance(item, ast.Call)}
    for item in items:
        # the text of every item takes seconds
        if not LAST.fullmatch(getattr(item, "attr", getattr(item, "id", ""))):
            continue
        if id(item) in calls:
            is_reader = READERS.fullmatch(ast.unparse(item)) and not _writes(calls[id(item)])
        else:
            is_reader = isinstance(item, ast.Attribute) and _is_handed_on(item)
        if is_reader:
            yield ast.unparse(item)


def _is_handed_on(item):
    return re.fullmatch(
        r"(np|numpy|torch)\.load|\w+\.(read_image_\w+|load_file|loadmat|imread)", ast.unparse(item)
    )


def _writes(call):
    """Whether a call opens a file to write it, by its mode."""
    modes = [*call.args[:2], *(word.value for word in call.keywords if word.arg == "mode")]
    texts = [m.value for m in modes if isinstance(m, ast.Constant) and isinstance(m.value, str)]
    return any(WRITES.fullmatch(text) for text in texts)


def stateless(path, tree):
    """The functions of a file that read and state no size: ``file:function`` with what they
    call.
    """
    for name, items in functions(tree):
        found = sorted(set(reads(items)))
        called = {
            getattr(item.func, "attr", getattr(item.func, "id", ""))
            for item in items
            if type(item) is ast.Call
        }
        if found and not any(map(STATES.fullmatch, called)):
            yield f"{path.relative_to(ROOT).as_posix()}:{name}", found


def parsed(path):
    return ast.parse(path.read_text())


# --- the tests ------------------------------------------------------------------------------------


def test_every_reader_states_its_size():
    found = {where: what for path in FILES for where, what in stateless(path, parsed(path))}
    assert {where: what for where, what in found.items() if where not in NO_SIZE} == {}
    assert set(NO_SIZE) <= set(found), "an entry that is needed no longer"


@pytest.mark.parametrize(
    "code",
    [
        "def _new(file):\n    import tifffile\n    return tifffile.imread(file)",
        "def _new(file):\n    return np.load(file)",
        "def _new(file):\n    with Image.open(file) as picture:\n        return np.array(picture)",
        "def _new(file):\n    return OpenEXR.File(str(file), separate_channels=True)",
        "def _new(file):\n    with h5py.File(file) as opened:\n        return opened['x'][...]",
        "def _new(file):\n    return fits.open(file)[0].data",
        "def _new(file):\n    return json.loads(file.read_text())",
        "def _new(file):\n    return torch.load(file, weights_only=True)",
        "def _new(file):\n    return [line for line in open(file)]",
        "_NEW = {'.npy': np.load}",
        "def _new(file):\n    read = io.read_image_tiff_u16\n    return read(str(file), 'mono')",
    ],
    ids=lambda code: code.splitlines()[-1].strip()[:40],
)
def test_a_new_reader_without_a_size_is_found(code):
    path = ROOT / "nodes" / "scene" / "_photograph.py"
    assert len(list(stateless(path, ast.parse(f"{path.read_text()}\n\n{code}\n")))) == 1


def test_a_reader_that_states_its_size_is_none_of_them():
    code = "def _new(file):\n    npy_needs(file, 1.0)\n    return np.load(file)\n"
    assert not list(stateless(ROOT / "nodes" / "new.py", ast.parse(code)))
    assert not list(
        stateless(
            ROOT / "nodes" / "new.py", ast.parse("def _new(file):\n    open(file, 'wb').write(b'')")
        )
    )
