"""The lock, the list of advisories and the bill of materials that CI uses."""

from __future__ import annotations

import email.message
import hashlib
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
OF_WHEELS = [path for path in LOCKS if path.stem.startswith("wheel-")]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
pytestmark = pytest.mark.skipif(not LOCKS, reason="not in a source archive: .ci is of the repository")


def script(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / ".ci" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def versions_of(lock):
    return script("check_advisories").locked(lock.read_text())


@pytest.mark.parametrize("lock", LOCKS, ids=lambda path: path.stem)
def test_lock_has_every_direct_dependency_at_a_version_that_it_allows(lock):
    lines = [line for line in lock.read_text().splitlines() if not line.startswith("#")]
    assert all(re.fullmatch(r"[a-z0-9-]+==\S+ --hash=sha256:[0-9a-f]{64}", line) for line in lines)
    versions = versions_of(lock)
    what, python, machine = re.match(r"(test|wheel|build)-cp3(\d+)-linux-(.+)", lock.stem).groups()
    where = {
        "python_version": f"3.{python}", "python_full_version": f"3.{python}.0", "sys_platform": "linux",
        "platform_machine": machine, "platform_system": "Linux", "extra": "",
    }  # fmt: skip
    direct = {
        "wheel": script("make_sbom").direct_needs(PROJECT, "all"),
        "test": script("make_sbom").direct_needs(PROJECT, "test"),
        "build": ["build", *tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]["requires"]],
    }[what]
    for text in direct:
        need = Requirement(text)
        if need.marker is None or need.marker.evaluate(where):
            assert versions[canonicalize_name(need.name)] in need.specifier, text


@pytest.mark.parametrize("lock", OF_WHEELS, ids=lambda path: path.stem)
def test_locks_of_one_platform_agree(lock):
    wheel = set(lock.read_text().splitlines()[1:])
    test = set(lock.with_name(lock.name.replace("wheel-", "test-")).read_text().splitlines()[1:])
    assert wheel < test
    build = versions_of(lock.with_name(lock.name.replace("wheel-", "build-")))
    tested = script("check_advisories").locked("\n".join(test))
    assert {name: tested[name] for name in build if name in tested}.items() <= build.items()


def test_lock_is_made_of_what_pip_reports():
    def item(name, version, **archive):
        return {"metadata": {"name": name, "version": version}, "download_info": {"archive_info": archive}}

    report = {"install": [item("B_b.c", "2", hashes={"sha256": "b" * 64}), item("coview-stream", "0.1.0"),
                          item("a", "1", hashes={"sha256": "a" * 64})]}  # fmt: skip
    made = script("make_lock").lock_of(report, "a try")
    assert made.splitlines()[1:] == [f"a==1 --hash=sha256:{'a' * 64}", f"b-b-c==2 --hash=sha256:{'b' * 64}"]
    with pytest.raises(ValueError, match="c 3: pip reports no sha256"):
        script("make_lock").lock_of({"install": [item("c", "3")]}, "a try")


def test_what_is_installed_and_not_as_it_is_locked_is_named(tmp_path, capsys, monkeypatch):
    check = script("check_lock")
    lock = tmp_path / "lock.txt"
    lock.write_text("".join(f"{name}==1.0 --hash=sha256:{'0' * 64}\n" for name in ("same", "other", "gone")))
    there = {"same": "1.0", "other": "1.1", "new": "3", "pip": "23", "coview-stream": "0.1.0"}
    monkeypatch.setattr(check, "installed", lambda: there)
    assert check.main(str(lock)) == 1
    told = capsys.readouterr().out
    assert "other 1.1 is installed, 1.0 is locked" in told
    assert "gone 1.0 is locked and not installed" in told
    assert "new 3 is installed and not locked" in told
    assert "same" not in told
    there |= {"other": "1.0", "gone": "1.0"}
    del there["new"]
    assert check.main(str(lock)) == 0


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


def test_bill_of_materials_names_what_a_wheel_brings_in_and_not_what_tests_do(tmp_path):
    wheel = tmp_path / "some.whl"
    wheel.write_bytes(b"wheel")
    made = script("make_sbom").document(OF_WHEELS[0].read_text(), PROJECT, wheel)
    assert (made["bomFormat"], made["specVersion"], made["version"]) == ("CycloneDX", "1.5", 1)
    own = made["metadata"]["component"]
    assert own["hashes"] == [{"alg": "SHA-256", "content": hashlib.sha256(b"wheel").hexdigest()}]
    names = {each["name"] for each in made["components"]}
    assert {"numpy", "scipy", "eclipse-zenoh", "lazrs"} <= names
    assert not {"ruff", "mypy", "hypothesis"} & names
    for each in made["components"]:
        assert each["purl"] == each["bom-ref"] == f"pkg:pypi/{each['name']}@{each['version']}"
        assert re.fullmatch("[0-9a-f]{64}", each["hashes"][0]["content"])
    licensed = {each["name"]: each["licenses"] for each in made["components"] if "licenses" in each}
    assert {"numpy", "scipy", "gtsam", "lazrs"} <= set(licensed)
    for stated in [own["licenses"], *licensed.values()]:  # one expression, or licences that are named
        assert all(set(one) == {"expression"} for one in stated[:1]) or all(one["license"]["name"] for one in stated)


def test_bill_of_materials_says_who_needs_whom():
    made = script("make_sbom").document(OF_WHEELS[0].read_text(), PROJECT)
    refs = [made["metadata"]["component"]["bom-ref"], *(each["bom-ref"] for each in made["components"])]
    assert len(set(refs)) == len(refs)
    needs = {each["ref"]: each["dependsOn"] for each in made["dependencies"]}
    assert set(needs) == set(refs)  # each once, and nothing that is not listed
    assert {other for others in needs.values() for other in others} == set(refs[1:])
    by_name = {ref.split("/")[1].split("@")[0]: others for ref, others in needs.items()}
    assert any(other.startswith("pkg:pypi/numpy@") for other in by_name["scipy"])
    assert any(other.startswith("pkg:pypi/lazrs@") for other in by_name["laspy"])  # by its extra
    direct = {ref.split("/")[1].split("@")[0] for ref in by_name["coview-stream"]}
    assert "numpy" in direct
    assert "lazrs" not in direct


def test_licences_are_expressions_or_names_and_never_whole_texts(monkeypatch):
    sbom = script("make_sbom")

    def stated(**fields):
        message = email.message.Message()
        for name, value in fields.items():
            message[name.replace("_", "-")] = value
        monkeypatch.setattr(sbom, "metadata", lambda _: message)
        return sbom.licences("any")

    assert stated(License_Expression="MIT OR BSD-3-Clause") == [{"expression": "MIT OR BSD-3-Clause"}]
    assert stated(Classifier="License :: OSI Approved :: MIT License") == [{"license": {"name": "MIT License"}}]
    assert stated(License="BSD") == [{"license": {"name": "BSD"}}]
    assert stated(License="Copyright (c)\n\nPermission is hereby granted") == []
    assert stated() == []
