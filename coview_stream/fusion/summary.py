"""Summary of a fused cloud in a few lines, for a person."""

from __future__ import annotations

from collections.abc import Sequence

from coview_stream.fusion.fuse import Fused
from coview_stream.fusion.records import GONE, NEW


def summary(fused: Fused, names: Sequence[str], changes: bool) -> str:
    """Say what each source brought, what of blind spots was filled and, if asked for, how much has changed."""
    lines = [f"{'0 base map':<18} {len(fused.base_map.points):,} points"]
    for k, (name, added) in enumerate(zip(names, fused.added, strict=True), start=1):
        left = [
            f"{count} frames {why}"
            for count, why in ((added.without_pose, "without a pose left out"), (added.damaged, "damaged"))
            if count
        ]
        told = ", ".join([f"{added.points:,} points of {added.frames} frames", *left])
        lines.append(f"{f'{k} {name}':<18} {told}")
    lines.append(f"{'blind spots':<18} about {fused.filled:,.0f} m2 of surface filled")
    lines.append(f"{'moving':<18} {fused.moving:,} voxels that rays went through")
    if changes:
        lines.append(f"{'new':<18} {int((fused.change == NEW).sum()):,} points")
        lines.append(f"{'gone':<18} {int((fused.base_change == GONE).sum()):,} points of the base map")
    return "\n".join(lines)
