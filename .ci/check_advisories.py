"""Check installed or locked packages against the advisories in advisories.json.

    python .ci/check_advisories.py                   # the packages of this Python
    python .ci/check_advisories.py .ci/lock/*.txt    # the locked packages

The list was entered by hand and is pinned: it knows nothing newer than its date. Exit code 1 if an advisory applies;
one with a ``waiver`` is printed and does not fail.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Sequence
from importlib.metadata import distributions
from pathlib import Path

from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

ADVISORIES = Path(__file__).with_name("advisories.json")
_LOCKED = re.compile(r"^([A-Za-z0-9._-]+)==([^\s;]+)", re.M)


def locked(text: str) -> set[tuple[str, str]]:
    """Return the names and versions in a lock; a package can have a version for each platform."""
    return {(canonicalize_name(name), version) for name, version in _LOCKED.findall(text)}


def installed() -> set[tuple[str, str]]:
    """Return the names and versions of the packages of this Python."""
    return {(canonicalize_name(name), item.version) for item in distributions() if (name := item.metadata["Name"])}


def main(paths: Sequence[str], advisories: Path = ADVISORIES) -> int:
    """Check; return the exit code."""
    document = json.loads(advisories.read_text())
    code = 0
    sets = [(path, locked(Path(path).read_text())) for path in paths] or [("installed", installed())]
    for source, packages in sets:
        hits = 0
        for entry in document["advisories"]:
            affected, waiver = SpecifierSet(entry["affected"], prereleases=True), entry.get("waiver")
            for name, version in sorted(packages):
                if name == canonicalize_name(entry["package"]) and affected.contains(version):
                    about = f"{entry['id']} ({entry['about']}), affected {entry['affected']}"
                    sys.stdout.write(f"{source}: {name} {version}: {about}{f'; waived: {waiver}' if waiver else ''}\n")
                    hits += 1
                    code |= not waiver
        known = f"{hits} of {len(document['advisories'])} advisories of {document['date']} apply"
        sys.stdout.write(f"{source}: {len(packages)} packages; {known}\n")
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
