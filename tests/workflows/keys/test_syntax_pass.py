"""The text of a syntax tree: it differs where the syntax differs, and nowhere else."""

import ast
from pathlib import Path

import pytest

from neusee.workflows.keys import code_digest as engine_digest
from neusee.workflows.keys import module_digest as code_memo
from neusee.workflows.keys import source_summary
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.keys.source_summary import summarise
from neusee.workflows.keys.source_syntax import Syntax

EVERYTHING = '''"""Words."""
from __future__ import annotations
import a.b as c, d
from ..e import f as g, h
if TYPE_CHECKING:
    import k
else:
    k = None
X: int = 1; Y: str
async def outer(p, /, q=1, *r: int, s=None, **t) -> int:
    """More words."""
    global X
    with open(p) as u, v: pass
    async with w as (aa, bb): await cc
    async for i in j: await i
    return lambda z=2: z
def some(): x = yield; yield from x
@deco(1)
class K(Base, metaclass=M):
    """Words of a class."""
    slot: float = 1e-3
    def m(self): nonlocal_ = -1j; del self.x[1:2, ::3], y; return not self
for n in range(3):
    if n < 1 <= 2 != 3: continue
    elif n is not None or n not in (1, 2): break
    else: assert n, "no"
else:
    raise ValueError(f"{n!r:>{w}} b") from None
while True: x += 1; y @= 2; z = x if y else ~z
try: {**a, "b": 1}; [*l, b"2"]; {1, 2}
except (E, F) as error: print(*r, sep="", **t)
else: pass
finally: (w := 3) and w // 2 ** 3
match s:
    case {"a": 1, **rest} if s: pass
    case 1 | [2, *_]: pass
    case Point(x=0, y=None) as pp: pass
    case _: pass
{i: j for i, j in k if i for l in m}; [i for i in j]; {i for i in j}; (i for i in j)
... is Ellipsis
'''


def text_of(tree):
    return [text for _, text in Syntax(tree).texts]


def changes(tree):
    """Copies of a tree, each with one name, number, text, operator, item or part changed."""
    for place, item in enumerate(ast.walk(tree)):
        for field, value in ast.iter_fields(item):
            if field in ("ctx", "kind", "type_comment", "type_ignores"):
                continue
            other = ast.parse(EVERYTHING)
            part = next(each for n, each in enumerate(ast.walk(other)) if n == place)
            if isinstance(value, list) and len(value) > 1:
                setattr(part, field, getattr(part, field)[:-1])
            elif isinstance(value, str):
                setattr(part, field, value + "x")
            elif isinstance(value, bool) or value is None or value is ...:
                setattr(part, field, 7 if isinstance(item, ast.Constant) else value)
            elif isinstance(value, int | float | complex):
                setattr(part, field, value + 1)
            elif isinstance(value, ast.Name):
                setattr(part, field, ast.Constant(value.id))
            elif isinstance(value, ast.operator):
                setattr(part, field, ast.Mod())
            else:
                continue
            yield other


def without_documents(tree):
    """Take the docstrings out of a tree, by the rule of Python itself, and return its dump."""
    for item in ast.walk(tree):
        has_words = isinstance(
            item, ast.Module | ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
        )
        if has_words and ast.get_docstring(item, clean=False) is not None:
            item.body = item.body[1:]
    return ast.dump(tree)


def test_two_trees_have_one_text_exactly_if_python_dumps_them_alike():
    tree = ast.parse(EVERYTHING)
    seen = {without_documents(ast.parse(EVERYTHING)): text_of(tree)}
    count = 0
    for other in changes(tree):
        count += 1
        text = text_of(other)
        dump = without_documents(other)
        assert seen.setdefault(dump, text) == text
    assert count > 200
    texts = [tuple(text) for text in seen.values()]
    assert len(set(texts)) == len(texts) > 200


@pytest.mark.parametrize(
    "edit", [("Words.", "Others."), ("More words.", "M"), ("\nfor n", "\n\n# c\nfor  n")]
)
def test_words_and_layout_change_no_text_and_words_change_the_whole(edit):
    old, new = (summarise(text.encode()) for text in (EVERYTHING, EVERYTHING.replace(*edit)))
    assert old.tree == new.tree
    assert (old.whole != new.whole) == ("words" in edit[0].lower())


def test_blocks_that_do_not_run_have_a_text_and_no_imports():
    source = (
        "if TYPE_CHECKING:\n    import a\nelse:\n    import b\nif __name__ == '__main__':\n   "
        " open('c.csv')\n"
    )
    found = summarise(source.encode())
    assert [way[1] for way in found.imports] == ["b"]
    assert found.constructs == []
    assert found.tree != summarise(source.replace("import a", "import aa").encode()).tree
    inside = (
        "def f():\n    if typing.TYPE_CHECKING:\n        import a\n    else:\n        import b\n"
    )
    assert [way[1] for way in summarise(inside.encode()).imports] == ["b"]


def test_a_source_of_the_program_is_parsed_once_and_then_read_from_the_memo(tmp_path, monkeypatch):
    source = Path(engine_digest.__file__).read_bytes() + b"\nNEVER_SEEN_BEFORE = 1\n"
    first = engine_digest.outline(source)
    Code(tmp_path / "code.json").save()
    code_memo.outlines.clear()
    Code(tmp_path / "code.json")
    monkeypatch.setattr(engine_digest, "syntax_outline", lambda source: pytest.fail("parsed again"))
    assert engine_digest.outline(source) == first
    imports = {module: names for module, names, *_ in first.imports}
    assert "digest" in imports["neusee.workflows.keys.cache_key"]
    assert first.digest == source_summary.summarise(source).tree
