"""The order of the package's folders, the imports between them, and the picture of both in CONTRIBUTING.md.

``python tests/import_graph.py`` writes the picture anew.
"""

import ast
import textwrap
from collections import defaultdict
from collections.abc import Mapping
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "coview_stream"
PAGE = ROOT / "CONTRIBUTING.md"
MARKS = ("<!-- folders -->", "<!-- end -->")

FOLDERS = (
    "geometry",
    "config",
    "clouds",
    "messages",
    "descriptors",
    "odometry",
    "basemap",
    "recordings",
    "localization",
    "stream",
    "report",
    "fusion",
    "viewers",
    "sim",
    "training",
    "doctor",
    "cli",
)
"""Folders in the way of the data: each may import those before it, none those after it."""

INNER = {
    "basemap": (
        "progress",
        "signature",
        "file_format",
        "tiles",
        "ground",
        "stations",
        "station_index",
        "likelihood_field",
        "sources",
        "map_arrays",
        "build",
        "map_parts",
        "summary",
        "site",
        "basemap",
        "joined",
    ),
    "localization": ("state", "registration", "evidence", "calibration", "tracking", "witness", "result", "search"),
    "stream": ("transport", "maps", "node", "client"),
}
"""Parts of a folder that has folders of its own, likewise; what is not named here may import all of them."""

BELOW_ALL = ("version", "errors")
"""Modules in the root that every folder may import; the package itself and ``__main__`` stand above all."""


def modules() -> dict[str, Path]:
    return {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
        for path in PACKAGE.rglob("*.py")
    }


@cache
def imports() -> dict[str, set[str]]:
    """Return which modules each module imports, at any level of its code."""
    known = modules()
    found: dict[str, set[str]] = {name: set() for name in known}
    for name, path in known.items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module:
                inner = [f"{node.module}.{alias.name}" for alias in node.names]
                names = [each if each in known else node.module for each in inner]
            else:
                continue
            found[name] |= {each for each in names if each in known and each != name}
    return found


def folder(module: str) -> str:
    """Return the folder of a module, or the module's own name in the root."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else ""


def rank(module: str) -> tuple[int, int]:
    """Return the place of a module in the order: what it imports has to have no higher one."""
    if folder(module) in BELOW_ALL:
        return -1, 0
    if folder(module) not in FOLDERS:
        return len(FOLDERS), 0
    inner = INNER.get(folder(module), ())
    rest = ".".join(module.split(".")[2:])
    ranks = [k for k, part in enumerate(inner) if rest == part or rest.startswith(f"{part}.")]
    return FOLDERS.index(folder(module)), ranks[0] if ranks else len(inner)


def upward() -> list[str]:
    """Return the imports that run upward, as ``module -> module``."""
    return sorted(f"{a} -> {b}" for a, found in imports().items() for b in found if rank(b) > rank(a))


def circles(graph: Mapping[str, set[str]]) -> list[str]:
    """Return the nodes of a circle of a graph, the first one again at the end; none without a circle."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def folder_graph() -> dict[str, set[str]]:
    """Return which folders each folder imports."""
    graph: defaultdict[str, set[str]] = defaultdict(set)
    for name, found in imports().items():
        for other in found:
            a, b = folder(name), folder(other)
            if a in FOLDERS and b in FOLDERS and a != b:
                graph[a].add(b)
    return {name: graph[name] for name in FOLDERS}


def picture() -> str:
    """Return the folders as a Mermaid diagram; an arrow that others imply is left out."""
    graph = folder_graph()

    def reaches(start: str, goal: str) -> bool:
        return goal in graph[start] or any(reaches(each, goal) for each in graph[start])

    lines = ["```mermaid", "flowchart BT"]
    for name in FOLDERS:
        text = ast.get_docstring(ast.parse((PACKAGE / name / "__init__.py").read_text(encoding="utf-8"))) or ""
        sentence = text.partition("\n")[0].rstrip(".").replace("`", "").replace('"', "")
        lines.append(f'    {name}["<b>{name}</b><br/>{"<br/>".join(textwrap.wrap(sentence, 60))}"]')
    for name in FOLDERS:
        for other in sorted(graph[name], key=FOLDERS.index):
            if not any(reaches(each, other) for each in graph[name] if each != other):
                lines.append(f"    {name} --> {other}")
    return "\n".join([*lines, "```"])


def page_with_picture(page: str) -> str:
    """Return the text of CONTRIBUTING.md with the picture as it is now."""
    before, _, rest = page.partition(MARKS[0])
    _, _, after = rest.partition(MARKS[1])
    return f"{before}{MARKS[0]}\n{picture()}\n{MARKS[1]}{after}"


if __name__ == "__main__":
    PAGE.write_text(page_with_picture(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
