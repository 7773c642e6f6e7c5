"""The house: no import runs upward, none goes in a circle, and CONTRIBUTING shows the folders as they are."""

from import_graph import BELOW_ALL, FOLDERS, PACKAGE, PAGE, circles, imports, picture, upward


def test_folders_are_those_of_the_order() -> None:
    found = {path.name for path in PACKAGE.iterdir() if path.is_dir() and path.name != "__pycache__"}
    assert found == set(FOLDERS)


def test_root_holds_no_other_modules() -> None:
    assert {path.stem for path in PACKAGE.glob("*.py")} == {"__init__", "__main__", *BELOW_ALL}


def test_no_import_runs_upward() -> None:
    assert upward() == []


def test_no_circles_of_files() -> None:
    apex = ("coview_stream", "coview_stream.__main__")  # the package names all that is public
    assert circles({name: found for name, found in imports().items() if name not in apex}) == []


def test_circles_are_found() -> None:
    assert set(circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}})) == {"a", "b", "c"}


def test_contributing_shows_the_folders_as_they_are() -> None:
    assert picture() in PAGE.read_text(encoding="utf-8"), "run python tests/import_graph.py"
