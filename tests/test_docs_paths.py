"""Names of modules, files and sections in the documentation and in docstrings: each of them exists."""

from __future__ import annotations

import ast
import re
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
SOURCES = sorted(
    path
    for folder in ("coview_stream", "kernels/coview_kernels", "bench", "examples")
    for path in (ROOT / folder).rglob("*.py")
)

DOTTED = re.compile(r"(?<![\w./-])(?:coview_stream|coview_kernels|bench)(?:\.[a-zA-Z_]\w*)+(?![\w/])")
FILE = re.compile(r"(?<![\w./-])(?:coview_stream|coview_kernels|kernels|tests|bench|examples|docs|\.ci)/[\w./-]*\w/?")
BARE_FILE = re.compile(r"`(\w+\.py)`")
MEMBER = re.compile(r"`([A-Z]\w+)\.([a-z]\w*)[`(]")
IMPORT = re.compile(r"^\s*(?:>>> )?from (coview_\w[\w.]*|bench[\w.]*) import ([\w, ]+)", re.MULTILINE)
LINK = re.compile(r"\]\(([^)#\s]*)(?:#([\w-]+))?\)")
ROLE = re.compile(r":(?:mod|class|func|meth|data|attr|exc):`~?([\w.]+)`")
SUFFIXES = {"py", "json", "toml", "md", "cpp", "tum"}  # bench.json is a file, not a module; TRUTH.tum no member


@cache
def module_file(dotted):
    """The file or folder of a module, None if there is none."""
    path = ROOT / ("kernels" if dotted.startswith("coview_kernels") else "") / dotted.replace(".", "/")
    files = (path.with_suffix(".py"), path / "__init__.py", path)
    return next((file for file in files if file.exists()), None)


@cache
def defined(path):
    """All names that a module defines or imports, those of its classes and functions included."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            names.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            names.add(node.attr)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            names.update((alias.asname or alias.name).split(".")[0] for alias in node.names)
    return names


def exists(dotted):
    """Whether a dotted name is a module, or a name in one."""
    parts = dotted.split(".")
    for size in range(len(parts), 0, -1):
        file = module_file(".".join(parts[:size]))
        if file is not None:
            rest = parts[size:]
            return not rest or (file.is_file() and set(rest) <= defined(file))
    return False


def unknown_names(text):
    """Dotted names, paths and imports in a text that lead nowhere."""
    dotted = {name for name in DOTTED.findall(text) if name.rsplit(".", 1)[1] not in SUFFIXES}
    files = set(FILE.findall(text))
    bare = set(BARE_FILE.findall(text)) - file_names()
    members = {
        f"{name}.{member}"
        for name, member in MEMBER.findall(text)
        if member not in SUFFIXES and not has_member(name, member)
    }
    imported = {
        f"{module}.{name.strip()}"
        for module, names in IMPORT.findall(text)
        for name in names.split(",")
        if name.strip()
    }
    missing = {name for name in dotted | imported if not exists(name)}
    missing |= {name for name in files if not any((ROOT / base / name).exists() for base in ("", "kernels"))}
    return sorted(missing | bare | members)


@cache
def file_names():
    """Names of all Python files of the repository."""
    folders = ("coview_stream", "kernels", "tests", "bench", "examples")
    return {path.name for folder in folders for path in (ROOT / folder).rglob("*.py")}


def has_member(name, member):
    """Whether a module of the package that defines the class defines the member too; True for foreign classes."""
    homes = [path for path in SOURCES if name in defined(path)]
    return not homes or any(member in defined(path) for path in homes)


@cache
def docstrings(path):
    """Docstrings and comments of a module."""
    text = path.read_text(encoding="utf-8")
    strings = [
        node.value.value
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    ]
    comments = re.findall(r"(?:^|\s)# (.*)$", text, re.MULTILINE)
    return "\n".join([*strings, *comments])


def headings(page):
    """Anchors of a page, as GitHub makes them of its headings."""
    titles = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_names_in_page_exist(page):
    assert unknown_names(page.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_in_page_lead_somewhere(page):
    for target, anchor in LINK.findall(page.read_text(encoding="utf-8")):
        if "://" in target:
            continue
        file = page.parent / target if target else page
        assert file.exists(), target
        assert not anchor or anchor in headings(file), f"{target}#{anchor}"


def test_names_in_docstrings_exist():
    missing = {str(path.relative_to(ROOT)): names for path in SOURCES if (names := unknown_names(docstrings(path)))}
    assert missing == {}


def test_roles_in_docstrings_name_something():
    missing = {}
    for path in SOURCES:
        for name in set(ROLE.findall(docstrings(path))):
            if name.startswith((".", "coview_", "bench.")):
                known = exists(f"coview_stream{name}" if name.startswith(".") else name)
            else:
                parts = set(name.split("."))
                known = parts <= defined(path) or any(parts <= defined(other) for other in SOURCES)
            if not known and name.partition(".")[0] not in sys.stdlib_module_names:
                missing.setdefault(str(path.relative_to(ROOT)), []).append(name)
    assert missing == {}


@pytest.mark.parametrize(
    "text",
    [
        "see `coview_stream.stream.lane`",
        "see `coview_stream.localization.result.Answer`",
        "in coview_stream/localizer.py",
        "in `whereabouts.py`",
        "`Localizer.take`",
        "from coview_stream.recordings.run import open_run",
    ],
)
def test_unknown_names_are_found(text):
    assert len(unknown_names(text)) == 1


def test_known_names_pass():
    names = ("`coview_stream.recordings.open_run`", "coview_stream/errors.py", "`errors.py`", "`Localizer.step`")
    assert unknown_names(", ".join([*names, "bench.json", "docs/method.md"])) == []
