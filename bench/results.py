"""Run benchmarks and write their tables into docs/results.md.

``python -m bench results [--only NAME...] [--quick]`` replaces only the tables that it runs; every table stands below
its command, date, machine, the commit (``+``: with uncommitted changes) and two hashes: of the product, and of the
benchmark with the modules that it imports. Quick runs have tables of their own.

``python -m bench release --work DIR [--only NAME...] [--quick]`` makes a page of one product, for a release. The page
is its memory: a table that is there, of both hashes and by the same command, is done, and one that is made goes into it
at once. So a release continues in another DIR or on another machine while the product's hash is the same (comments,
docstrings and layout do not count, nor :data:`UNMEASURED` code; it is one minor version of Python's), and a mended
benchmark repeats only its own tables. Remove the file of the kept runs of ``integrity`` when the product has changed.
The most valuable tables come first. Those without times run side by side, one on each core, the others alone; most keep
the results of each drive or site in ``DIR/worlds`` as well, so that an interruption costs minutes (``soak``, an hour in
one piece, starts again). It says which tables are missing, and about how long they take. What a table leaves out to be
done in time stands behind ``thinned``. Once all are there, older tables are removed; those that no command makes are
kept below the others. A quick release has its page in DIR.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from bench.__main__ import BENCHMARKS, BUSY, parser_of, tables_of
from bench.harness.files import ROOT, commit, data, environment, fingerprint, imported
from bench.harness.rows import HEAD as COLUMNS
from bench.harness.rows import Row, table
from coview_stream.clouds.atomic_file import atomic_path
from coview_stream.errors import InputError

PAGE = ROOT / "docs" / "results.md"
UNMEASURED = (
    "cli/demo.py", "cli/doctor.py", "doctor/", "report/relief.py", "stream/transport/ros2_transport.py", "viewers/",
)  # fmt: skip
"""Parts of the package that no benchmark runs: the picture of a map, views, ROS 2, the demo and the doctor."""


class Table(NamedTuple):
    """How a table is made."""

    command: str
    minutes: float  # about, on quiet cores, until the page says how long it took
    beside: bool = False  # runs beside others, on a core of its own: no time in it has a target
    quick: str = ""  # the command beside --quick, if it is another one
    thinned: str = ""  # parts left out, so that everything ends within twelve hours


SETS_OF_TWO = "--sets kitti04 handheld_livox --conditions base pitch:3"

TABLES = {
    "integrity": Table(
        "integrity --kept docs/integrity.jsonl.xz", 275, quick="integrity --count 6", thinned="a frame every 0.8 m"
    ),
    "accuracy": Table("accuracy --only worlds", 60, True),
    "conditions": Table("conditions", 15, True, f"conditions {SETS_OF_TWO}"),
    "forest": Table("forest", 12, True),
    "tracking": Table("tracking", 40, True),
    "surveys": Table("surveys", 25, True),
    "dirt": Table("accuracy --only dirt --drives 1", 15, True, "accuracy --only dirt", "one of the four drives"),
    "protection": Table(
        "protection --worlds 26", 70, True, "protection --worlds 1",
        "26 of 30 worlds of each family: 999 blocks, by which a risk of 1e-3 is calibrated; to show it takes 75 worlds",
    ),
    "faults": Table(
        "faults --worlds town forest kitti04 handheld_livox", 17, True, "faults", "four of the six worlds"
    ),
    "conditions beside the paper": Table(
        "conditions --conditions base --paper", 3, True, "conditions --conditions base --sets kitti04 --paper"
    ),
    "forest_drives": Table("forest_drives --plots docs/images", 50, True, "forest_drives"),
    "challenge": Table("challenge --count 20", 10, True, "challenge", "20 of 100 runs"),
    "exposure": Table("exposure --worlds 26", 1, False, f"exposure --worlds 1 {SETS_OF_TWO}"),  # of results of those
    "peers": Table("peers --places 6 --limit 90", 28, True, "peers --limit 60", "6 of 20 places of each world"),
    "search": Table("search", 4),
    "engine": Table("engine", 3),
    "memory": Table("memory --km2 0.05 1", 8, False, "memory", "the largest of three maps, which city has"),
    "start": Table("start", 3),
    "soak": Table("soak --minutes 60", 62, quick="soak --minutes 0.5 --every 10"),
    "city": Table("city --side 2 4", 30),
    "stream": Table("stream raw cdr protobuf jitter robots", 8, quick="stream jitter"),
    "lidars": Table("stream lidars", 7),
    "throughput": Table("engine --throughput", 7),
    "registration": Table("registration", 5),
    "fleet": Table("fleet", 4),
    "fuzz": Table("fuzz --seconds 10", 8, True, "fuzz --seconds 2", "ten seconds for each target"),
    "ablation, spacing": Table(
        "ablation --only spacing --picture docs/images/spacing.png", 5, False, "ablation --only spacing --sites kitti04"
    ),
    **{
        f"ablation, {group}": Table(f"ablation --only {group}", 8, True, f"ablation --only {group} --sites {few}")
        for group, few in {"channels": "kitti04", "localizer": "kitti04", "elsewhere": "kitti04 handheld_livox"}.items()
    },
    "changed ground": Table("ground", 15, True),
    "overlap": Table(
        "conditions --overlaps 5 20 35 65 --sets handheld_livox kitti04 town-vlp16-4201 village-bpearl-4203",
        9, True, "conditions --overlaps 35 --sets kitti04",
    ),
    "airborne-like maps": Table(
        "conditions --conditions base --densities 4 8 20 --paper", 12, True,
        "conditions --conditions base --densities 8 --sets kitti04",
    ),
    "covariance": Table("covariance", 5, True, "covariance --sets kitti04"),
    "smooth": Table("smooth", 12, True, "smooth kitti04"),
    "changes": Table("changes", 8, True),
}  # fmt: skip
"""All tables by name, the most valuable first."""

HEAD = """# Results

All figures of the documentation, each below the command that prints it, its date, its machine and the commit of the
measured code. `python -m bench results --only NAME...` measures again and replaces only the tables of these names.
"""


def chosen(names: Sequence[str]) -> list[str]:
    """Return the names of the tables to make; InputError for an unknown one."""
    if unknown := [name for name in names if name not in TABLES]:
        raise InputError(f"no table {', '.join(unknown)}; there are {', '.join(TABLES)}")
    return list(names) or list(TABLES)


def block(name: str, command: str, text: str, date: str, version: str, machine: str = "2 shared cores") -> str:
    """Return a table's part of the page; ``version`` names the commit, and the hash of the code."""
    about = f"`python -m bench {command}`, {date}, {machine}, commit {version}"
    return f"\n<!-- results: {name} -->\n## {name}\n\n{about}\n\n{text}\n<!-- end -->\n"


def replaced(page: str, name: str, part: str) -> str:
    """Put a part into its place in the page, or at its end."""
    place = rf"(?s)\n<!-- results: {re.escape(name)} -->\n.*?<!-- end -->\n"
    new, count = re.subn(place, lambda _: part, page)
    return new if count else f"{page.rstrip()}\n{part}"


class Children:
    """The processes that measure; once they are told to end, no further one begins."""

    def __init__(self) -> None:
        self._lock, self._running, self.ended = threading.Lock(), set[subprocess.Popen[bytes]](), False

    def run(self, line: Sequence[str], threads: int | None) -> int | None:
        """Run a command in a session of its own, its output on stderr; return its exit code, None if all ended."""
        with self._lock:
            if self.ended:
                return None
            process = subprocess.Popen(line, env=environment(threads), stdout=sys.stderr, start_new_session=True)
            self._running.add(process)
        try:
            code = process.wait()
        finally:  # perhaps interrupted
            with self._lock:
                self._running.discard(process)
            _kill(process)
        return None if self.ended else code

    def end(self, seconds: float = 10.0) -> None:
        """Tell all to end; kill those that have not after so many seconds."""
        with self._lock:
            self.ended, running = True, list(self._running)
        for process in running:
            _kill(process, signal.SIGTERM)  # so that it ends the processes that it began
        until = time.monotonic() + seconds
        for process in running:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(max(0.0, until - time.monotonic()))
            _kill(process)


def _kill(process: subprocess.Popen[bytes], how: signal.Signals = signal.SIGKILL) -> None:
    with contextlib.suppress(ProcessLookupError):  # with the processes of its own
        os.killpg(process.pid, how)


def measured(command: str, threads: int | None, children: Children) -> str:
    """Run a benchmark in a process of its own; return its tables, then its targets or all rows, without padding.

    Empty if a part of it failed, or it was told to end.
    """
    name, *words = command.split()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "rows.json"
        line = [sys.executable, "-m", "bench", name, *words, "--json", str(file)]
        if children.run(line, threads) not in (0, 1) or not file.is_file():
            return ""
        rows = [Row.from_dict(values) for values in json.loads(file.read_text())]
    if broken := [row.name for row in rows if row.target == "runs"]:
        print(f"=== {command}: {'; '.join(broken)}", file=sys.stderr, flush=True)
        return ""
    own = tables_of(name, rows, parser_of(name).parse_args(words))
    parts = [f"{title}\n\n{text}".strip() for title, text in own.items()]
    shown = [row for row in rows if row.target or not own]
    if shown:
        cells = [[row.name.removeprefix(name).lstrip("/,: "), *row.cells()[1:]] for row in shown]
        parts.append(table(COLUMNS, cells))
    return re.sub(r"(?m)^\|.*$", lambda line: re.sub(r" *\| *", "|", line[0]), "\n\n".join(parts))


def main(arguments: Sequence[str], *, release: bool = False) -> int:
    """Make the tables one after the other; each is written as soon as it is there."""
    name = "release" if release else "results"
    parser = ArgumentParser(f"python -m bench {name}", description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    if release:
        parser.add_argument("--work", type=Path, required=True, metavar="DIR", help="folder of worlds and tables")
        parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="cores (all)")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help=", ".join(TABLES))
    parser.add_argument("--quick", action="store_true", help="smaller sizes, in tables of their own")
    parser.add_argument("--page", type=Path, help=f"({PAGE.relative_to(ROOT)}; of a quick release DIR/results.md)")
    asked = parser.parse_args(arguments)
    try:
        names = chosen(asked.only)
    except InputError as error:
        print(f"bench {name}: {error}", file=sys.stderr)
        return 2
    asked.page = asked.page or (asked.work / PAGE.name if release and asked.quick else PAGE)
    code = _release(asked, names) if release else _results(asked, names)
    if asked.page == PAGE:  # figures of other pages
        subprocess.run([sys.executable, PAGE.with_name("write_reference.py")], env=environment(), check=False)
    return code


def _results(asked: Namespace, names: Sequence[str]) -> int:
    """Make the tables one after the other."""
    missing = []
    for name in names:
        if part := _part(name, asked, None, Children()):
            _write(asked.page, replaced(text_of(asked.page), _title(name, asked), part))
        else:
            missing.append(name)
    print(f"{len(names) - len(missing)} tables written; not measured: {', '.join(missing) or 'none'}")
    return int(bool(missing))


def text_of(page: Path) -> str:
    """Return a page, or the text above the tables of a new one."""
    return page.read_text() if page.is_file() else HEAD


def _write(page: Path, text: str) -> None:
    page.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(page) as file:
        file.write_text(text)


def _title(name: str, asked: Namespace) -> str:
    return f"{name}, quick" if asked.quick else name


def _command(name: str, asked: Namespace) -> str:
    of = TABLES[name]
    return f"{of.quick or of.command} --quick" if asked.quick else of.command


def _part(name: str, asked: Namespace, threads: int | None, children: Children) -> str:
    """Measure a table; return its part of the page, empty if it failed."""
    of, command = TABLES[name], _command(name, asked)
    print(f"=== {command}", file=sys.stderr, flush=True)
    load, begin, version = os.getloadavg()[0], time.monotonic(), f"{commit()}, {_made_by(name)}"
    text = measured(command, threads, children)
    took = (time.monotonic() - begin) / 60
    print(f"=== {command}: {took:.1f} min{'' if text else ', FAILED'}", file=sys.stderr, flush=True)
    busy = load > BUSY and threads is None
    machine = f"{os.cpu_count()} shared cores{f', load {load:.0f} from other work' * busy}"
    thinned = f"; thinned: {of.thinned}" if of.thinned and not asked.quick else ""
    about = f"{version}, {took:.1f} min{thinned}"
    return text and block(_title(name, asked), command, text, time.strftime("%Y-%m-%d"), about, machine)


def _release(asked: Namespace, names: Sequence[str]) -> int:
    """Make the tables that the page does not have of this code; remove older ones if then none is missing."""
    os.environ["COVIEW_BENCH"] = str(asked.work / "worlds")
    code, children, lock = _code(), Children(), threading.Lock()

    def make(name: str, threads: int | None) -> None:
        part = ""
        if _code() == code and not children.ended:
            try:
                part = _part(name, asked, threads, children)
            except Exception:  # the other tables go on
                traceback.print_exc()
        if part and _code() == code:
            with lock:
                text = counted(replaced(text_of(asked.page), _title(name, asked), part), code, asked)
                _write(asked.page, text)

    if not any(data().glob("surveys/*.laz")):
        print(f"bench release: no surveys in {data()} (COVIEW_DATA): all sites are simulated", file=sys.stderr)
    left = [name for name in names if name not in done(text_of(asked.page), asked)]
    print(f"code {code}: {len(left)} of {len(names)} tables to make{_about(left, asked)}", file=sys.stderr, flush=True)
    for beside, some in itertools.groupby(left, lambda name: TABLES[name].beside):
        with ThreadPoolExecutor(max(1, asked.jobs) if beside else 1) as pool:
            try:
                list(pool.map(make, some, itertools.repeat(1 if beside else None)))
            except BaseException:  # interrupted, or told to end
                pool.shutdown(wait=False, cancel_futures=True)
                children.end()
                raise
    if _code() != code:
        print("bench release: the code changed meanwhile; begin again", file=sys.stderr)
        return 2
    page = text_of(asked.page)
    there, parts = done(page, asked), parts_of(page)
    missing = [
        f"{name} (of other code)" if _title(name, asked) in parts else name for name in TABLES if name not in there
    ]
    print(f"code {code}: {len(there)} of {len(TABLES)} tables; missing: {'; '.join(missing) or 'none'}")
    if not missing:
        _write(asked.page, counted(introduction(page) + "".join(there.values()) + without(page), code, asked))
        print(asked.page)
    return int(bool(missing))


def parts_of(page: str) -> dict[str, str]:
    """Return a page's tables by title."""
    found = re.finditer(r"(?s)\n<!-- results: ([^\n]+) -->\n.*?<!-- end -->\n", page)
    return {part[1]: part[0] for part in found}


def done(page: str, asked: Namespace) -> dict[str, str]:
    """Return the tables of a page that their commands of today have made of a code, by name."""
    parts = {name: parts_of(page).get(_title(name, asked), "") for name in TABLES}
    return {
        name: part for name, part in parts.items()
        if re.search(rf"\n`python -m bench {re.escape(_command(name, asked))}`, .*, {_made_by(name)}, ", part)
    }  # fmt: skip


def counted(page: str, code: str, asked: Namespace) -> str:
    """Return the page with a line above its tables that says how many of them are of a code."""
    head = re.sub(r"\n\d+ of \d+ tables are of code \w+\.\n", "", introduction(page)).rstrip()
    line = f"\n\n{len(done(page, asked))} of {len(TABLES)} tables are of code {code}.\n"
    return head + line + page.removeprefix(introduction(page))


def _about(names: Sequence[str], asked: Namespace) -> str:
    """Say how long tables will take, as those of the page took, or else as :data:`TABLES` says."""
    parts, hours = parts_of(text_of(asked.page)), 0.0
    for name in names:
        took = re.search(r", code \w+, bench \w+, ([\d.]+) min", parts.get(_title(name, asked), ""))
        minutes = float(took[1]) if took else 0.5 if asked.quick else TABLES[name].minutes
        hours += minutes / 60 / (asked.jobs if TABLES[name].beside else 1)
    return f", about {hours:.1f} h"


def without(page: str) -> str:
    """Return a page's tables that no command of :data:`TABLES` makes; they name their own commit."""
    made = {entry.command.split()[0] for entry in TABLES.values()}

    def outdated(name: str, part: str) -> bool:
        by = re.search(r"`python -m bench (\w+)([^`]*)`", part.partition("\n|")[0])
        return name in TABLES or name.endswith(", quick") or bool(by and by[1] in made and "FILE" not in by[2])

    return "".join(part for name, part in parts_of(page).items() if not outdated(name, part))


def introduction(page: str) -> str:
    """Return a page's text above its first table."""
    return page.partition("\n<!-- results: ")[0]


def _code() -> str:
    """Short hash of the product and the kernels, but for :data:`UNMEASURED`."""
    return fingerprint(without=UNMEASURED)


def _made_by(name: str) -> str:
    """Name the code of a table: the product's hash, and that of the benchmark's modules with all that they import."""
    files: list[Path] = []

    def add(module: str) -> None:
        file = ROOT / f"{module.replace('.', '/')}.py"
        if module.startswith("bench.") and module != __name__ and file.is_file() and file not in files:
            files.append(file)
            for part in imported(file.read_bytes()):
                add(part)

    add(f"bench.{BENCHMARKS[TABLES[name].command.split()[0]].module}")
    return f"code {_code()}, bench {fingerprint(*sorted(str(file.relative_to(ROOT)) for file in files))}"
