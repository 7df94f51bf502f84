"""The figure of one's own tables: a panel for each table in use, with the numbers and units of
its file.
"""

import numpy as np
import pytest

from neusee.workflows.report.figures import optics

draw = optics.tables.__wrapped__


def panels(figure):
    return {ax.get_title(): ax for ax in figure.axes if ax.get_visible() and ax.get_title()}


def test_every_table_has_its_panel_and_its_numbers(table_arguments):
    shown = panels(draw(**table_arguments))
    assert list(shown) == ["mono.csv", "glass.csv", "lamp.csv", "lasers", "map.npy"]
    (curve,) = shown["mono.csv"].lines
    np.testing.assert_allclose(curve.get_xdata()[[0, -2]], [400, 1064])
    np.testing.assert_allclose(curve.get_ydata()[[0, -2]], [45, 0.8])
    assert shown["mono.csv"].get_ylabel() == "quantum efficiency (%)"
    used, rows = shown["glass.csv"].lines
    np.testing.assert_allclose(
        np.interp(rows.get_xdata(), used.get_xdata(), used.get_ydata()), rows.get_ydata(), atol=1e-5
    )
    np.testing.assert_allclose(rows.get_ydata(), [1.539, 1.5214, 1.5131, 1.5049])
    np.testing.assert_allclose(shown["lamp.csv"].lines[0].get_ydata(), np.array([1, 3, 9, 0.5]) / 9)
    assert [text.get_text() for text in shown["lasers"].get_legend().get_texts()] == [
        "argon, argon.csv",
        "diode, diode.csv",
    ]
    (bars,) = shown["lasers"].collections
    np.testing.assert_allclose(
        [segment[1] for segment in bars.get_segments()], [[457.9, 0.15], [488, 0.75], [514.5, 1]]
    )
    (picture,) = shown["map.npy"].images
    np.testing.assert_allclose(picture.get_extent(), (-3, 3, -4, 4))
    np.testing.assert_allclose(picture.get_array()[39, 29], 39**2 * 1e-3 + 29e-3)


def test_what_is_no_table_of_the_user_has_no_panel():
    coefficients = {"B": (1.1,), "C": (0.01,), "range": (4e-7, 7e-7)}
    shown = panels(
        draw(
            camera="CIE 1931", light="D65", glass=coefficients, lasers={"green": None}, height=None
        )
    )
    assert list(shown) == ["Sellmeier coefficients"]
    (curve,) = shown["Sellmeier coefficients"].lines
    assert curve.get_ydata()[0] == pytest.approx((1 + 1.1 * 0.16 / (0.16 - 0.01)) ** 0.5, rel=1e-12)
    with pytest.raises(ValueError, match="no table of its own"):
        draw(camera="CIE 1931", glass="BK7", light="D65", lasers={"green": None}, height=None)


def test_a_colour_camera_has_three_curves_relative_to_the_largest(tmp_path):
    (tmp_path / "rgb.csv").write_text(
        "wavelength (nm),red (1),green (1),blue (1)\n400,0,0,3\n550,1,4,1\n700,3,0,0\n"
    )
    (panel,) = panels(draw(camera=tmp_path / "rgb.csv")).values()
    assert [line.get_label() for line in panel.lines] == ["red", "green", "blue"]
    assert max(line.get_ydata().max() for line in panel.lines) == 1
    assert panel.get_ylabel() == "relative sensitivity"


def test_a_map_without_pitch_is_drawn_over_its_samples(table_arguments):
    (panel,) = panels(draw(height=table_arguments["height"], unit=1e-6)).values()
    assert panel.get_xlabel() == "u (samples)"
    np.testing.assert_allclose(panel.images[0].get_extent(), (-15, 15, -20, 20))
