"""Puts measured tables into a page: ``python -m bench.publish out/bench.json [--peers FILE] [--where FILE]``.

A table goes between ``<!-- table: NAME -->`` and the next ``<!-- end -->``. NAME is ``bench MODULE`` for rows of
``python -m bench --json``, ``bench.peers`` for the answers of ``python -m bench.peers --json``, ``bench.where`` for
what that prints, and ``machine`` for where that was: publish on the machine, and from the environment, that measured.
What was not measured stays as it is.
"""

from __future__ import annotations

import argparse
import datetime
import importlib.metadata
import json
import platform
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from bench.__main__ import HEAD, cells
from bench.harness.rows import Row
from bench.harness.tables import table
from bench.peers import peers
from bench.peers.trial import Trial

T = TypeVar("T")

PAGE = Path("docs/performance.md")
_PACKAGES = (
    "numpy",
    "scipy",
    "taichi",
    "quadrants",
    "open3d-cpu",
    "small-gicp",
    "kiss-matcher",
    "map-closures",
)
_PLACE = re.compile(r"(<!-- table: ([^>]*?) -->\n).*?(<!-- end -->)", re.DOTALL)


def filled(page: str, tables: Mapping[str, str]) -> str:
    """Return the page with the tables in their places.

    Raises:
        ValueError: the page has no place for one of the tables.
    """
    places = {match[2] for match in _PLACE.finditer(page)}
    if missing := sorted(set(tables) - places):
        raise ValueError(
            f"no place for {', '.join(missing)}: add '<!-- table: {missing[0]} -->' and '<!-- end -->'"
        )

    def put(match: re.Match[str]) -> str:
        return f"{match[1]}{tables[match[2]]}\n{match[3]}" if match[2] in tables else match[0]

    return _PLACE.sub(put, page)


def suite_tables(rows: Sequence[Row]) -> dict[str, str]:
    """One table per benchmark; what stands before the slash in a row's name says which."""
    names = dict.fromkeys(_module(row) for row in rows)
    return {
        f"bench {name}": table(HEAD, [_short(row, name) for row in rows if _module(row) == name])
        for name in names
    }


def _module(row: Row) -> str:
    return re.split(r"[/,:]", row.name, maxsplit=1)[0].strip()


def _short(row: Row, name: str) -> list[str]:
    first, *rest = cells(row)
    return [first.removeprefix(name).lstrip("/,: ") or first, *rest]


def peers_table(answers: Sequence[dict[str, Any]]) -> str:
    """All peers in all worlds; those that did nothing say why below."""
    trials = [Trial(**{**one, "prepare_s": _or_nan(one["prepare_s"])}) for one in answers]
    shown = table(peers.HEAD, [peers.cells(trial) for trial in trials])
    troubles = [f"{trial.peer}, {trial.scene}: {trial.trouble}" for trial in trials if trial.trouble]
    return shown + "".join(f"\n\n{trouble}" for trouble in troubles)


def _or_nan(value: float | None) -> float:
    return float("nan") if value is None else value


def machine() -> str:
    """Describe machine and environment in one line."""
    versions = []
    for package in _PACKAGES:
        try:
            versions.append(f"{package} {importlib.metadata.version(package)}")
        except importlib.metadata.PackageNotFoundError:
            continue
    day = datetime.date.today().isoformat()
    return f"Measured {day}: {_processor()}; Python {platform.python_version()}, {', '.join(versions)}."


def _processor() -> str:
    from coview_kernels.runtime import cores

    info = Path("/proc/cpuinfo")
    found = re.search(r"model name\s*:\s*(.*)", info.read_text()) if info.is_file() else None
    return f"{cores()} cores of {found[1].strip() if found else platform.processor() or platform.machine()}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Fill the page."""
    parser = argparse.ArgumentParser(prog="python -m bench.publish", description=__doc__)
    parser.add_argument("rows", type=Path, metavar="BENCH.json", nargs="?")
    parser.add_argument("--peers", type=Path, metavar="PEERS.json")
    parser.add_argument("--where", type=Path, metavar="FILE", help="what bench.where has printed")
    parser.add_argument("--page", type=Path, default=PAGE, help=f"({PAGE})")
    options = parser.parse_args(arguments)
    if not (options.rows or options.peers or options.where):
        parser.error("nothing to publish: name a file")
    tables = {"machine": machine()}
    try:
        if options.rows:
            tables |= _read(options.rows, lambda text: suite_tables([Row.from_dict(r) for r in _list(text)]))
        if options.peers:
            tables["bench.peers"] = _read(options.peers, lambda text: peers_table(_list(text)))
        if options.where:
            tables["bench.where"] = _read(options.where, str.strip)
        options.page.write_text(_read(options.page, lambda page: filled(page, tables)))
    except ValueError as error:
        print(f"bench.publish: {error}", file=sys.stderr)
        return 2
    print(f"{options.page}: {', '.join(tables)}")
    return 0


def _read(file: Path, parse: Callable[[str], T]) -> T:
    """Parse a file; ValueError names the one that cannot be."""
    try:
        return parse(file.read_text())
    except OSError as error:
        raise ValueError(f"{file}: {error.strerror}") from error
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"{file} is not what belongs here: {error}") from error


def _list(text: str) -> list[dict[str, Any]]:
    found = json.loads(text)
    if not isinstance(found, list) or not found:
        raise ValueError("a list of objects is expected, with at least one")
    return found


if __name__ == "__main__":
    sys.exit(main())
