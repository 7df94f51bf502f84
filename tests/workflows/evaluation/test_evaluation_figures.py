"""Figures of an evaluation: the means can be read beside wide intervals."""

from __future__ import annotations

import numpy as np
import pytest

from neusee.workflows.evaluation import evaluation_page as evaluation_figures
from neusee.workflows.evaluation.confidence_intervals import METRICS, MetricTable


def table(*scenes):
    """A table in which scene ``i`` has the value ``scenes[i]`` at every strength, for each
    metric.
    """
    values = np.repeat(np.asarray(scenes, dtype=float)[:, None], 3, axis=1)
    return MetricTable(
        (0.0, 1e3, 1e6), {name: values for name in (*METRICS, "l1 small")}, np.arange(len(scenes))
    )


@pytest.mark.parametrize("scenes", [(0.05, 0.11), (0.08, 0.08, 0.08)])
def test_an_interval_of_few_scenes_does_not_squeeze_the_means(scenes):
    tables = {"flat+none": table(*scenes), "axicon+wiener": table(*(1.2 * x for x in scenes))}
    figure = evaluation_figures.strengths.__wrapped__(tables, 64)
    largest = 1.2 * float(np.mean(scenes))
    for ax in figure.axes:
        low, high = ax.get_ylim()
        assert low == 0
        assert largest < high <= 1.05 * 3 * largest + 1e-9
