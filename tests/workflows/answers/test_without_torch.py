"""Commands in processes of their own: the repeated command imports no torch, and says and writes
the same.
"""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
LIGHT = """
import sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("torch", "numpy", "pydantic", "ruamel", "typer", "rich"):
            raise RuntimeError(f"{name} is imported")

sys.meta_path.insert(0, Refuse())
from neusee.workflows.cli.app import main
main()
"""
QUICK = ("safety.draws=100", "safety.protection={filter: 1e-2}")


class Terminal:
    """A working folder, a home and a cache, in which commands run in processes of their own."""

    def __init__(self, root):
        self.folder, self.cache, home = root / "work", root / "cache", root / "home"
        # made while a command runs, they would be a change
        for folder in (home, self.cache, self.folder / "runs"):
            folder.mkdir(parents=True)
        self.env = {
            **os.environ,
            "NEUSEE_CACHE": str(self.cache),
            "HOME": str(home),
            "OMP_NUM_THREADS": "1",
        }
        self.env |= {"PYTHONPATH": str(ROOT / ".src"), "PYTEST_CURRENT_TEST": ""}

    def __call__(self, *words, light=False):
        """Run a command; ``light`` refuses the import of torch and other large packages."""
        code = LIGHT if light else LIGHT.replace("sys.meta_path", "#")
        command = [sys.executable, "-c", code, *words]
        done = subprocess.run(
            command, cwd=self.folder, env=self.env, capture_output=True, text=True, check=False
        )
        return done.returncode, done.stdout, done.stderr


@pytest.fixture
def neusee(tmp_path):
    return Terminal(tmp_path)


RUN = """# A frame that a user took.
steps:
  frame:
    node: scene.photograph
    with: {file: frame.png, shape: "${size.shape}"}
size: {shape: [16, 16]}
outputs: [frame]
"""


def refuses(done):
    return done[0] == 1 and "is imported" in done[2]


def plain(text):
    """The text of a command without the number at the end of its folder."""
    return re.sub(r"(_[0-9a-f]{8})(_\d+)?/", r"\1/", text)


@pytest.mark.slow
def test_a_repeated_estimate_is_the_same_without_torch_and_a_new_option_ends_it(neusee):
    words = ("safety", "safety_pointer", *QUICK)
    first = neusee(*words)
    assert first[0] == 0, first
    again = neusee(*words, light=True)
    assert (again[0], plain(again[1]), again[2]) == (0, plain(first[1]), "")
    one, two = (neusee.folder / text.rstrip().rpartition(" ")[2] for text in (first[1], again[1]))
    assert one != two
    for name in ("limits.csv", "recipe.yaml", "figures/irradiance.png", "figures/distances.png"):
        assert (one.parent / name).read_bytes() == (two.parent / name).read_bytes(), name
    said = [json.loads((page.parent / "provenance.json").read_text()) for page in (one, two)]
    assert said[0] | {"date": 0, "seconds": 0} == said[1] | {"date": 0, "seconds": 0}
    assert refuses(neusee(*words, "--json", light=True)), "another command"
    document = json.loads(neusee(*words, "--json")[1])
    repeated = json.loads(neusee(*words, "--json", light=True)[1])
    assert Path(neusee.folder, repeated["report"]).is_file()
    assert repeated | {"report": 0} == document | {"report": 0}
    assert refuses(neusee(*words, "--help", light=True))
    (neusee.folder / "optics").mkdir()
    (neusee.folder / "optics" / "lens_only.yaml").write_text(
        (ROOT / "recipes/optics/lens_only.yaml").read_text()
    )
    assert refuses(neusee(*words, light=True)), "an option beside the recipe hides a packaged one"


@pytest.mark.slow
def test_a_recipe_with_a_mistake_or_code_of_its_own_has_no_stored_answer(neusee):
    text = (ROOT / "recipes/safety_pointer.yaml").read_text()
    (neusee.folder / "mine.py").write_text(
        "from neusee.nodes import node\n\n@node()\ndef twice(x):\n    return 2 * x\n"
    )
    (neusee.folder / "mine.yaml").write_text(f"{text}\nnodes: [mine.py]\n")
    for words, code in ((("mine.yaml", *QUICK), 0), (("safety_pointer", "safety.draws=-1"), 2)):
        assert neusee("safety", *words)[0] == code
        assert refuses(neusee("safety", *words, light=True))
    assert not (neusee.cache / "answers").exists()
    for words in (
        ("validate", "first_light"),
        ("validate", "first_light", "--json"),
        ("config", "first_light"),
    ):
        first = neusee(*words)
        assert first[0] == 0
        assert neusee(*words, light=True) == first
    (neusee.folder / "sensor").mkdir()
    (neusee.folder / "sensor" / "neusee.yaml").write_text(
        (ROOT / "recipes/sensor/neusee.yaml").read_text()
    )
    assert refuses(neusee("config", "first_light", light=True))


def picture(neusee, level):
    from PIL import Image

    Image.new("RGB", (24, 20), (level, 90, 30)).save(neusee.folder / "frame.png")


@pytest.mark.slow
def test_a_run_from_the_cache_is_given_again_until_anything_changes(neusee):
    (neusee.folder / "mine.yaml").write_text(
        f"{RUN}defaults: [size: small]\n".replace("size: {shape: [16, 16]}\n", "")
    )
    (neusee.folder / "size").mkdir()
    (neusee.folder / "size" / "small.yaml").write_text("size: {shape: [16, 16]}\n")
    picture(neusee, 200)
    words = ("run", "mine.yaml")

    def kept(*words):
        """Return the answer without torch, after the runs that compute, load and keep."""
        done = [neusee(*words) for _ in range(2)]
        assert [each[0] for each in done] == [0, 0], done
        again = neusee(*words, light=True)
        assert again[0] == 0, again
        assert again[2] == ""
        seconds = re.compile(r"[0-9.]+ s\)")
        assert seconds.sub("", plain(again[1])) == seconds.sub("", plain(done[1][1]))
        return json.loads((neusee.folder / "runs/latest/provenance.json").read_text())

    assert refuses(neusee(*words, light=True)), "nothing is computed yet"
    assert neusee(*words)[0] == 0
    assert refuses(neusee(*words, light=True)), "the first run has computed its step"
    first = kept(*words)
    assert first["counts"] == "1 cached"
    assert refuses(neusee(*words, "--json", light=True))
    assert refuses(neusee(*words, "size.shape=[8, 8]", light=True))
    other = kept(*words, "size.shape=[8, 8]")
    assert other["steps"][0]["key"] != first["steps"][0]["key"]
    changes = {
        "a frame": lambda: picture(neusee, 201),
        "an option": lambda: (neusee.folder / "size/small.yaml").write_text(
            "size: {shape: [16, 14]}\n"
        ),
        "the recipe": lambda: (neusee.folder / "mine.yaml").write_text(
            f"{RUN}seed: 3\n".replace("16, 16", "16, 12"),
        ),
        "the environment": lambda: neusee.env.update(NEUSEE_CACHE_VERIFY="sampled"),
        "a module that hides a package": lambda: (neusee.folder / "scipy.py").write_text("x = 1\n"),
    }
    seen = {first["steps"][0]["key"]}
    for name, change in changes.items():
        change()
        assert refuses(neusee(*words, light=True)), name
        if name == "a module that hides a package":
            break
        seen.add(kept(*words)["steps"][0]["key"])
    assert len(seen) == 4, (
        "frame, option and recipe each give another result; the environment does not"
    )


@pytest.mark.slow
def test_a_run_with_a_node_of_the_user_is_never_given_again(neusee):
    (neusee.folder / "helper.py").write_text("factor = 2\n")
    (neusee.folder / "mine.py").write_text(
        "import torch\nfrom neusee.nodes import node\nfrom helper import factor\n\n"
        "@node()\ndef made(*, x: float) -> torch.Tensor:\n    return torch.tensor(x * factor)\n"
    )
    (neusee.folder / "mine.yaml").write_text(
        "steps:\n  made: {node: mine.made, with: {x: 3.0}}\noutputs: [made]\nnodes: [mine.py]\n"
    )
    for _ in range(2):
        done = neusee("run", "mine.yaml")
        assert done[0] == 0, done
    assert refuses(neusee("run", "mine.yaml", light=True))
    assert not (neusee.cache / "answers").exists()


@pytest.mark.slow
def test_plan_and_why_are_given_again_until_the_cache_says_something_else(neusee):
    # large enough for a file of its own
    (neusee.folder / "mine.yaml").write_text(RUN.replace("16, 16", "48, 48"))
    picture(neusee, 200)
    plan, why = ("plan", "mine.yaml"), ("why", "frame", "mine.yaml")
    assert neusee(*plan)[0] == 0
    assert refuses(neusee(*plan, light=True)), (
        "a step would run, and its time and the free memory count"
    )
    assert neusee("run", "mine.yaml")[0] == 0
    for words in (plan, why, (*plan, "--json")):
        first = neusee(*words)
        assert first[0] == 0, first
        assert neusee(*words, light=True) == first
    assert "0 of 1 steps would run" in neusee(*plan, light=True)[1]
    assert neusee("run", "mine.yaml", "size.shape=[8, 8]")[0] == 0
    assert refuses(neusee(*why, light=True)), (
        "the journal has one more result, with which this one is compared"
    )
    for words in (plan, why):
        assert neusee(*words)[0] == 0
    key = json.loads((neusee.folder / "runs/latest/provenance.json").read_text())["steps"][0]["key"]
    (neusee.cache / key[:2] / f"{key}.json").unlink()
    assert neusee(*plan, light=True)[0] == 0, "another result is gone"
    for each in neusee.cache.glob("??/*.safetensors"):
        each.unlink()
    for words in (plan, why):
        assert refuses(neusee(*words, light=True)), "the value is gone"
