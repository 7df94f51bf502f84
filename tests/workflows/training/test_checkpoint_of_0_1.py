"""The state of a training as 0.1 wrote it: read, or refused with a sentence that says what to
do.
"""

import pytest
import torch
from torch import nn

from neusee.workflows.training.resumable_loop import StateFile


def written(path, parts, edition=1):
    torch.save({"edition": edition, "stage": 1, "iteration": 3, "parts": parts}, path)
    return path


def test_a_state_of_0_1_is_read(tmp_path):
    old = nn.Linear(2, 1)
    found = StateFile(
        written(tmp_path / "state.pt", {"relief": old.state_dict(), "net": {}})
    ).read()
    now = nn.Linear(2, 1)
    now.load_state_dict(found["parts"]["mask"])
    assert torch.equal(now.weight, old.weight)
    assert (found["stage"], found["iteration"]) == (1, 3)


@pytest.mark.parametrize(("parts", "edition"), [({}, 0), ([], 1), (None, 1)])
def test_what_is_no_state_is_refused_with_what_to_do(tmp_path, parts, edition):
    with pytest.raises(
        ValueError, match=r"state.pt cannot be read .*: remove its folder to start again"
    ):
        StateFile(written(tmp_path / "state.pt", parts, edition)).read()
