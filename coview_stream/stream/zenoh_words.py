"""What zenoh says when it refuses something, in one short line that ends with the remedy."""

from __future__ import annotations

import difflib
import re
from typing import Any

_REMEDIES = {
    "Address already in use": "another node or router holds the port: --connect to it, or another --listen",
    "Cannot assign requested address": "no address of this machine: --listen on one that it has, or --connect to the "
    "machine that has it",
}
_MESSAGE = re.compile(
    r'JSON error: Message \{ msg: "((?:[^"\\]|\\.)*)", location: (?:Some\(.*?line: (\d+),.*|None.*)'
)
_SYNTAX = re.compile(r"^--> (\d+):(\d+) \|.*\| = (.*)$")
_FIELD = re.compile(r"unknown field `([^`]*)`(?:, (?:expected (?:one of )?)?(.*?))?(?=$| at line )")
_PLACE = re.compile(r" at line (\d+) column \d+")


def reason(error: BaseException) -> str:
    """Return what zenoh says, on one line, without the places in its source, with a remedy where we know one."""
    text = re.sub(r" at \S+\.rs:\d+\.?", "", " ".join(str(error).split()))
    text = _mistake(text.strip()) or type(error).__name__
    for cause, remedy in _REMEDIES.items():
        if cause in text:
            return f"{text}; {remedy}"
    return text


def _mistake(text: str) -> str:
    """Shorten a complaint about a configuration file, which names all keys that there could have been."""
    if found := _MESSAGE.fullmatch(text):
        line = f"line {found[2]}: " if found[2] else ""
        return line + _field(re.sub(r"\\(.)", r"\1", found[1]))
    if found := _SYNTAX.match(text):
        return f"line {found[1]}, column {found[2]}: {found[3]}"
    return _field(text)


def _field(text: str) -> str:
    found: Any = _FIELD.search(text)
    if found is None:
        return text
    place = _PLACE.search(text)
    known = re.findall(r"`([^`]+)`", found[2] or "")
    near = difflib.get_close_matches(found[1], known, 1)
    line = f"line {place[1]}: " if place else ""
    return f"{line}unknown key {found[1]!r}" + (f"; did you mean {near[0]!r}?" if near else "; take it out")
