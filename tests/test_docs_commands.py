"""Every command in the bash blocks of docs/ is run, page by page, on a simulated world with the names of the page."""

import contextlib
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

from coview_stream.clouds.python_child import python_command, python_environment
from coview_stream.sim import SimulationConfig, simulate

DOCS = Path(__file__).resolve().parents[1] / "docs"
LASTING = {"serve", "serve-map", "watch"}
"""Commands that go on until they are told to end."""

NEEDS = {
    "kiss-icp": "kiss_icp", "--foxglove": "foxglove", "--record": "foxglove", "drive.rrd": "rerun", "--ros2": "rclpy",
    "--sign": "cryptography",
}  # fmt: skip
"""Modules without which commands with a word are left out."""

NOT_RUN = {"demo": "has tests of its own", "train": "takes an hour", "https://.../area.copc.laz": "the network"}
"""Words of commands that are left out, and why."""

LIVE, LIMIT = 8.0, 900.0


def commands(page):
    """Words of each call of coview-stream in a page's bash blocks."""
    blocks = re.findall(r"^```bash\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    lines = [shlex.split(line, comments=True) for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    return [words for words in lines if words[:1] == ["coview-stream"]]


PAGES = [page for page in sorted(DOCS.glob("*.md")) if commands(page)]


def left_out(words):
    missing = [name for name, module in NEEDS.items() if name in words and importlib.util.find_spec(module) is None]
    return bool(missing) or any(word in NOT_RUN for word in words)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """A folder with the files that pages name: surveys, runs, maps."""
    folder = tmp_path_factory.mktemp("pages")
    simulate(folder / "made", SimulationConfig(seed=41, size=140.0, length=9.0, density=8.0))
    for name in ("site.laz", "als.laz", "survey.laz", "survey/one.laz", "scans/one.laz"):
        (folder / name).parent.mkdir(exist_ok=True)
        shutil.copy(folder / "made" / "base.laz", folder / name)
    shutil.copytree(folder / "made" / "run", folder / "run")
    shutil.copy(folder / "made" / "run" / "frames" / "000000.pcd", folder / "scan.pcd")
    shutil.copy(folder / "made" / "truth.tum", folder)
    build = python_command("coview_stream", "build", "site.laz", "-o", "site.coview")
    subprocess.run(build, cwd=folder, env=python_environment(), check=True, capture_output=True)
    for name in ("floor0.coview", "floor1.coview"):
        shutil.copy(folder / "site.coview", folder / name)
    return folder


class Lasting:
    """Commands that go on while others run; each is ended by SIGINT."""

    def __init__(self):
        self.processes, self.wrong = [], []

    def start(self, words, **how):
        if words[0] == "serve" or "--web" in words:  # the last one's port has to be free
            self.end({"serve", "watch"})
        command = python_command("coview_stream", *words)
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, **how)
        self.processes.append((words, process))
        time.sleep(LIVE)

    def end(self, names=LASTING):
        for words, process in [pair for pair in self.processes if pair[0][0] in names]:
            self.processes.remove((words, process))
            process.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(30)
            process.kill()
            error = process.communicate()[1]
            if process.returncode not in (0, 130) or "Traceback" in error:
                self.wrong.append(f"{shlex.join(words)}: {process.returncode} {error[-500:]}")


def run_page(page, folder, cache):
    """Run a page's commands in order; return the failures."""
    how = {"cwd": folder, "env": {**python_environment(), "COVIEW_CACHE": str(cache), "PYTHONUNBUFFERED": "1"}}
    lasting = Lasting()
    for _, *words in commands(page):
        if left_out(words):
            continue
        words = [word.replace("tcp/router:", "tcp/127.0.0.1:") for word in words]
        if words[0] in LASTING:
            lasting.start(words, **how)
            continue
        done = subprocess.run(
            python_command("coview_stream", *words), capture_output=True, text=True, timeout=LIMIT, **how
        )
        if done.returncode not in ((0, 1) if words[0] in ("doctor", "locate") else (0,)) or "Traceback" in done.stderr:
            lasting.wrong.append(f"{page.name}: {shlex.join(words)}: {done.returncode} {done.stderr[-500:]}")
    lasting.end()
    return lasting.wrong


@nightly
@pytest.mark.skipif(sys.platform == "win32", reason="ends processes by SIGINT")
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_of_page_run(page, world, tmp_path):
    folder = tmp_path / "pages"
    shutil.copytree(world, folder)
    assert run_page(page, folder, tmp_path / "cache") == []
