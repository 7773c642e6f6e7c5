"""Localizers with hints of where they may be."""

from __future__ import annotations

import numpy as np

from coview_stream.config import AcceptanceConfig
from coview_stream.geometry.transforms import pose_from, rot_z

RULE = AcceptanceConfig()
NEAR = pose_from(rot_z(np.radians(2.0)), [0.6, -0.5, 0.1])  # what a parked robot's last pose may be off by
BESIDE = pose_from(rot_z(2.0), [9.0, -14.0, 0.0])  # another place of the map


def follow(localizer, drive, frames, first=0):
    return [localizer.step(drive.clouds[k], drive.T_odom_body[k], 0.5 * k) for k in range(first, first + frames)]


def first_fix(fixes):
    return next((k for k, fix in enumerate(fixes) if fix.T_map_body is not None), None)


def voteless(localizer, monkeypatch):
    """The keyframes vote, but nothing comes of it."""
    monkeypatch.setattr(localizer.search.coview.consensus, "hypotheses", list)
    return localizer


def misled(localizer, drive, monkeypatch):
    """The votes name some places, but never the right one, nor any near it."""
    consensus = localizer.search.coview.consensus
    found = consensus.hypotheses

    def wrong():
        newest = localizer._newest.T_odom_body
        k = int(np.argmin([abs(T[:3, 3] - localizer._frames.anchor - newest[:3, 3]).sum() for T in drive.T_odom_body]))
        there = drive.T_map_body[k][:3, 3]
        return [each for each in found() if np.linalg.norm((each.T_map_odom @ newest)[:3, 3] - there) > 8.0]

    monkeypatch.setattr(consensus, "hypotheses", wrong)
    return localizer
