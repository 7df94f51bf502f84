"""Expected numbers hold for the recipe as written; what an override reaches is no longer
promised.
"""

import pytest

from neusee.workflows import load

TEXT = """
outputs: [psf]
optics: {waves: 20, pitch: 2.9 um}
expect:
  bands: {step: bands, at: [centres, 0], value: 400e-9, rtol: 1e-6}
  height: {step: height, at: [0, 0], value: 0, rtol: 1e-6}
steps:
  bands: {node: spectra.bands, with: {start: 400 nm, stop: 700 nm, count: 3}}
  index: {node: doe.material, from: bands}
  stop: {node: optics.stop, with: {samples: 8, pitch: 1 mm, diameter: 8 mm}}
  height: {node: doe.axicon, from: stop, with: {waves: "${optics.waves}"}}
  pupil: {node: optics.pupil, from: {height: height, index: index, bands: bands, stop: stop}}
  psf: {node: optics.psf, from: pupil, with: {focal_length: 0.1 m, pixel_pitch: "${optics.pitch}", shape: [4, 4]}}
"""


@pytest.mark.parametrize(
    ("override", "kept"),
    [
        ((), {"bands", "height"}),
        (("optics.pitch=3 um",), {"bands", "height"}),
        (("optics.waves=21",), {"bands"}),
        (("steps.bands.with.count=4",), {"height"}),
        (("optics.waves=21", "expect.height.value=1"), {"bands", "height"}),
    ],
)
def test_an_override_takes_back_the_promises_it_reaches(tmp_path, override, kept):
    path = tmp_path / "small.yaml"
    path.write_text(TEXT)
    recipe = load(path, override)
    assert {e.name for e in recipe.expect} == kept
    taken = {"bands", "height"} - kept
    assert any("your changes affect" in n for n in recipe.notes) == bool(taken)
