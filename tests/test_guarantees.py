"""Each promise of docs/guarantees.md names tests, and they exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "guarantees.md").read_text(encoding="utf-8")
NAMED = sorted(set(re.findall(r"`(tests/[\w/]+\.py)(?:::(\w+))?`", PAGE)))


def test_page_names_tests():
    assert len(NAMED) > 15


@pytest.mark.parametrize(("file", "test"), NAMED)
def test_named_test_exists(file, test):
    source = (ROOT / file).read_text(encoding="utf-8")
    assert re.search(rf"^def {test or 'test_'}", source, re.MULTILINE)


def test_each_promise_is_shown_by_a_test():
    promises = [line for line in PAGE.splitlines() if line.startswith("| **")]
    assert len(promises) > 10
    for line in promises:
        assert "`tests/" in line or "python -m bench" in line, line
