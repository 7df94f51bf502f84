"""Small files that would take gigabytes of memory, or would never end, each with the reader that
meets it.
"""

import os
import socket
import struct
import zipfile
import zlib
from pathlib import Path

import numpy as np

MB = 1_000_000
_ZEROS = bytes(MB)


# --- pictures -------------------------------------------------------------------------------------


def exr(path, channels=("R", "G", "B"), size=(30_000, 30_000), deep=False, parts=1):
    """Write an OpenEXR file of 4 x 4 pixels whose headers state ``size`` (y, x)."""
    import OpenEXR

    planes = {name: np.full((4, 4), 0.5, np.float32) for name in channels}
    if parts == 1:
        OpenEXR.File({}, planes).write(str(path))
    else:
        OpenEXR.File([OpenEXR.Part({}, planes, name=f"p{i}") for i in range(parts)]).write(
            str(path)
        )
    raw = bytearray(path.read_bytes())
    place = -1
    while (place := raw.find(b"dataWindow\0box2i\0", place + 1)) >= 0:
        at = place + len(b"dataWindow\0box2i\0") + 4
        raw[at : at + 16] = struct.pack("<4i", 0, 0, size[1] - 1, size[0] - 1)
    if deep:
        raw[4:8] = struct.pack("<I", struct.unpack("<I", raw[4:8])[0] | 1 << 11)
    path.write_bytes(raw)


def tiff(path, pages, shape=(3000, 4000), tile=0):
    """Write a TIFF file of 16 bits whose pages share one strip of zeros, or state a tile of
    ``tile`` x ``tile``.
    """
    strip = zlib.compress(bytes(2 * shape[0] * shape[1]), 1)
    raw, place = bytearray(b"II*\0" + struct.pack("<I", 8 + len(strip)) + strip), 8 + len(strip)
    tags = {256: shape[1], 257: shape[0], 258: 16, 259: 8, 262: 1, 277: 1}
    tags |= (
        {322: tile, 323: tile, 324: 8, 325: len(strip)}
        if tile
        else {273: 8, 278: shape[0], 279: len(strip)}
    )
    for number in range(pages):
        raw += struct.pack("<H", len(tags))
        for tag, value in sorted(tags.items()):
            raw += struct.pack("<HHII", tag, 4, 1, value)
        place += 2 + 12 * len(tags) + 4
        raw += struct.pack("<I", place if number + 1 < pages else 0)
    path.write_bytes(raw)


def png(path, side, colour=0, depth=8):
    """Write a PNG file whose header states ``side`` x ``side`` pixels."""
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", side, side, depth, colour, 0, 0, 0))]
    chunks += [(b"IDAT", zlib.compress(_ZEROS)), (b"IEND", b"")]
    raw = b"\x89PNG\r\n\x1a\n"
    for kind, data in chunks:
        raw += (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )
    path.write_bytes(raw)


def jpeg(path, side):
    """Write a JPEG file of 16 x 16 pixels whose header states ``side`` x ``side``."""
    from PIL import Image

    Image.fromarray(np.zeros((16, 16, 3), np.uint8)).save(path, "JPEG", progressive=True)
    raw = bytearray(path.read_bytes())
    at = raw.find(b"\xff\xc2") + 5
    raw[at : at + 4] = struct.pack(">HH", side, side)
    path.write_bytes(raw)


# --- arrays ---------------------------------------------------------------------------------------


def fits(path, side):
    cards = [
        "SIMPLE  =                    T",
        "BITPIX  =                   16",
        "NAXIS   =                    2",
    ]
    cards += [
        f"NAXIS1  = {side:20d}",
        f"NAXIS2  = {side:20d}",
        "BZERO   =              32768.0",
        "END",
    ]
    path.write_bytes("".join(card.ljust(80) for card in cards).ljust(2880).encode() + bytes(2880))
    os.truncate(path, 5760 + 2 * side * side)  # the numbers are a hole in the file


def npy(path, shape, dtype="<f4", hole=False):
    """Write a .npy file whose header states ``shape``; its numbers are missing, or a hole in the
    file.
    """
    head = str({"descr": dtype, "fortran_order": False, "shape": shape}).encode().ljust(117) + b"\n"
    path.write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + bytes(64))
    if hole:
        os.truncate(path, 10 + len(head) + int(np.prod(shape)) * np.dtype(dtype).itemsize)


def npy_head(shape, dtype="<f8"):
    head = str({"descr": dtype, "fortran_order": False, "shape": shape}).encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head


def zipped(path, members):
    """Write a zip archive of compressed files: the first bytes of each, and the megabytes of
    zeros behind them.
    """
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, (head, megabytes) in members.items():
            with archive.open(name, "w", force_zip64=True) as file:
                file.write(head)
                for _ in range(megabytes):
                    file.write(_ZEROS)


def npz(path, names, megabytes=120):
    count = megabytes * MB // 8
    zipped(path, {f"{name}.npy": (npy_head((count,)), megabytes) for name in names})


def checkpoint(path, megabytes=120):
    """Write a file of `torch.save` whose tensor is ``megabytes`` of zeros, compressed."""
    import io

    import torch

    memory = io.BytesIO()
    torch.save({"w": torch.zeros(4)}, memory)
    with zipfile.ZipFile(memory) as plain:
        members = {
            name: (plain.read(name), megabytes * name.endswith("data/0"))
            for name in plain.namelist()
        }
    zipped(path, members)


def mat(path, name, megabytes=120, lies=False):
    """Write a .mat file of one compressed array of zeros; if it ``lies``, its dimensions state
    one number.
    """
    count = megabytes * MB // 8
    body = struct.pack("<IIII", 6, 8, 6, 0) + struct.pack("<IIii", 5, 8, 1, 1 if lies else count)
    body += struct.pack("<II", 1, len(name)) + name.encode().ljust(-(-len(name) // 8) * 8, b"\0")
    body += struct.pack("<II", 9, 8 * count)
    packer = zlib.compressobj(1)
    packed = packer.compress(struct.pack("<II", 14, len(body) + 8 * count) + body)
    for _ in range(megabytes):
        packed += packer.compress(_ZEROS)
    packed += packer.flush()
    head = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H2s", 0x0100, b"IM")
    path.write_bytes(head + struct.pack("<II", 15, len(packed)) + packed)


def safetensors(path, count, header=None):
    """Write a .safetensors file whose header states a tensor of ``count`` numbers, or a length
    of ``header``.
    """
    text = (
        f'{{"height":{{"dtype":"F32","shape":[{count}],"data_offsets":[0,{4 * count}]}}}}'.encode()
    )
    path.write_bytes(struct.pack("<Q", header or len(text)) + text + bytes(64))


def chain(path):
    """Write a sealed file of draws with a data set of 4 GB of zeros in compressed chunks."""
    import h5py

    from neusee.workflows.calibration import emcee_sampler

    part = path.with_suffix(".part")
    with h5py.File(part, "w", userblock_size=emcee_sampler._SEAL_BYTES) as file:
        group = file.create_group("ensemble0")
        chunks = {"chunks": (1000, 64, 8), "compression": "gzip"}
        group.create_dataset("chain", (1_000_000, 64, 8), "f8", **chunks)
        group.create_dataset("log_prob", (1_000_000, 64), "f8", chunks=(1000, 64))
        group.create_dataset("accepted", (64,), "f8")
        group.attrs.update({"iteration": 1_000_000, "nwalkers": 64, "ndim": 8, "has_blobs": False})
    content = part.read_bytes()[emcee_sampler._SEAL_BYTES :]
    seal = emcee_sampler.seal_file("draws", path.stem, content).ljust(
        emcee_sampler._SEAL_BYTES, b"\0"
    )
    path.write_bytes(seal + content)


# --- texts and what is no file --------------------------------------------------------------------


def long_line(path, megabytes=12):
    with path.open("wb") as file:
        for _ in range(megabytes):
            file.write(b"1," * (MB // 2))


def hole(path, gigabytes=8):
    path.write_bytes(b"wavelength,a\n")
    os.truncate(path, gigabytes * 1000 * MB)


def aliases(path, first=""):
    """Write a YAML file of a few lines whose aliases stand for 9 ** 12 values."""
    lines = [f"{first}a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12)]
    path.write_text("\n".join(lines) + "\n")


def pipe(path):
    os.mkfifo(path)


def device(path):
    path.symlink_to("/dev/zero")


def unix_socket(path):
    here = Path.cwd()
    os.chdir(path.parent)  # the name of a socket has at most 107 bytes
    try:
        with socket.socket(socket.AF_UNIX) as server:
            server.bind(path.name)
    finally:
        os.chdir(here)


def loop(path):
    path.symlink_to(path.name)


def folder_of_loops(path):
    """Make a folder with photographs and links that lead back."""
    from PIL import Image

    (path / "a" / "b").mkdir(parents=True)
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(path / "a" / "one.png")
    pipe(path / "a" / "two.png")
    for number in range(6):
        (path / "a" / "b" / f"back{number}").symlink_to(path, target_is_directory=True)
        (path / f"again{number}").symlink_to(path, target_is_directory=True)
