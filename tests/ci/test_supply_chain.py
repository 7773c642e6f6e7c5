"""The locks and the list of advisories that CI uses."""

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

CI = Path(__file__).resolve().parents[2] / ".ci"
PYPROJECT = tomllib.loads((CI.parent / "pyproject.toml").read_text())
PROJECT = PYPROJECT["project"]
LOCKS = {path.stem: path for path in sorted((CI / "lock").glob("*.txt"))}
pytestmark = pytest.mark.skipif(not LOCKS, reason="not in a source archive: .ci is of the repository")


@pytest.fixture(scope="module")
def check():
    spec = importlib.util.spec_from_file_location("check_advisories", CI / "check_advisories.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def direct_needs(extra):
    for text in PROJECT["optional-dependencies"][extra]:
        if own := re.fullmatch(r"coview-stream\[(.+)\]", text):
            for other in own[1].split(","):
                yield from direct_needs(other)
        else:
            yield text


EXTRAS = ("all", "cluster", "e57", "foxglove", "kiss-icp", "s3", "sign", "viz")


@pytest.mark.parametrize(
    ("lock", "extra"), [("test", "test"), ("wheel", "all"), ("tools", None), *(("extras", name) for name in EXTRAS)]
)
@pytest.mark.parametrize("machine", ["x86_64", "aarch64"])
@pytest.mark.parametrize("python", ["3.11", "3.12", "3.13", "3.14"])
def test_lock_has_every_direct_dependency_at_an_allowed_version(lock, extra, machine, python):
    where = {
        "python_version": python, "python_full_version": f"{python}.0", "sys_platform": "linux",
        "platform_machine": machine, "platform_system": "Linux", "extra": "",
    }  # fmt: skip
    versions = {}
    for entry in re.findall(r"^[a-z0-9-]+==[^\\]+(?= \\$)", LOCKS[lock].read_text(), re.M):
        need = Requirement(entry)
        if need.marker is None or need.marker.evaluate(where):
            assert need.name not in versions, entry  # one version a platform
            versions[need.name] = str(need.specifier).removeprefix("==")
    direct = (
        PYPROJECT["build-system"]["requires"] if extra is None else [*PROJECT["dependencies"], *direct_needs(extra)]
    )
    for need in map(Requirement, direct):
        if need.marker is None or need.marker.evaluate(where):
            assert versions[canonicalize_name(need.name)] in need.specifier, need


@pytest.mark.parametrize("lock", LOCKS)
def test_every_locked_version_has_hashes(lock):
    entries = re.split(r"^(?=[a-z0-9])", LOCKS[lock].read_text(), flags=re.M)[1:]
    assert entries
    assert all(re.search(r"--hash=sha256:[0-9a-f]{64}$", entry, re.M) for entry in entries)


def test_locks_agree(check):
    test, wheel, tools, extras = (
        check.locked(LOCKS[name].read_text()) for name in ("test", "wheel", "tools", "extras")
    )
    assert wheel < test
    assert wheel < extras
    for other in (tools, extras):
        shared = {name for name, _ in other} & {name for name, _ in test}
        assert {entry for entry in other if entry[0] in shared} == {entry for entry in test if entry[0] in shared}


def test_advisory_for_a_locked_version_fails_and_a_waived_one_is_printed(check, tmp_path, capsys):
    lock, advisories = tmp_path / "lock.txt", tmp_path / "advisories.json"
    lock.write_text(f"numpy==2.0.0 --hash=sha256:{'0' * 64}\nother==1.0 --hash=sha256:{'0' * 64}\n")
    listed = {"package": "NumPy", "id": "X-1", "affected": ">=1,<2.1", "about": "made up"}

    def code(*entries):
        advisories.write_text(json.dumps({"date": "2026-01-01", "advisories": entries}))
        return check.main([str(lock)], advisories)

    assert code(listed) == 1
    assert "numpy 2.0.0: X-1 (made up), affected >=1,<2.1" in capsys.readouterr().out
    assert code(listed | {"waiver": "not reached"}) == 0
    assert "waived: not reached" in capsys.readouterr().out
    assert code(listed | {"affected": "<2.0.0"}, listed | {"package": "absent"}) == 0


def test_list_of_advisories_is_well_formed_and_none_applies_to_a_locked_version(check):
    document = json.loads((CI / "advisories.json").read_text())
    assert re.fullmatch(r"20\d\d-\d\d-\d\d", document["date"])
    for entry in document["advisories"]:
        assert {"package", "id", "affected", "about"} <= set(entry)
        assert str(SpecifierSet(entry["affected"]))
    assert check.main([str(path) for path in LOCKS.values()]) == 0
