"""The Dockerfile copies what there is and asks for extras that exist. There is no engine here to build it."""

import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from coview_stream.cli import build_parser
from coview_stream.config.node import METRICS_ADDRESS
from coview_stream.stream.node.health import metrics_server

ROOT = Path(__file__).resolve().parents[1]
FILE = ROOT / "examples" / "docker" / "Dockerfile"
TEXT = FILE.read_text(encoding="utf-8")


def test_what_is_copied_is_there():
    sources = [word for line in re.findall(r"^COPY (?!--from)(.*)$", TEXT, re.MULTILINE) for word in line.split()[:-1]]
    assert {"pyproject.toml", "coview_stream", "kernels"} <= set(sources)
    assert [source for source in sources if not (ROOT / source).exists()] == []


def test_what_the_package_is_built_of_is_copied():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    needed = [project["project"]["readme"], *project["project"]["license-files"]]
    needed += [path.split("/")[0] for path in project["tool"]["hatch"]["build"]["targets"]["wheel"]["only-include"]]
    for name in needed:
        assert re.search(rf"^COPY .*\b{re.escape(name)}\b", TEXT, re.MULTILINE), name


def test_extras_exist_and_the_user_has_no_rights():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(re.findall(r"'\.\[([a-z-]+)\]'", TEXT)) <= set(extras)
    assert re.search(r"^USER (?!root)", TEXT, re.MULTILINE)


def test_the_command_in_its_comment_parses_and_is_what_the_health_check_asks():
    comment = " ".join(line.lstrip("# ").rstrip("\\ ") for line in TEXT.splitlines() if line.startswith("#"))
    command = re.search(r"coview-stream (serve .*--metrics \S+)", comment)
    assert command
    args = build_parser("serve").parse_args(command[1].split())
    assert args.metrics in TEXT.partition("HEALTHCHECK")[2]
    assert args.metrics == METRICS_ADDRESS


@pytest.mark.parametrize("live", [True, False])
def test_the_health_check_asks_whether_the_node_lives_not_whether_it_is_ready(live):
    server = metrics_server("127.0.0.1:0", lambda: {"live": {"ok": live}, "ready": {"ok": False}})
    server.start()
    try:
        program = json.loads(re.search(r"^    CMD (\[.*\])$", TEXT, re.MULTILINE)[1])[2]
        program = program.replace("127.0.0.1:9464", server.url.removeprefix("http://").rstrip("/"))
        done = subprocess.run([sys.executable, "-c", program], timeout=20, check=False)
        assert done.returncode == int(not live)
    finally:
        server.close()
