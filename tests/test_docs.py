"""Links, names, commands and code in the pages: each leads somewhere, exists, parses, runs."""

import ast
import dataclasses
import importlib.util
import re
import shlex
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from sockets import until

import coview_stream
from bench.__main__ import BENCHMARKS
from coview_stream import RejectionReason, State
from coview_stream.cli import build_parser
from coview_stream.cli.info import describe
from coview_stream.doctor.finding import Finding
from coview_stream.localization.offline import RunResult
from coview_stream.localization.result import KeyframeEvidence
from coview_stream.messages import decode_cloud, decode_odometry, encode_pose
from coview_stream.messages.types import PoseMessage, Sample
from coview_stream.report.evaluation import Evaluation
from coview_stream.stream.node.counters import Counters
from coview_stream.stream.transport.keys import PRESETS, robot_keys
from coview_stream.stream.transport.memory_transport import MemoryTransport

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.glob("*.md"))]
SOURCES = sorted(
    path
    for folder in ("coview_stream", "kernels/coview_kernels", "bench", "examples")
    for path in (ROOT / folder).rglob("*.py")
)

DOTTED = re.compile(r"(?<![\w./-])(?:coview_stream|coview_kernels|bench)(?:\.[a-zA-Z_]\w*)+(?![\w/])")
FILE = re.compile(r"(?<![\w./-])(?:coview_stream|coview_kernels|kernels|tests|bench|examples|docs|\.ci)/[\w./-]*\w/?")
BARE_FILE = re.compile(r"`(\w+\.py)`")
MEMBER = re.compile(r"`([A-Z]\w+)\.([a-z]\w*)[`(]")
IMPORT = re.compile(r"^\s*(?:>>> )?from (coview_\w[\w.]*|bench[\w.]*) import ([\w, ]+)", re.MULTILINE)
LINK = re.compile(r"\]\(([^)#\s]*)(?:#([\w-]+))?\)")
ROLE = re.compile(r":(?:mod|class|func|meth|data|attr|exc):`~?([\w.]+)`")
NAMED_TEST = re.compile(r"`(tests/[\w/]+\.py)(?:::(\w+))?`")
SUFFIXES = {"py", "json", "toml", "md", "cpp", "tum"}  # bench.json is a file, not a module; TRUTH.tum no member


def text_of(page):
    return (DOCS / page).read_text(encoding="utf-8")


def blocks(page, language):
    return re.findall(rf"^```{language}\n(.*?)^```", text_of(page), re.MULTILINE | re.DOTALL)


def script(path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


# ---- names


@cache
def module_file(dotted):
    """The file or folder of a module, None if there is none."""
    path = ROOT / ("kernels" if dotted.startswith("coview_kernels") else "") / dotted.replace(".", "/")
    return next((file for file in (path.with_suffix(".py"), path / "__init__.py", path) if file.exists()), None)


@cache
def defined(path):
    """All names that a module defines or imports, those of its classes and functions included."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            names.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            names.add(node.attr)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            names.update((alias.asname or alias.name).split(".")[0] for alias in node.names)
    return names


def exists(dotted):
    """Whether a dotted name is a module, or a name in one."""
    parts = dotted.split(".")
    for size in range(len(parts), 0, -1):
        file = module_file(".".join(parts[:size]))
        if file is not None:
            rest = parts[size:]
            return not rest or (file.is_file() and set(rest) <= defined(file))
    return False


@cache
def file_names():
    folders = ("coview_stream", "kernels", "tests", "bench", "examples")
    return {path.name for folder in folders for path in (ROOT / folder).rglob("*.py")}


def has_member(name, member):
    """Whether a module of the package that defines the class defines the member too; True for foreign classes."""
    homes = [path for path in SOURCES if name in defined(path)]
    return not homes or any(member in defined(path) for path in homes)


def unknown_names(text):
    """Dotted names, paths and imports in a text that lead nowhere."""
    dotted = {name for name in DOTTED.findall(text) if name.rsplit(".", 1)[1] not in SUFFIXES}
    dotted |= {f"{module}.{name.strip()}" for module, names in IMPORT.findall(text) for name in names.split(",")}
    missing = {name for name in dotted if not exists(name.rstrip("."))}
    missing |= {n for n in FILE.findall(text) if not any((ROOT / base / n).exists() for base in ("", "kernels"))}
    missing |= set(BARE_FILE.findall(text)) - file_names()
    members = {pair for pair in MEMBER.findall(text) if pair[1] not in SUFFIXES and not has_member(*pair)}
    return sorted(missing | {".".join(pair) for pair in members})


@cache
def docstrings(path):
    text = path.read_text(encoding="utf-8")
    strings = [
        node.value.value
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    ]
    return "\n".join([*strings, *re.findall(r"(?:^|\s)# (.*)$", text, re.MULTILINE)])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_names_in_page_exist(page):
    assert unknown_names(page.read_text(encoding="utf-8")) == []


def test_names_in_docstrings_exist():
    missing = {str(path.relative_to(ROOT)): names for path in SOURCES if (names := unknown_names(docstrings(path)))}
    assert missing == {}


def test_roles_in_docstrings_name_something():
    missing = {}
    for path in SOURCES:
        for name in set(ROLE.findall(docstrings(path))):
            if name.startswith((".", "coview_", "bench.")):
                known = exists(f"coview_stream{name}" if name.startswith(".") else name)
            else:
                parts = set(name.split("."))
                known = parts <= defined(path) or any(parts <= defined(other) for other in SOURCES)
            if not known and name.partition(".")[0] not in sys.stdlib_module_names:
                missing.setdefault(str(path.relative_to(ROOT)), []).append(name)
    assert missing == {}


@pytest.mark.parametrize(
    "text",
    [
        "see `coview_stream.stream.lane`",
        "see `coview_stream.localization.result.Answer`",
        "in coview_stream/localizer.py",
        "in `whereabouts.py`",
        "`Localizer.take`",
        "from coview_stream.recordings.run import open_run",
    ],
)
def test_unknown_names_are_found(text):
    assert len(unknown_names(text)) == 1


# ---- links, navigation, generated pages


def headings(page):
    """Anchors of a page, as GitHub makes them of its headings."""
    titles = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    titles = [re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", title) for title in titles]
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", [*PAGES, DOCS / "llms.txt"], ids=lambda page: page.name)
def test_links_in_page_lead_somewhere(page):
    for target, anchor in LINK.findall(page.read_text(encoding="utf-8")):
        if "://" in target:
            continue
        file = page.parent / target if target else page
        assert file.exists(), target
        assert not anchor or anchor in headings(file), f"{target}#{anchor}"


def test_pages_that_messages_and_comments_point_at_exist():
    for path in [*SOURCES, ROOT / "pyproject.toml", ROOT / ".ci" / "run"]:
        for page in re.findall(r"docs/[\w/]+\.md", path.read_text(encoding="utf-8")):
            assert (ROOT / page).exists(), f"{path}: {page}"


def test_navigation_names_every_page_once():
    named = re.findall(r"^ *- .*?([\w-]+\.md)$", (DOCS / "site" / "mkdocs.yml").read_text(), re.MULTILINE)
    assert sorted(named) == sorted(page.name for page in DOCS.glob("*.md"))


def test_site_shows_links_out_of_docs_as_text_and_the_reference_in_full():
    hooks = script(DOCS / "site" / "hooks.py")
    text = "see [Contributing](../CONTRIBUTING.md):\n* one\n\n```text\n[a](../b)\nx\n* y\n```\n"
    expected = "see Contributing (`CONTRIBUTING.md`):\n\n* one\n\n```text\n[a](../b)\nx\n* y\n```\n"
    assert hooks.on_page_markdown(text) == expected
    assert hooks.on_page_content(":class:<code>~coview_stream.a.B</code>") == "<code>B</code>"
    assert "\n::: coview_stream.Localizer\n" in hooks.on_page_markdown(text_of("python.md"))


def test_generated_pages_are_those_of_the_code():
    reference = script(DOCS / "write_reference.py")
    assert text_of("options.md") == reference.options_page(), "run python docs/write_reference.py"
    limits = reference.limits_page(text_of("limits.md"), text_of("results.md"))
    assert text_of("limits.md") == limits, "run python docs/write_reference.py"
    marked = "\n## all faults\n\n|a|b|c|\n|-|-|-|\n|x, y|1|2|\n\n|d|c|\n|x|3|\n<!-- end -->"
    figures = (
        "<!-- all faults, x, y @ c -->0<!-- end --><!-- all faults, x -->0<!-- end --><!-- none, x -->0<!-- end -->"
    )
    assert re.findall(r"-->(\d)<", reference.limits_page(figures, marked)) == ["2", "3", "0"]
    assert text_of("python.md") == reference.python_page(text_of("python.md")), "run python docs/write_reference.py"
    fields = text_of("options.md").partition("## Configuration in Python")[2]
    assert re.findall(r"^\|`(\w+)`\|.*\|\|$", fields, re.MULTILINE) == []  # each says its meaning


def test_citation_is_of_this_version():
    lines = (ROOT / "CITATION.cff").read_text(encoding="utf-8").splitlines()
    fields = dict(line.split(": ", 1) for line in lines if re.match(r"[a-z-]+: ", line))
    assert {"cff-version", "message", "title", "version", "license"} <= set(fields)
    assert fields["version"] == coview_stream.__version__


# ---- commands and code


def calls(page):
    """Calls of coview-stream in bash blocks and, as patterns that may be incomplete, in the text of a page."""
    text = page.read_text(encoding="utf-8")
    code = "".join(re.findall(r"^```bash\n(.*?)^```", text, re.MULTILINE | re.DOTALL)).replace("\\\n", " ")
    prose = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    mentions = [call for call in re.findall(r"`([^`]+)`", prose) if re.match(r"coview-stream \w+ \S*[./=-]", call)]
    for whole, lines in ((True, code.splitlines()), (False, mentions)):
        for line in (re.split(r"\s+[#&>|]|;", line)[0].strip() for line in lines):
            if re.match(r"(\.venv/bin/)?coview-stream ", line) and "..." not in line:
                yield whole, shlex.split(line)[1:]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_in_page_parse(page):
    for whole, call in calls(page):
        try:
            build_parser().parse_args(call)
        except coview_stream.CoViewError as error:
            assert "arguments are required" in str(error), call  # noqa: PT017
            assert not whole, call


def test_commands_are_found_and_a_wrong_option_is_refused():
    assert sum(whole for page in PAGES for whole, _ in calls(page)) > 30
    assert sum(not whole for page in PAGES for whole, _ in calls(page)) > 2
    with pytest.raises(coview_stream.CoViewError, match="no-such"):
        build_parser().parse_args(["watch", "--no-such"])


def test_benchmarks_in_pages_exist():
    named = {name for page in PAGES for name in re.findall(r"python -m bench (\w+)", page.read_text(encoding="utf-8"))}
    assert len(named) > 5
    assert named - {*BENCHMARKS, "results", "release"} == set()


def test_code_about_frames_runs():
    exec(compile(blocks("locate.md", "python")[0], "locate.md", "exec"), {})


def test_client_example_runs(capsys):
    net = MemoryTransport()

    def answer(sample):
        pose = PoseMessage(decode_cloud(sample).stamp_ns, "rover1", "TRACKING", np.eye(4), np.eye(6), 0.5, "ab")
        net.publish(Sample("coview/rover1/out/pose", encode_pose(pose, "json").payload))

    net.subscribe("coview/rover1/in/cloud", answer, "newest")
    code = re.search(r"<!-- client -->\n```python\n(.*?)```\n<!-- end -->", text_of("python.md"), re.DOTALL)[1]
    code = code.replace("timeout=1.0", "timeout=0").replace('"tcp/127.0.0.1:7447"', "transport=net")
    names = {"T_odom_body": np.eye(4), "points": np.ones((3, 3)), "stamp": 2.5, "net": net}
    exec(compile(code, "python.md", "exec"), names)
    assert capsys.readouterr().out.startswith("2500000000 [[1.")


def test_program_of_the_feed_prints_poses(capsys):
    net = MemoryTransport()

    def publish(_):
        pose = PoseMessage(0, "r1", "TRACKING", np.eye(4), np.eye(6), 0.9, "ab" * 32)
        net.publish(Sample("coview/r1/out/pose", encode_pose(pose, "json").payload, "application/json"))
        printed = []
        until(lambda: printed.append(capsys.readouterr().out) or "r1 [0. 0. 0.]" in "".join(printed))

    code = blocks("serve.md", "python")[0].replace("open_client()", "net")
    exec(compile(code, "serve.md", "exec"), {"net": net, "input": publish})


class Asked:
    """A client that notes its guesses."""

    def suggest(self, *place, **more):
        return [*place], more


def test_guesses_of_a_receiver_and_of_a_tag():
    gnss, tag = blocks("guess.md", "python")
    names = {}
    exec(compile(tag, "guess.md", "exec"), names)
    T_map_tag, T_body_tag = np.eye(4), np.eye(4)
    T_map_tag[:3, :3], T_map_tag[:3, 3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]], (10.0, 20.0, 1.0)
    T_body_tag[:3, 3] = 3.0, 0.0, 1.0
    (x, y), more = names["suggest_tag"](Asked(), T_map_tag, T_body_tag)
    np.testing.assert_allclose([x, y, more["yaw"]], [10.0, 17.0, np.pi / 2])
    pytest.importorskip("pyproj", reason="pip install '.[geo]'")
    exec(compile(gnss.partition("\n\nwith ")[0], "guess.md", "exec"), names)
    (x, y), more = names["suggest_gnss"](Asked(), 48.1372, 11.5756, sigma=20.0)
    np.testing.assert_allclose([x, y], [691_600, 5_334_800], atol=300)
    assert more == {"within": 100.0}


# ---- the wire, the evidence, reasons, promises


def test_every_key_encoding_counter_and_field_is_listed():
    wire = text_of("wire.md")
    keys = robot_keys("native", "{base}", "{robot}")
    listed = [keys.status, keys.alive, keys.relocalize, keys.reset, keys.suggest, keys.initial_pose]
    listed += [key for preset in PRESETS.values() for key in (preset.cloud, preset.odometry, preset.pose)]
    listed += [*PRESETS, *Counters().to_json()]
    pose = PoseMessage(1, "r", "TRACKING", np.eye(4), np.eye(6), 0.5, "ab" * 32)
    listed += [encode_pose(pose, name).encoding for name in ("json", "cdr", "foxglove")]
    assert [name for name in listed if f"`{name}`" not in wire] == []
    assert f"`serve --pose-encoding cdr` ({len(encode_pose(pose, 'cdr').payload)} bytes)" in wire
    table = text_of("method.md").split("## Fields of the evidence")[1].split("\n## ")[0]
    named = [name for row in re.findall(r"^\| (`.*?) \|", table, re.MULTILINE) for name in re.findall(r"`(\w+)`", row)]
    assert sorted(named) == sorted(KeyframeEvidence(0.0, State.LOST, "").to_json())


def test_documented_bytes_are_read():
    wire = text_of("wire.md")
    encoding = re.search(r'z_encoding_from_str\(&encoding, "(.*?)"\)', wire)[1]
    rows = np.arange(6, dtype="<f4").tobytes()
    message = decode_cloud(Sample("k", rows, encoding, (5).to_bytes(8, "little", signed=True)))
    assert message.stamp_ns == 5
    assert message.points.tolist() == [[0, 1, 2], [3, 4, 5]]
    odometry = blocks("wire.md", "json")[0]
    assert decode_odometry(Sample("k", odometry.encode(), "application/json")).T_odom_body[0, 3] == 1.5


def test_every_state_and_cause_is_documented():
    page = text_of("reasons.md")
    assert [cause.value for cause in RejectionReason if f"| `{cause.value}` |" not in page] == []
    assert [state.value for state in State if state.value not in page] == []


@pytest.mark.parametrize(("file", "test"), sorted(set(NAMED_TEST.findall(text_of("limits.md")))))
def test_test_behind_a_promise_exists(file, test):
    assert re.search(rf"^def {test or 'test_'}", (ROOT / file).read_text(encoding="utf-8"), re.MULTILINE)


def test_each_promise_names_a_test_or_a_benchmark():
    promises = [line for line in text_of("limits.md").splitlines() if line.startswith("| **")]
    assert len(promises) > 10
    assert [line for line in promises if "`tests/" not in line and "python -m bench" not in line] == []


def test_fields_of_json_are_documented(world_map):
    fields = {
        "out/result.json": RunResult(1, []).to_json(world_map),
        "eval --json": {"format", *(field.name for field in dataclasses.fields(Evaluation))},
        "doctor --json": {"format", "findings", *(field.name for field in dataclasses.fields(Finding))},
        "info --json": {"format", "signature", *describe(world_map)},
    }
    section = text_of("wire.md").partition("## JSON of commands")[2]
    for name, known in fields.items():
        row = re.search(rf"^\| `{re.escape(name)}` \| (.*) \|$", section, re.M)[1]
        named = set(re.findall(r"`([\w ]+)`", row))
        assert set(known) <= named, name
