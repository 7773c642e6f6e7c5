"""Value of each choice of the method, group by group, on sites that separate the choices.

Every variant changes one choice. Choices of the search are judged at single keyframes, the others by the whole
localizer, also on maps of other sites (``elsewhere``). Sites: an airborne-like map of 6 pulses per square metre,
streets of equal houses, a sparse sensor, a dirty world, forests, one changed since the survey, and real runs
(``--data``). The first row of a group is the default. ``spacing`` is the first paper's Fig. 9, which ``--picture``
draws. Learned features, descriptors and both are rows of ``python -m bench forest``; odometry alone, map alone and no
graph are rows of ``python -m bench forest_drives``. Results stay in ``--work``.
"""

from __future__ import annotations

import time
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from bench.accuracy import paper
from bench.accuracy.choices import Choice, LocalizerChoice, Site, uncalibrated, unverified
from bench.harness.files import add_data, fingerprint, folder, isolated, remembered
from bench.harness.rows import Row, informs, listed
from bench.harness.worlds import prepare
from coview_stream import BaseMap
from coview_stream.clouds import read_cloud, read_tum, write_cloud
from coview_stream.config import Channel, ConsensusConfig, DescriptorConfig, LocalizerConfig, RegistrationConfig
from coview_stream.config.localizer import AcceptanceConfig, TrackingConfig
from coview_stream.errors import InputError
from coview_stream.sim import KINDS, SimulationConfig, buildings, parse_dirt
from coview_stream.sim.kinds import Plot

_DEFAULT = DescriptorConfig()
_ROWS = KINDS["town"]._replace(
    plots=(Plot(buildings.house, 1.0, (10.0, 10.0), (9.0, 9.0)),), setback=(4.0, 4.0), gap=(5.0, 5.0), vacant=0.0,
    infill=0.0, trees=0.0005, hedges=0.0,
)  # fmt: skip

_LENGTH = 24.0  # metres driven in a simulated site
_WORLD: dict[str, Any] = {"size": 180.0, "length": _LENGTH, "speed": 3.0, "changed": 0.2}
WORLDS: dict[str, dict[str, Any]] = {
    "airborne-like": {"scene": "town", "sensor": "vlp16", "seed": 2101, "density": 6.0},
    "repetitive": {"scene": "rows", "sensor": "vlp16", "seed": 2102},
    "sparse": {"scene": "campus", "sensor": "mid360", "seed": 2103, "density": 10.0},
    "dirty": {"scene": "industrial", "sensor": "os64", "seed": 2104, "dirt": "mounting,odometry,traffic,seasons,years"},
    "forest": {"scene": "forest", "sensor": "os64", "seed": 2105},
    "changed": {"scene": "industrial", "sensor": "vlp16", "seed": 2107, "size": 224.0, "changed": 0.4},
    "stand": {"scene": "forest", "sensor": "vlp16", "seed": 2108, "size": 224.0},
}
"""Simulated sites; seeds held out, as those of ``python -m bench accuracy``."""

REAL, _REAL_METRES, _AROUND = ("riverside_a", "kitti04", "handheld_livox"), 72.0, 110.0
"""Real runs, the metres used of each, and the metres around these that are in the map."""


def _with(**changes: Any) -> DescriptorConfig:
    return replace(_DEFAULT, **changes)


SPACINGS = (2.0, 1.0, 3.0, 4.0, 6.0, 8.0)

CHANNELS: tuple[tuple[Channel, ...], ...] = (
    ("scan_context", "coview"), ("scan_context",), ("coview",), ("paper",), ("scan_context", "paper"),
    ("coview", "paper"), ("scan_context", "coview", "paper"),
)  # fmt: skip
"""Channels and their sums."""


def _channels(names: Sequence[Channel]) -> str:
    return f"{'default: ' if names == _DEFAULT.channels else ''}{' + '.join(names)}"


SEARCH: dict[str, dict[str, Choice]] = {
    "channels": {
        **{_channels(names): Choice(_with(channels=names)) for names in CHANNELS},
        "zero at the sensor": Choice(_with(ground_zero=False)),
    },
    "spacing": {f"{'default: ' if m == SPACINGS[0] else ''}L = {m:g} m": Choice(spacing=m) for m in SPACINGS},
}
"""Choices of the search."""

LOCALIZER = {
    "default": LocalizerChoice(),
    **{
        f"{n} keyframes vote": LocalizerChoice(LocalizerConfig(consensus=ConsensusConfig(window=n))) for n in (1, 5, 20)
    },
    "verification off": LocalizerChoice(changed=unverified),
    "risk 0.4": LocalizerChoice(LocalizerConfig(acceptance=AcceptanceConfig(risk=0.4))),
    "calibration off": LocalizerChoice(changed=uncalibrated),
    "60 % of the pairs": LocalizerChoice(LocalizerConfig(registration=RegistrationConfig(keep=0.6))),
    "frames of two metres registered": LocalizerChoice(
        LocalizerConfig(tracking=TrackingConfig(window=2.0, min_points=50_000))
    ),
}
"""Choices of the whole localizer."""

ELSEWHERE = {name: LOCALIZER[name] for name in ("default", "1 keyframes vote", "verification off", "risk 0.4")}
"""Choices that may accept a wrong place, for runs on the map of the next site."""

GROUPS = (*SEARCH, "localizer", "elsewhere")
SITES: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(GROUPS, ("airborne-like", "sparse", "changed", *REAL)),
    "localizer": ("airborne-like", "repetitive", "sparse", "dirty", *REAL[:2]),
    "channels": ("airborne-like", "repetitive", "sparse", "forest", "changed", "stand", *REAL),
    "elsewhere": ("airborne-like", "repetitive", "sparse", "dirty"),
    "spacing": ("airborne-like", "sparse", *REAL[:2]),
}
"""Sites of each group, chosen so that all groups take less than 40 minutes of one core."""


def sites(names: Sequence[str], data: Path) -> dict[str, Path]:
    """Return the folders of sites by name, created if missing; ``data`` holds the real runs."""
    out = {}
    for name in names:
        if name in WORLDS:
            out[name] = isolated(_simulated, folder(), WORLDS[name])
        elif (data / name / "base.laz").is_file():
            out[name] = isolated(_real, folder(), data / name)
        else:
            raise InputError(f"{data / name}: not there; --data names the folder of the real runs, --sites fewer sites")
    return out


def _simulated(below: Path, changes: Mapping[str, Any]) -> Path:
    with patch.dict(KINDS, {"rows": _ROWS}):
        dirt = parse_dirt(changes.get("dirt", ""))
        config = SimulationConfig(**{**_WORLD, **changes, "dirt": dirt})
        return prepare(below / "ablation", config)


def _real(below: Path, source: Path) -> Path:
    """Crop a real survey to the surroundings of the used frames, and build its map."""
    out = below / "ablation" / source.name

    def make() -> None:
        out.mkdir(parents=True, exist_ok=True)
        _, truth = read_tum(source / "truth.tum")
        cloud = read_cloud(source / "base.laz")
        way = truth[np.cumsum([0.0, *np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1)]) < _REAL_METRES, :2, 3]
        low, high = (way.min(axis=0) - _AROUND, way.max(axis=0) + _AROUND)
        xy = cloud.points[:, :2] + np.asarray(cloud.origin)[:2]
        inside = ((xy > low) & (xy < high)).all(axis=1)
        write_cloud(out / "base.laz", cloud.points[inside], origin=cloud.origin)
        BaseMap.build(out / "base.laz").save(out / "site.coview")
        for part in ("run", "truth.tum"):
            link = out / part
            if not link.exists():
                link.symlink_to(source / part)

    parts = (f"coview_stream/{part}" for part in ("basemap", "descriptors", "config"))
    remembered(out / "built.json", {"metres": [_REAL_METRES, _AROUND], "code": fingerprint(*parts)}, make)
    return out


def metres(name: str) -> float:
    """Return the metres used of a site's run."""
    return _REAL_METRES if name in REAL else _LENGTH


def measure(
    name: str, place: Path, groups: Sequence[str], code: Mapping[str, str], other: Path
) -> dict[str, dict[str, Any]]:
    """Measure missing groups on one site; return results by group and variant, with ``cpu`` seconds per group.

    ``other`` is the folder of another site.
    """
    site = cache(lambda: Site(place, metres(name)))

    def make(group: str) -> dict[str, Any]:
        begin, out = time.process_time(), {}
        if group == "localizer":
            out = {variant: site().located(choice) for variant, choice in LOCALIZER.items()}
        elif group == "elsewhere":
            out = {variant: site().elsewhere(choice, other) for variant, choice in ELSEWHERE.items()}
        else:
            out = {variant: site().search(choice) for variant, choice in SEARCH[group].items()}
        if group == "spacing":
            for variant, choice in SEARCH[group].items():
                stations, truth = site().stations(choice.spacing), site().truth[1]
                out[variant]["paper"] = paper.located(site().map, site().run, truth, choice.spacing, stations)
        if group == "channels":
            for channels in CHANNELS:
                out[_channels(channels)]["located"] = site().located(LocalizerChoice(channels=channels))
        return out | {"cpu": time.process_time() - begin}

    return {
        group: remembered(
            folder() / "results" / f"ablation-{group}-{name}.json",
            {"site": name, "group": group, **code}, partial(make, group),
        )
        for group in groups
    }  # fmt: skip


def search_row(group: str, name: str, by_site: Mapping[str, Mapping[str, Any]]) -> Row:
    """Return the row of a search choice: shares of keyframes over all sites, and per site that of the best place."""

    def share(key: str, of: str, some: Sequence[Mapping[str, Any]]) -> float:
        return float(sum(each[key] for each in some) / max(1.0, sum(each[of] for each in some)))

    every = list(by_site.values())
    details: dict[str, Any] = {
        "group": group, "variant": name, "top1": share("top1", "keyframes", every),
        "top10": share("top10", "keyframes", every), "coarse": share("coarse", "windows", every),
        "keyframes": sum(each["keyframes"] for each in every),
        "ms": 1e3 * share("seconds", "keyframes", every),
        **{site: share("top1", "keyframes", [each]) for site, each in by_site.items()},
    }  # fmt: skip
    details |= {"first": np.nan, "worst": np.nan, "false": "-"}
    if located := [each["located"] for each in every if "located" in each]:
        first = [np.inf if each["first_fix_m"] is None else each["first_fix_m"] for each in located]
        wrong = f"{sum(each['false_frames'] for each in located)} of {sum(each['posed'] for each in located)}"
        details |= {"first": float(np.mean(first)), "worst": float(max(first)), "false": wrong}
    if group == "spacing":
        answers = [each["paper"] for each in every]
        for way in paper.WAYS:
            details[way] = float(np.mean([answer[way]["success"] for answer in answers]))
            details[f"{way}, ms"] = float(np.mean([answer[way]["keyframe_ms"] for answer in answers]))
        details["stations"] = float(np.mean([each["stations"] for each in every]))
    return informs(f"ablation/{group}, {name}: top-1", 100.0 * details["top1"], "%", details)


def localizer_row(name: str, by_site: Mapping[str, Mapping[str, Any]]) -> Row:
    """Return the row of a localizer choice; a run without a fix counts as an infinite first fix."""
    every = list(by_site.values())
    first = [np.inf if each["first_fix_m"] is None else each["first_fix_m"] for each in every]
    found = sum(each["success"] for each in every)
    details: dict[str, Any] = {
        "group": "localizer", "variant": name, "right": f"{found} of {len(every)}",
        "false": f"{sum(each['false_frames'] for each in every)} of {sum(each['posed'] for each in every)}",
        "first": float(np.median(first)), "worst": float(max(first)),
        **{key: float(np.mean([each[key] for each in every if each[key] is not None])) for key in ("e_t", "e_r", "ms")},
    }  # fmt: skip
    return informs(f"ablation/localizer, {name}: runs localized", found, "", details)


def elsewhere_row(name: str, by_site: Mapping[str, Mapping[str, Any]]) -> Row:
    """Return the row of a localizer choice on maps of other places."""
    posed, frames = (sum(each[key] for each in by_site.values()) for key in ("posed", "frames"))
    details = {
        "group": "elsewhere", "variant": name, "false": f"{posed} of {frames}",
        "runs": f"{sum(each['posed'] > 0 for each in by_site.values())} of {len(by_site)}",
    }  # fmt: skip
    return informs(f"ablation/elsewhere, {name}: false poses", posed, "", details)


def options(parser: ArgumentParser) -> None:
    """Add the groups and the sites."""
    groups = ", ".join(GROUPS)
    parser.add_argument("--only", nargs="+", choices=GROUPS, default=list(GROUPS), metavar="GROUP", help=groups)
    every = (*WORLDS, *REAL)
    parser.add_argument("--sites", nargs="+", choices=every, metavar="SITE", help=f"(by group) {', '.join(every)}")
    add_data(parser)
    parser.add_argument("--picture", type=Path, metavar="FILE", help="draw the group spacing")


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield a row per variant."""
    some = {group: 2 if group == "elsewhere" else 1 for group in asked.only}  # the other site's map is elsewhere
    chosen = {group: tuple(asked.sites or SITES[group])[: some[group] if asked.quick else None] for group in some}
    if len(chosen.get("elsewhere", "ab")) < 2:
        raise InputError("--sites: the group elsewhere takes maps of other sites: name two or more")
    places = sites(list(dict.fromkeys(name for names in chosen.values() for name in names)), asked.data)
    files = (f"bench/accuracy/{part}.py" for part in ("ablation", "choices", "paper"))
    code = {"code": fingerprint(), "bench": fingerprint(*files)}
    by_site_and_group = {}
    for name, place in places.items():
        groups = [group for group in asked.only if name in chosen[group]]
        of = list(chosen.get("elsewhere", (name,)))
        other = places[of[(of.index(name) + 1) % len(of)]] if name in of else place
        by_site_and_group[name] = isolated(measure, name, place, groups, code, other)
    for group in asked.only:
        measured = {name: by_site_and_group[name][group] for name in chosen[group]}
        cpu = sum(each.pop("cpu") for each in measured.values())
        variants = next(iter(measured.values()))
        for variant in variants:
            by_site = {name: each[variant] for name, each in measured.items()}
            if group == "localizer":
                row = localizer_row(variant, by_site)
            elif group == "elsewhere":
                row = elsewhere_row(variant, by_site)
            else:
                row = search_row(group, variant, by_site)
            row.details.update(sites=list(measured), cpu=cpu)
            yield row


_SHARES = (
    ("variant", "variant", None),
    ("top-1", "top1", 2),
    ("top-10", "top10", 2),
    ("keyframes together", "coarse", 2),
)
COLUMNS = {
    "channels": (
        *_SHARES, ("mean first fix m", "first", 1), ("latest", "worst", 1), ("false frames", "false", None),
    ),
    "spacing": (*_SHARES, *((way, way, 2) for way in paper.WAYS), ("stations", "stations", 0), ("ms", "ms", 0)),
    "localizer": (
        ("variant", "variant", None), ("runs", "right", None), ("false frames", "false", None),
        ("median first fix m", "first", 1), ("latest", "worst", 1), ("e_t m", "e_t", 3), ("e_r deg", "e_r", 2),
        ("step ms", "ms", 0),
    ),
    "elsewhere": (("variant", "variant", None), ("false poses", "false", None), ("in runs", "runs", None)),
}  # fmt: skip


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """Return one table per group, below its sites and processor time, and draw the picture."""
    out = {}
    for group in dict.fromkeys(row.details["group"] for row in rows):
        found = [row.details for row in rows if row.details["group"] == group]
        per_site = (
            ()
            if group in ("localizer", "elsewhere", "spacing")
            else tuple((site, site, 2) for site in found[0]["sites"])
        )
        columns = (*COLUMNS[group], *per_site)
        about = f"Sites: {', '.join(found[0]['sites'])}; {found[0]['cpu'] / 60.0:.1f} minutes of one core."
        out[group] = f"{about}\n\n{listed(columns, found)}"
        if group == "spacing" and asked.picture:
            draw(found, asked.picture)
    return out


def draw(found: Sequence[Mapping[str, Any]], file: Path) -> None:
    """Draw success and time against L = sigma_d, like the first paper's Fig. 9."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    found = sorted(found, key=lambda row: row["stations"], reverse=True)
    spacing = sorted(SPACINGS)
    figure = Figure(figsize=(8.0, 3.8), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    lines = {"ours, five keyframes": ("coarse", None, "C0o-"), "ours, one keyframe": ("top1", "ms", "C1o-")}
    lines |= {way: (way, f"{way}, ms", f"C{k}s--") for k, way in enumerate(paper.WAYS, start=2)}
    for label, (share, ms, style) in lines.items():
        left.plot(spacing, [100.0 * row[share] for row in found], style, label=label)
        if ms is not None:
            right.plot(spacing, [row[ms] for row in found], style)
    left.set(xlabel="L = sigma_d, m", ylabel="right, % (ours: keyframes; paper: runs)", ylim=(-4, 104))
    right.set(xlabel="L = sigma_d, m", ylabel="ms per keyframe", yscale="log")
    figure.legend(loc="outside lower center", ncols=3, fontsize=8)
    figure.savefig(file, dpi=110)
