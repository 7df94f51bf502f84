"""The second derivatives of a fit of lasers, in frames so large that float32 loses what tells
values apart.
"""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from neusee.nodes.restore.lasers import _frame_likelihood


@pytest.mark.parametrize("seed", [0, 1])
def test_values_that_hardly_differ_are_told_apart_in_a_large_frame(seed):
    rng = np.random.default_rng(seed)
    # light is positive: its sum grows, and float32 loses its last digits
    shared = rng.gamma(0.5, size=1_229_218)
    columns = np.stack(
        [shared * (1 + 1e-3 * rng.normal(size=shared.size)) for _ in range(4)]
    ).astype(np.float32)
    parts = (SimpleNamespace(precision=torch.zeros(4)),)
    found = _frame_likelihood._normal(parts, torch.from_numpy(columns)).numpy()
    exact = np.array([[np.dot(a.astype(float), b.astype(float)) for b in columns] for a in columns])
    assert np.linalg.eigvalsh(found) == pytest.approx(np.linalg.eigvalsh(exact), rel=1e-6)
