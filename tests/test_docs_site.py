"""The site of docs/: its navigation, the pages written from the code, and commands in all pages parse."""

from __future__ import annotations

import importlib.util
import re
import shlex
from pathlib import Path

import pytest

import coview_stream
from coview_stream.cli import build_parser

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.glob("*.md"))
WRITTEN = "python docs/write_reference.py writes it anew"


def script(path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def commands(page):
    """Calls of coview-stream in the bash blocks of a page."""
    text = page.read_text(encoding="utf-8")
    blocks = re.findall(r"^```bash\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    return calls(line for block in blocks for line in block.replace("\\\n", " ").splitlines())


def mentions(page):
    """Calls in the text of a page, which may leave out what every call needs."""
    prose = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    return calls(line for line in re.findall(r"`([^`]+)`", prose) if re.match(r"coview-stream \w+ \S*[./=-]", line))


def calls(lines):
    """Arguments of those lines that call coview-stream, without comments and pipes; a line with ... is a pattern."""
    found = [re.split(r"\s+[#&>|]|;", line)[0].strip() for line in lines]
    return [shlex.split(call)[1:] for call in found if call.startswith("coview-stream ") and "..." not in call]


def test_navigation_names_pages_that_exist_and_each_once():
    named = re.findall(r"^ *- .*?([\w-]+\.md)$", (DOCS / "site" / "mkdocs.yml").read_text(), re.MULTILINE)
    assert len(named) > 15
    assert len(set(named)) == len(named)
    assert [name for name in named if not (DOCS / name).exists()] == []


def test_pages_that_the_navigation_lacks_are_added():
    nav = [{"Start": "index.md"}, {"Use": [{"Streaming": "streaming.md"}]}]
    config = script(DOCS / "site" / "hooks.py").on_config({"nav": nav})
    more = config["nav"][-1]["More"]
    assert sorted(["index.md", "streaming.md", *more]) == [page.name for page in PAGES]


def test_links_out_of_docs_become_text_and_code_is_left_alone():
    hooks = script(DOCS / "site" / "hooks.py")
    text = "see [Contributing](../CONTRIBUTING.md):\n* one\n\n```text\n[a](../b)\nx\n* y\n```\n"
    expected = "see Contributing (`CONTRIBUTING.md`):\n\n* one\n\n```text\n[a](../b)\nx\n* y\n```\n"
    assert hooks.on_page_markdown(text) == expected
    assert hooks.on_page_content(":class:<code>~coview_stream.a.B</code>") == "<code>B</code>"


def test_options_are_those_of_the_code():
    assert (DOCS / "options.md").read_text(encoding="utf-8") == script(DOCS / "write_reference.py").options_page(), (
        WRITTEN
    )


def test_python_of_the_page_about_frames_runs():
    block = re.search(r"```python\n(.*?)```", (DOCS / "frames.md").read_text(encoding="utf-8"), re.DOTALL)
    exec(compile(block[1], "frames.md", "exec"), {})


def test_map_of_the_pages_for_language_models_leads_somewhere():
    text = (DOCS / "llms.txt").read_text(encoding="utf-8")
    links = re.findall(r"\]\(([^)]+)\)", text)
    assert text.startswith("# coview_stream\n\n> ")
    assert len(links) > 10
    assert [link for link in links if not (DOCS / link).exists()] == []


def test_citation_is_of_this_version():
    lines = (ROOT / "CITATION.cff").read_text(encoding="utf-8").splitlines()
    fields = dict(line.split(": ", 1) for line in lines if re.match(r"[a-z-]+: ", line))
    assert {"cff-version", "message", "title", "version", "license"} <= set(fields)
    assert fields["version"] == coview_stream.__version__


def test_every_option_and_field_says_what_it_means():
    """What stands for itself (an output, a robot's name) may say nothing; a field of the configuration may not."""
    page = (DOCS / "options.md").read_text(encoding="utf-8").partition("## Configuration in Python")[2]
    assert page.count("\n### ") > 10
    assert re.findall(r"^\| `(\w+)` \|.*\|  \|$", page, re.MULTILINE) == []


def test_reference_has_every_public_name():
    page = (DOCS / "api.md").read_text(encoding="utf-8")
    assert page == script(DOCS / "write_reference.py").api_page(), WRITTEN
    assert all(f"::: coview_stream.{name}\n" in page for name in coview_stream.__all__ if not name.startswith("_"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_in_page_parse(page):
    parser = build_parser()
    for call in commands(page):
        parser.parse_args(call)
    for call in mentions(page):
        try:
            parser.parse_args(call)
        except coview_stream.CoViewError as error:
            assert "arguments are required" in str(error), call  # noqa: PT017 (any other error is a wrong option)


def test_commands_are_found_and_a_wrong_option_is_refused():
    assert len([call for page in PAGES for call in commands(page)]) > 10
    assert len([call for page in PAGES for call in mentions(page)]) > 10
    with pytest.raises(coview_stream.CoViewError, match="no-such"):
        build_parser().parse_args(["watch", "--no-such"])
