"""Bill of materials of a wheel: what ``all`` brings in, as CycloneDX 1.5, from a lock and what is installed of it.

    ENVIRONMENT/bin/python .ci/make_sbom.py .ci/lock/wheel-cp311-linux-x86_64.txt dist/*.whl > coview-stream.cdx.json

Names, versions and hashes are those of the lock; licences and who needs whom are told by the metadata of packages in
the environment that runs this, into which the lock has been installed. It has no time and no random number in it: the
same wheel and the same lock have the same bill.
"""

from __future__ import annotations

import hashlib
import json
import re
import sys
import tomllib
from collections.abc import Iterable, Iterator
from importlib.metadata import PackageNotFoundError, metadata, requires
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
_LOCKED = re.compile(r"^([A-Za-z0-9._-]+)==(\S+) --hash=sha256:([0-9a-f]{64})$", re.M)
_LONGEST = 100  # characters of a licence's name; some packages put the whole text there


def needed(name: str, extras: Iterable[str] = ()) -> Iterator[Requirement]:
    """Yield what an installed package requires here, nothing for one that is not installed."""
    try:
        texts = requires(name) or []
    except PackageNotFoundError:
        return
    yield from applying(texts, extras)


def applying(texts: Iterable[str], extras: Iterable[str] = ()) -> Iterator[Requirement]:
    """Yield the requirements that apply to this Python and platform, with these extras."""
    for need in map(Requirement, texts):
        if need.marker is None or any(need.marker.evaluate({"extra": extra}) for extra in ("", *extras)):
            yield need


def direct_needs(project: dict[str, Any], extra: str = "all") -> list[str]:
    """Return what a project requires with one of its extras, and with the extras of its own that this one names."""
    own = f"{project['name']}["
    needs = list(project["dependencies"])
    for text in project["optional-dependencies"][extra]:
        if not text.startswith(own):
            needs.append(text)
            continue
        for other in text[len(own) :].partition("]")[0].split(","):
            needs += direct_needs(project, other)
    return sorted(set(needs))


def edges(direct: Iterable[str], locked: set[str]) -> dict[str, set[str]]:
    """Return who needs whom, of what is locked; the project itself is the empty name."""
    found: dict[str, set[str]] = {"": set()}
    todo = [("", need) for need in applying(direct)]
    done: set[tuple[str, str, frozenset[str]]] = set()
    while todo:
        who, need = todo.pop()
        name, extras = canonicalize_name(need.name), frozenset(need.extras)
        if name not in locked or (who, name, extras) in done:
            continue
        done.add((who, name, extras))
        found.setdefault(who, set()).add(name)
        found.setdefault(name, set())
        todo += [(name, each) for each in needed(name, extras)]
    return found


def licences(name: str) -> list[dict[str, Any]]:
    """Return the licences that an installed package states, as CycloneDX has them; none where it states none."""
    try:
        told = metadata(name)
    except PackageNotFoundError:
        return []
    if expression := told.get("License-Expression"):
        return [{"expression": expression}]
    if classified := [each for each in told.get_all("Classifier") or [] if each.startswith("License :: ")]:
        return [{"license": {"name": each.rsplit(" :: ", 1)[1]}} for each in sorted(classified)]
    line = (told.get("License") or "").strip()
    return [{"license": {"name": line}}] if line and "\n" not in line and len(line) <= _LONGEST else []


def document(lock: str, project: dict[str, Any], wheel: Path | None = None) -> dict[str, Any]:
    """Return the bill of materials of a project whose packages a lock has.

    Args:
        lock: text of the lock.
        project: table of that name in pyproject.toml.
        wheel: the file, for its hash.
    """
    packages = {canonicalize_name(name): (version, sha256) for name, version, sha256 in _LOCKED.findall(lock)}
    graph = edges(direct_needs(project), set(packages))
    refs = {name: f"pkg:pypi/{name}@{version}" for name, (version, _) in packages.items()}
    refs[""] = f"pkg:pypi/{project['name']}@{project['version']}"
    own: dict[str, Any] = {
        "type": "library", "bom-ref": refs[""], "name": project["name"], "version": project["version"],
        "purl": refs[""], "licenses": [{"expression": project["license"]}],
    }  # fmt: skip
    if wheel is not None:
        own["hashes"] = [{"alg": "SHA-256", "content": hashlib.sha256(wheel.read_bytes()).hexdigest()}]
    components = []
    for name in sorted(set(graph) - {""}):
        version, sha256 = packages[name]
        component: dict[str, Any] = {
            "type": "library", "bom-ref": refs[name], "name": name, "version": version, "purl": refs[name],
            "hashes": [{"alg": "SHA-256", "content": sha256}],
        }  # fmt: skip
        if stated := licences(name):
            component["licenses"] = stated
        components.append(component)
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {"component": own},
        "components": components,
        "dependencies": [
            {"ref": refs[name], "dependsOn": sorted(refs[other] for other in others)}
            for name, others in sorted(graph.items())
        ],
    }


def main(lock: str, wheel: str | None = None) -> None:
    """Print the bill of materials for a lock and, for its hash, a wheel."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    bill = document(Path(lock).read_text(), project, None if wheel is None else Path(wheel))
    sys.stdout.write(json.dumps(bill, indent=1) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:3])
