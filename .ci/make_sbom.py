"""Bill of materials of the wheel: what it brings in, as CycloneDX 1.5, from a lock.

    python .ci/make_sbom.py .ci/lock/cp311-linux-x86_64.txt > coview-stream.cdx.json

It lists what ``pip install`` takes in by requirement, and not the packages of extras, which a plain installation does
not bring.
"""

from __future__ import annotations

import json
import re
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
_LOCKED = re.compile(r"^([A-Za-z0-9._-]+)==(\S+) --hash=sha256:([0-9a-f]{64})$", re.M)


def wanted(direct: list[str], locked: set[str]) -> set[str]:
    """Return the names that requirements bring in, with theirs, of those that are locked."""
    todo = [Requirement(each) for each in direct]
    names: set[str] = set()
    done: set[tuple[str, frozenset[str]]] = set()
    while todo:
        need = todo.pop()
        name, extras = canonicalize_name(need.name), frozenset(need.extras)
        applies = need.marker is None or any(need.marker.evaluate({"extra": extra}) for extra in ("", *extras))
        if not applies or name not in locked or (name, extras) in done:
            continue
        done.add((name, extras))
        names.add(name)
        try:
            for text in requires(name) or []:
                each = Requirement(text)
                if each.marker is None or any(each.marker.evaluate({"extra": extra}) for extra in ("", *extras)):
                    each.marker = None
                    todo.append(each)
        except PackageNotFoundError:
            continue  # of another platform
    return names


def document(lock: str, project: dict[str, Any]) -> dict[str, Any]:
    """Return the bill of materials of a project whose packages a lock has."""
    packages = {canonicalize_name(name): (version, sha256) for name, version, sha256 in _LOCKED.findall(lock)}
    names = sorted(wanted(project["dependencies"], set(packages)))
    own = f"pkg:pypi/{project['name']}@{project['version']}"
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {
            "component": {
                "type": "library", "bom-ref": own, "name": project["name"], "version": project["version"], "purl": own,
                "licenses": [{"license": {"id": project["license"]}}],
            }
        },
        "components": [
            {
                "type": "library", "bom-ref": f"pkg:pypi/{name}@{packages[name][0]}", "name": name,
                "version": packages[name][0], "purl": f"pkg:pypi/{name}@{packages[name][0]}",
                "hashes": [{"alg": "SHA-256", "content": packages[name][1]}],
            }
            for name in names
        ],
        "dependencies": [{"ref": own, "dependsOn": [f"pkg:pypi/{name}@{packages[name][0]}" for name in names]}],
    }  # fmt: skip


def main(path: str) -> None:
    """Print the bill of materials for a lock."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    sys.stdout.write(json.dumps(document(Path(path).read_text(), project), indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1])
