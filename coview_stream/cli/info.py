"""``coview-stream info``: the contents of a base map file."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from coview_stream.cli.map_argument import add_map, open_map_argument
from coview_stream.cli.options import acceptance_config, add_shared, check_picture
from coview_stream.errors import naming_missing_libraries, printable

if TYPE_CHECKING:
    from coview_stream.basemap.basemap import BaseMap
    from coview_stream.config import AcceptanceConfig

HELP = "show the contents of a base map file"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add_map(parser)
    parser.add_argument("--plot", type=Path, metavar="F.png", help="draw the map from above; F.tif: a GeoTIFF")
    parser.add_argument(
        "--ambiguity",
        action="store_true",
        help="look at the map from its own places: where a robot may stay AMBIGUOUS, and how far it has to drive "
        "there; takes about a minute",
    )
    parser.add_argument("-o", "--output", type=Path, metavar="A.png", help="draw the ambiguity")
    add_shared(parser, "--risk", "--verify-key")
    parser.set_defaults(risk=None)
    add_shared(parser, "--json")


def run(args: argparse.Namespace) -> int:
    """Print the map's contents, parameters and hash."""
    from coview_stream.basemap.basemap import BaseMap
    from coview_stream.basemap.file_format import signer
    from coview_stream.basemap.site.manifest import Manifest
    from coview_stream.basemap.site.site_grid import site_directory
    from coview_stream.clouds.reference_system import short_name
    from coview_stream.config import AcceptanceConfig
    from coview_stream.errors import ConfigError

    if args.output and not args.ambiguity:
        raise ConfigError("-o draws the ambiguity: give --ambiguity as well, or --plot for the map and its stations")
    if args.risk is not None and not args.ambiguity:
        raise ConfigError("--risk is that of the ambiguity: give --ambiguity as well")
    acceptance = AcceptanceConfig() if args.risk is None else acceptance_config(args.risk)
    check_picture("-o", args.output)
    check_picture("--plot", args.plot)
    source = open_map_argument(args)
    base_map = BaseMap.load(args.map, verify_key=args.verify_key)
    facts = describe(base_map)
    directory = site_directory(args.map)
    if directory is not None:
        facts["site"] = _site(directory)
    for mirror in source.mirrors:
        facts["fetched from"] = mirror.source.name + (", not reached now" if mirror.offline else "")
    by = signer(args.map) if directory is None else Manifest.load(directory).signer
    verified = "verified" if args.verify_key is not None else "it says; --verify-key verifies it"
    facts["signature"] = f"by {by}, {verified}" if by else "none"
    if args.ambiguity:
        facts["ambiguity"] = _ambiguity(base_map, acceptance, args)
    if args.plot:
        with naming_missing_libraries("coview-stream info --plot", "plot"):
            from coview_stream.report.relief import plot_map

            plot_map(base_map, args.plot, args.map.name)
    if not args.json and (written := [str(file) for file in (args.output, args.plot) if file]):
        facts["written"] = ", ".join(written)
    if args.json:
        print(json.dumps({"format": 1} | facts, indent=1))
    else:
        facts["crs"] = short_name(base_map.crs)  # not a page of WKT
        print("\n".join(f"{name:<14} {_text(value)}" for name, value in facts.items()))
    return 0


def _ambiguity(base_map: BaseMap, acceptance: AcceptanceConfig, args: argparse.Namespace) -> object:
    """Return the map's ambiguity, numbers for JSON or a sentence; draw it on request."""
    from coview_stream.clouds.progress import progress_bar
    from coview_stream.config import LocalizerConfig
    from coview_stream.localization.search.ambiguity import ambiguity
    from coview_stream.report import ambiguity as report

    with progress_bar("looking, then driving", unit="place") as step:
        found = ambiguity(base_map, LocalizerConfig(acceptance=acceptance), progress=step)
    if args.output:
        report.plot_ambiguity(found, base_map, args.output, args.map.name)
    return report.facts(found, base_map) if args.json else report.summary(found, base_map)


def describe(base_map: BaseMap) -> dict[str, object]:
    """Return the facts that ``info`` prints, by name; metres in the source's frame."""
    from dataclasses import asdict

    from coview_stream.basemap.summary import summary

    low, high = (corner + base_map.origin for corner in (base_map.points.min(axis=0), base_map.points.max(axis=0)))
    learned, features = "no features", base_map.learned
    if features is not None:
        size = f"{features.bytes / 1e6:.1f} MB"
        learned = f"features of {features.area:.0f} m2, {size}, weights {features.weights[:12]}"
    covered = summary(base_map)
    return {
        "covers": str(covered),
        "warnings": list(covered.warnings) or "none",
        "stations": len(base_map),
        "points": len(base_map.points),
        "source points": base_map.parameters.get("source_points"),
        "from": [round(float(v), 2) for v in low],
        "to": [round(float(v), 2) for v in high],
        "origin": base_map.origin.tolist(),
        "crs": base_map.crs,
        "ground filter": base_map.parameters.get("ground_filter"),
        "learned": learned,
        "sources": base_map.sources,
        "sha256": base_map.sha256,
        "parameters": asdict(base_map.config),
    }


def _site(directory: Path) -> dict[str, object]:
    """Describe the directory that holds a map's tiles."""
    from coview_stream.basemap.site.manifest import Manifest

    site = Manifest.load(directory)
    layers = {
        name: sum(tile.layers[name].bytes for tile in site.tiles if name in tile.layers)
        for name in ("cloud", "stations", "features")
    }
    return {"tiles": len(site.tiles), "edge": site.tile, "bytes": site.nbytes, "manifest": site.sha256} | {
        f"bytes of {name}": size for name, size in layers.items()
    }


def _text(value: object) -> str:
    if isinstance(value, dict):
        rows = []
        for key, inner in value.items():
            parts = inner.items() if isinstance(inner, dict) else [("", inner)]
            rows += [printable(f"{key}{'.' if name else ''}{name} = {item}") for name, item in parts]
        return ("\n" + " " * 15).join(rows)
    if isinstance(value, list):
        return printable("  ".join(str(v) for v in value))
    return "unknown" if value is None else printable(" ".join(str(value).split()))[:300]
