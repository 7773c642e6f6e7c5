"""Run benchmarks and write their tables into docs/results.md.

``python -m bench results [--only NAME...] [--quick]`` replaces only the tables that it runs; every table stands below
its command, date, machine and the commit of the code (``+``: with uncommitted changes). Quick runs have tables of their
own.

``python -m bench release --work DIR [--only NAME...] [--quick]`` makes a page of one code, for a release: a table is
kept in DIR as soon as it is there, a second call goes on with those that are missing, and the page is written once all
are of one code (in DIR, if they are quick). The most valuable tables come first. Those without times run side by side,
one on each core, the others alone; most keep the results of each drive or site in ``DIR/worlds`` as well, so that an
interruption costs minutes (``soak``, an hour in one piece, begins anew). It says what is left, and about how long that
takes: at most 12 hours on two cores. What a table leaves out for that stands behind ``thinned``. Tables of the page
that no command makes are kept below the others.
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

from bench.__main__ import BUSY, parser_of, tables_of
from bench.harness.files import ROOT, commit, data, environment, fingerprint
from bench.harness.rows import HEAD as COLUMNS
from bench.harness.rows import Row, table
from coview_stream.clouds.atomic_file import atomic_path
from coview_stream.errors import InputError

PAGE = ROOT / "docs" / "results.md"


class Table(NamedTuple):
    """How a table is made."""

    command: str
    minutes: float  # about, on quiet cores, until the folder of a release says how long it took here
    beside: bool = False  # runs beside others, on a core of its own: no time in it has a target
    quick: str = ""  # the command beside --quick, if it is another one
    thinned: str = ""  # what is left out, so that all ends in twelve hours


SETS_OF_TWO = "--sets kitti04 handheld_livox --conditions base pitch:3"

TABLES = {
    "integrity": Table("integrity", 220, quick="integrity --count 6", thinned="a frame every 0.8 m"),
    "accuracy": Table("accuracy --only worlds", 60, True),
    "conditions": Table("conditions", 15, True, f"conditions {SETS_OF_TWO}"),
    "forest": Table("forest", 12, True),
    "tracking": Table("tracking", 40, True),
    "dirt": Table("accuracy --only dirt --drives 2", 30, True, "accuracy --only dirt", "two of the four drives"),
    "protection": Table(
        "protection --worlds 26", 70, True, "protection --worlds 1",
        "26 of 30 worlds of each family; 999 blocks, which a risk of 1e-3 needs, are in 25",
    ),
    "faults": Table("faults", 25, True),
    "conditions beside the paper": Table(
        "conditions --conditions base --paper", 3, True, "conditions --conditions base --sets kitti04 --paper"
    ),
    "forest_drives": Table("forest_drives --plots docs/images", 50, True, "forest_drives"),
    "challenge": Table("challenge --count 40", 20, True, "challenge", "40 of 100 runs"),
    "exposure": Table("exposure --worlds 26", 1, False, f"exposure --worlds 1 {SETS_OF_TWO}"),  # of results of those
    "peers": Table("peers --places 12 --limit 90", 40, quick="peers --limit 60", thinned="12 places of each world"),
    "search": Table("search", 4),
    "engine": Table("engine", 3),
    "memory": Table("memory", 15),
    "start": Table("start", 3),
    "soak": Table("soak --minutes 60", 62, quick="soak --minutes 0.5 --every 10"),
    "city": Table("city --side 2 4", 30),
    "stream": Table("stream raw cdr protobuf jitter robots", 8, quick="stream jitter"),
    "lidars": Table("stream lidars", 7),
    "throughput": Table("engine --throughput", 7),
    "registration": Table("registration", 5),
    "fleet": Table("fleet", 4),
    "fuzz": Table("fuzz --seconds 30", 10, quick="fuzz --seconds 2", thinned="half a minute for each target"),
    "ablation, spacing": Table(
        "ablation --only spacing --picture docs/images/spacing.png", 5, False, "ablation --only spacing --sites kitti04"
    ),
    **{
        f"ablation, {group}": Table(f"ablation --only {group}", 8, True, f"ablation --only {group} --sites kitti04")
        for group in ("channels", "registration", "localizer", "elsewhere")
    },
    "changed ground": Table("ground", 15, True),
    "overlap": Table(
        "conditions --overlaps 5 20 35 50 65 85 --sets handheld_livox kitti04 town-vlp16-4201 village-bpearl-4203",
        13, True, "conditions --overlaps 35 --sets kitti04",
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


_RUNNING: set[subprocess.Popen[bytes]] = set()


def measured(command: str, threads: int | None = None) -> str:
    """Run a benchmark in a process of its own; return its tables, then its targets or all rows, without padding.

    Empty if it failed.
    """
    name, *words = command.split()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "rows.json"
        line = [sys.executable, "-m", "bench", name, *words, "--json", str(file)]
        process = subprocess.Popen(line, env=environment(threads), stdout=sys.stderr, start_new_session=True)
        _RUNNING.add(process)
        code = process.wait()
        _RUNNING.discard(process)
        if code not in (0, 1) or not file.is_file():
            return ""
        rows = [Row.from_dict(values) for values in json.loads(file.read_text())]
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
    parser.add_argument("--page", type=Path, default=PAGE, help=f"({PAGE.relative_to(ROOT)})")
    asked = parser.parse_args(arguments)
    missing = []
    try:
        names = chosen(asked.only)
    except InputError as error:
        print(f"bench {name}: {error}", file=sys.stderr)
        return 2
    if release:
        return _release(asked, names)
    for name in names:
        if not (part := _part(name, asked)):
            missing.append(name)
            continue
        title = f"{name}, quick" if asked.quick else name
        page = asked.page.read_text() if asked.page.is_file() else HEAD
        with atomic_path(asked.page) as file:
            file.write_text(replaced(page, title, part))
    print(f"{len(names) - len(missing)} tables written; not measured: {', '.join(missing) or 'none'}")
    return int(bool(missing))


def _part(name: str, asked: Namespace, threads: int | None = None) -> str:
    """Measure a table; return its part of the page, empty if it failed."""
    of = TABLES[name]
    command = f"{of.quick or of.command} --quick" if asked.quick else of.command
    print(f"=== {command}", file=sys.stderr, flush=True)
    load, begin = os.getloadavg()[0], time.monotonic()
    text = measured(command, threads)
    took = (time.monotonic() - begin) / 60
    print(f"=== {command}: {took:.1f} min{'' if text else ', FAILED'}", file=sys.stderr, flush=True)
    title = f"{name}, quick" if asked.quick else name
    busy = load > BUSY and threads is None
    machine = f"{os.cpu_count()} shared cores{f', load {load:.0f} from other work' * busy}"
    thinned = f"; thinned: {of.thinned}" if of.thinned and not asked.quick else ""
    version = f"{commit()}, code {_code()}, {took:.1f} min{thinned}"
    return text and block(title, command, text, time.strftime("%Y-%m-%d"), version, machine)


def _release(asked: Namespace, names: Sequence[str]) -> int:
    """Make the tables of this code that are missing in the folder; write the page if then none is."""
    os.environ["COVIEW_BENCH"] = str(asked.work / "worlds")
    code = _code()
    tables = asked.work / f"tables-{code}{'-quick' * asked.quick}"
    tables.mkdir(parents=True, exist_ok=True)
    files = {name: tables / f"{name.replace(' ', '_')}.md" for name in TABLES}

    stopped = threading.Event()

    def make(name: str, threads: int | None) -> None:
        part = ""
        if _code() == code and not stopped.is_set():
            try:
                part = _part(name, asked, threads)
            except Exception:  # the other tables go on
                traceback.print_exc()
        if part and _code() == code and not stopped.is_set():  # an interrupted soak tells of what it did
            with atomic_path(files[name]) as file:
                file.write_text(part)

    if not any(data().glob("surveys/*.laz")):
        print(f"bench release: no surveys in {data()} (COVIEW_DATA): all sites are simulated", file=sys.stderr)
    left = [name for name in names if not files[name].is_file()]
    print(f"code {code}: {len(left)} of {len(names)} tables to make{_about(left, asked)}", file=sys.stderr, flush=True)
    for beside, some in itertools.groupby(left, lambda name: TABLES[name].beside):
        with ThreadPoolExecutor(max(1, asked.jobs) if beside else 1) as pool:
            try:
                list(pool.map(make, some, itertools.repeat(1 if beside else None)))
            except BaseException:  # interrupted, or told to end
                stopped.set()
                pool.shutdown(wait=False, cancel_futures=True)
                for process in list(_RUNNING):  # with the processes of its own
                    with contextlib.suppress(ProcessLookupError):
                        os.killpg(process.pid, signal.SIGTERM)
                raise
    if _code() != code:
        print("bench release: the code changed meanwhile; begin again", file=sys.stderr)
        return 2
    missing = [name for name, file in files.items() if not file.is_file()]
    print(f"code {code}: {len(files) - len(missing)} of {len(files)} tables; missing: {', '.join(missing) or 'none'}")
    if not missing:
        page = tables / "results.md" if asked.quick else asked.page
        text = introduction(asked.page) + "".join(file.read_text() for file in files.values()) + without(asked.page)
        with atomic_path(page) as file:
            file.write_text(text)
        if page == PAGE:  # figures of other pages
            subprocess.run([sys.executable, PAGE.with_name("write_reference.py")], env=environment(), check=True)
        print(page)
    return int(bool(missing))


def _about(names: Sequence[str], asked: Namespace) -> str:
    """Say how long tables will take, as earlier ones in the folder took, or else as :data:`TABLES` says."""
    minutes = {name: 0.5 if asked.quick else TABLES[name].minutes for name in names}
    for file in sorted(asked.work.glob("tables-*/*.md"), key=os.path.getmtime):
        found = re.match(
            r"(?s)\n<!-- results: ([^\n]*?)(, quick)? -->[^`]*`[^`]*`[^\n]*, ([\d.]+) min", file.read_text()
        )
        if found and found[1] in minutes and bool(found[2]) == asked.quick:
            minutes[found[1]] = float(found[3])
    hours = [value / 60 / (asked.jobs if TABLES[name].beside else 1) for name, value in minutes.items()]
    return f", about {sum(hours):.1f} h"


def without(page: Path) -> str:
    """Return a page's tables that no command of :data:`TABLES` makes; they name their own commit."""
    text = page.read_text() if page.is_file() else ""
    made = {entry.command.split()[0] for entry in TABLES.values()}

    def outdated(name: str, part: str) -> bool:
        by = re.search(r"`python -m bench (\w+)([^`]*)`", part.partition("\n|")[0])
        return name in TABLES or name.endswith(", quick") or bool(by and by[1] in made and "FILE" not in by[2])

    parts = re.findall(r"(?s)\n<!-- results: ([^\n]+) -->\n(.*?)<!-- end -->\n", text)
    kept = [(name, part) for name, part in parts if not outdated(name, part)]
    return "".join(f"\n<!-- results: {name} -->\n{part}<!-- end -->\n" for name, part in kept)


def _code() -> str:
    """Short hash of the product, the kernels and the benchmarks."""
    return fingerprint("coview_stream", "coview_kernels", "bench")


def introduction(page: Path) -> str:
    """Return a page's text above its first table."""
    return page.read_text().partition("\n<!-- results: ")[0] if page.is_file() else HEAD
