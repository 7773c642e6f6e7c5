"""Neither the commands nor the processes that they start import from the current directory."""

import os
import subprocess
import sys

import pytest
from sockets import free_endpoint

from coview_stream.doctor.machine_checks import probe

MARK = "print('EXECUTED', flush=True)\nopen('executed', 'a').write('x')\n"
SHADOWED = ("numpy.py", "json.py", "zenoh.py", "coview_kernels.py", "logging.py")


@pytest.fixture
def trap(tmp_path, monkeypatch):
    for name in SHADOWED:
        (tmp_path / name).write_text(MARK)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def environment(folder):
    paths = os.pathsep.join(p for p in sys.path if p and p != str(folder))
    return {k: v for k, v in os.environ.items() if k != "PYTHONSAFEPATH"} | {"PYTHONPATH": paths}


@pytest.mark.slow
def test_probes_of_the_doctor_do_not_import_from_the_current_directory(trap):
    assert "error" not in probe("kernels")
    assert not (trap / "executed").exists()


@pytest.mark.slow
def test_engines_do_not_import_from_the_current_directory(trap, world_file):
    args = ["serve", str(world_file), "--robot", "r1", "--listen", free_endpoint(), "--no-state"]
    with subprocess.Popen(
        [sys.executable, "-m", "coview_stream", *args], env=environment(trap), stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            said = next((line for line in process.stderr if "ready" in line or "Error" in line), "")
            process.terminate()
            assert process.wait(30.0) == 0
        finally:
            process.kill()
    assert "ready" in said
    assert not (trap / "executed").exists()
