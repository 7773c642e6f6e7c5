"""``import coview_stream`` is cheap, and every public name is there."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import coview_stream
from coview_stream import errors

HEAVY = ("taichi", "quadrants", "open3d", "matplotlib", "zenoh", "laspy", "CSF")
ENVIRONMENT = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


def run_python(script: str) -> list[str]:
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, env=ENVIRONMENT, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.slow
def test_import_of_all_names_loads_no_heavy_library():
    script = f"from coview_stream import *\nimport sys; print('loaded:', *sorted({set(HEAVY)!r} & set(sys.modules)))"
    assert run_python(script) == ["loaded:"]


@pytest.mark.slow
@pytest.mark.parametrize("part", ["engines", "serve"])
def test_processes_of_a_node_load_no_library_that_they_do_not_use(part):
    """SciPy takes up to 37 MB and a third of a second, in each of three processes."""
    unused = ("scipy", "pandas", "rosbags", "pyproj", "laspy", "open3d", "matplotlib")
    script = f"from coview_stream.stream.node import {part}\nfrom coview_stream.messages import CLOUD_CODECS, prepare\n"
    script += f"import sys; print('loaded:', *sorted({{*{unused}}} & set(sys.modules)))"
    assert run_python(script) == ["loaded:"]


def test_dunder_all_is_sorted_and_resolvable():
    names = coview_stream.__all__
    assert sorted(names) == list(names)
    assert len(set(names)) == len(names)
    for name in names:
        assert getattr(coview_stream, name) is not None
    assert set(names) <= set(dir(coview_stream))
    assert {"BaseMap", "Localizer", "LocalizerConfig", "Fix", "RejectionReason", "KeyframeEvidence"} <= set(names)


def test_dir_shows_nothing_but_public_names():
    coview_stream.open_run  # noqa: B018  # what has been used is no different
    shown = [name for name in dir(coview_stream) if not name.startswith("__")]
    assert shown == [name for name in coview_stream.__all__ if name != "__version__"]


def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = coview_stream.no_such_name


def test_all_errors_derive_from_coview_error():
    kinds = [
        k
        for k in vars(errors).values()
        if isinstance(k, type) and issubclass(k, Exception) and not issubclass(k, Warning)
    ]
    assert len(kinds) >= 7
    for kind in kinds:
        assert issubclass(kind, errors.CoViewError)
        assert kind.__doc__
    assert issubclass(errors.MapError, errors.InputError)
    assert issubclass(errors.DependencyError, ImportError)
    assert issubclass(errors.ConfigError, ValueError)


@pytest.mark.slow
def test_types_of_a_users_program_check(tmp_path):
    """Arrays as NumPy makes them, float64, are welcome wherever points are."""
    program = tmp_path / "program.py"
    program.write_text("""
import numpy as np
from coview_stream import AcceptanceConfig, AsyncLocalizer, BaseMap, Localizer, LocalizerConfig, MapConfig, RobotClient

points = np.zeros((100, 3))
base_map = BaseMap.build(points, config=MapConfig(voxel=0.5), crs="EPSG:25832")
localizer = Localizer(base_map, LocalizerConfig(acceptance=AcceptanceConfig(risk=1e-5)))
fix = localizer.step(points, np.eye(4), 0.0)
fix = localizer.step(points.astype(np.float32), np.eye(4), 0.1)
if fix.T_map_body is not None and fix.protection is not None:
    print(fix.position, fix.protection.metres)
localizer.save_state("robot.json")
with AsyncLocalizer("site.coview") as loop, RobotClient("rover1", "tcp/127.0.0.1:7447") as robot:
    loop.load_state("robot.json")
    loop.step(points, np.eye(4), 0.2)
    robot.send_cloud(points, 0.2)
""")
    root = Path(__file__).resolve().parents[1]
    version = "{}.{}".format(*sys.version_info)  # NumPy's types are of it
    options = f"--strict --follow-imports=silent --python-version={version}"
    command = [sys.executable, "-m", "mypy", *options.split(), f"--config-file={root}/pyproject.toml", str(program)]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
