"""What the frames do not tell has no value in any file of a calibration, and no draws."""

import io
from types import SimpleNamespace

import numpy as np
import pytest

from neusee.workflows.calibration import run_calibration
from neusee.workflows.calibration.identifiability import Identifiability, withheld_electrons
from neusee.workflows.recipe.distributions.joint_distribution import read_posterior

KINDS = {"gain": "estimate", "read_noise": "upper", "full_well": "none", "dark_current": "none"}


@pytest.fixture
def result():
    """A finished calibration of four parameters, two of which only the prior knows."""
    rng = np.random.default_rng(0)
    draws = {name: rng.normal(number + 2, 0.1, (2, 40, 8)) for number, name in enumerate(KINDS)}
    flat = np.stack([x.reshape(-1) for x in draws.values()], -1)
    labels = tuple(f"log {name}" for name in KINDS)
    problem = SimpleNamespace(
        names=tuple(KINDS),
        measured=None,
        coordinates=SimpleNamespace(labels=labels),
        recipe=SimpleNamespace(name="it"),
    )
    known = Identifiability(KINDS, [], [], "")
    chains = SimpleNamespace(flat=flat, log=rng.normal(size=(2, 40, 8)))
    return SimpleNamespace(
        problem=problem,
        chains=chains,
        identifiability=known,
        draws=draws,
        checks=[],
        models=[],
        frames=[],
        rows=list,
        beside=[],
    )


def test_files_have_draws_of_what_the_frames_tell_alone(result):
    with np.load(io.BytesIO(run_calibration._draws(result))) as draws:
        assert set(draws) == {"gain", "read_noise"}
        assert np.allclose(
            np.sort(draws["read_noise"]), np.sort(result.draws["read_noise"].reshape(-1))
        )
    assert set(run_calibration._inference_data(result).posterior) == {"gain", "read_noise"}
    law = run_calibration._document(result)["gaussian"]
    assert law["coordinates"] == ["log gain", "log read_noise"]
    assert np.allclose(law["mean"], [2, 3], atol=0.05)
    both = np.stack([result.draws[name].reshape(-1) for name in ("gain", "read_noise")])
    assert np.allclose(law["covariance"], np.cov(both))


def test_a_recipe_that_takes_the_posterior_names_what_it_does_not_tell(result, tmp_path):
    (tmp_path / "draws.npz").write_bytes(run_calibration._draws(result))
    units = {"gain": "DN/e-", "read_noise": "e-", "full_well": "e-", "dark_current": "e- in 0.01 s"}
    rows = "\n".join(
        f"  {name}: {{kind: {kind}, unit: {units[name]}}}" for name, kind in KINDS.items()
    )
    (tmp_path / "posterior.json").write_text(f"failed: 0\nparameters:\n{rows}\n")
    found = read_posterior(tmp_path)
    assert found.joint.names == ("gain", "read_noise")
    assert found.untold == ("full_well", "dark_current")


@pytest.mark.parametrize(
    ("gain", "left"), [("none", "none"), ("upper", "estimate"), ("estimate", "estimate")]
)
def test_without_a_gain_nothing_is_told_in_electrons(gain, left):
    kinds = {
        "gain": gain,
        "read_noise": "estimate",
        "dark_signal": "estimate",
        "full_well": "lower",
        "dark_current": "none",
    }
    sentences = withheld_electrons(
        kinds, ["full well: only a lower limit", "dark signal: whatever"]
    )
    assert kinds["read_noise"] == left
    assert kinds["dark_signal"] == "estimate"
    if gain != "none":
        assert sentences == ["full well: only a lower limit", "dark signal: whatever"]
        return
    assert kinds["full_well"] == "none"
    assert sentences[-1] == "dark signal: whatever"
    assert [text.partition(":")[0] for text in sentences[:-1]] == ["read noise", "full well"]
    assert all("no value in electrons without the gain" in text for text in sentences[:-1])
