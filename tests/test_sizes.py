"""The ratchet: sizes of the house do not grow. tests/sizes.toml holds the limits, and the reason of each one raised.

``python tests/test_sizes.py`` lowers the limits to today's sizes; nothing raises them but a hand.
"""

import ast
import re
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LIMITS = ROOT / "tests" / "sizes.toml"


@cache
def sources(folder: str) -> dict[Path, str]:
    return {path: path.read_text(encoding="utf-8") for path in sorted((ROOT / folder).rglob("*.py"))}


@cache
def nodes() -> list[ast.AST]:
    """Syntax nodes of the package."""
    return [node for text in sources("coview_stream").values() for node in ast.walk(ast.parse(text))]


def lines(folder: str) -> int:
    return sum(len(text.splitlines()) for text in sources(folder).values())


def occurrences(folder: str, pattern: str) -> int:
    return sum(len(re.findall(pattern, text)) for text in sources(folder).values())


def pages() -> list[str]:
    return [path.read_text(encoding="utf-8") for path in (ROOT / "docs").rglob("*.md")]


def readme() -> str:
    return (ROOT / "README.md").read_text(encoding="utf-8")


def docstrings() -> Iterator[str]:
    for node in nodes():
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield ast.get_docstring(node) or ""


def what_per_1000(texts: list[str]) -> float:
    """How often ``what`` stands among a thousand words: a sign of sentences that name nothing."""
    text = " ".join(texts)
    return round(1000 * len(re.findall(r"\bwhat\b", text, re.IGNORECASE)) / len(text.split()), 1)


def largest_class() -> int:
    methods = ast.FunctionDef | ast.AsyncFunctionDef
    return max(sum(isinstance(item, methods) for item in n.body) for n in nodes() if isinstance(n, ast.ClassDef))


def options() -> int:
    """Declarations of options of the command line."""
    calls = (n for n in nodes() if isinstance(n, ast.Call) and getattr(n.func, "attr", "") == "add_argument")
    return sum(any(isinstance(a, ast.Constant) and str(a.value).startswith("--") for a in call.args) for call in calls)


def config_fields() -> int:
    trees = (ast.parse(text) for text in sources("coview_stream/config").values())
    classes = (node for tree in trees for node in tree.body if isinstance(node, ast.ClassDef))
    return sum(isinstance(item, ast.AnnAssign) for node in classes for item in node.body)


SIZES = {
    "package_files": lambda: len(sources("coview_stream")),
    "package_lines": lambda: lines("coview_stream"),
    "kernels_lines": lambda: lines("kernels"),
    "bench_files": lambda: len(sources("bench")),
    "bench_lines": lambda: lines("bench"),
    "tests_lines": lambda: lines("tests"),
    "node_files": lambda: len(sources("coview_stream/stream/node")),
    "largest_class": largest_class,
    "positional_arguments": lambda: max(len(n.args) for n in nodes() if isinstance(n, ast.Call)),
    "options": options,
    "config_fields": config_fields,
    "set_by_hand": lambda: occurrences("coview_stream", "set by hand"),
    "pages": lambda: len(pages()),
    "page_words": lambda: sum(len(text.split()) for text in [*pages(), readme()]),
    "readme_lines": lambda: len(readme().splitlines()),
    "changelog_bullets": lambda: (ROOT / "CHANGELOG.md").read_text(encoding="utf-8").count("\n- "),
    "what_in_docstrings": lambda: what_per_1000(list(docstrings())),
    "what_in_pages": lambda: what_per_1000(pages()),
    "monkeypatched_attributes": lambda: occurrences("tests", r"monkeypatch\.setattr"),
    "private_attributes_in_tests": lambda: occurrences("tests", r"(?<!self)\.(?<!\.\.)_[a-z]\w*"),
}


@pytest.mark.parametrize("name", SIZES)
def test_sizes_do_not_grow(name: str) -> None:
    limit = tomllib.loads(LIMITS.read_text(encoding="utf-8"))[name]
    assert SIZES[name]() <= limit, f"{name}: cut something, or raise the limit in tests/sizes.toml and say why there"


def test_every_limit_is_a_size() -> None:
    assert set(tomllib.loads(LIMITS.read_text(encoding="utf-8"))) == set(SIZES)


if __name__ == "__main__":
    text = LIMITS.read_text(encoding="utf-8")
    for name, limit in tomllib.loads(text).items():
        text = re.sub(
            rf"^{name} = {re.escape(str(limit))}\b", f"{name} = {min(limit, SIZES[name]())}", text, flags=re.M
        )
    LIMITS.write_text(text, encoding="utf-8")
