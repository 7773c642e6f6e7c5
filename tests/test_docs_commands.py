"""Every command in the bash blocks of docs/ is run, page by page, on a simulated world with the names of the page."""

from __future__ import annotations

import importlib.util
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from nightly import nightly
from recordings import bag_files

from coview_stream.clouds.python_child import python_command, python_environment
from coview_stream.recordings.open_run import open_run
from coview_stream.sim import SimulationConfig, simulate

DOCS = Path(__file__).resolve().parents[1] / "docs"
LASTING = {"serve", "serve-map", "watch"}
"""Commands that go on until they are told to end."""

NEEDS = {"kiss-icp": "kiss_icp", "--foxglove": "foxglove", "--save": "rerun", "--sign": "cryptography"}
"""Modules without which commands with a word are left out."""

NOT_RUN = {
    "pip": "installs",
    "python": "the project's own scripts, with tests of their own",
    "--rerun": "opens a window",
    "demo": "has tests of its own",
}
"""First words, commands or options that are left out, and why."""

LIVE, SECONDS, LIMIT = 8.0, "3", 240.0


def commands(page: Path) -> list[list[str]]:
    """Words of each line of a page's bash blocks."""
    blocks = re.findall(r"^```bash\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines() if line.strip()]
    return [shlex.split(line, comments=True) for line in lines if shlex.split(line, comments=True)]


PAGES = [page for page in sorted(DOCS.glob("*.md")) if commands(page)]


def left_out(words: list[str]) -> bool:
    """Whether a command is not run here."""
    if any(word in NOT_RUN for word in words):
        return True
    return any(name in words and importlib.util.find_spec(module) is None for name, module in NEEDS.items())


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """A folder with what pages name: surveys, runs, a bag and maps."""
    folder = tmp_path_factory.mktemp("pages")
    simulate(folder / "made", SimulationConfig(seed=41, size=140.0, length=9.0, density=8.0))
    base = folder / "made" / "base.laz"
    for name in ("site.laz", "als.laz", "survey.laz"):
        shutil.copy(base, folder / name)
    for name in ("scans", "survey"):
        (folder / name).mkdir()
        shutil.copy(base, folder / name / "one.laz")
    for name in ("run", "RUN"):
        shutil.copytree(folder / "made" / "run", folder / name)
    shutil.copy(folder / "made" / "truth.tum", folder)
    frames = [(round(frame.stamp * 1e9), frame) for frame in open_run(folder / "run")]
    topics = {
        "/points": [bag_files.cloud(stamp, frame.points) for stamp, frame in frames],
        "/odom": [bag_files.odometry(stamp, frame.T_odom_body) for stamp, frame in frames],
    }
    bag_files.write_bag(folder / "bag", topics)
    build = python_command("coview_stream", "build", "site.laz", "-o", "site.coview")
    subprocess.run(build, cwd=folder, env=python_environment(), check=True, capture_output=True)
    for name in ("floor0.coview", "floor1.coview"):
        shutil.copy(folder / "site.coview", folder / name)
    return folder


def run_page(page: Path, folder: Path, cache: Path) -> list[str]:
    """Run a page's commands in order, those that last beside the others; return what went wrong."""
    environment = {**python_environment(), "COVIEW_CACHE": str(cache), "PYTHONUNBUFFERED": "1"}
    lasting: list[tuple[str, subprocess.Popen[str]]] = []
    wrong = []
    for words in commands(page):
        if left_out(words):
            continue
        assert words[0] == "coview-stream", words
        line = shlex.join(words)
        given = [word.replace("tcp/router:", "tcp/127.0.0.1:") for word in words[1:]]
        given = [SECONDS if before == "--seconds" else word for before, word in zip(["", *given], given, strict=False)]
        command = python_command("coview_stream", *given)
        if given[0] in LASTING:
            if given[0] == "serve" or "--web" in given:  # which would have the port of the one before
                wrong += ended(lasting, {"serve", "watch"})
            process = subprocess.Popen(
                command, cwd=folder, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
            )
            lasting.append((line, process))
            time.sleep(LIVE)
            continue
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=LIMIT)
        if done.returncode not in ((0, 1) if given[0] == "doctor" else (0,)) or "Traceback" in done.stderr:
            wrong.append(f"{page.name}: {line}: {done.returncode} {done.stderr[-500:]}")
    return wrong + ended(lasting, LASTING)


def ended(lasting: list[tuple[str, subprocess.Popen[str]]], names: set[str]) -> list[str]:
    """End those that still go on, as Ctrl-C does; return what went wrong."""
    wrong = []
    for line, process in [each for each in lasting if each[0].split()[1] in names]:
        lasting.remove((line, process))
        process.send_signal(signal.SIGINT)
        try:
            said = process.communicate(timeout=30)[1]
        except subprocess.TimeoutExpired:
            process.kill()
            said = process.communicate()[1] + "did not end"
        if process.returncode not in (0, 130) or "Traceback" in said:
            wrong.append(f"{line}: {process.returncode} {said[-500:]}")
    return wrong


@nightly
@pytest.mark.skipif(sys.platform == "win32", reason="ends processes by SIGINT")
def test_commands_of_all_pages_do_what_they_say(world, tmp_path):
    wrong = []
    for page in PAGES:  # one after the other: they use the same ports
        folder = tmp_path / page.stem
        shutil.copytree(world, folder)
        wrong += run_page(page, folder, tmp_path / "cache")
    assert wrong == [], "\n".join(wrong)


def test_every_command_that_is_left_out_has_a_reason():
    used = {word for page in PAGES for words in commands(page) for word in words}
    assert set(NOT_RUN) <= used
    assert len(PAGES) > 10
