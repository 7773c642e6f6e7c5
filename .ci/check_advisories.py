"""Check of what is installed, or locked, against the advisories that are listed beside this file.

    python .ci/check_advisories.py                   # what this Python has installed
    python .ci/check_advisories.py .ci/lock/*.txt    # what is locked

The list is pinned: it knows what was public at its date and was entered by hand. Exit code 1 names each package that
one of them is about, and the versions that it is about; one with a ``waiver`` is told and does not fail.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from importlib.metadata import distributions
from pathlib import Path

from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

ADVISORIES = Path(__file__).with_name("advisories.json")
_LOCKED = re.compile(r"^([A-Za-z0-9._-]+)==([^\s;]+)", re.M)


def locked(text: str) -> dict[str, str]:
    """Return the versions, by name, of a lock."""
    return {canonicalize_name(name): version for name, version in _LOCKED.findall(text)}


def installed() -> dict[str, str]:
    """Return the versions, by name, that this Python has."""
    return {canonicalize_name(each.metadata["Name"]): each.version for each in distributions() if each.metadata["Name"]}


def found(versions: Mapping[str, str], advisories: Iterable[Mapping[str, str]]) -> Iterator[Mapping[str, str]]:
    """Yield the advisories that are about what is there."""
    for advisory in advisories:
        version = versions.get(canonicalize_name(advisory["package"]))
        if version is not None and SpecifierSet(advisory["affected"], prereleases=True).contains(version):
            yield advisory


def main(paths: list[str]) -> int:
    """Check; return the exit code."""
    document = json.loads(ADVISORIES.read_text())
    code = 0
    for where, versions in [(path, locked(Path(path).read_text())) for path in paths] or [("installed", installed())]:
        hits = list(found(versions, document["advisories"]))
        for hit in hits:
            name, waiver = hit["package"], f"; waived: {hit['waiver']}" if hit.get("waiver") else ""
            about = f"{hit['id']} ({hit['about']}), affected {hit['affected']}{waiver}"
            sys.stdout.write(f"{where}: {name} {versions[canonicalize_name(name)]}: {about}\n")
        code |= any(not hit.get("waiver") for hit in hits)
        known = f"{len(hits)} of {len(document['advisories'])} advisories of {document['date']}"
        sys.stdout.write(f"{where}: {len(versions)} packages; {known} are about them\n")
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
