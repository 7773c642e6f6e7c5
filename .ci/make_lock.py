"""Locks of the packages that CI takes in: names, versions and hashes, for pip's ``--require-hashes``.

    python .ci/make_lock.py                  # asks pip what it would install now, and writes .ci/lock/*-PLATFORM.txt

There are three: ``test`` of ``pip install '.[test]'``, ``wheel`` of ``pip install '.[all]'`` (the same
versions), ``build`` of what makes the wheel. A lock is of one Python and one platform, for a hash is of one file. It is
made again when something is to be newer.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import sysconfig
import tempfile
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
OURS = "coview-stream"
LOCKED = re.compile(r"^([A-Za-z0-9._-]+)==([^\s;]+) --hash=sha256:([0-9a-f]{64})$", re.M)


def platform_name() -> str:
    """Return the platform that a lock is of, for example ``cp311-linux-x86_64``."""
    return f"cp{sys.version_info.major}{sys.version_info.minor}-{sysconfig.get_platform()}"


def lock_of(report: dict[str, Any], what: str) -> str:
    """Return the lock for pip's report of an installation; ValueError where something has no hash."""
    lines = []
    for item in report["install"]:
        name, version = item["metadata"]["name"], item["metadata"]["version"]
        if re.sub("[-_.]+", "-", name).lower() == OURS:
            continue
        sha256 = item["download_info"].get("archive_info", {}).get("hashes", {}).get("sha256")
        if sha256 is None:
            raise ValueError(f"{name} {version}: pip reports no sha256; install it from an index")
        lines.append(f"{re.sub('[-_.]+', '-', name).lower()}=={version} --hash=sha256:{sha256}\n")
    head = f"# made by `python .ci/make_lock.py`: {what}; checked by tests/ci/test_supply_chain.py\n"
    return head + "".join(sorted(lines))


def resolve(folder: Path, wanted: list[str], constraints: str = "") -> dict[str, Any]:
    """Return pip's report of what it would install into an empty environment."""
    report, versions = folder / "report.json", folder / "versions.txt"
    versions.write_text("".join(f"{name}=={version}\n" for name, version, _ in LOCKED.findall(constraints)))
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed"]
    subprocess.run([*command, "--constraint", str(versions), "--report", str(report), *wanted], check=True)
    result: dict[str, Any] = json.loads(report.read_text())
    return result


def main() -> None:
    """Ask pip, and write the locks of this platform."""
    backend = tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]["requires"]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        test = lock_of(resolve(folder, [f"{ROOT}[test]"]), "pip install '.[test]'")
        wheel = lock_of(resolve(folder, [f"{ROOT}[all]"], test), "pip install '.[all]'")
        build = lock_of(resolve(folder, ["build", *backend], test), "python -m build --no-isolation")
    for what, text in (("test", test), ("wheel", wheel), ("build", build)):
        path = ROOT / ".ci" / "lock" / f"{what}-{platform_name()}.txt"
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
        sys.stdout.write(f"{path.relative_to(ROOT)}: {len(LOCKED.findall(text))} packages\n")


if __name__ == "__main__":
    main()
