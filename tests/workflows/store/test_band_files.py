"""Blobs: one file a band, one tensor over many of them, and never a wrong byte."""

import gc
import json
import math
import os
import threading
from itertools import product
from pathlib import Path

import pytest
import torch

from neusee.nodes.values import Psf
from neusee.workflows.store import band_files, serialization
from neusee.workflows.store.band_files import Blobs, Damaged, Stacked, bytes_of
from neusee.workflows.store.metadata import checked_layout

PAGES = (4, 32, 64)  #: float32 slices of two pages
DTYPES = [*serialization._DTYPES, torch.complex64, torch.complex128]


@pytest.fixture
def blobs(tmp_path):
    return Blobs(tmp_path / "bands")


def stack(*shape, dtype=torch.float32):
    raw = torch.randint(0, 2, (*shape[:-1], shape[-1] * dtype.itemsize), dtype=torch.uint8)
    return raw.view(dtype)


def names_of(x):
    return [f"{i:02x}{id(x):030x}.0" for i in range(len(x))]


def kept(blobs, x):
    names = names_of(x)
    for name, part in zip(names, x, strict=True):
        blobs.write(name, part)
    return names


def file_of(blobs, name):
    return blobs.root / name[:2] / name


def bits(x):
    return bytes(x.contiguous().reshape(-1).view(torch.uint8).numpy())


def maps():
    path = Path("/proc/self/maps")
    return (
        path.read_text()
        if path.exists()
        else pytest.skip("this system does not show what is mapped")
    )


def test_every_type_comes_back_in_one_piece(tmp_path):
    shapes, wrong = [(3, 32, 128), (3, 7, 5), (1, 1), (2, 4096)], []
    for number, (dtype, shape) in enumerate(product(DTYPES, shapes)):
        blobs, x = Blobs(tmp_path / str(number) / "bands"), stack(*shape, dtype=dtype)
        found = Blobs(blobs.root).read(kept(blobs, x), x.shape, dtype)
        right = (found.dtype, found.shape, bits(found)) == (dtype, x.shape, bits(x))
        if not (right and found.is_contiguous() and found.data_ptr() % 64 == 0):
            wrong.append((dtype, shape))
    assert wrong == []


@pytest.mark.parametrize("shape", [(0, 3), (3, 0), (0,)])
def test_what_is_empty_needs_no_file(blobs, shape):
    x = torch.empty(shape)
    assert blobs.read(names_of(x), shape, x.dtype).shape == x.shape


def test_scalars_of_each_band_come_back(blobs):
    x = torch.rand(5, dtype=torch.float64)
    assert torch.equal(blobs.read(kept(blobs, x), (5,), x.dtype), x)


def test_any_order_and_repetition_is_a_stack(blobs):
    x = stack(*PAGES)
    names = kept(blobs, x)
    which = [2, 0, 0, 3, 2]
    assert torch.equal(blobs.read([names[i] for i in which], (5, 32, 64), x.dtype), x[which])


def test_a_slice_of_whole_pages_is_mapped_and_any_other_copied(blobs):
    mapped, copied = (
        blobs.read(kept(blobs, x), x.shape, x.dtype) for x in (stack(*PAGES), stack(4, 32, 63))
    )
    assert maps().count(str(blobs.root)) == 4
    assert mapped.untyped_storage().nbytes() == mapped.nbytes
    del copied
    part = mapped[1]
    del mapped
    gc.collect()
    assert maps().count(str(blobs.root)) == 4, "a view holds the memory"
    assert float(part.sum()) == float(part.clone().sum())
    del part
    assert str(blobs.root) not in maps()


@pytest.mark.parametrize("size", [64, 63])
def test_writing_to_a_loaded_tensor_leaves_the_store_alone(blobs, size):
    x = stack(4, 32, size)
    names = kept(blobs, x)
    first, second = (blobs.read(names, x.shape, x.dtype) for _ in range(2))
    first.fill_(7.0)
    assert torch.equal(second, x)
    assert torch.equal(Blobs(blobs.root).read(names, x.shape, x.dtype), x)


def test_a_tensor_outlives_the_files_it_was_mapped_from(blobs):
    x = stack(*PAGES)
    names = kept(blobs, x)
    found = blobs.read(names, x.shape, x.dtype)
    for name in names:
        os.unlink(file_of(blobs, name))
    assert torch.equal(found, x)


@pytest.mark.parametrize("lacking", ["no libc", "no maps"])
def test_where_nothing_can_be_mapped_it_is_copied(blobs, monkeypatch, lacking):
    def refuse(*args):
        raise OSError(19, "no such device")

    x = stack(*PAGES)
    names = kept(blobs, x)
    monkeypatch.setattr(
        band_files, *(("_LIBC", None) if lacking == "no libc" else ("_map", refuse))
    )
    found = blobs.read(names, x.shape, x.dtype)
    assert str(blobs.root) not in maps()
    assert torch.equal(found, x)


def flip(data, at):
    data[at] ^= 1


DAMAGES = {
    "one bit of a value": lambda data: flip(data, 5),
    "one bit of the checksum": lambda data: flip(data, -10),
    "the last byte": lambda data: flip(data, -1),
    "half is gone": lambda data: data.__delitem__(slice(len(data) // 2, None)),
    "all is gone": lambda data: data.clear(),
    "zeros": lambda data: data.__setitem__(slice(None), bytes(len(data))),
    "longer": lambda data: data.extend(b"more"),
    "another shape": lambda data: data.__setitem__(slice(None), data.replace(b"[32, 6", b"[64, 3")),
}


@pytest.mark.parametrize("size", [64, 63])
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_blob_is_put_aside_and_can_be_written_again(blobs, damage, size):
    x = stack(4, 32, size)
    names = kept(blobs, x)
    path = file_of(blobs, names[2])
    data = bytearray(path.read_bytes())
    DAMAGES[damage](data)
    path.write_bytes(data)
    blobs = Blobs(blobs.root)
    with pytest.raises(Damaged, match=names[2]):
        blobs.read(names, x.shape, x.dtype)
    assert [blobs.has(name) for name in names] == [True, True, False, True]
    assert (blobs.root.parent / "bad" / names[2]).read_bytes() == data
    blobs.write(names[2], x[2])
    assert torch.equal(blobs.read(names, x.shape, x.dtype), x)


def test_a_missing_blob_is_said_to_be(blobs):
    x = stack(*PAGES)
    names = kept(blobs, x)
    os.unlink(file_of(blobs, names[1]))
    with pytest.raises(Damaged, match=names[1]):
        blobs.read(names, x.shape, x.dtype)


def test_what_cannot_be_moved_away_is_missing_all_the_same(blobs):
    x = stack(*PAGES)
    names = kept(blobs, x)
    (blobs.root.parent / "bad").write_text("in the way")
    path = file_of(blobs, names[0])
    path.write_bytes(b"short")
    with pytest.raises(Damaged):
        blobs.read(names, x.shape, x.dtype)
    assert path.exists()
    assert not blobs.has(names[0])
    blobs.write(names[0], x[0])
    assert torch.equal(blobs.read(names, x.shape, x.dtype), x)


def test_unverified_a_flipped_bit_goes_unseen_but_a_wrong_size_does_not(blobs):
    x = stack(*PAGES)
    names = kept(blobs, x)
    path = file_of(blobs, names[0])
    data = bytearray(path.read_bytes())
    data[0] ^= 1
    path.write_bytes(data)
    assert not torch.equal(blobs.read(names, x.shape, x.dtype, verify=False), x)
    path.write_bytes(data[:-8])
    with pytest.raises(Damaged):
        blobs.read(names, x.shape, x.dtype, verify=False)


def test_the_first_content_of_a_name_stays(blobs):
    first, second = stack(*PAGES), stack(*PAGES) + 2
    written = blobs.write("ab.0", first[0])
    assert blobs.write("ab.0", second[0]) == written == blobs.about("ab.0").xxh3
    assert torch.equal(Blobs(blobs.root).read(["ab.0"], (1, 32, 64), first.dtype)[0], first[0])


def test_equal_bytes_of_another_shape_have_another_checksum(blobs):
    x = torch.zeros(8, 8)
    assert blobs.write("aa.0", x) != blobs.write("bb.0", x.reshape(4, 16))


def test_many_writers_of_one_name_leave_one_whole_blob(blobs):
    x = stack(1, 64, 64)
    digests = []
    threads = [
        threading.Thread(target=lambda: digests.append(Blobs(blobs.root).write("ab.0", x[0])))
        for _ in range(8)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(digests)) == 1
    assert len(digests) == 8
    assert torch.equal(blobs.read(["ab.0"], x.shape, x.dtype), x)
    assert [p.name for p in (blobs.root.parent / "tmp").iterdir()] == []


def test_a_folder_that_takes_nothing_raises(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="file"):
        Blobs(tmp_path / "file" / "bands").write("ab.0", torch.zeros(3))


def test_a_layout_names_its_blobs_and_gives_the_stack_back(blobs):
    x, peak = stack(*PAGES), torch.rand(4, dtype=torch.float64)
    names = names_of(x)
    psf = Psf(Stacked(x, tuple(names)), Stacked(peak, tuple(f"{n[:-2]}.1" for n in names)))
    value = {"psf": psf, "list": [torch.ones(3), psf.intensity], "items": "stacked"}
    layout, tensors = serialization.pack(value, blobs)
    # of an unknown cut-off, and of the list
    assert [t.tolist() for t in tensors] == [[], [], [1.0, 1.0, 1.0]]
    layout = json.loads(json.dumps(layout))
    assert set(checked_layout(layout)) == {*names, *psf.clear_peak.names}
    found = serialization.unpack(layout, tensors, Blobs(blobs.root))
    assert type(found["psf"]) is Psf
    assert torch.equal(found["psf"].intensity, x)
    assert torch.equal(found["psf"].clear_peak, peak)
    assert torch.equal(found["list"][1], x)
    assert found["items"] == "stacked"


def test_without_blobs_a_stack_is_a_tensor_like_any_other():
    x = stack(*PAGES)
    layout, tensors = serialization.pack([Stacked(x, ("aa.0",) * 4), 3])
    assert checked_layout(layout) == {}
    assert torch.equal(serialization.unpack(layout, tensors)[0], x)


def test_a_layout_refuses_a_blob_with_another_content(blobs):
    x = stack(*PAGES)
    layout, tensors = serialization.pack(Stacked(x, tuple(names_of(x))), blobs)
    os.unlink(file_of(blobs, names_of(x)[1]))
    blobs.write(names_of(x)[1], x[1] + 1)
    with pytest.raises(ValueError, match="a different band"):
        serialization.unpack(layout, tensors, blobs)


def test_a_layout_with_blobs_needs_their_folder(blobs):
    x = stack(*PAGES)
    layout, tensors = serialization.pack(Stacked(x, tuple(names_of(x))), blobs)
    with pytest.raises(ValueError, match="give the folder of the band files"):
        serialization.unpack(layout, tensors)


@pytest.mark.parametrize("shape", [(1, 4), (4, 1), (1, 1), (3, 4)])
def test_a_column_of_any_stride_has_its_bytes(shape):
    """One element of a row is contiguous by definition, with the stride of the row."""
    x = torch.arange(math.prod(shape), dtype=torch.float64).reshape(shape)
    for column in (*x.unbind(1), *x.unbind(0)):
        assert bytes(bytes_of(column)) == bytes(
            bytes_of(column.clone(memory_format=torch.contiguous_format))
        )
