"""Estimates without what helps, which is half of their work and stands beside them."""

import pytest

from neusee.workflows.safety import safety_estimate


@pytest.fixture(scope="module")
def without_remedies():
    """Leave out what helps against a limit: `test_what_helps` judges it, and nothing else of an
    estimate reads it.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(safety_estimate, "remedies", lambda *_: ())
        yield
