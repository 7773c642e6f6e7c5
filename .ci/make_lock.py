"""Lock of the packages that CI and a wheel's user get: names, versions and hashes, for pip's ``--require-hashes``.

    python .ci/make_lock.py                  # asks pip what it would install now, and writes .ci/lock/PLATFORM.txt

A lock is of one Python and one platform, for a hash is of one file. It is made again when something is to be newer.
"""

from __future__ import annotations

import json
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
OURS = "coview-stream"
HEAD = "# made by `python .ci/make_lock.py`, of `pip install '.[test]'`; checked by tests/supply_chain\n"


def platform_name() -> str:
    """Return the platform that a lock is of, for example ``cp311-linux-x86_64``."""
    return f"cp{sys.version_info.major}{sys.version_info.minor}-{sysconfig.get_platform()}"


def lock_of(report: dict[str, Any]) -> str:
    """Return the lock for pip's report of an installation; ValueError where something has no hash."""
    lines = []
    for item in report["install"]:
        name, version = item["metadata"]["name"], item["metadata"]["version"]
        if name.replace("_", "-").lower() == OURS:
            continue
        sha256 = item["download_info"].get("archive_info", {}).get("hashes", {}).get("sha256")
        if sha256 is None:
            raise ValueError(f"{name} {version}: pip reports no sha256; install it from an index")
        lines.append(f"{name.replace('_', '-').lower()}=={version} --hash=sha256:{sha256}\n")
    return HEAD + "".join(sorted(lines))


def main() -> None:
    """Ask pip, and write the lock of this platform."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        command = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed"]
        subprocess.run([*command, "--report", str(report), f"{ROOT}[test]"], check=True)
        text = lock_of(json.loads(report.read_text()))
    path = ROOT / ".ci" / "lock" / f"{platform_name()}.txt"
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    sys.stdout.write(f"{path.relative_to(ROOT)}: {text.count('==')} packages\n")


if __name__ == "__main__":
    main()
