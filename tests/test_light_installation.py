"""An installation without extras: the robot's side works, the rest names the extra that it needs."""

import os
import sys

import light_installation
import pytest

from tests.test_public_names import run_python


@pytest.mark.slow
def test_client_needs_no_extra():
    block = f"BLOCKED = {set(light_installation.EXTRA_OF)!r}{light_installation.BLOCK}"
    run_python(f"{block}\nimport light_installation\nlight_installation.check_client()")


@pytest.mark.slow
def test_commands_work_or_name_the_extra_that_they_need(world_file, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, sys.path)))
    light_installation.check_commands(tmp_path, world_file, block=True)
