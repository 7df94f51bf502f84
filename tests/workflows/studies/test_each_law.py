"""Studies of a node of one's own with closed forms: each law, a table and a covariance against
brute force.
"""

import json
import math

import numpy as np
import pytest
from scipy import stats

from neusee.workflows import load
from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.recipe.uncertain_inputs import Inputs
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.output_draws import OutputDraws
from neusee.workflows.studies.run_study import StudyRefused, study_recipe

NODE = '''\
"""Functions with closed forms."""

import math

import torch
from torch import Tensor

from neusee.nodes import node
from neusee.nodes.units import Count, Electrons, Length, Real


@node()
def product(*, x: Electrons = 10.0, y: Real = 1.0, z: Length = 1e-6) -> Tensor:
    """Multiply x squared by y; z does not matter."""
    return torch.tensor(x**2 * y, dtype=torch.float64)


@node()
def ishigami(*, x: Real = 0.0, y: Real = 0.0, z: Real = 0.0, n: Count = 2) -> Tensor:
    """Compute the function of Ishigami and Homma."""
    return torch.tensor(math.sin(x) + 7 * math.sin(y) ** n + 0.1 * z**4 * math.sin(x), dtype=torch.float64)


@node()
def clipped(*, x: Electrons = 10.0) -> Tensor:
    """Clip x at 100 electrons from below."""
    return torch.tensor(max(x, 100.0), dtype=torch.float64)
'''
RECIPE = """\
# Closed forms.
nodes: [closed_forms.py]
values: {x: 10 e-, y: 1, z: 1 um}
angles: {x: 0.1, y: 0.2, z: 0.3, n: 2}
steps:
  product: {node: closed_forms.product, with: {x: "${values.x}", y: "${values.y}", z: "${values.z}"}}
  ishigami:
    node: closed_forms.ishigami
    with: {x: "${angles.x}", y: "${angles.y}", z: "${angles.z}", n: "${angles.n}"}
  clipped: {node: closed_forms.clipped, with: {x: "${values.x}"}}
outputs: [product]
"""
SAMPLES = np.random.default_rng(6).gamma(20.0, 0.5, 400)
COUNT = 400_000


def truncated(rng):
    """Draw a truncated normal law by rejection."""
    wide = rng.normal(10, 2, 4 * COUNT)
    return wide[(wide > 9) & (wide < 12.5)][:COUNT]


#: of each kind one; `recipe/distributions/test_laws.py` has the quantiles of every law
BRUTE = {
    "normal(10 e-, 1 e-)": lambda rng: rng.normal(10, 1, COUNT),
    "beta(2, 5, 8 e-, 13 e-)": lambda rng: 8 + 5 * rng.beta(2, 5, COUNT),
    "discrete(8 e- weight 0.2, 10 e- weight 0.5, 13 e- weight 0.3)": lambda rng: rng.choice(
        [8.0, 10.0, 13.0], COUNT, p=[0.2, 0.5, 0.3]
    ),
    "empirical(samples.csv, unit e-)": lambda rng: rng.choice(SAMPLES, COUNT),
    "truncated(normal(10 e-, 2 e-), 9 e-, 12.5 e-)": truncated,
}


@pytest.fixture(scope="module")
def nodes(tmp_path_factory):
    """Return the file of the nodes, which has one place in a process."""
    path = tmp_path_factory.mktemp("nodes") / "closed_forms.py"
    path.write_text(NODE)
    return path


@pytest.fixture
def own(tmp_path, monkeypatch, nodes):
    """Return a function that studies the recipe of closed forms with other values."""
    (tmp_path / "closed_forms.yaml").write_text(RECIPE.replace("closed_forms.py", str(nodes)))
    np.savetxt(tmp_path / "samples.csv", SAMPLES)
    monkeypatch.chdir(tmp_path)

    def study(words, **options):
        recipe = load("closed_forms.yaml", words)
        folder = study_recipe(
            "uncertainty", recipe, Store(tmp_path / "store"), tmp_path, workers=1, **options
        )
        return json.loads((folder / "provenance.json").read_text())

    return study


INPUTS = ("values.x", "values.y")
EMPIRICAL = "empirical(samples.csv, unit e-)"


def by_input(doc, quantity, kind):
    """Return the Sobol indices of a quantity by the name of the input."""
    rows = zip(doc["inputs"], doc["sensitivity"][quantity][kind], strict=True)
    return {given["name"]: row["value"] for given, row in rows}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "points"), [*((law, "sobol") for law in BRUTE), (EMPIRICAL, "draws")]
)
def test_a_study_of_each_law_is_that_of_brute_force(own, law, points):
    """Mean, standard deviation, quantiles and Sobol indices of x**2 y, against 400,000 draws by
    NumPy.
    """
    doc = own([f"values.x={law}", "values.y=normal(1, 0.1)"], points=points, most=256, error=0.001)
    found = {
        name: value[0]
        for name, value in doc["quantities"]["product"].items()
        if isinstance(value, list)
    }
    rng = np.random.default_rng(8)
    x, y = BRUTE[law](rng), rng.normal(1, 0.1, COUNT)
    product = x**2 * y
    error = 4 * doc["error"] if points == "draws" else 0.03
    assert found["sd"] == pytest.approx(product.std(), rel=error)
    assert found["mean"] == pytest.approx(product.mean(), abs=4 * product.std() / math.sqrt(256))
    assert stats.percentileofscore(product, found["low"]) == pytest.approx(5, abs=4)
    assert stats.percentileofscore(product, found["high"]) == pytest.approx(95, abs=4)
    second = np.var(x**2) * y.mean() ** 2, np.mean(x**2) ** 2 * y.var(), np.var(x**2) * y.var()
    first = np.array(second[:2]) / sum(second)
    total = first + second[2] / sum(second)
    assert doc["sensitivity"]["product"]["explained"] > 0.999
    assert by_input(doc, "product", "first") == pytest.approx(
        dict(zip(INPUTS, first, strict=True)), abs=0.06
    )
    assert by_input(doc, "product", "total") == pytest.approx(
        dict(zip(INPUTS, total, strict=True)), abs=0.06
    )


def test_sobol_indices_of_a_study_are_those_of_the_closed_form(own):
    laws = [f"angles.{axis}=uniform({-math.pi!r}, {math.pi!r})" for axis in "xyz"]
    doc = own([*laws, "outputs=[ishigami]"], points="sobol", most=256, error=0.001)
    first = {"angles.x": 0.3139, "angles.y": 0.4424, "angles.z": 0.0}
    total = {"angles.x": 0.5576, "angles.y": 0.4424, "angles.z": 0.2437}
    assert by_input(doc, "ishigami", "first") == pytest.approx(first, abs=1e-3)
    assert by_input(doc, "ishigami", "total") == pytest.approx(total, abs=1e-3)
    sd = math.sqrt(49 / 8 + 0.1 * math.pi**4 / 5 + 0.01 * math.pi**8 / 18 + 0.5)
    assert doc["quantities"]["ishigami"]["sd"][0] == pytest.approx(sd, rel=4 * doc["error"])


def test_a_table_is_drawn_by_whole_rows(own, tmp_path):
    """Rows on a parabola, which no Gaussian copula has: with all rows, the study has their
    moments exactly.
    """
    rng = np.random.default_rng(9)
    x = 10 + rng.normal(0, 1, 256)
    y = 1 + 0.2 * (x - 10) ** 2
    np.savetxt(
        tmp_path / "rows.csv",
        np.stack([x, y], 1),
        "%.17g",
        ",",
        header="values.x [e-],values.y",
        comments="",
    )
    doc = own(["+posterior=rows.csv"], most=256, error=0.001)
    assert doc["draws"] == 256
    assert doc["quantities"]["product"]["sd"][0] == pytest.approx(
        np.std(x**2 * y, ddof=1), rel=1e-9
    )
    assert doc["quantities"]["product"]["mean"][0] == pytest.approx(np.mean(x**2 * y), rel=1e-9)


def test_a_covariance_is_drawn_as_it_is(own, tmp_path):
    covariance = [[1.0, 0.06], [0.06, 0.01]]
    (tmp_path / "joint.yaml").write_text(
        f"mean: {{values.x: 10 e-, values.y: 1}}\ncovariance: {covariance}\n"
    )
    doc = own(["+posterior=joint.yaml"], points="sobol", most=256, error=0.001)
    x, y = np.random.default_rng(8).multivariate_normal([10, 1], covariance, COUNT).T
    assert doc["quantities"]["product"]["sd"][0] == pytest.approx(np.std(x**2 * y), rel=0.03)


def test_columns_are_converted_to_the_units_of_the_recipe(own, tmp_path):
    """1000 to 2000 nm are 1 to 2 um, and ke- are thousands of electrons."""
    x, z = np.linspace(8, 12, 64), np.linspace(1000, 2000, 64)[::-1]
    rows = np.stack([x / 1000, z], 1)
    np.savetxt(
        tmp_path / "rows.csv",
        rows,
        delimiter=",",
        header="values.x [ke-],values.z [nm]",
        comments="",
    )
    inputs = Inputs.of(load("closed_forms.yaml", ["+posterior=rows.csv"]))
    drawn = dict(zip(inputs.names, inputs.independent(64, 1).values.T, strict=True))
    assert sorted(drawn["values.x"]) == pytest.approx(x)
    assert sorted(drawn["values.z"]) == pytest.approx(z[::-1] * 1e-9)


@pytest.mark.parametrize(
    ("heading", "told"),
    [
        (
            "values.z",
            (
                r"the values.z of the posterior has no unit: write it after the mean, or in the"
                r" heading"
            ),
        ),
        ("values.z [s]", "the values.z of the posterior is in s, and the value of the recipe in m"),
    ],
)
def test_a_column_of_another_unit_is_refused(own, tmp_path, heading, told):
    np.savetxt(tmp_path / "rows.csv", np.linspace(1, 2, 64), header=heading, comments="")
    with pytest.raises(RecipeError, match=told):
        load("closed_forms.yaml", ["+posterior=rows.csv"])


def test_a_covariance_that_none_can_have_is_refused_at_its_line(own, tmp_path):
    recipe = (tmp_path / "closed_forms.yaml").read_text()
    text = (
        recipe
        + "posterior:\n  mean: {values.x: 10 e-, values.y: 1}\n  covariance: [[1, 2], [2, 1]]\n"
    )
    (tmp_path / "wrong.yaml").write_text(text)
    with pytest.raises(
        RecipeError, match=r"wrong.yaml:14:15 +posterior.covariance .*least eigenvalue is -1"
    ):
        load("wrong.yaml")


@pytest.mark.slow
def test_a_changed_file_of_samples_is_another_study(own, tmp_path):
    words = ["values.x=empirical(samples.csv, unit e-)"]
    before = own(words, most=64, error=1.0)
    assert own(words, most=64, error=1.0)["computed"] == 0
    np.savetxt(tmp_path / "samples.csv", 2 * SAMPLES)
    after = own(words, most=64, error=1.0)
    assert after["computed"] >= 64
    assert after["quantities"]["product"]["sd"][0] == pytest.approx(
        4 * before["quantities"]["product"]["sd"][0]
    )


def test_draws_are_the_same_with_any_number_of_processes(own, tmp_path):
    inputs = Inputs.of(load("closed_forms.yaml", [f"values.x={law}" for law in list(BRUTE)[:1]]))
    values = inputs.independent(20, 7).values
    one = OutputDraws(inputs, Store(tmp_path / "one"), workers=1).numbers(values)
    assert OutputDraws(inputs, Store(tmp_path / "three"), workers=3).numbers(values) == one
    assert [row["product"][0] for row in one] == pytest.approx(values[:, 0] ** 2, rel=1e-15)


def test_nothing_that_varies_ends_the_study_before_its_draws(own):
    """Of 10 electrons, clipped at 100 from below, no distribution is left."""
    with pytest.raises(
        StudyRefused,
        match=r"nothing varies: clipped is the same in 5 runs, with all inputs at their",
    ):
        own(["values.x=normal(10 e-, 1 e-)", "outputs=[clipped]"], most=64)
    with pytest.raises(StudyRefused, match=r"no output depends on values\.z"):
        own(["values.z=normal(1 um, 0.1 um)", "outputs=[clipped]"], most=64)
    with pytest.raises(
        StudyRefused, match="--until clipped: this output depends on no uncertain input"
    ):
        own(["values.y=normal(1, 0.1)", "outputs=[product, clipped]"], most=64, until=("clipped",))


def test_an_output_that_varies_at_its_rare_ends_only_is_studied(own):
    doc = own(["values.x=normal(80 e-, 8 e-)", "outputs=[clipped]"], most=64, error=1.0)
    assert doc["quantities"]["clipped"]["sd"][0] >= 0


def test_a_whole_number_is_no_distribution(own):
    with pytest.raises(
        StudyRefused, match=r"angles\.n is a whole number and cannot be sampled: compare"
    ):
        own(["angles.n=discrete(2, 4)", "outputs=[ishigami]"], most=64)


def test_a_bound_of_a_parameter_never_ends_a_study_midway(own):
    """Of normal(10 e-, 3.1 e-) 6e-4 are negative, which Electrons cannot be; 256 draws run to
    the end.
    """
    doc = own(["values.x=normal(10 e-, 3.1 e-)"], most=256, error=0.001)
    law = stats.truncnorm(-10 / 3.1, math.inf, 10, 3.1)
    square = law.moment(4) - law.moment(2) ** 2
    assert doc["quantities"]["product"]["sd"][0] == pytest.approx(
        math.sqrt(square), rel=4 * doc["error"]
    )
    assert "0.00063 of it lies outside the allowed values" in doc["cut off"]["values.x"]


@pytest.mark.parametrize(
    ("law", "told"),
    [
        (
            "discrete(-1 e- weight 0.0005, 2 e- weight 0.9995)",
            r"outside the allowed values .*: remove these values",
        ),
        (
            "truncated(normal(2 e-, 1 e-), -3 e-, inf)",
            r"2\.27% of this distribution .*: set tighter bounds",
        ),
        (
            "normal(2 e-, 1 e-)",
            r"2\.28% of this .*: write truncated\(normal\(2 e-, 1 e-\), 0 e-, inf\)",
        ),
    ],
)
def test_a_law_beyond_a_bound_is_refused_with_what_to_write(own, law, told):
    with pytest.raises(RecipeError, match=told) as error:
        own([f"values.x={law}"], most=64)
    assert str(error.value).startswith("argument 1 ")
