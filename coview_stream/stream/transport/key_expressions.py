"""Zenoh key expressions: their validity, with remedies for users, and the keys that they match."""

from __future__ import annotations

import re
from itertools import pairwise

from coview_stream.errors import ConfigError

_FORBIDDEN = re.compile(r"[*$?#]")


def check_chunk(text: str, option: str) -> str:
    """Return ``text`` if it can be one chunk of a key, such as a robot's name.

    Args:
        text: what the user gave.
        option: its name in error messages, for example ``--robot``.

    Raises:
        ConfigError: if it is empty, starts with ``@``, or holds one of ``/*$?#`` or what cannot be printed.
    """
    if not text:
        raise ConfigError(f"{option} is empty: give it a name")
    if "/" in text:
        raise ConfigError(f"{option} {text!r} holds a '/': a name is one chunk of a zenoh key")
    return _checked_plain(text, text, option)


def check_prefix(text: str, option: str) -> str:
    """Return ``text`` if it can start a key: one chunk or several. Arguments and errors as in :func:`check_chunk`."""
    for chunk in text.split("/"):
        if not chunk:
            raise ConfigError(f"{option} {text!r} has an empty part: no leading, trailing or double '/'")
        _checked_plain(chunk, text, option)
    return text


def _checked_plain(chunk: str, text: str, option: str) -> str:
    found = _FORBIDDEN.search(chunk)
    if found:
        raise ConfigError(f"{option} {text!r} holds {found.group()!r}, which zenoh reserves in keys: leave it out")
    if chunk.startswith("@"):
        raise ConfigError(f"{option} {text!r}: a part that starts with '@' is hidden from zenoh wildcards: rename it")
    if not chunk.isprintable():
        raise ConfigError(f"{option} {text!r} holds unprintable characters: leave them out")
    return text


def check_expression(text: str, option: str, wildcards: bool = True) -> str:
    """Return ``text`` if it is a key expression in zenoh's canonical form.

    Args:
        text: what the user gave.
        option: its name in error messages.
        wildcards: accept ``*``, ``**`` and ``$*``; False for a key to publish on.

    Raises:
        ConfigError: if it is not one.
    """
    chunks = text.split("/")
    for chunk in chunks:
        if not chunk:
            raise ConfigError(f"{option} {text!r} has an empty part: no leading, trailing or double '/'")
        wild = chunk in ("*", "**") or "$*" in chunk
        if wild and not wildcards:
            raise ConfigError(f"{option} {text!r} has a wildcard, but one can only publish on a plain key")
        rest = "" if chunk in ("*", "**") else chunk.replace("$*", "")
        if _FORBIDDEN.search(rest) or chunk == "$*" or "$*$*" in chunk or not chunk.isprintable():
            raise ConfigError(
                f"{option} {text!r}: {chunk!r} is no part of a zenoh key ('*' and '**' stand alone, '$*' within text)"
            )
    for first, second in pairwise(chunks):
        if first == "**" and second in ("*", "**"):
            short = "**" if second == "**" else "*/**"
            raise ConfigError(f"{option} {text!r}: write '{short}' for '{first}/{second}'")
    return text


def matches(expression: str, key: str) -> bool:
    """Tell whether two valid key expressions have a key in common; a plain ``key``: whether ``expression`` holds it."""
    import zenoh

    return bool(zenoh.KeyExpr(expression).intersects(zenoh.KeyExpr(key)))
