"""Findings about machine, libraries and map; probes survive a library that crashes."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import coview_kernels as kernels
from coview_kernels import reference
from coview_stream.doctor import machine_checks as machine
from coview_stream.doctor.finding import Finding, failed, from_error
from coview_stream.doctor.map_checks import map_findings, node_memory, open_map
from coview_stream.errors import MapError

GOOD = {
    "kernels": {"backend": "quadrants", "seconds": 1.5, "differing": []},
    "zenoh": {"version": "1.10.2"},
    "codecs": {"missing": []},
    "open3d": {"version": "0.20"},
    "matplotlib": {"version": "3.9"},
}


def test_healthy_machine_has_no_failures(monkeypatch):
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "1")
    found = list(machine.machine_findings(lambda name: GOOD[name]))
    assert not failed(found)
    assert [f.what for f in found] == [
        "python", "processor", "memory", "BLAS threads", "parts", "kernels", "zenoh", "message formats", "open3d",
        "matplotlib",
    ]  # fmt: skip
    assert {f.verdict for f in found if f.what not in ("python", "processor", "memory")} == {"ok"}


@pytest.mark.parametrize(
    ("finding", "verdict", "part"),
    [
        (machine.python_finding((3, 15, 1)), "warn", "3.11"),
        (machine.python_finding((3, 10, 9)), "warn", "3.11"),
        (machine.python_finding((3, 14, 1)), "ok", ""),
        (machine.processor_finding("cpu", 8, 1.5), "warn", "2 or more"),
        (machine.processor_finding("cpu", 1, None), "warn", "2 or more"),
        (machine.processor_finding("cpu", 4, 3.0), "ok", ""),
        (machine.memory_finding(int(8e9), int(2e8)), "warn", "0.6 GB"),
        (machine.memory_finding(None, None), "ok", ""),
        (machine.blas_finding("16"), "warn", "at 1"),
        (machine.blas_finding(""), "warn", "at 1"),
        (machine.kernels_finding({"error": "SIGILL"}, False), "FAIL", "COVIEW_KERNELS=numpy"),
        (machine.kernels_finding({"error": "no cuda"}, True), "FAIL", "unset"),
        (machine.kernels_finding(GOOD["kernels"] | {"differing": ["polar_bin"]}, False), "FAIL", "numpy"),
        (machine.kernels_finding(GOOD["kernels"] | {"backend": "numpy"}, False), "warn", "install quadrants"),
        (machine.kernels_finding(GOOD["kernels"] | {"backend": "numpy"}, True), "warn", "unset"),
        (machine.zenoh_finding({"error": "ModuleNotFoundError"}), "FAIL", "eclipse-zenoh"),
        (machine.zenoh_finding({"version": "1.9.0"}), "warn", "upgrade"),
        (machine.codecs_finding({"missing": ["rosbags"]}), "warn", "[messages]"),
        (machine.open3d_finding({"error": "DependencyError: no libX11; install it"}), "ok", "install it"),
        (machine.matplotlib_finding({"error": "ImportError"}), "warn", "[plot]"),
    ],
)
def test_machine_faults_have_a_remedy(finding, verdict, part):
    assert finding.verdict == verdict
    assert part in finding.remedy


def test_available_memory_is_read():
    total, available = machine.memory()
    assert total is None or 0 <= available <= total


@pytest.mark.slow
def test_kernel_probe_runs_in_a_process():
    found = machine.probe("kernels")
    assert found["differing"] == []
    assert found["backend"] in ("taichi", "quadrants", "numpy")
    assert found["seconds"] >= 0


def test_wrong_kernel_result_is_named():
    def half(*args):
        grid, dropped = reference.polar_bin(*args)
        return tuple(np.asarray(part) // 2 for part in grid), dropped

    wrong = SimpleNamespace(**{name: getattr(reference, name) for name in kernels.__all__ if hasattr(reference, name)})
    assert machine.differing(wrong, reference) == []
    wrong.polar_bin = half
    assert machine.differing(wrong, reference) == ["polar_bin"]


@pytest.mark.parametrize(
    ("code", "out", "err", "part"),
    [
        (-4, "", "", "SIGILL"),
        (3, "", "line\nImportError: no module", "code 3: ImportError: no module"),
        (0, "banner only\n", "", "it said nothing"),
    ],
)
def test_failing_probe_process_is_reported(code, out, err, part):
    assert part in machine.read_answer(code, out, err)["error"]


def test_probe_output_skips_library_banners():
    assert machine.read_answer(0, 'hello\n{"a": 1}\n', "") == {"a": 1}


def test_probe_exception_is_reported(monkeypatch, capsys):
    monkeypatch.setitem(machine.PROBES, "open3d", lambda: Path("/no/such/file").stat())
    machine.main("open3d")
    assert "FileNotFoundError" in machine.read_answer(0, capsys.readouterr().out, "")["error"]


def test_finding_lines_are_formatted():
    finding = Finding("warn", "clouds", "evil\x1b[2Jtext\n", "do that", "r1")
    assert finding.line() == "warn  r1 clouds               evil [2Jtext   (do that)"
    assert from_error("map", MapError("f: damaged; build it again")) == Finding(
        "FAIL", "map", "f: damaged", "build it again"
    )


def test_map_findings(world_file, world_map, tmp_path):
    base_map, finding = open_map(world_file)
    assert finding.verdict == "ok"
    assert f"{len(world_map)} stations" in finding.found
    verdicts = {
        available: [f.verdict for f in map_findings(base_map, int(1e8), available)]
        for available in (None, int(1e6), int(node_memory(base_map) + 1e6), int(64e9))
    }
    assert list(verdicts.values()) == [
        ["ok", "ok", "ok"],
        ["ok", "ok", "FAIL"],
        ["ok", "ok", "warn"],
        ["ok", "ok", "ok"],
    ]
    assert open_map(tmp_path / "none.coview")[1].verdict == "FAIL"


def test_robot_side_alone_is_all_right_and_says_what_more_there_is():
    found = machine.parts_finding(machine.lacking_modules(lambda name: None))
    assert found.verdict == "ok"
    assert "client, watch, info, doctor" in found.found
    assert "[node,build,plot]" in found.found


def test_part_without_one_of_its_modules_is_a_warning_with_its_remedy():
    found = machine.parts_finding(machine.lacking_modules(lambda name: None if name == "lazrs" else object()))
    assert found.verdict == "warn"
    assert "node lacks lazrs" in found.found
    assert "[node]" in found.remedy
