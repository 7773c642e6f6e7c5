"""Resolve the package for platforms that CI does not run on: from wheels alone, nothing built.

    pip install uv && python .ci/check_platforms.py [--all]

Prints a table: for each platform and Python, whether the robot's side, ``[node]`` and ``[all]`` resolve; takes minutes.
Exit code 1 where one that docs/small.md promises does not. ``--all``: also older glibc, and Windows.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PARTS = ("", "node", "all")
PROMISED = {"x86_64-manylinux_2_28": PARTS, "aarch64-manylinux_2_28": PARTS, "aarch64-apple-darwin": ("", "node")}
"""Platforms as uv names them, with the oldest glibc, and what docs/small.md says resolves there."""

TRIED = ("x86_64-manylinux_2_17", "x86_64-pc-windows-msvc")
PYTHONS = ("3.11", "3.12", "3.13", "3.14")


def resolves(uv: str, platform: str, python: str, part: str) -> str:
    """Return an empty text, or why a part cannot be resolved."""
    command = [uv, "pip", "compile", "--quiet", "--no-build", "--python-platform", platform, "--python-version", python]
    done = subprocess.run(
        [*command, *(["--extra", part] if part else []), str(ROOT / "pyproject.toml")],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, check=False,
    )  # fmt: skip
    return "" if done.returncode == 0 else " ".join(done.stderr.split())[:300] or "uv failed"


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--all", action="store_true")
    more = parser.parse_args().all
    uv = shutil.which("uv", path=str(Path(sys.executable).parent)) or shutil.which("uv")
    if uv is None:
        sys.stdout.write("uv is not installed: pip install uv\n")
        return 1
    failed = False
    for platform in (*PROMISED, *(TRIED if more else ())):
        for python in PYTHONS:
            wrong = {part: resolves(uv, platform, python, part) for part in PARTS}
            cells = "  ".join(f"{part or 'plain'} {'no' if why else 'yes'}" for part, why in wrong.items())
            sys.stdout.write(f"{platform:<24} {python}  {cells}\n")
            for part, why in wrong.items():
                if why and part in PROMISED.get(platform, ()):
                    failed = True
                    sys.stdout.write(f"  {part or 'plain'}: {why}\n")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
