"""The lock, the list of advisories and the bill of materials that CI uses."""

from __future__ import annotations

import importlib.util
import json
import re
import tomllib
from pathlib import Path

import pytest

packaging = pytest.importorskip("packaging")
from packaging.requirements import Requirement  # noqa: E402
from packaging.specifiers import SpecifierSet  # noqa: E402
from packaging.utils import canonicalize_name  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
LOCKS = sorted((ROOT / ".ci" / "lock").glob("*.txt"))
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
pytestmark = pytest.mark.skipif(not LOCKS, reason="not in a source archive: .ci is of the repository")


def script(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / ".ci" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("lock", LOCKS, ids=lambda path: path.stem)
def test_lock_has_every_direct_dependency_at_a_version_that_it_allows(lock):
    lines = [line for line in lock.read_text().splitlines() if not line.startswith("#")]
    assert all(re.fullmatch(r"[a-z0-9.-]+==\S+ --hash=sha256:[0-9a-f]{64}", line) for line in lines)
    versions = script("check_advisories").locked(lock.read_text())
    python, machine = re.match(r"cp3(\d+)-linux-(.+)", lock.stem).groups()
    where = {
        "python_version": f"3.{python}", "python_full_version": f"3.{python}.0", "sys_platform": "linux",
        "platform_machine": machine, "platform_system": "Linux", "extra": "",
    }  # fmt: skip
    for text in (*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["test"]):
        need = Requirement(text)
        if need.marker is None or need.marker.evaluate(where):
            assert versions[canonicalize_name(need.name)] in need.specifier, text


def test_lock_is_made_of_what_pip_reports():
    def item(name, version, **archive):
        return {"metadata": {"name": name, "version": version}, "download_info": {"archive_info": archive}}

    report = {"install": [item("B_b", "2", hashes={"sha256": "b" * 64}), item("coview-stream", "0.1.0"),
                          item("a", "1", hashes={"sha256": "a" * 64})]}  # fmt: skip
    made = script("make_lock").lock_of(report)
    assert made.splitlines()[1:] == [f"a==1 --hash=sha256:{'a' * 64}", f"b-b==2 --hash=sha256:{'b' * 64}"]
    with pytest.raises(ValueError, match="c 3: pip reports no sha256"):
        script("make_lock").lock_of({"install": [item("c", "3")]})


def test_advisory_about_what_is_locked_fails_and_a_waived_one_is_told(tmp_path, capsys, monkeypatch):
    check = script("check_advisories")
    lock = tmp_path / "lock.txt"
    lock.write_text(f"numpy==2.0.0 --hash=sha256:{'0' * 64}\nother==1.0 --hash=sha256:{'0' * 64}\n")
    listed = {"package": "NumPy", "id": "X-1", "affected": ">=1,<2.1", "about": "made up"}

    def with_list(*advisories):
        path = tmp_path / "advisories.json"
        path.write_text(json.dumps({"date": "2026-01-01", "advisories": advisories}))
        monkeypatch.setattr(check, "ADVISORIES", path)
        return check.main([str(lock)])

    assert with_list(listed) == 1
    assert "NumPy 2.0.0: X-1 (made up), affected >=1,<2.1" in capsys.readouterr().out
    assert with_list(listed | {"waiver": "not reached"}) == 0
    assert "waived: not reached" in capsys.readouterr().out
    assert with_list(listed | {"affected": "<2.0.0"}, listed | {"package": "absent"}) == 0


def test_list_of_advisories_can_be_used_and_is_about_nothing_that_is_locked():
    document = json.loads((ROOT / ".ci" / "advisories.json").read_text())
    assert re.fullmatch(r"20\d\d-\d\d-\d\d", document["date"])
    for each in document["advisories"]:
        assert {"package", "id", "affected", "about"} <= set(each)
        assert str(SpecifierSet(each["affected"]))
    assert script("check_advisories").main([str(path) for path in LOCKS]) == 0


def test_bill_of_materials_names_what_a_wheel_brings_in_and_not_what_tests_do():
    made = script("make_sbom").document(LOCKS[0].read_text(), PROJECT)
    assert (made["bomFormat"], made["specVersion"]) == ("CycloneDX", "1.5")
    names = {each["name"] for each in made["components"]}
    assert {"numpy", "scipy", "eclipse-zenoh", "lazrs"} <= names
    assert not {"ruff", "mypy", "hypothesis"} & names
    for each in made["components"]:
        assert each["purl"] == each["bom-ref"] == f"pkg:pypi/{each['name']}@{each['version']}"
        assert re.fullmatch("[0-9a-f]{64}", each["hashes"][0]["content"])
    assert set(made["dependencies"][0]["dependsOn"]) == {each["bom-ref"] for each in made["components"]}
