"""A missing library is named with what installs it; one that is there but broken, with what is wrong with it."""

import json
import re
import sys
import tomllib
from pathlib import Path

import pytest

from coview_stream import errors
from coview_stream.errors import DependencyError, install_command, naming_missing_libraries, require_library


@pytest.mark.parametrize("module", ["fast_sums", "fast_sums.quick"])
def test_missing_library_is_named_with_install_command(module):
    with pytest.raises(DependencyError) as caught:
        require_library(module, "fast-sums>=2.1", "sums")
    assert str(caught.value) == f"sums: fast-sums is not installed; {sys.executable} -m pip install 'fast-sums>=2.1'"


@pytest.mark.parametrize(("kind", "reason"), [("Import", "libsums.so.3: no such file"), ("Attribute", "not found")])
def test_broken_library_error_gives_the_reason(tmp_path, monkeypatch, kind, reason):
    module = f"broken_{kind}"
    (tmp_path / f"{module}.py").write_text(f"raise {kind}Error({reason!r})")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(DependencyError, match=rf"broken-{kind} cannot be loaded \({reason}\)"):
        require_library(module, "broken-sums", "sums")


def test_missing_library_of_an_extra_is_named_with_the_extra(monkeypatch):
    monkeypatch.setitem(errors.EXTRA_OF, "fast_sums", "node")
    says = rf"^sums: fast-sums is not installed; {re.escape(install_command('node'))}$"
    with pytest.raises(DependencyError, match=says):
        require_library("fast_sums.quick", "fast-sums>=2.1", "sums")
    with pytest.raises(DependencyError, match=says), naming_missing_libraries("sums"):
        import fast_sums  # noqa: F401


FILE = {"url": "file:///tmp/a%20b/coview_stream-0.1.0-py3-none-any.whl", "archive_info": {}}
CHECKOUT = {"url": "file:///src/coview", "dir_info": {}}


@pytest.mark.parametrize(
    ("source", "command"),
    [
        (FILE, "pip install '/tmp/a b/coview_stream-0.1.0-py3-none-any.whl[e57]'"),
        (CHECKOUT, "pip install '/src/coview[e57]'"),
        (CHECKOUT | {"dir_info": {"editable": True}}, "pip install -e '/src/coview[e57]'"),
        (FILE | {"url": "https://host/a.whl"}, "pip install 'coview-stream[e57] @ https://host/a.whl'"),
        (None, "pip install 'coview-stream[e57]==0.7'"),  # of an index
    ],
)
def test_extras_are_installed_from_where_the_package_came(tmp_path, monkeypatch, source, command):
    about = tmp_path / "coview_stream-0.7.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: coview-stream\nVersion: 0.7\n")
    if source is not None:
        (about / "direct_url.json").write_text(json.dumps(source))
    monkeypatch.syspath_prepend(tmp_path)
    assert install_command("e57") == f"{sys.executable} -m {command}"


def test_no_message_names_the_package_alone():
    """Whoever registers the name with an index would be installed."""
    root = Path(__file__).parents[1]
    files = [path for folder in ("coview_stream", "docs", "examples") for path in (root / folder).rglob("*.*")]
    texts = {path: path.read_text() for path in files if path.suffix in (".py", ".md")}
    named = [path for path, text in texts.items() if re.search(r"(?i)pip.install}? 'coview-stream\[", text)]
    assert named == [root / "coview_stream" / "errors.py"]


def test_bug_of_our_own_is_not_taken_for_a_missing_library():
    with pytest.raises(ModuleNotFoundError) as caught, naming_missing_libraries("sums"):
        import coview_stream.no_such_module  # noqa: F401
    assert not isinstance(caught.value, DependencyError)


def test_extras_that_messages_name_bring_the_library():
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]

    def brought(extra):
        own = [name for name in extras[extra] if name.startswith("coview-stream[")]
        more = [part for name in own for part in name[len("coview-stream[") : -1].split(",")]
        rest = [re.split(r"[\[><=;]", name)[0].strip() for name in extras[extra] if name not in own]
        return {*rest, *(name for part in more for name in brought(part))}

    spelt = {"google": "protobuf", "CSF": "cloth-simulation-filter", "rerun": "rerun-sdk", "lazrs": "laspy"}
    spelt["PIL"] = "matplotlib"
    spelt |= {"open3d": "open3d-cpu", "foxglove": "foxglove-sdk", "rclpy": "ros-kilted-rclpy"}
    for module, extra in errors.EXTRA_OF.items():
        assert spelt.get(module, module.replace("_", "-")) in brought(extra), module


def test_install_commands_match_pyproject_extras():
    root = Path(__file__).parents[1]
    sources = "".join(path.read_text() for path in (root / "coview_stream").rglob("*.py"))
    named = set(re.findall(r'require_library\(f?"[^"]+", "([^"]+)"', sources))
    assert len(named) > 8
    project = (root / "pyproject.toml").read_text()
    assert all(f'"{name}' in project for name in named - {"lazrs>=0.6"})  # which laspy brings
