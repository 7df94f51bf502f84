"""Every law against SciPy and against samples by NumPy; wrong forms are refused once and where
they stand.
"""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from neusee.workflows import load
from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.recipe.distributions.law_text import KINDS, read_law
from neusee.workflows.recipe.distributions.shapes import (
    Discrete,
    Normal,
    draw_laws,
    scores_between,
    share_between,
)
from neusee.workflows.report.checked_recipe import recipe_text

LAWS = [
    ("triangular(9 e-, 10 e-, 12 e-)", stats.triang(1 / 3, 9, 3)),
    ("triangular(9 e-, 9 e-, 12 e-)", stats.triang(0, 9, 3)),
    ("triangular(1 um, 3 um, 3 um)", stats.triang(1, 1e-6, 2e-6)),
    ("beta(2, 5)", stats.beta(2, 5)),
    ("beta(0.5, 0.7, 2 e-, 6 e-)", stats.beta(0.5, 0.7, 2, 4)),
    ("truncated(normal(2 e-, 1 e-), 0 e-, inf)", stats.truncnorm(-2, math.inf, 2, 1)),
    ("truncated(normal(2 e-, 1 e-), -inf, 1 e-)", stats.truncnorm(-math.inf, -1, 2, 1)),
    ("truncated(normal(2 e-, 1 e-), 5 e-, 9 e-)", stats.truncnorm(3, 7, 2, 1)),
    ("truncated(uniform(0, 4), 1, 3)", stats.uniform(1, 2)),
    ("truncated(loguniform(1, 1e4), 10, 100)", stats.loguniform(10, 100)),
]
ROWS = np.random.default_rng(3).gamma(2.0, 3.0, 101)


@pytest.fixture
def table(tmp_path):
    """A table of samples with two columns."""
    path = tmp_path / "noise.csv"
    lines = [f"{x!r},{2 * x!r}" for x in map(float, ROWS)]
    path.write_text("\n".join(["read_noise [e-],exposure [ms]", *lines]))
    return path


# --- values ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("text", "law"), LAWS, ids=[text for text, _ in LAWS])
def test_quantiles_are_those_of_scipy(text, law):
    z = np.linspace(-4, 4, 41)
    assert read_law(text).at(z) == pytest.approx(
        law.ppf(stats.norm.cdf(z)), rel=1e-8, abs=1e-12 * law.std()
    )


@pytest.mark.parametrize(("text", "law"), LAWS, ids=[text for text, _ in LAWS])
def test_moments_are_those_of_scipy(text, law):
    mean, sd = read_law(text).shape.moments()
    assert mean == pytest.approx(law.mean(), rel=1e-4)
    assert sd == pytest.approx(law.std(), rel=1e-3)


@pytest.mark.parametrize(("text", "law"), LAWS, ids=[text for text, _ in LAWS])
def test_a_score_is_the_inverse_of_a_quantile(text, law):
    shape = read_law(text).shape
    for z in (-3.0, -0.4, 0.0, 1.7, 3.0):
        assert shape.score(float(shape.at(np.array(z)))) == pytest.approx(z, abs=1e-6)


def test_a_truncated_lognormal_law_is_the_conditional_law():
    whole = stats.lognorm(math.log(2), scale=3)
    low, high = whole.cdf(2), whole.cdf(20)
    share = stats.norm.cdf(np.linspace(-3, 3, 13))
    found = read_law("truncated(lognormal(3, 2), 2, 20)").at(stats.norm.ppf(share))
    assert found == pytest.approx(whole.ppf(low + share * (high - low)), rel=1e-9)


def test_bounds_far_in_a_tail_keep_their_accuracy():
    """Beyond 12 standard deviations a truncated normal law is exponential: 1 / 12 of a deviation
    to the bound.
    """
    z = np.linspace(-8, 8, 17)
    for low, high, sign in ((12.0, math.inf, 1), (-math.inf, -12.0, -1)):
        x = sign * scores_between(z, low, high)
        assert (x >= 12.0).all()
        assert (np.diff(sign * x) > 0).all()
        assert np.median(x) == pytest.approx(stats.truncnorm(12, math.inf).median(), rel=1e-9)


def test_a_discrete_law_has_its_values_with_their_weights():
    law = read_law("discrete(12 e- weight 0.5, 10 e- weight 0.2, 15 e- weight 0.3)")
    drawn = law.at(np.random.default_rng(1).standard_normal(100_000))
    values, counts = np.unique(drawn, return_counts=True)
    assert values.tolist() == [10.0, 12.0, 15.0]
    assert stats.chisquare(counts, [20_000, 50_000, 30_000]).pvalue > 1e-3
    assert law.median == 12.0
    assert law.shape.moments() == pytest.approx((12.5, 1.8027756))


def test_without_weights_all_values_are_equally_probable():
    drawn = read_law("discrete(1, 2, 4)").at(np.random.default_rng(1).standard_normal(60_000))
    assert stats.chisquare(np.unique(drawn, return_counts=True)[1]).pvalue > 1e-3


def test_samples_of_a_file_are_drawn_as_they_are(table):
    law = read_law("empirical(noise.csv, column read_noise)", table.parent)
    z = np.random.default_rng(2).standard_normal(4000)
    drawn = law.at(z)
    assert set(drawn.tolist()) <= set(ROWS.tolist())
    assert drawn == pytest.approx(np.quantile(ROWS, stats.norm.cdf(z), method="inverted_cdf"))
    assert stats.kstest(drawn, ROWS).pvalue > 1e-3
    assert law.unit == "e-"


def test_a_column_is_read_in_its_unit(table):
    law = read_law('empirical("noise.csv", column exposure)', table.parent)
    assert law.median == pytest.approx(2e-3 * np.median(ROWS))
    assert law.unit == "s"


@pytest.mark.parametrize("suffix", [".txt", ".csv", ".npy", ".npz"])
def test_a_file_of_one_column_needs_no_name(tmp_path, suffix):
    path = tmp_path / f"noise{suffix}"
    if suffix == ".npy":
        np.save(path, ROWS)
    elif suffix == ".npz":
        np.savez(path, read_noise=ROWS)
    else:
        np.savetxt(path, ROWS)
    law = read_law(f"empirical({path.name}, unit ke-)", tmp_path)
    assert law.at(np.array([-8.0, 8.0])) == pytest.approx([1e3 * ROWS.min(), 1e3 * ROWS.max()])
    assert law.unit == "e-"


def test_a_gain_in_electrons_a_number_is_drawn_as_written():
    z = np.linspace(-3, 3, 13)
    law = read_law("truncated(normal(0.37 e-/DN, 0.2 e-/DN), 0.1 e-/DN, inf)")
    assert 1 / law.at(z) == pytest.approx(
        stats.truncnorm(-1.35, math.inf, 0.37, 0.2).ppf(stats.norm.cdf(z))
    )
    assert law.unit == "DN/e-"


@given(st.floats(-3, 3), st.floats(0.01, 4))
def test_a_truncated_law_stays_between_its_bounds(low, width):
    shape = Normal(1.0, 2.0).truncated(low, low + width)
    z = np.linspace(-9, 9, 181)
    x = shape.at(z)
    assert (x >= low).all()
    assert (x <= low + width).all()
    assert (np.diff(x) >= 0).all()


@given(st.floats(-9, 9), st.floats(-9, 9))
def test_probabilities_between_two_scores_are_accurate(a, b):
    low, high = sorted((a, b))
    exact = (
        stats.norm.cdf(high) - stats.norm.cdf(low)
        if low < 0
        else stats.norm.sf(low) - stats.norm.sf(high)
    )
    assert share_between(low, high) == pytest.approx(exact, rel=1e-9, abs=1e-15)


#: first draws of each law with the seed 7, by another implementation: Generator(PCG64), then
#: quantiles of SciPy
def test_a_seed_has_the_same_draws_whatever_the_law_beside():
    texts = {
        "a": "normal(2, 1)",
        "b": "beta(2, 5)",
        "c": "triangular(0, 1, 4)",
        "d": "truncated(normal(2, 1), 0, 3)",
    }
    laws = [
        stats.norm(2, 1),
        stats.beta(2, 5),
        stats.triang(0.25, 0, 4),
        stats.truncnorm(-2, 1, 2, 1),
    ]
    drawn = draw_laws({name: read_law(text) for name, text in texts.items()}, 5, [7, 1])
    z = np.random.Generator(np.random.PCG64(np.random.SeedSequence([7, 1]))).standard_normal((5, 4))
    for i, (name, law) in enumerate(zip(texts, laws, strict=True)):
        assert drawn[name] == pytest.approx(law.ppf(stats.norm.cdf(z[:, i])), rel=1e-9)


# --- wrong forms ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("law", "message"),
    [
        (
            "truncated(normal(2 e-, 1 e-), 0 e-)",
            "lower bound or -inf, and its upper bound or inf: write truncated",
        ),
        ("truncated(normal(2 e-, 1 e-))", "lower bound or -inf"),
        ("truncated(2 e-, 0 e-, 3 e-)", "needs a distribution, its lower bound"),
        ("truncated(normal(2 e-, 1 e-), -inf, inf)", "needs a bound"),
        ("truncated(normal(2 e-, 1 e-), 3 e-, 1 e-)", "lower bound 3 must be smaller"),
        ("truncated(normal(2 e-, 1 e-), 0 nm, inf)", "0 nm and normal.* must have the same unit"),
        ("truncated(normal(2 e-, 1 e-), 90 e-, inf)", "less than 1e-9 of the distribution"),
        ("truncated(uniform(2 e-, 3 e-), 4 e-, 5 e-)", "less than 1e-9 of the distribution"),
        ("truncated(discrete(1 e-, 2 e-), 2 e-, inf)", "fewer than two values"),
        (
            "truncated(truncated(normal(2 e-, 1 e-), 0 e-, inf), 1 e-, inf)",
            "cannot be truncated again",
        ),
        ("truncated(normal(2 e-, 0 e-), 0 e-, inf)", "standard deviation must be greater than 0"),
        ("triangular(9 e-, 12 e-)", "least, most probable and largest value: write triangular"),
        ("triangular(9 e-, 13 e-, 12 e-)", "must stand in this order"),
        ("triangular(9 e-, 9 e-, 9 e-)", "must stand in this order"),
        ("triangular(9 e-, 10 nm, 12 e-)", "same unit"),
        ("beta(0, 2)", "shape parameters of a beta distribution must be greater than 0"),
        (
            "beta(2, -1, 0 e-, 1 e-)",
            "shape parameters of a beta distribution must be greater than 0",
        ),
        ("beta(2 e-, 1)", "a shape parameter is a number without a unit"),
        ("beta(2, 1, 0 e-)", "two shape parameters, then the least and the largest value"),
        ("beta(2, 1, 3 e-, 1 e-)", "least value must be smaller"),
        ("discrete(10 e-)", "two or more different values"),
        ("discrete(10 e-, 10 e-)", "two or more different values"),
        ("discrete(10 e- weight 0.2, 12 e- weight 0.7)", "the weights sum to 0.9, not to 1"),
        ("discrete(10 e- weight 0.2, 12 e-)", "a weight for every value, or for none"),
        ("discrete(10 e- weight 0, 12 e- weight 1)", "every weight must be greater than 0"),
        ("discrete(10 e- weight -1, 12 e- weight 2)", "every weight must be greater than 0"),
        (
            "discrete(10 e- weight 1 e-, 12 e- weight 2)",
            r"neither a number|without a unit|10 e- weight 1",
        ),
        ("discrete(10 e-, 12 nm)", "same unit"),
        ("empirical()", "samples in a file"),
        ("empirical(none.csv)", "there is no file"),
        ("empirical(noise.png)", "is not a table of samples"),
        ("normal(1 e-, 2 e-) + normal(1 e-, 2 e-)", "not a complete distribution"),
        ("normal(1 e-, 2 e-, 3 e-)", "needs mean and standard deviation"),
    ],
)
def test_a_wrong_form_is_refused_once_and_where_it_stands(law, message):
    with pytest.raises(RecipeError, match=message) as error:
        load("first_light", [f"sensor.read_noise={law}"])
    assert str(error.value).startswith("argument 1 ")
    assert len(error.value.diagnostics) == 1


@pytest.mark.parametrize(
    ("content", "law", "message"),
    [
        ("1\n" * 20 + "nan\n" * 20, "empirical(a.csv, unit e-)", "sample 21 of a.csv is nan"),
        ("1\n" * 20 + "inf\n" * 20, "empirical(a.csv, unit e-)", "sample 21 of a.csv is inf"),
        (
            "1\n2\n",
            "empirical(a.csv, unit e-)",
            "a.csv has 2 samples, which are too few: give 30 or more",
        ),
        ("1\n" * 40, "empirical(a.csv, unit e-)", "all samples of a.csv are equal"),
        ("", "empirical(a.csv, unit e-)", "a.csv is empty"),
        ("x [e-]\n1\n\n3,4\n", "empirical(a.csv)", "line 4 of a.csv must have 1 values"),
        ("x [e-]\n1\ntwo\n", "empirical(a.csv)", "line 3 of a.csv must contain numbers, not 'two'"),
        ("1,2\n3,4\n", "empirical(a.csv, unit e-)", "must have a heading for each of its columns"),
        (
            "x,y\n1,2\n",
            "empirical(a.csv, unit e-)",
            r"has the columns x, y: write empirical\(a.csv, column NAME\)",
        ),
        ("x,y\n1,2\n", "empirical(a.csv, column z, unit e-)", "has no column z"),
        (
            "x [e-]\n1\n",
            "empirical(a.csv, unit e-)",
            "gives the unit e- of x: remove the unit here",
        ),
        ("x [bar]\n1\n", "empirical(a.csv)", "1 bar is neither a number nor a quantity"),
        ("x\n1\n", "empirical(a.csv, unit bar)", "1 bar is neither a number nor a quantity"),
        ("x\n1\n", "empirical(a.csv, x)", "samples in a file, its column, and their unit"),
    ],
)
def test_a_file_that_has_no_samples_is_refused(tmp_path, content, law, message):
    (tmp_path / "a.csv").write_text(content)
    with pytest.raises(RecipeError, match=message) as error:
        load("first_light", [f"sensor.read_noise={law}"], folder=tmp_path)
    assert str(error.value).startswith("argument 1 ")
    assert len(error.value.diagnostics) == 1


def test_samples_without_their_unit_are_refused_by_what_reads_them(tmp_path):
    np.savetxt(tmp_path / "a.csv", ROWS)
    with pytest.raises(RecipeError, match="needs a unit"):
        load("first_light", ["sensor.read_noise=empirical(a.csv)"], folder=tmp_path)


def test_every_kind_has_an_example_that_is_valid(tmp_path):
    np.savetxt(tmp_path / "noise.csv", ROWS, header="read_noise", comments="")
    for form, _ in KINDS.values():
        law = read_law(form, tmp_path)
        assert law.at(np.array(-2.0)) < law.at(np.array(2.0)), form


# --- files ----------------------------------------------------------------------------------------


def test_the_content_of_a_file_of_samples_counts(table):
    law = "sensor.read_noise=empirical(noise.csv, column read_noise)"
    before = load("first_light", [law], folder=table.parent)
    table.write_text(table.read_text().replace("\n", "\n1", 1))
    after = load("first_light", [law], folder=table.parent)
    one, other = (recipe.uncertain.laws["sensor.read_noise"] for recipe in (before, after))
    assert one.text == other.text
    assert one.identity != other.identity
    assert one.shape != other.shape


def test_the_recipe_of_a_run_names_the_file_wherever_it_is_read(table, tmp_path):
    recipe = load(
        "first_light",
        ["sensor.read_noise=empirical(noise.csv, column read_noise)"],
        folder=table.parent,
    )
    again = tmp_path / "elsewhere" / "again.yaml"
    again.parent.mkdir()
    again.write_text(recipe_text(recipe))
    assert (
        load(again).uncertain.laws["sensor.read_noise"].shape
        == recipe.uncertain.laws["sensor.read_noise"].shape
    )


def test_equal_samples_weigh_together():
    shape = Discrete.of(np.array([3.0, 1.0, 3.0, 2.0]), np.full(4, 0.25))
    assert shape.values.tolist() == [1.0, 2.0, 3.0]
    assert shape.weights.tolist() == [0.25, 0.25, 0.5]
