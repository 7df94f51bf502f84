"""Figures of the training of a network from RGB to spectra: each pixel is found in the picture,
each curve named.
"""

from __future__ import annotations

import torch

from neusee.workflows.training.lift_training import lifted_spectra


def test_each_pixel_has_its_number_in_the_picture_and_each_curve_its_name():
    cube = torch.rand(31, 32, 32)
    centres = torch.linspace(400e-9, 700e-9, 31, dtype=torch.float64)
    arguments = (torch.rand(3, 32, 32), cube, {"mst_plus_plus": cube, "linear": cube}, centres)
    figure = lifted_spectra.__wrapped__(*arguments)
    assert [text.get_text() for text in figure.axes[0].texts] == ["1", "2", "3", "4", "5"]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [
        "truth",
        "mst_plus_plus",
        "linear",
    ]
    assert figure.axes[1].get_ylabel() == "reflectance"
    styles = [line.get_linestyle() for line in figure.axes[1].lines]
    assert len(set(styles[1:])) == 2  # curves that coincide are both seen
    assert lifted_spectra(*arguments)[:4] == b"\x89PNG"
