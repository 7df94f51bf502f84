"""Files of torch.export: what they may hold, the sizes they take, and that no pickle of such a
file runs.
"""

import io
import os
import zipfile

import pytest
import torch
from torch import nn

from neusee.nodes import ParameterError, restore

pytestmark = pytest.mark.slow  # torch.export takes seconds to load


class Net(nn.Module):
    def __init__(self):
        super().__init__()
        torch.manual_seed(1)
        self.first, self.last = nn.Conv2d(3, 4, 3, 2, 1), nn.ConvTranspose2d(4, 3, 2, 2)
        self.norm = nn.BatchNorm2d(4)

    def forward(self, image):
        return image + self.last(torch.relu(self.norm(self.first(image))))


def saved(net, path, *shape, dynamic=False, dtype=torch.float32):
    sizes = None
    if dynamic:
        y, x = torch.export.Dim("y", min=4, max=100), torch.export.Dim("x", min=4, max=100)
        sizes = ({2: 2 * y, 3: 2 * x},)
    whole = torch.export.export(net, (torch.rand(*shape, dtype=dtype),), dynamic_shapes=sizes)
    torch.export.save(whole, path)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("exported")
    saved(Net().eval(), folder / "any.pt2", 1, 3, 32, 48, dynamic=True)
    saved(Net().eval(), folder / "fixed.pt2", 1, 3, 32, 32)
    return folder


def ready(folder, name="any.pt2", *sizes, **more):
    """Check a file as before a run."""
    picture = torch.empty(3, *sizes, device="meta") if sizes else None
    return restore.network.hooks.preflight(weights=folder / name, picture=picture, **more)


def test_a_file_restores_like_the_network_that_it_was_made_from(folder):
    assert ready(folder, "any.pt2", 51, 70) == [
        "any.pt2 of torch.export holds the operations of a network, which this recipe runs"
    ]
    picture = torch.rand(3, 51, 70)
    found = restore.network(picture, weights=folder / "any.pt2")
    padded = torch.nn.functional.pad(picture[None], (0, 0, 0, 1), "reflect")
    with torch.no_grad():
        assert torch.equal(found, Net().eval()(padded)[0, :, :51])
    tiled = restore.network(torch.rand(3, 40, 50), weights=folder / "fixed.pt2", tile=32)
    assert tiled.shape == (3, 40, 50)


@pytest.mark.parametrize(
    ("name", "sizes", "more", "message"),
    [
        (
            "fixed.pt2",
            (40, 32),
            {},
            "fixed.pt2 takes pictures with 32 pixels along y, and gets 40: .* write tile: 32",
        ),
        (
            "any.pt2",
            (40, 300),
            {},
            "any.pt2 takes pictures with 8 to 200, by 2 pixels along x, and gets 300",
        ),
        (
            "any.pt2",
            (33, 33),
            {"multiple": 1},
            "any.pt2 takes pictures with .* along y, and gets 33",
        ),
        (
            "any.pt2",
            (40, 40),
            {"parameters": {"width": 1}},
            "any.pt2 of torch.export holds its own network: remove pa",
        ),
    ],
)
def test_sizes_that_a_file_does_not_take_are_a_mistake(name, sizes, more, message, folder):
    with pytest.raises(ParameterError, match=message):
        ready(folder, name, *sizes, **more)
    ready(folder, "fixed.pt2", 40, 50, tile=32)


class Command:
    """An object whose unpickling runs a command."""

    def __init__(self, file):
        self.file = file

    def __reduce__(self):
        return os.system, (f"touch {self.file}",)


def changed(folder, name, change, more=()):
    """Write a copy of ``any.pt2`` with other content."""
    with zipfile.ZipFile(folder / "any.pt2") as old, zipfile.ZipFile(folder / name, "w") as new:
        for member in old.namelist():
            new.writestr(member, change(member, old.read(member)))
        for member in more:
            new.writestr(member, b"")
    return name


def in_graph(old, new):
    def change(member, data):
        assert not member.endswith("model.json") or "config" in member or old in data
        return data.replace(old, new)

    return change


def test_a_pickle_that_runs_a_command_is_refused(folder, tmp_path):
    evil = io.BytesIO()
    torch.save((Command(tmp_path / "ran"),), evil)
    inputs = next(n for n in zipfile.ZipFile(folder / "any.pt2").namelist() if n.endswith(".pt"))
    changed(folder, "evil.pt2", lambda member, data: evil.getvalue() if member == inputs else data)
    with pytest.raises(
        ParameterError,
        match=r"evil.pt2 holds a pickle with more than tensors \(.*\), which could run",
    ):
        ready(folder, "evil.pt2")
    with pytest.raises(ParameterError):
        restore.network(torch.rand(3, 40, 40), weights=folder / "evil.pt2")
    assert not (tmp_path / "ran").exists()
    evil.seek(0)
    # as torch.export.load does, at once or where the limited way fails
    torch.load(evil, weights_only=False)
    assert (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    ("change", "more", "message"),
    [
        (
            in_graph(b"torch.ops.aten.relu.default", b"torch.hub.load"),
            (),
            "calls torch.hub.load, and only operators of",
        ),
        (
            in_graph(b"torch.ops.aten.relu.default", b"torch.ops.aten.from_file.default"),
            (),
            "calls torch.ops.aten.fr",
        ),
        (
            in_graph(b"torch.ops.aten.relu.default", b"_operator.attrgetter"),
            (),
            "calls _operator.attrgetter",
        ),
        (
            in_graph(b"Mul(Integer(2)", b"Mul(__import__('os')"),
            (),
            "has a formula of sizes with other names: Mul",
        ),
        (
            in_graph(b'\\"builtins.tuple\\"', b'\\"collections.x\\"'),
            (),
            "takes or returns a collections.x",
        ),
        (
            lambda member, data: data,
            ["any/data/aotinductor/model/x.so"],
            "holds a compiled program",
        ),
        (in_graph(b'"use_pickle": false', b'"use_pickle": true'), (), "holds a pickle"),
        (
            lambda member, data: b"{" if member.endswith("models/model.json") else data,
            (),
            "is no file of torch.export",
        ),
        (in_graph(b'"tensor_values"', b'"others"'), (), "has a graph of an unknown form"),
    ],
)
def test_what_could_run_code_is_refused(change, more, message, folder, request):
    if "use_pickle" in message or message == "holds a pickle":
        names = zipfile.ZipFile(folder / "any.pt2").namelist()
        assert any("config.json" in name for name in names)
        old = change

        def change(member, data):
            return old("", data) if member.endswith("config.json") else data

    name = changed(folder, f"changed{abs(hash(request.node.name))}.pt2", change, more)
    with pytest.raises(ParameterError, match=message):
        ready(folder, name)


def test_a_damaged_a_short_and_another_file_are_refused(folder):
    whole = (folder / "any.pt2").read_bytes()
    (folder / "short.pt2").write_bytes(whole[: len(whole) // 2])
    (folder / "text.pt2").write_text("no network")
    flipped = bytearray(whole)
    with zipfile.ZipFile(folder / "any.pt2") as archive:
        member = next(item for item in archive.infolist() if item.filename.endswith("weight_0"))
    flipped[whole.index(member.filename.encode()) + len(member.filename) + 80] ^= 1
    (folder / "flipped.pt2").write_bytes(bytes(flipped))
    torch.save(Net().state_dict(), folder / "state.pt2")
    for name, message in {
        "short.pt2": "a part of it is missing",
        "text.pt2": "is no file of torch.export",
        "flipped.pt2": "flipped.pt2 is damaged: copy the file again",
        "state.pt2": "is no file of torch.export: write it by torch.export.save",
    }.items():
        with pytest.raises(ParameterError, match=message):
            ready(folder, name)


class Four(Net):
    def forward(self, image):
        return super().forward(image[:, :3])


class Half(Net):
    def forward(self, image):
        return super().forward(image)[..., ::2]


class Two(Net):
    def forward(self, image):
        return super().forward(image), image


class Noisy(Net):
    def forward(self, image):
        return super().forward(image) + torch.rand_like(image)


@pytest.mark.parametrize(
    ("net", "shape", "dtype", "message"),
    [
        (
            Four().eval(),
            (1, 4, 32, 32),
            torch.float32,
            "takes pictures 1 x 4 x 32 x 32, and a colour picture is 1 x 3",
        ),
        (
            Half().eval(),
            (1, 3, 32, 32),
            torch.float32,
            "returns 1 x 3 x 32 x 16 for a picture of other sizes",
        ),
        (Two().eval(), (1, 3, 32, 32), torch.float32, "takes 1 inputs and returns 2 results"),
        (
            Net().train(),
            (1, 3, 32, 32),
            torch.float32,
            r"was exported in training mode: call eval\(\)",
        ),
        (Net().eval().double(), (1, 3, 32, 32), torch.float64, "other numbers than float32"),
        (Noisy().eval(), (1, 3, 32, 32), torch.float32, "gives other numbers for the same picture"),
    ],
)
def test_a_network_that_is_no_restorer_is_refused(net, shape, dtype, message, tmp_path):
    saved(net, tmp_path / "net.pt2", *shape, dtype=dtype)
    with pytest.raises(ParameterError, match=message):
        ready(tmp_path, "net.pt2")
