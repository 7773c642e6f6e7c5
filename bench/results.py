"""Run benchmarks and write their tables into docs/results.md.

``python -m bench results [--only NAME...] [--quick]`` replaces only the tables that it runs; every table stands below
its command, date, machine and the commit of the code (``+``: with uncommitted changes). Quick runs have tables of their
own.

``python -m bench release --work DIR [--only NAME...] [--quick]`` makes a page of one code, for a release: a table is
kept in DIR as soon as it is there, a second call goes on with those that are missing, and the page is written once all
are of one code (in DIR, if they are quick). Tables without times run side by side, one on each core, then the others
alone. It says what is left, and about how long that takes: a release is to end in 12 hours on two cores. For that,
``integrity`` ends after three hours, with as many of its 3,000 runs as are there: run it alone with ``--work
DIR/worlds`` before, on as many days as it takes. Tables of the page that no command makes are kept below the others.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from bench.__main__ import BENCHMARKS, BUSY, parser_of, tables_of
from bench.harness.files import ROOT, commit, environment, fingerprint
from bench.harness.rows import HEAD as COLUMNS
from bench.harness.rows import Row, table
from coview_stream.clouds.atomic_file import atomic_path
from coview_stream.errors import InputError

PAGE = ROOT / "docs" / "results.md"

ABLATION = ("channels", "registration", "localizer", "elsewhere")
COMMANDS = {
    **{name: name for name in BENCHMARKS if name not in ("ground", "ablation", "challenge")},
    "integrity": "integrity --minutes 180",
    "changed ground": "ground",
    "throughput": "engine --throughput",
    "city": "city --side 2 4",
    **{f"ablation, {group}": f"ablation --only {group}" for group in ABLATION},
    "ablation, spacing": "ablation --only spacing --picture docs/images/spacing.png",
    "accuracy": "accuracy --only worlds",
    "dirt": "accuracy --only dirt",
    "conditions beside the paper": "conditions --conditions base --paper",
    "airborne-like maps": "conditions --conditions base --densities 4 8 20 --paper",
    "overlap": "conditions --overlaps 5 20 35 50 65 85 "
    "--sets handheld_livox kitti04 town-vlp16-4201 village-bpearl-4203",
    "lidars": "stream lidars",
    "forest_drives": "forest_drives --plots docs/images",
    "fuzz": "fuzz --seconds 60",
    "soak": "soak --minutes 60",
}
"""Name of each table, and the command that prints it."""

QUICK = {
    "integrity": "integrity --count 12 --minutes 2",
    "conditions": "conditions --conditions base pitch:3 --sets kitti04 handheld_livox",
    "conditions beside the paper": "conditions --conditions base --sets kitti04 --paper",
    "airborne-like maps": "conditions --conditions base --densities 8 --sets kitti04",
    "overlap": "conditions --overlaps 35 --sets kitti04",
    **{f"ablation, {group}": f"ablation --only {group} --sites kitti04" for group in (*ABLATION, "spacing")},
    "protection": "protection --worlds 1",
    "covariance": "covariance --sets kitti04",
    "smooth": "smooth kitti04",
    "memory": "memory --km2 0.05",
    "fuzz": "fuzz --seconds 5",
    "soak": "soak --minutes 2",
}
"""Commands that are other ones with ``--quick``, beside that option."""

SIDE_BY_SIDE = {
    "accuracy", "dirt", "conditions", "conditions beside the paper", "airborne-like maps", "overlap", "changed ground",
    "faults", "tracking", "smooth", "covariance", "protection", "forest", "forest_drives", "changes",
    *(f"ablation, {group}" for group in ABLATION),
}  # fmt: skip
"""Tables that run side by side, one on each core: no time in them has a target."""

MINUTES = {
    "integrity": 180, "soak": 61, "accuracy": 30, "dirt": 60, "tracking": 40, "protection": 80, "conditions": 15,
    "forest": 30, "forest_drives": 30, "changed ground": 30, "city": 30, "smooth": 20, "stream": 15,
    "faults": 15, "overlap": 13, "airborne-like maps": 12, "covariance": 10, "peers": 15, "memory": 10, "lidars": 10,
    "fleet": 10, "registration": 10, "throughput": 7,
}  # fmt: skip
"""About how long a table takes on two quiet cores, the others five minutes, until DIR says how long it took here."""

HEAD = """# Results

All figures of the documentation, each below the command that prints it, its date, its machine and the commit of the
measured code. `python -m bench results --only NAME...` measures again and replaces only the tables of these names.
"""


def chosen(names: Sequence[str]) -> list[str]:
    """Return the names of the tables to make; InputError for an unknown one."""
    if unknown := [name for name in names if name not in COMMANDS]:
        raise InputError(f"no table {', '.join(unknown)}; there are {', '.join(COMMANDS)}")
    return list(names) or list(COMMANDS)


def block(name: str, command: str, text: str, date: str, version: str, machine: str = "2 shared cores") -> str:
    """Return a table's part of the page; ``version`` names the commit, and the hash of the code."""
    about = f"`python -m bench {command}`, {date}, {machine}, commit {version}"
    return f"\n<!-- results: {name} -->\n## {name}\n\n{about}\n\n{text}\n<!-- end -->\n"


def replaced(page: str, name: str, part: str) -> str:
    """Put a part into its place in the page, or at its end."""
    place = rf"(?s)\n<!-- results: {re.escape(name)} -->\n.*?<!-- end -->\n"
    new, count = re.subn(place, lambda _: part, page)
    return new if count else f"{page.rstrip()}\n{part}"


def measured(command: str, threads: int | None = None) -> str:
    """Run a benchmark in a process of its own; return its tables, then its targets or all rows, without padding.

    Empty if it failed.
    """
    name, *words = command.split()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "rows.json"
        code = subprocess.run(
            [sys.executable, "-m", "bench", name, *words, "--json", str(file)],
            env=environment(threads),
            stdout=sys.stderr,
        ).returncode
        if code not in (0, 1) or not file.is_file():
            return ""
        rows = [Row.from_dict(values) for values in json.loads(file.read_text())]
    own = tables_of(name, rows, parser_of(name).parse_args(words))
    parts = [f"{title}\n\n{text}".strip() for title, text in own.items()]
    shown = [row for row in rows if row.target] if own else rows
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
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help=", ".join(COMMANDS))
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
    command = f"{QUICK.get(name, COMMANDS[name])} --quick" if asked.quick else COMMANDS[name]
    print(f"=== {command}", file=sys.stderr, flush=True)
    load, begin = os.getloadavg()[0], time.monotonic()
    text = measured(command, threads)
    took = (time.monotonic() - begin) / 60
    print(f"=== {command}: {took:.1f} min", file=sys.stderr, flush=True)
    title = f"{name}, quick" if asked.quick else name
    busy = load > BUSY and threads is None
    machine = f"{os.cpu_count()} shared cores{f', load {load:.0f} from other work' * busy}"
    version = f"{commit()}, code {_code()}, {took:.1f} min"
    return text and block(title, command, text, time.strftime("%Y-%m-%d"), version, machine)


def _release(asked: Namespace, names: Sequence[str]) -> int:
    """Make the tables of this code that are missing in the folder; write the page if then none is."""
    os.environ["COVIEW_BENCH"] = str(asked.work / "worlds")
    code = _code()
    tables = asked.work / f"tables-{code}{'-quick' * asked.quick}"
    tables.mkdir(parents=True, exist_ok=True)
    files = {name: tables / f"{name.replace(' ', '_')}.md" for name in COMMANDS}

    def make(name: str, threads: int | None) -> None:
        if _code() == code and (part := _part(name, asked, threads)) and _code() == code:
            with atomic_path(files[name]) as file:
                file.write_text(part)

    left = [name for name in names if not files[name].is_file()]
    print(f"code {code}: {len(left)} of {len(names)} tables to make{_about(left, asked)}", file=sys.stderr, flush=True)
    beside = sorted(SIDE_BY_SIDE.intersection(left), key=lambda name: -MINUTES.get(name, _MINUTES))
    with ThreadPoolExecutor(max(1, asked.jobs)) as pool:
        list(pool.map(make, beside, [1] * len(beside)))
    for name in left:
        if name not in beside:
            make(name, None)
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
        print(page)
    return int(bool(missing))


_MINUTES = 5.0


def _about(names: Sequence[str], asked: Namespace) -> str:
    """Say how long tables will take, as earlier ones in the folder took, or else by :data:`MINUTES`."""
    took = {} if asked.quick else dict[str, float](MINUTES)
    for file in sorted(asked.work.glob("tables-*/*.md"), key=os.path.getmtime):
        found = re.match(r"(?s)\n<!-- results: ([^\n]*?)(, quick)? -->.*?, ([\d.]+) min\n", file.read_text())
        if found and bool(found[2]) == asked.quick:
            took[found[1]] = float(found[3])
    usual = 0.5 if asked.quick else _MINUTES
    minutes = {name: took.get(name, usual) for name in names}
    beside = sum(value for name, value in minutes.items() if name in SIDE_BY_SIDE)
    return f", about {(sum(minutes.values()) - beside + beside / max(1, asked.jobs)) / 60:.1f} h"


def without(page: Path) -> str:
    """Return a page's tables that no command makes, or that need files of others; they name their own commit."""
    parts = (
        re.findall(r"(?s)\n<!-- results: ([^\n]+) -->\n(.*?)<!-- end -->\n", page.read_text()) if page.is_file() else []
    )
    kept = [(name, text) for name, text in parts if name not in COMMANDS and not name.endswith(", quick")]
    return "".join(f"\n<!-- results: {name} -->\n{text}<!-- end -->\n" for name, text in kept)


def _code() -> str:
    """Short hash of the product, the kernels and the benchmarks."""
    return fingerprint("coview_stream", "coview_kernels", "bench")


def introduction(page: Path) -> str:
    """Return a page's text above its first table."""
    return page.read_text().partition("\n<!-- results: ")[0] if page.is_file() else HEAD
