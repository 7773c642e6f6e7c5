"""What an installation without extras can do, and how it names what it lacks.

``python tests/light_installation.py MAP``: CI runs it in an environment with nothing but the wheel;
``tests/test_light_installation.py`` in the usual one, where what extras bring cannot be imported.
"""

import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from coview_stream.errors import EXTRA_OF, DependencyError, install_command

BLOCK = """
import sys
from importlib.machinery import PathFinder

class Finder:
    find_distributions = PathFinder.find_distributions

    @staticmethod
    def find_spec(name, path=None, target=None):
        return None if name.partition(".")[0] in BLOCKED else PathFinder.find_spec(name, path, target)

sys.meta_path[:] = [Finder if finder is PathFinder else finder for finder in sys.meta_path]
"""
"""Makes modules as good as not installed; BLOCKED has their names."""

WORKS = (
    ["--help"],
    ["--version"],
    ["watch", "--help"],
    ["watch", "--seconds", "0.5"],
    ["watch", "--web=127.0.0.1:0", "--map", "MAP", "--seconds", "0.5"],
    ["info", "MAP"],
    ["info", "MAP", "--json"],
)
LACKING = (
    ("build", ["build", "cloud.npy", "-o", "out.coview"]),
    ("build", ["simulate", "world"]),
    ("build", ["airborne", "cloud.npy", "-o", "air.npy"]),
    ("all", ["demo", "--out", "demo"]),
    ("node", ["serve", "MAP", "--robot", "r1", "--no-state"]),
    ("node", ["locate", "MAP", "run", "-o", "out"]),
    ("node", ["replay", "run", "--robot", "r1"]),
    ("node", ["eval", "a.tum", "a.tum"]),
    ("node", ["info", "MAP", "--ambiguity"]),
    ("plot", ["info", "MAP", "--plot", "map.png"]),
    ("sign", ["keygen", "key"]),
    ("learn-train", ["train", "out"]),
)
"""Commands, and the extra that each asks for."""


def run(folder: Path, map_path: Path, arguments: list[str], block: bool) -> subprocess.CompletedProcess[str]:
    words = [str(map_path) if word == "MAP" else word for word in arguments]
    start = f"BLOCKED = {set(EXTRA_OF)!r}{BLOCK}" if block else "import sys"
    script = f"{start}\nfrom coview_stream.cli import main\nsys.exit(main(sys.argv[1:]))"
    return subprocess.run(
        [sys.executable, "-c", script, *words], cwd=folder, capture_output=True, text=True, check=False
    )


def check_commands(folder: Path, map_path: Path, block: bool) -> None:
    """Run what has to work, and what has to name the extra that it lacks, in one line."""
    write_inputs(folder)
    for arguments in WORKS:
        done = run(folder, map_path, arguments, block)
        assert done.returncode == 0, (arguments, done.stderr)
    done = run(folder, map_path, ["doctor", "MAP"], block)
    assert "Traceback" not in done.stderr, done.stderr
    parts = f"client, watch, info, doctor (more: {install_command('node,build,plot')})"
    assert parts in done.stdout, done.stdout
    alone = ["doctor", "--robot", "r1", "--listen", "tcp/127.0.0.1:0", "--seconds", "0.5"]
    done = run(folder, map_path, alone, block)
    assert done.returncode == 1, (done.returncode, done.stdout, done.stderr)
    assert "nothing has connected" in done.stdout, done.stdout
    for extra, arguments in LACKING:
        done = run(folder, map_path, arguments, block)
        assert done.returncode == 2, (arguments, done.returncode, done.stdout, done.stderr)
        last = done.stderr.strip().splitlines()[-1]
        assert last.endswith(f"is not installed; {install_command(extra)}"), (arguments, done.stderr)
        assert "Traceback" not in done.stderr, done.stderr


def write_inputs(folder: Path) -> None:
    cloud = np.random.default_rng(1).uniform(-20, 20, (2000, 3)).astype(np.float32)
    np.save(folder / "cloud.npy", cloud)
    (folder / "run" / "frames").mkdir(parents=True)
    np.save(folder / "run" / "frames" / "000000.npy", cloud)
    for name in ("run/odometry.tum", "a.tum"):
        (folder / name).write_text("0.0 0 0 0 0 0 0 1\n")


def check_client() -> None:
    """Send what needs no extra, and see what does refused by name."""
    from coview_stream import RobotClient

    assert not set(EXTRA_OF) & set(sys.modules), "something heavy was imported"
    cloud = np.random.default_rng(1).uniform(-20, 20, (200, 3)).astype(np.float32)
    with RobotClient("r1", "tcp/127.0.0.1:1") as robot:  # nothing is there: what is sent is lost
        robot.send_odometry(np.eye(4), 1.0)
        robot.send_cloud(cloud, 1.0)
        lacks("messages", lambda: robot.send_cloud(cloud, 1.0, np.zeros(len(cloud))))
    for name in ("cdr", "foxglove"):
        with RobotClient("r1", "tcp/127.0.0.1:1", cloud_encoding=name) as robot:
            lacks("messages", lambda robot=robot: robot.send_cloud(cloud, 1.0))
    import coview_stream

    lacks("build", lambda: coview_stream.BaseMap.build("cloud.npy"))


def lacks(extra: str, act: Callable[[], object]) -> None:
    try:
        act()
    except DependencyError as error:
        message = str(error)
    else:
        message = "nothing is lacking"
    assert message.endswith(f"is not installed; {install_command(extra)}"), message


if __name__ == "__main__":
    check_client()
    with tempfile.TemporaryDirectory() as name:
        check_commands(Path(name), Path(sys.argv[1]).resolve(), block=False)
    sys.stdout.write("the robot's side works, and what is lacking is named\n")
