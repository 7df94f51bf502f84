"""Networks of a user: computed and keyed with their code, and their mistakes located before the
run.
"""

import os
import pickle
import subprocess
import sys

import pytest
import torch
from safetensors.torch import load_file, save_file

from neusee.nodes import restore
from neusee.nodes.own_modules import Architecture
from neusee.workflows import RecipeError, Store, load, run
from neusee.workflows.graph.errors import RunError
from neusee.workflows.recipe.node_families import NO_CODE_VARIABLE

NETWORK = '''\
"""Networks."""

import time

import torch
from {helper} import share
from torch import nn


class Small(nn.Module):
    """A network."""

    multiple = 4

    def __init__(self, width=3, mean=True):
        super().__init__()
        self.first, self.last = nn.Conv2d(3, width, 3, 2, 1), nn.ConvTranspose2d(width, 3, 4, 2, 1)
        self.norm, self.drop, self.mean = nn.BatchNorm2d(width), nn.Dropout(0.5), mean
        self.register_buffer("kernel", torch.full((3, 1, 1), 0.5), persistent=False)

    def forward(self, x):
        return x * self.kernel + share() * self.last(self.drop(self.norm(self.first(x))))


class Plain(nn.Conv2d):
    def __init__(self, width=3, **others):
        super().__init__(3, width, 1, **others)


class Two(Plain):
    def forward(self, x):
        return super().forward(x), x


class Noisy(Plain):
    def forward(self, x):
        return super().forward(x) + torch.rand_like(x)


class Counting(Plain):
    calls = 0

    def forward(self, x):
        self.calls += 1
        return super().forward(x) * self.calls


class Writing(Plain):
    def forward(self, x):
        return super().forward(x.mul_(2))


class Secret(Plain):
    def forward(self, x):
        x.data.mul_(2)
        return super().forward(x)


class Endless(Plain):
    def forward(self, x):
        return super().forward(x) / 0


class Halving(Plain):
    def forward(self, x):
        return super().forward(x)[..., ::2, ::2]


class Eight(Plain):
    def forward(self, x):
        return super().forward(x).unflatten(-1, (-1, 8)).flatten(-2)


class Double(Plain):
    def forward(self, x):
        return super().forward(x).double()


class Whole(Plain):
    def forward(self, x):
        return super().forward(x).long()


class Odd(Plain):
    multiple = 0.5


class Timed(Plain):
    def forward(self, x):
        return super().forward(x) * (1 + 0 * time.time())


def small():
    return 1
'''
RECIPE = """\
# Mine.
nodes: [{family}.py]
network: {{architecture: {family}.Small, parameters: {{width: 4}}, weights: small.safetensors, multiple: null}}
steps:
  scene: {{node: scene.targets, with: {{kind: points, shape: [21, 30]}}}}
  restored:
    node: restore.network
    from: scene
    with:
      architecture: "${{network.architecture}}"
      parameters: "${{network.parameters}}"
      weights: "${{network.weights}}"
      multiple: "${{network.multiple}}"
outputs: [restored]
"""

pytestmark = pytest.mark.usefixtures("forget")


@pytest.fixture
def mine(tmp_path):
    """Write networks, the weights of one and a recipe with it, and give the recipe."""

    def mine(family="net_a", share=0.5):
        (tmp_path / f"{family}_helper.py").write_text(f"def share():\n    return {share}\n")
        (tmp_path / f"{family}.py").write_text(NETWORK.format(helper=f"{family}_helper"))
        (tmp_path / "mine.yaml").write_text(RECIPE.format(family=family))
        sys.path.append(str(tmp_path))
        trained = __import__(family).Small(4)
        torch.manual_seed(3)
        for one in trained.state_dict().values():
            one.copy_(torch.rand_like(one) if one.is_floating_point() else one)
        save_file(trained.state_dict(), tmp_path / "small.safetensors")
        return tmp_path / "mine.yaml"

    return mine


def problems(*arguments):
    with pytest.raises(RecipeError) as caught:
        load(*arguments)
    return [f"{p.mark} | {p.path} | {p.message}" for p in caught.value.diagnostics]


def test_the_picture_goes_through_the_class_with_its_weights(mine, tmp_path):
    recipe = load(mine(), ["outputs=[scene, restored]"], tmp_path)
    with torch.random.fork_rng():
        torch.manual_seed(5)
        before = torch.random.get_rng_state()
        found = run(recipe, store=Store(tmp_path / "cache"))
        assert torch.equal(torch.random.get_rng_state(), before)
    net = sys.modules["net_a"].Small(4)
    net.load_state_dict(load_file(tmp_path / "small.safetensors"))
    # to multiples of 4
    padded = torch.nn.functional.pad(found["scene"][None], (0, 2, 0, 3), "reflect")
    with torch.no_grad():
        wanted = net.eval()(padded)[0, :, :21, :30]
    assert torch.equal(found["restored"], wanted)
    assert restore.network(
        found["scene"],
        architecture=type(net),
        parameters={"width": 4},
        weights=tmp_path / "small.safetensors",
    ).equal(wanted)


def test_a_recipe_is_the_same_in_another_folder_and_as_a_final_recipe(mine, tmp_path, monkeypatch):
    recipe = load(mine(), (), tmp_path)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    (tmp_path / "elsewhere" / "final.yaml").write_text(recipe.config.to_yaml())
    again = load(tmp_path / "elsewhere" / "final.yaml")
    assert str(again.steps["restored"].params["architecture"]) == "net_a.Small"
    store = Store(tmp_path / "cache")
    assert run(recipe, store=store).keys == run(again, store=store).keys


@pytest.mark.slow
def test_an_edit_of_the_class_or_of_its_helper_runs_it_again_and_why_names_it(mine, tmp_path):
    mine("net_k")
    env = {**os.environ, "NEUSEE_CACHE": str(tmp_path / "cache")}

    def say(*words):
        command = [sys.executable, "-m", "neusee", *words]
        ran = subprocess.run(
            command, cwd=tmp_path, env=env, capture_output=True, text=True, check=False
        )
        assert ran.returncode in (0, 3), ran.stdout + ran.stderr
        return ran.stdout

    def edited(file, old, new):
        text = (tmp_path / file).read_text()
        assert old in text
        (tmp_path / file).write_text(text.replace(old, new))

    say("run", "mine.yaml")
    edited("net_k.py", "return x * self.kernel +", "return x * self.kernel -")
    assert "restored: class Small in net_k.py changed" in say("why", "restored", "mine.yaml")
    edited("net_k.py", "return x * self.kernel -", "return x * self.kernel +")
    edited("net_k_helper.py", "return 0.5", "return 0.25")
    assert "restored: code of share() in net_k_helper.py changed" in say(
        "why", "restored", "mine.yaml"
    )


#: what is overridden, and the start of the mistake that it makes
MISTAKES = [
    ("network.architecture=net_m.Smal", "net_m has no network class Smal; did you mean Small?"),
    (
        "network.architecture=net_m.small",
        "net_m.small is no class of torch.nn.Module; did you mean Small?",
    ),
    (
        "network.architecture=other.Small",
        (
            "no family of your own has the name other; there are: net_m; list the file of the class,"
            " such as `nodes"
        ),
    ),
    (
        "network.architecture=net_m",
        "must be the name of a network class in a family of your own, such as mynet.Small",
    ),
    ("network.architecture=3", "must be the name of a network class in a family of your own"),
    ("network.architecture=null", "name the class of the network, such as mynet.SmallUNet"),
    ("network.parameters={with: 3}", "net_m.Small takes no argument with; did you mean width?"),
    (
        "network.parameters={width: -1}",
        "net_m.Small(width=-1): Trying to create tensor with negative dimension -1",
    ),
    ("network.parameters=4", "must be a mapping"),
    ("network.multiple=0", "must be greater than or equal to 1"),
    ("network.weights=null", "a network needs trained weights: train them by `neusee train`"),
    ("network.weights=none.safetensors", "no such file: "),
    ("network.weights=mine.yaml", "mine.yaml is not a safetensors file"),
    ("network.weights=cut.safetensors", "cut.safetensors is not a safetensors file"),
    (
        "network.weights=small.pth",
        "small.pth is a pickle, which can run code when it is read: save the weights as .safe",
    ),
    (
        "network.weights=nan.safetensors",
        "nan.safetensors: first.bias holds 1 values that are not finite",
    ),
    (
        "network.weights=other.safetensors",
        "other.safetensors was trained with class: Other, and this network has class: ",
    ),
    (
        "network.weights=mean.safetensors",
        (
            'mean.safetensors was trained with parameters: {"mean": false, "width": 4}, and this'
            ' network has parameters: {"mean": true, "width": 4}; write parameters: {"mean": false,'
            ' "width": 4}'
        ),
    ),
    ("Two", "net_m.Two returns a tuple, not one picture 1 x 3 x 33 x 35"),
    (
        "Noisy",
        (
            "net_m.Noisy gives other numbers for the same picture in eval(): draw random numbers"
            " only while self.tr"
        ),
    ),
    ("Counting", "net_m.Counting gives other numbers for the same picture in eval(): "),
    ("Writing", "net_m.Writing changes its input: work on a copy, such as picture.clone()"),
    ("Secret", "net_m.Secret changes its input: work on a copy, such as picture.clone()"),
    (
        "Endless",
        (
            "net_m.Endless returns 3465 values that are not finite (NaN or infinity) for 1 x 3 x 33"
            " x 35"
        ),
    ),
    (
        "Halving",
        (
            "net_m.Halving returns 1 x 3 x 17 x 18 for a picture 1 x 3 x 33 x 35: return the same"
            " shape; if it needs sides"
        ),
    ),
    ("Eight", "net_m.Eight fails for a picture 1 x 3 x 33 x 35: net_m.py:71: unflatten: "),
    ("Double", "net_m.Double returns torch.float64 for torch.float32: keep the type"),
    ("Whole", "net_m.Whole returns torch.int64: return floating-point numbers"),
    ("Odd", "net_m.Odd.multiple = 0.5 must be a whole number from 1"),
]


@pytest.mark.parametrize(
    ("given", "message"), MISTAKES, ids=lambda text: text[:30].replace(" ", "_")
)
def test_a_mistake_is_located_before_anything_runs(given, message, mine, tmp_path):
    recipe = mine("net_m")
    state = {"first.weight": torch.ones(4, 3, 3, 3), "first.bias": torch.full((4,), torch.inf)}
    state["first.bias"][1:] = 0
    whole = load_file(tmp_path / "small.safetensors")
    save_file({**whole, "first.bias": state["first.bias"]}, tmp_path / "nan.safetensors")
    save_file(whole, tmp_path / "other.safetensors", {"neusee.options": '{"class": "Other"}'})
    options = '{"parameters": {"mean": false, "width": 4}}'
    save_file(whole, tmp_path / "mean.safetensors", {"neusee.options": options})
    (tmp_path / "cut.safetensors").write_bytes((tmp_path / "small.safetensors").read_bytes()[:99])
    (tmp_path / "small.pth").write_bytes(b"")
    if "=" not in given:
        given, more = f"network.architecture=net_m.{given}", ["network.parameters=null"]
    else:
        more = []
    found = problems(recipe, [given, *more], tmp_path)
    assert len(found) == 1
    place, path, text = found[0].split(" | ", 2)
    assert place == "argument 1"
    assert path.startswith(given.partition("=")[0])
    assert text.startswith(message)


def test_a_file_that_cannot_be_imported_is_one_mistake_at_its_entry(mine, tmp_path):
    recipe = mine("net_b")
    (tmp_path / "net_c.py").write_text("import nothing_of_this_name\n")
    recipe.write_text(recipe.read_text().replace("net_b", "net_c"))
    (found,) = problems(recipe, (), tmp_path)
    assert found.startswith(
        "mine.yaml:2:9 | nodes.0 = net_c.py | net_c.py cannot be imported: net_c.py:1: ModuleNotF"
    )
    (tmp_path / "net_d.py").write_text("from torch import nn\n")
    recipe.write_text(recipe.read_text().replace("net_c", "net_d"))
    (found,) = problems(recipe, (), tmp_path)
    assert found.startswith("mine.yaml:2:9 | nodes.0 = net_d.py | net_d defines no node")


def test_weights_of_other_shapes_are_a_mistake_at_the_file_of_weights(mine, tmp_path):
    (found,) = problems(mine("net_s"), ["network.parameters={width: 5}"], tmp_path)
    assert found.startswith("mine.yaml:3:71 | network.weights = small.safetensors | ")
    assert found.endswith("small.safetensors: first.bias is (4,), net_s.Small has (5,)")


def test_a_class_that_reads_a_clock_has_no_key(mine, tmp_path):
    whole = {"weight": torch.ones(3, 3, 1, 1), "bias": torch.zeros(3)}
    recipe = mine("net_t")
    save_file(whole, tmp_path / "small.safetensors")
    loaded = load(recipe, ["network.architecture=net_t.Timed", "network.parameters=null"], tmp_path)
    with pytest.raises(RunError, match=r"mine.yaml:6:3 .*net_t.py:90: time.time: a clock"):
        run(loaded, store=Store(tmp_path / "cache"))


def test_no_code_refuses_the_class_and_a_file_of_torch_export(mine, tmp_path, monkeypatch):
    recipe = mine("net_n")
    (tmp_path / "whole.pt2").write_bytes(b"")
    (tmp_path / "bare.yaml").write_text(
        "# Bare.\nsteps:\n  scene: {node: scene.targets, with: {kind: points, shape: [8, 8]}}\n "
        " restored: {node: restore.network, from: scene, with: {weights: whole.pt2}}\noutputs:"
        " [restored]\n"
    )
    monkeypatch.setenv(NO_CODE_VARIABLE, "1")
    assert any(
        "names code, which NEUSEE_NO_CODE" in text for text in problems(recipe, (), tmp_path)
    )
    (found,) = problems(tmp_path / "bare.yaml", (), tmp_path)
    assert (
        found
        == "bare.yaml:4:66 | steps.restored.with.weights = whole.pt2 | a file of torch.export holds"
        " code, which NEUSEE_NO_CODE or --no-code refuses to run"
    )


def test_an_architecture_is_pickled_by_name_with_the_files_of_its_process(mine, tmp_path):
    load(mine("net_p"), (), tmp_path)
    network = sys.modules["net_p"].Small
    made, (name, module, qualname, files) = Architecture("net_p.Small", network).__reduce__()
    assert (name, module, qualname) == ("net_p.Small", "net_p", "Small")
    assert str(tmp_path / "net_p.py") in files
    assert pickle.loads(pickle.dumps(Architecture("net_p.Small", network))).network is network
    assert made(name, module, qualname, files) == Architecture("net_p.Small", network)
