"""A training with any changed input begins anew and says what changed; with equal inputs it goes
on, renamed or not.

Each kind of input changes the content of a file under its old name, with its old size and time
where that can be, or one value, one line of code, one law. The folder of results is compared, which
the digest of all inputs names.
"""

import os
import re
import shutil
import sys
import uuid
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file, save_file

from neusee.nodes.losses import _restoration_losses
from neusee.nodes.restore import NAFNet, start_network
from neusee.workflows import Store, load
from neusee.workflows.training.recorded_inputs import prepare_folder
from neusee.workflows.training.resumable_loop import TrainingSession
from neusee.workflows.training.run_training import BegunTraining, UnchangedFiles, train

TINY = [
    "optics.samples=48",
    "optics.pitch=168.27 um",
    "optics.bands=3",
    "optics.window=[32, 32]",
    "scene.shape=[32, 32]",
    "sensor.shape=[24, 24]",
    "train.held_out=0.4",
]
NODE = '''\
"""A plate of glass."""

import csv
from pathlib import Path

import torch
from torch import Tensor

from {helper} import thickness_of
from neusee.nodes import node
from neusee.nodes.units import PositiveLength
from neusee.nodes.values import Stop


@node(depends=["glass.csv"])
def plate(stop: Stop, *, thickness: PositiveLength = 1e-6) -> Tensor:
    """Return an even height."""
    row = next(csv.reader((Path(__file__).parent / "glass.csv").open()))
    return torch.full(stop.amplitude.shape, thickness_of(thickness) * float(row[0]), dtype=torch.float64)
'''
HELPER = (
    '"""Glass."""\n\n\ndef thickness_of(metres):\n    """Return it."""\n    return 1.0 * metres\n'
)
NETWORK = '''\
"""A network."""

from torch import nn

from {layers} import last


class Small(nn.Module):
    """One layer."""

    def __init__(self, width=4):
        super().__init__()
        self.first, self.last = nn.Conv2d(3, width, 3, 1, 1), last(width)

    def forward(self, x):
        return x + self.last(self.first(x))
'''
LAYERS = '''\
"""Layers."""

from torch import nn


def last(width):
    """Return one."""
    return nn.Conv2d(width, 3, 1)
'''
OPTION = """\
# A plate of glass.
doe: {{thickness: 1 um}}
steps:
  height: {{node: {plates}.plate, from: stop, with: {{thickness: "${{doe.thickness}}"}}}}
"""
RECIPE = """\
# Mine.
nodes: [{plates}.py, {nets}.py]
defaults:
  [camera: neusee, scene: china, illuminant: daylight, lift: lmmse, laser: drawn, optics: small, sensor: small,
   doe: mine, flare: clean, restore: wiener, reading: coherent, train: recommended]
seed: 7
tolerance: 1e-3
outputs: [developed]
sensor: {{offset: "uniform(350 e-, 400 e-)"}}
train:
  learn: null
  photographs: photographs
  network: {{architecture: {nets}.Small, parameters: {{width: 4}}}}
"""
TABLE = "wavelength (nm),power (W/nm)\n300,{0}\n900,2\n"
CAMERA = "wavelength (nm),red,green,blue\n300,{0},1,0.2\n900,0.3,0.2,1\n"


@dataclass
class Laboratory:
    """The files of a user who trains, in a folder, and the folders of results."""

    folder: Path
    names: dict[str, str]  #: of modules
    store: Store
    runs: Path
    recipe: str = "mine.yaml"

    def path(self, name):
        return self.folder / name.format(**self.names)

    def begin(self, words):
        """Begin the training, as `train` does before its first iteration; return its folder and
        what was said.
        """
        for module in self.names.values():
            sys.modules.pop(module, None)
        recipe = load(self.path(self.recipe), [*TINY, *words], self.folder)
        lines = []
        begun = BegunTraining.of(recipe, recipe.training, self.store, self.runs)
        prepare_folder(begun.folder, begun.inputs, recipe, self.store, lines.append)
        (begun.folder / "state.pt").write_bytes(b"a checkpoint")
        return begun.folder, "\n".join(lines)

    def replace(self, name, old, new):
        """Change a text file, and give it its old times."""
        path = self.path(name)
        about, text = path.stat(), path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))
        os.utime(path, ns=(about.st_atime_ns, about.st_mtime_ns))


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return Store(tmp_path_factory.mktemp("store"))


@pytest.fixture
def lab(tmp_path, store):
    unique = uuid.uuid4().hex[:8]
    names = {name: f"{name}_{unique}" for name in ("plates", "helper", "nets", "layers")}
    folder = tmp_path / "lab"
    for below in ("photographs", "doe", "earlier"):
        (folder / below).mkdir(parents=True)
    texts = {
        "mine.yaml": RECIPE, "doe/mine.yaml": OPTION, "glass.csv": "1.0\n", "lamp.csv": TABLE.format(1),
        "camera.csv": CAMERA.format(1), "{plates}.py": NODE, "{helper}.py": HELPER, "{nets}.py": NETWORK,
        "{layers}.py": LAYERS,
    }  # fmt: skip
    for name, text in texts.items():
        filled = text.format(**names) if "{" in text else text
        (folder / name.format(**names)).write_text(filled)
    rng = np.random.default_rng(5)
    for i in range(4):
        pixels = rng.integers(0, 256, (40, 36, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / "photographs" / f"{i}.png")
    Image.fromarray(rng.integers(0, 256, (40, 36, 3), dtype=np.uint8)).save(folder / "scene.png")
    noise = rng.integers(0, 256, (640, 640, 3), dtype=np.uint8)
    Image.fromarray(noise).save(folder / "photographs" / "large.jpg", quality=95)
    np.save(folder / "m.npy", rng.uniform(0, 1e-6, (48, 48)))
    (folder / "first.safetensors").write_bytes(b"one")
    (folder / "earlier" / "network.safetensors").write_bytes(b"last")
    net = start_network(lambda: NAFNet(4), torch.Generator().manual_seed(1))
    save_file(net.state_dict(), folder / "restorer.safetensors")
    draws = "\n".join(f"{x:.6f}" for x in rng.normal(10, 1, 40))
    (folder / "draws.csv").write_text(f"read_noise [e-]\n{draws}\n")
    yield Laboratory(folder, names, store, tmp_path / "runs")
    for module in names.values():
        sys.modules.pop(module, None)
    sys.path[:] = [place for place in sys.path if not place.startswith(str(tmp_path))]


# --- what changes ---------------------------------------------------------------------------------


def another_map(lab):
    np.save(lab.path("m.npy"), np.random.default_rng(9).uniform(0, 1e-6, (48, 48)))


def inverted(name):
    def change(lab):
        path = lab.path(name)
        with Image.open(path) as image:
            other = image.point(lambda x: 255 - x)
        other.save(path)

    return change


def one_byte_within(lab):
    """The size of the file and its first and last 64 KiB stay."""
    path = lab.path("photographs/large.jpg")
    content = bytearray(path.read_bytes())
    assert len(content) > 3 * 65536
    middle = next(
        i
        for i in range(len(content) // 2, len(content))
        if 0 < content[i] < 0x7F and content[i - 1] != 0xFF
    )
    content[middle] ^= 1
    path.write_bytes(content)


def written(name, content):
    return lambda lab: lab.path(name).write_bytes(content)


def edited(name, old, new):
    return lambda lab: lab.replace(name, old, new)


def copied(old, new):
    def change(lab):
        shutil.copy(lab.path(old), lab.path(new))

    return change


def another_restorer(lab):
    net = start_network(lambda: NAFNet(4), torch.Generator().manual_seed(2))
    save_file(net.state_dict(), lab.path("restorer.safetensors"))


def another_draw(lab):
    path = lab.path("draws.csv")
    lines = path.read_text().splitlines()
    lines[7] = f"{float(lines[7]) + 0.5:.6f}"
    path.write_text("\n".join(lines) + "\n")


def another_constant_of_a_loss(lab):
    _restoration_losses._NEAR *= 2


def given(*words):
    """A change on the command line."""
    return lambda lab: words


PIXELS = ["doe=pixelwise", "doe.file=m.npy"]
KINDS = {
    "the mask": (PIXELS, another_map, r"file m\.npy: other content \(doe\.file"),
    "the mask of a further camera": (
        ["train.cameras=[[doe=pixelwise, doe.file=m.npy]]"], another_map, r"camera 2: file m\.npy: other content",
    ),
    "the map with which a mask begins": (
        ["doe=unet", "doe.grid=24", "train.learn=height", "+train.mask.start=m.npy"], another_map,
        r"file m\.npy: other content \(train\.mask\.start\)",
    ),
    "a photograph": ([], inverted("photographs/0.png"), r"photograph 0\.png: other content"),
    "a byte within a photograph": ([], one_byte_within, r"photograph large\.jpg: other content"),
    "one more photograph": ([], copied("scene.png", "photographs/new.png"), r"photograph new\.png is new"),
    "one photograph less": ([], lambda lab: lab.path("photographs/2.png").unlink(), r"photograph 2\.png is gone"),
    "the scene": (["train.photographs=null", "scene.file=scene.png"], inverted("scene.png"),
                  r"photograph scene\.png: other content"),
    "first weights": (["train.start=first.safetensors"], written("first.safetensors", b"two"),
                      r"file first\.safetensors: other content \(train\.start\)"),
    "first weights of a folder": (["train.start=earlier"], written("earlier/best.safetensors", b"best"),
                                  r"file best\.safetensors: other content \(train\.start\)"),
    "weights of the restorer": (
        ["restore=nafnet", "restore.weights=restorer.safetensors", "restore.width=4", "train.picture=restored"],
        another_restorer, r"file restorer\.safetensors: other content",
    ),
    "an own node": ([], edited("{plates}.py", "float(row[0])", "2 * float(row[0])"),
                    r"code of plate\(\) in plates_\w+\.py changed"),
    "what an own node imports": ([], edited("{helper}.py", "1.0", "1.5"),
                                 r"code of thickness_of\(\) in helper_\w+\.py changed"),
    "what an own node declares": ([], written("glass.csv", b"1.1\n"), r"declared file glass\.csv changed"),
    "an own network": ([], edited("{nets}.py", "x + self", "x - self"), r"class Small in nets_\w+\.py changed"),
    "what an own network imports": ([], edited("{layers}.py", "3, 1)", "3, 1, bias=False)"),
                                    r"code of last\(\) in layers_\w+\.py changed"),
    "an option of a group": ([], edited("doe/mine.yaml", "1 um", "2 um"), r"doe\.thickness 1 -> 2 um"),
    "a light": (["illuminant.kind=lamp.csv"], written("lamp.csv", TABLE.format(3).encode()),
                r"file lamp\.csv: other content"),
    "a sensor": (["sensor.camera=camera.csv"], written("camera.csv", CAMERA.format(2).encode()),
                 r"file camera\.csv: other content"),
    "draws of a calibration": (["posterior=draws.csv"], another_draw, r"posterior"),
    "a law": ([], edited("mine.yaml", "400 e-", "410 e-"), r"sensor\.offset .*400 e-\) -> .*410 e-\)"),
    "a law of the true camera": ([], given("train.mismatch={sensor.read_noise: 'normal(0 e-, 1 e-)'}"),
                                 r"train\.mismatch\.sensor\.read_noise no law -> normal\(0 e-, 1 e-\)"),
    "a setting": ([], given("train.rates.weights=1e-3"), r"train\.rates\.weights 0\.0002 -> 0\.001"),
    "the seed": ([], given("seed=8"), r"seed 7 -> 8"),
    "the tolerance": ([], given("tolerance=1e-4"), r"tolerance 0\.001 -> 0\.0001"),
    "code of neusee": ([], another_constant_of_a_loss, r"losses"),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_changed_input_begins_anew_and_is_named(lab, kind, monkeypatch):
    words, change, said = KINDS[kind]
    monkeypatch.setattr(_restoration_losses, "_NEAR", _restoration_losses._NEAR)
    first, nothing = lab.begin(words)
    assert nothing == ""
    more = change(lab) or ()
    again, lines = lab.begin([*words, *(more if isinstance(more, tuple) else ())])
    assert again != first
    assert (
        f"begins anew, because its inputs are not those of {first.name}, which stays as it is:"
        in lines
    )
    assert re.search(said, lines), lines
    assert len(lines.splitlines()) <= 4, "nothing else changed"


def test_equal_files_are_the_same_training_wherever_they_are_and_whatever_they_are_called(lab):
    words = [*PIXELS, "train.start=first.safetensors", "illuminant.kind=lamp.csv"]
    first, _ = lab.begin(words)
    assert lab.begin(words) == (first, "")
    for i in range(4):
        lab.path(f"photographs/{i}.png").rename(lab.path(f"photographs/{9 - i}_renamed.png"))
    for old, new in (
        ("m.npy", "n.npy"),
        ("first.safetensors", "1.safetensors"),
        ("lamp.csv", "l.csv"),
    ):
        lab.path(old).rename(lab.path(new))
    lab.path("mine.yaml").rename(lab.path("yours.yaml"))
    lab.path("doe/mine.yaml").rename(lab.path("doe/plate.yaml"))
    lab.replace("yours.yaml", "doe: mine", "doe: plate")
    moved = lab.folder.with_name("moved")
    sys.path[:] = [place for place in sys.path if place != str(lab.folder)]
    lab.folder.rename(moved)
    lab.folder, lab.recipe = moved, "yours.yaml"
    words = [
        "doe=pixelwise",
        "doe.file=n.npy",
        "train.start=1.safetensors",
        "illuminant.kind=l.csv",
    ]
    assert lab.begin(words) == (first, "")


@pytest.mark.slow
@pytest.mark.parametrize(
    "word", ["outputs=[truth]", "train.show=7", "train.keep=9", "train.tensorboard=false"]
)
def test_what_changes_no_weight_is_no_input(lab, word):
    first, _ = lab.begin([])
    assert lab.begin([word]) == (first, "")


def test_a_checkpoint_without_inputs_is_not_continued(lab):
    silent = lab.runs / "mine_train_0123abcd"
    silent.mkdir(parents=True)
    (silent / "state.pt").write_bytes(b"a checkpoint")
    folder, lines = lab.begin([])
    assert folder != silent
    assert "does not go on with mine_train_0123abcd" in lines


def test_code_that_reads_what_no_key_sees_is_refused_before_a_training(lab):
    lab.replace("{nets}.py", "from torch import nn\n", "import os\n\nfrom torch import nn\n")
    lab.replace(
        "{nets}.py", "return x + self", "return x * float(os.environ.get('SCALE', '1')) + self"
    )
    with pytest.raises(
        ValueError,
        match=r"train\.network\.architecture .*nets_\w+\.py:\d+: os\.environ.*a cache key",
    ):
        lab.begin([])


# --- while it runs --------------------------------------------------------------------------------


def test_a_photograph_that_is_changed_or_gone_while_a_training_runs_stops_it(tmp_path):
    """A new time alone is no change."""
    paths = [tmp_path / "a.png", tmp_path / "b.png"]
    for path in paths:
        path.write_bytes(b"picture " + path.name.encode())
    files = UnchangedFiles.of(paths)
    os.utime(paths[0], ns=(1, 1))
    files.require()
    paths[1].write_bytes(b"Picture b.png")
    with pytest.raises(
        ValueError,
        match=r"the photograph .*b\.png has another content now, after this training began",
    ):
        files.require()
    paths[1].unlink()
    with pytest.raises(ValueError, match=r"b\.png cannot be read any more \(No such file"):
        files.require()


WHOLE = [
    "train.learn=null",
    "train.network={kind: unet, width: 4}",
    "train.critics.width=4",
    "train.keep=1",
    "doe=flat",
    "train.stages.2.iterations=3",
    "train.stages.2.batch=1",
    "train.stages.2.adversarial=0",
    "train.average=0",
    "train.validate_every=9",
]


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_an_interrupted_training_with_renamed_photographs_goes_on_to_the_same_weights(lab):
    """And the network of other photographs under the old names is another one, which begins at
    the beginning.
    """

    def trained(runs, watch=None):
        recipe = load(
            "train_small", [*TINY, *WHOLE, f"train.photographs={lab.path('photographs')}"]
        )
        lines = []
        folder = train(
            recipe, TrainingSession(lab.store, lab.folder / runs, lines.append, watch=watch), (2,)
        )
        return folder, "\n".join(lines)

    def stopped(stage, done, losses):
        if done == 2:
            raise KeyboardInterrupt

    whole, _ = trained("whole")
    with pytest.raises(KeyboardInterrupt):
        trained("parts", stopped)
    photographs = sorted(lab.path("photographs").iterdir())
    for place, path in enumerate(photographs):  # the last by name becomes the first
        path.rename(path.with_name(f"z_{len(photographs) - place}{path.suffix}"))
    again, lines = trained("parts")
    assert "continues in stage 2 after 1 iterations" in lines
    assert again.name == whole.name
    assert (again / "network.safetensors").read_bytes() == (
        whole / "network.safetensors"
    ).read_bytes()
    for path in lab.path("photographs").glob("*.png"):
        inverted(f"photographs/{path.name}")(lab)
    other, lines = trained("parts")
    assert other != again
    assert "other content" in lines
    assert "continues" not in lines
    assert (other / "network.safetensors").read_bytes() != (
        whole / "network.safetensors"
    ).read_bytes()


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_another_mask_in_the_folder_of_a_training_is_not_that_of_its_second_stage(lab):
    stages = [
        "train.stages.1={iterations: 1, batch: 1, adversarial: 0}",
        "train.stages.2.iterations=1",
    ]
    words = [
        *TINY,
        *WHOLE,
        "doe=unet",
        "doe.grid=24",
        "train.learn=height",
        *stages,
        "train.held_out=null",
        f"train.photographs={lab.path('photographs')}",
    ]
    recipe = load("train_small", words)

    def trained(*numbers):
        return train(recipe, TrainingSession(lab.store, lab.runs, lambda line: None), numbers)

    file = trained(1) / "mask.safetensors"
    before = file.read_bytes()
    save_file({"height": load_file(file)["height"] * 1.1}, file)
    with pytest.raises(
        ValueError,
        match=r"mask\.safetensors has another content than the mask behind which stage 2",
    ):
        trained(2)
    file.write_bytes(before)
    assert (trained(2) / "training.json").is_file()
