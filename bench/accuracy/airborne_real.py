"""Real robot scans on airborne-like maps: what an aircraft might have seen of the same place, without facades.

Of ``base.laz`` of each set of ``--data`` (see ``python -m bench conditions --help``) an airborne-like cloud is made as
``coview-stream airborne`` does, at several densities; a map is built of it and the set's real run localized on that.
The last row of each set is the map of the ground survey itself. What is done stays in ``--work``.

``coview_stream/sim/airborne_survey.py`` says what such a cloud is and what it is not.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from bench.accuracy.conditions import SETS, add_sets, codes, map_of
from bench.accuracy.real_runs import RealSet, located
from bench.harness.files import code_line, fingerprint, folder, remembered
from bench.harness.rows import Row, informs, judged
from bench.harness.tables import number, table
from coview_stream.clouds import read_cloud, write_cloud
from coview_stream.sim.airborne_survey import Survey, airborne_survey, surface_of

DENSITIES = (4.0, 8.0, 20.0)  # pulses per square metre
_MAKER = ("coview_stream/sim/airborne_survey.py", "coview_stream/clouds")


def options(parser: ArgumentParser) -> None:
    """Add the sets, the densities and the conditions."""
    add_sets(parser, SETS)
    parser.add_argument("--densities", nargs="+", type=float, default=list(DENSITIES), metavar="PER_M2")
    parser.add_argument("--conditions", nargs="+", default=["base"], metavar="NAME", help="see bench conditions (base)")


def airborne(real: RealSet, density: float) -> tuple[Path, dict[str, Any]]:
    """Return the airborne-like cloud of a set, made now unless it is there, and what became of its points."""
    file = folder() / "conditions" / "airborne" / f"{real.name}-{density:g}.laz"

    def make() -> dict[str, Any]:
        cloud = read_cloud(real.survey)
        seen = airborne_survey(cloud.points, Survey(density=density))
        file.parent.mkdir(parents=True, exist_ok=True)
        write_cloud(file, seen, origin=cloud.origin)
        walls = [100.0 * float(surface_of(each).wall.mean()) for each in (cloud.points.astype(float), seen)]
        return {"points": len(cloud), "kept": len(seen), "walls_before": walls[0], "walls": walls[1]}

    spec = {"set": real.name, "bytes": real.survey.stat().st_size, "density": density, "code": fingerprint(*_MAKER)}
    return file, remembered(file.with_suffix(".json"), spec, make)


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield a row per set, density and condition, then the targets."""
    code, version = codes(asked)["now"]
    found: list[dict[str, Any]] = []
    for real in (RealSet(asked.data / name).checked() for name in asked.sets):
        for density in (*(asked.densities[:1] if asked.quick else asked.densities), None):
            cloud, facts = (real.survey, {}) if density is None else airborne(real, density)
            name = real.name if density is None else f"{real.name}-{density:g}"
            site = code.built([cloud], map_of(code, name))
            for condition in asked.conditions:
                below = condition.replace(":", "_")
                run = real.variant(condition, folder() / "conditions" / "runs" / real.name / below)
                out = folder() / "conditions" / f"runs-{version[:10]}" / name / below
                scores = located(code, version, site, run, out)
                details = {"set": real.name, "density": density, "condition": condition, **facts, **scores}
                found.append(details)
                what = f"{'ground survey' if density is None else f'{density:g} per m2'}, {condition}"
                percent = 100.0 * scores["posed"] / scores["frames"]
                yield informs(f"airborne_real/{real.name}, {what}: posed", percent, "%", details)
    false = sum(each["false_frames"] for each in found)
    yield judged("airborne_real/false frames", str(false), "0", false == 0, false)


_HEAD = (
    *("set", "condition", "pulses per m2", "points kept %", "walls %", "frames", "posed", "first fix m", "its error m"),
    *("deg", "rmse m", "deg", "max m", "deg", "false"),
)
_COLUMNS = (
    *(("posed", 0), ("first_fix_m", 1), ("first_m", 2), ("first_deg", 2), ("rmse_m", 3), ("rmse_deg", 2)),
    *(("max_m", 2), ("max_deg", 2), ("false_frames", 0)),
)


def cells(each: dict[str, Any]) -> list[str]:
    """One line of the table."""
    share = 100.0 * each["kept"] / each["points"] if "kept" in each else None
    ground = each["density"] is None
    return [
        each["set"], each["condition"], "ground survey" if ground else f"{each['density']:g}", number(share, 0),
        number(each.get("walls"), 1), str(each["frames"]), *(number(each[key], digits) for key, digits in _COLUMNS),
    ]  # fmt: skip


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """All runs, and the code that was measured."""
    shown = [row.details for row in rows if row.details]
    before = {each["set"]: each["walls_before"] for each in shown if "walls_before" in each}
    walls = ", ".join(f"{number(share, 1)} % of {name}" for name, share in before.items())
    said = f"Points on walls below their top edge, of the ground surveys: {walls}. " if walls else ""
    return {"": f"{table(_HEAD, [cells(each) for each in shown])}\n\n{said}{code_line()}"}
