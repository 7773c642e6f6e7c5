"""Hooks of the site: unnamed pages, links that leave docs/, the Python reference, roles of docstrings."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parents[1]
_OUTSIDE = re.compile(r"\[([^\]]*)\]\((\.\./[^)]*)\)")
_COMMENT = re.compile(r"^(<!--.*-->)\n(?=\S)", re.MULTILINE)
_ITEM = re.compile(r"^(?![*\-|>#\s]|\d+\. |```)(.+)\n(?=[*-] \S)", re.MULTILINE)
_NAMES = re.compile(r"<!-- names -->\n.*?<!-- end -->", re.DOTALL)
_NAME = re.compile(r"^\| ?`(\w+)`", re.MULTILINE)
_ROLE = re.compile(r":\w+:(<code>)~?\.?(?:coview_\w+\.(?:\w+\.)*)?")


def pages_in(nav: Any) -> list[str]:
    """Return the files that a navigation names, whatever its depth."""
    if isinstance(nav, str):
        return [nav]
    parts = nav.values() if isinstance(nav, dict) else nav
    return [page for part in parts for page in pages_in(part)]


def on_config(config: Any) -> Any:
    """Add the pages that the navigation does not name, under "More"."""
    more = sorted({path.name for path in DOCS.glob("*.md")} - set(pages_in(config["nav"])))
    if more:
        config["nav"] = [*config["nav"], {"More": more}]
    return config


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace the table of public names by their docstrings, and make the text fit for Python-Markdown.

    A link out of docs/ becomes its text and path; lists and comments get the blank lines that they need.
    """
    markdown = _NAMES.sub(_reference, markdown)
    parts = re.split(r"(^```.*?^```$)", markdown, flags=re.MULTILINE | re.DOTALL)
    return "".join(part if part.startswith("```") else _prose(part) for part in parts)


def _reference(table: re.Match[str]) -> str:
    return "\n\n".join(f"::: coview_stream.{name}" for name in _NAME.findall(table[0]))


def _prose(text: str) -> str:
    text = _ITEM.sub(r"\1\n\n", _COMMENT.sub(r"\1\n\n", text))
    return _OUTSIDE.sub(lambda link: f"{link[1]} (`{link[2].removeprefix('../')}`)", text)


def on_page_content(html: str, **_: Any) -> str:
    """Show a role of a docstring as the name that it gives."""
    return _ROLE.sub(r"\1", html)
