"""The algorithm on one screen: its two functions are short, and docs/method.md follows their steps."""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from pathlib import Path

import pytest

from coview_stream.localization.localizer import Localizer
from coview_stream.localization.search.global_search import GlobalSearch

PAGE = Path(__file__).resolve().parents[2] / "docs" / "method.md"
MAX_LINES = 40
STEPS = {
    Localizer.step: ["predict", "search", "match to map", "verify", "update"],
    GlobalSearch.update: ["vote", "propose", "score", "register", "decide"],
}


def lines_without_docstring(function):
    source = textwrap.dedent(inspect.getsource(function))
    (tree,) = ast.parse(source).body
    docstring = tree.body[0]
    assert ast.get_docstring(tree)
    return len(source.splitlines()) - (docstring.end_lineno - docstring.lineno + 1)


def headings():
    """Headings of the page, lower case, without what is in brackets."""
    text = PAGE.read_text(encoding="utf-8")
    return [heading.strip().lower() for heading in re.findall(r"^##+ ([^(\n]+)", text, re.MULTILINE)]


@pytest.mark.parametrize("function", STEPS, ids=lambda function: function.__qualname__)
def test_algorithm_fits_on_one_screen(function):
    assert lines_without_docstring(function) <= MAX_LINES


@pytest.mark.parametrize("function", STEPS, ids=lambda function: function.__qualname__)
def test_steps_are_called_in_order_and_are_headings_of_the_method_page(function):
    source, there = inspect.getsource(function), headings()
    for step in STEPS[function]:
        assert re.search(rf"\b_?{step.replace(' ', '_')}\b", source), step
        assert step in there
    if function is GlobalSearch.update:
        called = [name for name in re.findall(r"\b_?(\w+?)\(", source) if name in STEPS[function]]
        assert called == STEPS[function]


def test_headings_of_the_method_page_are_in_the_order_of_the_steps():
    there = headings()
    first = there.index("predict")
    assert there[first : first + 11] == [
        "predict", "search", "vote", "propose", "score", "register", "verify", "decide",
        "match to map", "verify", "update",
    ]  # fmt: skip
