"""Laws in the place of values, posteriors over several: read where they are right, and refused
where they stand.
"""

import json
import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from neusee.workflows import load
from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.recipe.distributions.joint_distribution import Joint, read_posterior, summary
from neusee.workflows.recipe.distributions.law_text import is_law, read_law
from neusee.workflows.report.checked_recipe import recipe_text

NOISE = "sensor.read_noise=normal(10.5 e-, 0.5 e-)"


def drawn(count=4000, rho=0.9, seed=1):
    """Gain and offset that go together, and a noise that does not; the gain is log-normal."""
    rng = np.random.default_rng(seed)
    z = rng.standard_normal((count, 3))
    tied = rho * z[:, 0] + math.sqrt(1 - rho**2) * z[:, 1]
    return np.stack([0.37 * np.exp(0.01 * z[:, 0]), 390 + 2 * tied, 10.5 + 0.1 * z[:, 2]], 1)


NAMES = ("gain", "offset", "read_noise")


@pytest.fixture
def calibrated(tmp_path):
    """The folder of a calibration."""

    def make(kinds=("estimate",) * 3, failed=0, units=("e-/DN", "e-", "e-"), extra=()):
        folder = tmp_path / "found"
        folder.mkdir(exist_ok=True)
        columns = dict(zip(NAMES, drawn().T, strict=True))
        rows = {
            name: {"kind": k, "unit": u} for name, k, u in zip(NAMES, kinds, units, strict=True)
        }
        for name, unit in extra:
            columns[name], rows[name] = (
                0.002 + 1e-4 * drawn()[:, 2],
                {"kind": "upper", "unit": unit},
            )
        np.savez(folder / "draws.npz", **columns)
        checks = [{"name": "chains agree", "mark": "fail" if failed else "pass"}]
        (folder / "posterior.json").write_text(
            json.dumps({"parameters": rows, "failed": failed, "checks": checks})
        )
        return folder

    return make


# --- laws -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "law"),
    [
        ("normal(10.5 e-, 0.5 e-)", stats.norm(10.5, 0.5)),
        ("lognormal(0.37, 1.02)", stats.lognorm(math.log(1.02), scale=0.37)),
        ("normal(2.7 DN/e-, 0.1 DN/e-)", stats.norm(2.7, 0.1)),
        ("uniform(1 um, 3 um)", stats.uniform(1e-6, 2e-6)),
        ("loguniform(1e-3, 1e3)", stats.loguniform(1e-3, 1e3)),
    ],
)
def test_a_law_is_that_of_scipy(text, law):
    z = np.linspace(-4, 4, 41)
    assert read_law(text).at(z) == pytest.approx(law.ppf(stats.norm.cdf(z)), rel=1e-9)
    assert read_law(text).median == pytest.approx(law.median())


@given(st.floats(1e-12, 1e12), st.floats(1.0001, 1e3), st.sampled_from(["lognormal", "loguniform"]))
def test_what_is_drawn_from_a_positive_law_is_positive_and_rises(first, factor, kind):
    law = read_law(f"{kind}({first!r}, {factor if kind == 'lognormal' else first * factor!r})")
    drawn = law.at(np.linspace(-5, 5, 11))
    assert (drawn > 0).all()
    assert (np.diff(drawn) > 0).all()


@pytest.mark.slow
@given(st.text(max_size=30))
def test_no_text_breaks_the_reader(text):
    """Hypothesis also tries constants of the modules that are loaded, and some of these are
    laws.
    """
    law, said = None, ""
    try:
        law = read_law(text) if is_law(text) else None
    except ValueError as error:
        said = str(error)
    assert law is not None or not is_law(text) or re.search(r"\w", said)
    assert law is None or np.isfinite(law.at(np.zeros(1))).all()


@pytest.mark.parametrize(
    ("law", "message"),
    [
        (
            "normal(10.5 e-)",
            "the distribution normal needs mean and standard deviation: write normal",
        ),
        ("normal(10.5 e-, 1 nm)", "must have the same unit"),
        ("normal(10.5 e-, 0 e-)", "greater than 0"),
        ("normal(10.5 e-, -1 e-)", "greater than 0"),
        ("normal(1e999 e-, 1 e-)", "not finite"),
        ("normal(1 kg, 2 kg)", "neither a number nor a quantity"),
        ("lognormal(10 e-, 1.1 e-)", "number without a unit"),
        ("lognormal(10 e-, 0.9)", "factor"),
        ("uniform(3 e-, 3 e-)", "first value must be smaller"),
        ("loguniform(0 e-, 3 e-)", "greater than 0"),
        ("normal(10 e-", "the text is not a complete distribution"),
    ],
)
def test_a_law_that_is_none_is_refused_once_and_where_it_stands(law, message):
    with pytest.raises(RecipeError, match=message) as error:
        load("first_light", [f"sensor.read_noise={law}"])
    assert str(error.value).startswith("argument 1 ")
    assert len(error.value.diagnostics) == 1


def test_a_law_of_the_wrong_unit_is_refused_by_what_reads_it():
    with pytest.raises(RecipeError, match="wrong unit"):
        load("first_light", ["sensor.read_noise=normal(10 nm, 1 nm)"])


def test_a_run_takes_the_median_and_keeps_the_law_in_its_text():
    recipe = load("first_light", ["sensor.read_noise=lognormal(20 e-, 1.1)"])
    assert recipe.steps["read[plain]"].params["read_noise"] == pytest.approx(20.0)
    assert "this run uses 20 e-" in " ".join(recipe.notes)
    assert "lognormal(20 e-, 1.1)" in recipe_text(recipe)


def test_a_recipe_that_is_sure_of_all_is_what_it_was():
    recipe = load("first_light")
    assert recipe.uncertain is None
    assert recipe == load("first_light", ["posterior=null"])


# --- joint laws -----------------------------------------------------------------------------------


def test_draws_come_back_from_their_numbers():
    draws = drawn()
    joint = Joint.of_draws(NAMES, draws)
    back = joint.at(joint.numbers())
    assert back == pytest.approx(draws, rel=1e-6)
    assert np.corrcoef(joint.numbers().T) == pytest.approx(np.eye(3), abs=0.05)


def test_points_of_draws_have_their_laws_and_their_correlation():
    joint = Joint.of_draws(NAMES, drawn())
    made = joint.at(np.random.default_rng(5).standard_normal((20000, 3)))
    assert made.std(0) == pytest.approx(joint.sd, rel=0.03)
    assert np.corrcoef(made.T)[0, 1] == pytest.approx(0.9, abs=0.01)
    assert stats.kstest(made[:, 0], joint.draws[:, 0]).pvalue > 1e-3


@given(st.floats(-0.99999, 0.99999), st.floats(1e-6, 1e6), st.floats(1e-6, 1e6))
def test_a_normal_law_has_its_covariance(rho, a, b):
    covariance = [[a * a, rho * a * b], [rho * a * b, b * b]]
    joint = summary({"mean": {"x": 0.0, "y": 1.0}, "covariance": covariance}).joint
    factor = joint.factor * joint.sd[:, None]
    assert factor @ factor.T == pytest.approx(np.array(covariance), rel=1e-6)


def test_some_of_a_normal_law_is_that_of_all():
    covariance = np.cov(drawn().T)
    joint = summary(
        {"mean": dict.fromkeys(NAMES, 1.0), "covariance": covariance.tolist()}
    ).joint.only(NAMES[1:])
    factor = joint.factor * joint.sd[:, None]
    assert factor @ factor.T == pytest.approx(covariance[1:, 1:], rel=1e-6, abs=1e-12)


def test_values_that_are_one_and_the_same_are_drawn_as_such():
    x = drawn()[:, :1]
    joint = Joint.of_draws(("a", "b"), np.concatenate([x, 2 * x], 1))
    made = joint.at(np.random.default_rng(1).standard_normal((100, 2)))
    assert made[:, 1] == pytest.approx(2 * made[:, 0], rel=1e-3)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.csv", "gain,offset\n1,2\n3\n", "line 3"),
        ("a.csv", "gain\n1\nx\n", "must contain numbers"),
        ("a.csv", "gain\n" + "1\n" * 50, "all samples of gain are equal"),
        ("a.csv", "gain\n1\n2\n", "gain has 2 samples, which are too few"),
        ("a.csv", "gain\n" + "1\n" * 30 + "nan\n" * 50, "sample 31 of gain is nan"),
        ("a.json", "{", "cannot be read"),
        ("a.json", "[1]", "must contain a mapping of keys to values"),
        ("a.json", '{"parameters": {"gain": {}}}', "there is no posterior file"),
        ("a.yaml", "mean: {gain: 1}", "needs mean"),
        ("a.yaml", "mean: {gain: 1}\nsd: {well: 1}", "sd must have a value for each name in mean"),
        ("a.yaml", "mean: {gain: 1}\nsd: {gain: 0}", "greater than 0"),
        (
            "a.yaml",
            "mean: {a: 1, b: 1}\ncovariance: [[1, 2], [2, 1]]",
            "its least eigenvalue is -1, so no distribution",
        ),
        ("a.yaml", "mean: {a: 1, b: 1}\ncovariance: [[1, 0.5], [0.4, 1]]", "symmetric"),
        ("a.yaml", "mean: {a: 1, b: 1}\ncovariance: [[1, 0], [0, -1]]", "positive variances"),
        ("a.yaml", "mean: {a: 1, b: 1}\ncovariance: [[1, 2], [1]]", "matrix"),
        ("a.yaml", "mean: {a: 1}\nsd: {a: 1}\nwidth: 1", "unknown key width"),
        ("a.txt", "1", "is not a posterior file"),
        ("a.csv", "gain [DN/e-],gain\n" + "1,2\n" * 40, "two columns have the name gain"),
        ("a.npz", "1", "cannot be read"),
    ],
)
def test_a_file_that_is_no_posterior_is_refused(tmp_path, name, content, message):
    (tmp_path / name).write_text(content)
    with pytest.raises(RecipeError, match=message) as error:
        load("first_light", [f"posterior={tmp_path / name}"])
    assert str(error.value).startswith("argument 1 ")


def test_a_file_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(RecipeError, match="there is no posterior file"):
        load("first_light", [f"posterior={tmp_path / 'none'}"])


def test_of_a_pattern_the_newest_is_read(tmp_path):
    import os

    for n, mean in enumerate((1.0, 2.0)):
        path = tmp_path / f"{n}.yaml"
        path.write_text(f"mean: {{gain: {mean}}}\nsd: {{gain: 0.1}}")
        os.utime(path, (1000 - n, 1000 - n))
    assert read_posterior(tmp_path / "*.yaml").joint.mean == pytest.approx([1.0])


# --- a posterior in a recipe ----------------------------------------------------------------------


def gain_of(recipe):
    return recipe.steps["digital[plain]"].params["gain"]


def test_a_run_takes_the_mean_of_what_is_told_and_no_value_of_what_is_not(calibrated):
    recipe = load(
        "first_light", [f"posterior={calibrated(kinds=('estimate', 'estimate', 'upper'))}"]
    )
    assert gain_of(recipe) == pytest.approx((1 / drawn()[:, 0]).mean())
    assert recipe.steps["read[plain]"].params["read_noise"] == 10.5
    used = {s.path: s.why for s in recipe.uncertain.standings}
    assert used == {"sensor.gain": "mean", "sensor.offset": "mean", "sensor.read_noise": "recipe"}


def test_a_run_takes_a_draw_with_all_that_goes_with_it(calibrated):
    recipe = load("first_light", posterior={"file": str(calibrated()), "use": 17})
    read = recipe.steps["read[mask]"].params
    assert (1 / gain_of(recipe), read["offset"], read["read_noise"]) == pytest.approx(
        tuple(drawn()[17])
    )


def test_a_run_may_keep_its_own(calibrated):
    recipe = load("first_light", posterior={"file": str(calibrated()), "use": "nominal"})
    assert recipe.steps == load("first_light").steps
    assert len(recipe.uncertain.names) == 3


def test_an_argument_is_stronger_than_the_posterior(calibrated):
    recipe = load("first_light", [f"posterior={calibrated()}", "sensor.gain=0.5 e-/DN"])
    assert gain_of(recipe) == 2.0
    assert "sensor.gain" not in recipe.uncertain.names
    assert "sensor.gain comes from the argument, not" in " ".join(recipe.notes)


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ({"use": 4000}, "0 to 3999"),
        ({"use": "median"}, "write mean, nominal"),
        ({"use": True}, "write mean, nominal"),
        ({"values": {"sensor.gain": "slope"}}, "slope is not in the posterior"),
        ({"values": {"sensor.speed": "gain"}}, "no value at the path sensor.speed"),
        ({"values": {"sensor.camera": "gain"}}, "neither a number nor a quantity"),
        ({"take": "mean"}, "unknown"),
    ],
)
def test_what_cannot_be_taken_of_a_posterior_is_refused(calibrated, said, message):
    with pytest.raises(RecipeError, match=message):
        load("first_light", posterior={"file": str(calibrated()), **said})


def test_a_calibration_that_is_not_fit_for_use_is_refused(calibrated):
    with pytest.raises(
        RecipeError, match="the calibration cannot be used: 1 check fails \\(chains agree\\)"
    ):
        load("first_light", [f"posterior={calibrated(failed=1)}"])


def test_numbers_of_another_convention_are_refused(calibrated):
    with pytest.raises(
        RecipeError, match=r"the gain of the posterior has no unit: name its draws 'gain \[DN/e-\]'"
    ):
        load("first_light", [f"posterior={calibrated(units=('', 'e-', 'e-'))}"])
    recipe = load("first_light", [f"posterior={calibrated(units=('DN/e-', 'e-', 'e-'))}"])
    assert gain_of(recipe) == pytest.approx(drawn()[:, 0].mean())
    with pytest.raises(
        RecipeError, match=r"the dark current is for 1 s in the posterior and 0.1 s in the recipe"
    ):
        load("first_light", [f"posterior={calibrated(extra=[('dark_current', 'e- in 1 s')])}"])


def test_a_law_and_a_posterior_of_one_value_are_refused(calibrated, tmp_path):
    own = tmp_path / "own.yaml"
    groups = (
        "camera: neusee, scene: china, illuminant: daylight, lift: lmmse, laser: green, optics:"
        " small"
    )
    groups += (
        ", sensor: small, doe: five_half_rings, flare: clean, restore: wiener, reading: coherent"
    )
    lines = [f"  - {group}" for group in groups.split(", ")]
    text = [
        "defaults:",
        *lines,
        "sensor: {gain: 'normal(0.37 e-/DN, 0.01 e-/DN)'}",
        f"posterior: {calibrated()}",
        "outputs: [raw]",
    ]
    own.write_text("\n".join(text))
    with pytest.raises(
        RecipeError,
        match=r"own.yaml:13.*sensor.gain +the value has a distribution both here and in the posterior",
    ):
        load(own)


def test_values_may_have_other_names_and_a_summary_may_stand_in_the_recipe():
    said = {
        "mean": {"temporal_dark_noise": "12 e-"},
        "sd": {"temporal_dark_noise": "0.5 e-"},
        "values": {"sensor.read_noise": "temporal_dark_noise"},
    }
    recipe = load("first_light", posterior=said)
    assert recipe.steps["read[plain]"].params["read_noise"] == 12.0
    assert recipe.uncertain.standings[0].below == pytest.approx(stats.norm.cdf(-3.0))
    assert recipe.uncertain.standings[0].far
    assert "far from its posterior, 12 ± 0.5 e-" in " ".join(recipe.notes)


# --- gains, and what 0.1 wrote --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "law"),
    [
        ("normal(0.37 e-/DN, 0.01 e-/DN)", stats.norm(0.37, 0.01)),
        ("lognormal(0.37 e-/DN, 1.02)", stats.lognorm(math.log(1.02), scale=0.37)),
        ("uniform(0.3 e-/DN, 0.4 e-/DN)", stats.uniform(0.3, 0.1)),
        ("loguniform(0.3 e-/DN, 0.4 e-/DN)", stats.loguniform(0.3, 0.4)),
    ],
)
def test_a_law_in_electrons_a_number_is_drawn_as_written_and_read_as_k(text, law):
    z = np.linspace(-4, 4, 41)
    assert 1 / read_law(text).at(z) == pytest.approx(law.ppf(stats.norm.cdf(z)), rel=1e-9)
    recipe = load("first_light", [f"sensor.gain={text}"])
    assert gain_of(recipe) == read_law(text).median
    assert recipe.uncertain.laws["sensor.gain"].unit == "DN/e-"


def test_a_median_in_electrons_a_number_is_to_the_last_bit_the_value_itself():
    assert gain_of(load("first_light", ["sensor.gain=lognormal(0.37 e-/DN, 1.02)"])) == gain_of(
        load("first_light")
    )


@pytest.mark.parametrize(
    ("law", "message"),
    [
        ("normal(0.37, 0.01)", "needs a unit: write 0.37 e-/DN or 0.37 DN/e-"),
        ("normal(0.37 e-/DN, 0.1 DN/e-)", "must have the same unit"),
    ],
)
def test_a_law_of_a_gain_says_its_unit(law, message):
    with pytest.raises(RecipeError, match=message):
        load("first_light", [f"sensor.gain={law}"])


def test_a_summary_of_a_gain_is_of_k():
    said = {"mean": {"gain": "0.37 e-/DN"}, "sd": {"gain": "0.01 e-/DN"}}
    with pytest.raises(
        RecipeError, match=r"0.37 e-/DN: write the mean and the sd of a gain in DN/e-"
    ):
        load("first_light", posterior=said)
    with pytest.raises(RecipeError, match="the gain of the posterior has no unit"):
        load("first_light", posterior={"mean": {"gain": 2.7}, "sd": {"gain": 0.01}})
    said = {"mean": {"gain": "2.6 DN/e-"}, "sd": {"gain": "0.01 DN/e-"}}
    assert gain_of(load("first_light", posterior=said)) == 2.6


@pytest.mark.parametrize(("unit", "k"), [("DN/e-", lambda x: x), ("e-/DN", lambda x: 1 / x)])
@pytest.mark.parametrize("suffix", [".csv", ".npz"])
def test_draws_of_a_gain_have_a_unit_in_their_heading(tmp_path, suffix, unit, k):
    draws, head = drawn()[:, :1], f"gain [{unit}]"
    if suffix == ".npz":
        np.savez(tmp_path / "a.npz", **{head: draws[:, 0]})
    else:
        (tmp_path / "a.csv").write_text("\n".join([head, *map(repr, draws[:, 0].tolist())]))
    recipe = load("first_light", [f"posterior={tmp_path / ('a' + suffix)}"])
    assert gain_of(recipe) == pytest.approx(k(draws).mean(), rel=1e-12)


@pytest.fixture
def by_0_1(tmp_path):
    """The folder of a calibration as 0.1 wrote it: of a sensor, or of a camera."""

    def make(names, units):
        folder = tmp_path / "by 0.1"
        folder.mkdir()
        np.savez(folder / "draws.npz", **dict(zip(names, drawn().T, strict=True)))
        rows = {
            name: {"name": name, "unit": u, "kind": "estimate"}
            for name, u in zip(names, units, strict=True)
        }
        doc = {
            "study": "calibrate",
            "failed": 0,
            "parameters": rows,
            "checks": [{"name": "fit", "mark": "pass"}],
        }
        (folder / "posterior.json").write_text(json.dumps(doc))
        return folder

    return make


def test_the_posterior_of_a_sensor_by_0_1_is_read(by_0_1):
    recipe = load(
        "first_light",
        [f"posterior={by_0_1(('gain', 'pedestal', 'read_noise'), ('e-/DN', 'e-', 'e-'))}"],
    )
    assert recipe.uncertain.joint.names == ("sensor.gain", "sensor.offset", "sensor.read_noise")
    assert gain_of(recipe) == pytest.approx((1 / drawn()[:, 0]).mean())
    assert recipe.steps["read[plain]"].params["offset"] == pytest.approx(drawn()[:, 1].mean())


def test_the_posterior_of_a_camera_by_0_1_is_read(by_0_1):
    folder = by_0_1(("gain", "dark_signal", "dark_noise"), ("DN/e-", "DN", "e-"))
    values = {"sensor.gain": "gain", "sensor.read_noise": "temporal_dark_noise"}
    recipe = load("first_light", posterior={"file": str(folder), "values": values})
    assert gain_of(recipe) == pytest.approx(drawn()[:, 0].mean())
    assert recipe.steps["read[plain]"].params["read_noise"] == pytest.approx(drawn()[:, 2].mean())
    with pytest.raises(RecipeError, match="dark_noise is called temporal_dark_noise now"):
        load(
            "first_light",
            posterior={"file": str(folder), "values": {"sensor.read_noise": "dark_noise"}},
        )


def test_the_draws_of_0_1_alone_say_no_unit_and_are_refused(by_0_1):
    folder = by_0_1(("gain", "pedestal", "read_noise"), ("e-/DN", "e-", "e-"))
    message = (
        r"the gain of the posterior has no unit.*the folder of `neusee calibrate` contains the unit"
    )
    with pytest.raises(RecipeError, match=message):
        load("first_light", [f"posterior={folder / 'draws.npz'}"])
