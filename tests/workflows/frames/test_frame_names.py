"""Exposure and light by the names of files: what laboratories write, and what is doubtful and
said to be.
"""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, PngImagePlugin

from neusee.nodes.calibrate import frame_header
from neusee.workflows.cli import app
from neusee.workflows.frames.frame_folder import FolderRefused, find_levels, read_name, read_table
from tests.workflows.frames.test_frame_folder import by_name, by_table, png, shots

LAB = Path("lab")


def said(name):
    return read_name(LAB / f"{name}.tif", LAB)


@pytest.mark.parametrize(
    ("name", "seconds"),
    [
        ("dark_1-200s_1", 1 / 200),
        ("dark_t1-200s_1", 1 / 200),
        ("flat_2000ph_1-1000s_1", 1 / 1000),
        ("1-60s/dark_1", 1 / 60),
        ("dark_1-60sec_3", 1 / 60),
        ("dark_1over200s", 1 / 200),
        ("dark_10p0ms_1", 0.01),
        ("dark_10p5ms_1", 0.0105),
        ("dark_2p5e1us", 25e-6),
        ("10ms_dark_1", 0.01),
        ("exp10ms_1", 0.01),
        ("10ms_exp_1", 0.01),
        ("exposure_ms_10_3", 0.01),
        ("ms10_dark_1", 0.01),
        ("exp_s_2_1", 2.0),
        ("dark_10_ms_1", 0.01),
        ("dark_0,5s", 0.5),
        ("dark_200s_1", 200.0),
        ("shots_1_10ms", 0.01),
        ("img_2024-01-20_10ms", 0.01),
        ("flat_s1_10ms", 0.01),
    ],
)
def test_an_exposure_is_read_as_it_is_meant(name, seconds):
    assert said(name).exposure == pytest.approx(seconds, rel=1e-12)
    assert not said(name).doubtful


@pytest.mark.parametrize("name", ["frames_1", "dark_s_1", "flat_1-200_2", "roi_10x20"])
def test_a_name_without_an_exposure_says_none(name):
    assert said(name).exposure is None


@pytest.mark.parametrize(
    ("name", "photons"),
    [
        ("flat_5000ph_10ms", 5000.0),
        ("flat_ph5000_10ms", 5000.0),
        ("5000_photons_a", 5000.0),
        ("photons_1p5e3", 1500.0),
    ],
)
def test_light_is_read_in_both_orders(name, photons):
    assert said(name).photons == photons


@pytest.mark.parametrize("name", ["dark-1-200s-1", "dark_1_200s_1", "dark1-200s"])
def test_a_number_before_seconds_that_may_be_a_fraction_is_refused_with_what_to_write(
    name, tmp_path
):
    by_name(tmp_path)
    for number in (1, 2):
        (tmp_path / f"dark_2ms_{number - 1}.png").rename(tmp_path / f"{name}_{number}.png")
    with pytest.raises(
        FolderRefused, match=r"may mean 1/200 s, or number 1 of 200 s: write 5ms or 200s"
    ):
        find_levels(tmp_path)


def test_a_second_number_shows_that_the_first_counts_frames(tmp_path):
    by_name(tmp_path)
    for number in (1, 2):
        (tmp_path / f"dark_2ms_{number - 1}.png").rename(tmp_path / f"dark_{number}_200s.png")
    times = [level.exposure for level in find_levels(tmp_path).levels if level.dark]
    assert times == [0.001, 200.0]


def test_what_is_read_as_exposure_is_told_before_any_frame_is_read(tmp_path):
    by_name(tmp_path)
    for number in (0, 1):
        (tmp_path / f"dark_2ms_{number}.png").rename(tmp_path / f"dark_1-500s_{number}.png")
    told = []
    find_levels(tmp_path, told.append)
    assert told == [
        "dark: exposure 1 ms, from 1ms of the name: 2 files such as dark_1ms_0.png",
        "dark: exposure 2 ms, from 1-500s of the name: 2 files such as dark_1-500s_0.png",
        "lit: exposure 1 ms, from 1ms of the name: 10 files such as flat_10000ph_1ms_0.png",
    ]


def test_a_header_that_says_a_fraction_is_read(tmp_path):
    frame = next(shots())[-1]
    for text in ("1/200 s", "1/200", "1/200s"):
        png(tmp_path / "a.png", frame, ExposureTime=text)
        assert frame_header(tmp_path / "a.png").exposure == pytest.approx(0.005)
    about = PngImagePlugin.PngInfo()
    about.add_text("Description", "none")
    exif = Image.Exif()
    exif[270] = "exposure=1/200s; photons=30"
    Image.fromarray(frame).save(tmp_path / "b.tif", exif=exif)
    assert frame_header(tmp_path / "b.tif").exposure == pytest.approx(0.005)


def test_a_table_takes_fractions(tmp_path):
    by_table(tmp_path / "lab")
    table = tmp_path / "lab" / "frames.csv"
    table.write_text(table.read_text().replace("2 ms", "1/500 s"))
    assert {row.exposure for row in read_table(table)} == {0.001, 0.002}
    table.write_text("file,exposure\nshot0.npy,1/500\n")
    with pytest.raises(
        ValueError, match=r"frames\.csv:2: exposure 1/500: write a time with a unit"
    ):
        read_table(table)


def jpeg(file):
    Image.fromarray(np.zeros((8, 10), np.uint8)).save(file)


def test_a_folder_of_jpeg_is_refused_by_name(tmp_path, capsys):
    for name in ("dark_1ms_1.jpg", "flat_1ms_1.JPEG"):
        jpeg(tmp_path / name)
    with pytest.raises(SystemExit) as ended:
        app.main(["calibrate", str(tmp_path)])
    assert ended.value.code == 2
    told = capsys.readouterr().err
    assert "dark_1ms_1.jpg, flat_1ms_1.JPEG: .jpeg/.jpg cannot be used for a calibration" in told
    assert "JPEG and similar formats change the noise of each pixel; save the raw frames" in told


def test_previews_beside_frames_are_told(tmp_path):
    by_name(tmp_path)
    jpeg(tmp_path / "preview.jpg")
    told = []
    assert len(find_levels(tmp_path, told.append).levels) == 7
    assert told[-1] == "not read: preview.jpg"
