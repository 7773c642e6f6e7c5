"""Code of an earlier commit beside today's: what a ratio is measured against, in one run."""

from __future__ import annotations

import io
import os
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from bench.harness.files import fingerprint, folder, remembered
from bench.harness.suite import ROOT, thread_settings
from coview_stream.errors import InputError

COMMIT = "1c85769b98b75633f82754048a1a67ec46fd42d2"
"""The last commit whose search registered and verified every place that votes named, one by one."""


class Code(NamedTuple):
    """Checkout with both import roots, and what results that it makes depend on."""

    root: Path
    version: str

    def command(self, *words: str) -> list[str]:
        """Return the command that runs Python with these words, the working directory no import root."""
        return [sys.executable, "-P", *words]

    def environment(self, threads: int = 1) -> dict[str, str]:
        """Return ours with this code's import roots and so many threads."""
        roots = os.pathsep.join((str(self.root), str(self.root / "kernels")))
        return {**os.environ, "PYTHONPATH": roots, **thread_settings(threads)}

    def built(self, sources: Sequence[Path], site: Path, threads: int = 2) -> Path:
        """Return the map that this code's command builds of clouds, built now unless it is there."""
        words = ("-m", "coview_stream", "build", *map(str, sources), "-o", str(site))

        def build() -> None:
            site.parent.mkdir(parents=True, exist_ok=True)
            done = subprocess.run(
                self.command(*words), env=self.environment(threads), cwd=site.parent, capture_output=True, text=True
            )
            if done.returncode:
                raise InputError(f"building {site.name}: {done.stderr.strip().splitlines()[-1]}")

        spec = {"sources": [[path.name, path.stat().st_size] for path in sources], "code": self.version}
        remembered(site.with_suffix(".json"), spec, build)
        return site


def today() -> Code:
    """Return this checkout; its maps depend on all of the product."""
    return Code(ROOT, fingerprint("coview_stream/basemap", "coview_stream/descriptors", "coview_stream/config"))


def pinned(commit: str = COMMIT) -> Code:
    """Return the product at a commit, extracted from this repository's history; InputError if it is not there."""
    root = folder() / f"code-{commit[:7]}"
    if not (root / "kernels").is_dir():
        words = ["git", "-C", str(ROOT), "archive", commit, "coview_stream", "kernels"]
        try:
            packed = subprocess.run(words, check=True, capture_output=True).stdout
        except (OSError, subprocess.CalledProcessError) as error:
            raise InputError(f"commit {commit[:7]} is not in this history; fetch all of it") from error
        root.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=root.parent) as part:
            with tarfile.open(fileobj=io.BytesIO(packed)) as archive:
                archive.extractall(Path(part) / "code", filter="data")
            (Path(part) / "code").rename(root)
    return Code(root, commit)
