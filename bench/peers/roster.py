"""Who takes part; the first of either kind is coview_stream."""

from __future__ import annotations

from bench.peers.method import Method, Peer
from coview_stream import BaseMap

OURS, OUR_TRACKING = "coview_stream", "coview_stream, tracking"


def _ours(site: BaseMap) -> Method:
    from bench.peers.ours import Keyframes

    return Keyframes(site)


def _one_scan(site: BaseMap) -> Method:
    from bench.peers.ours import OneScan

    return OneScan(site)


def _kiss(site: BaseMap) -> Method:
    from bench.peers.kiss import KissMatcher

    return KissMatcher(site)


def _closures(site: BaseMap) -> Method:
    from bench.peers.closures import MapClosures

    return MapClosures(site)


def _ransac(site: BaseMap) -> Method:
    from bench.peers.features import Features

    return Features(site, "ransac")


def _fgr(site: BaseMap) -> Method:
    from bench.peers.features import Features

    return Features(site, "fgr")


def _tracking(site: BaseMap) -> Method:
    from bench.peers.ours import Tracking

    return Tracking(site)


def _gicp(site: BaseMap) -> Method:
    from bench.peers.gicp import SmallGicp

    return SmallGicp(site, "GICP")


def _vgicp(site: BaseMap) -> Method:
    from bench.peers.gicp import SmallGicp

    return SmallGicp(site, "VGICP")


PEERS = (
    Peer(OURS, _ours),
    Peer("coview_stream, one scan", _one_scan),
    Peer("KISS-Matcher", _kiss, "kiss-matcher", "kiss_matcher"),
    Peer("MapClosures", _closures, "map-closures", "map_closures"),
    Peer("Open3D FPFH + RANSAC", _ransac),
    Peer("Open3D FPFH + FGR", _fgr),
    Peer(OUR_TRACKING, _tracking, tracking=True),
    Peer("small_gicp GICP", _gicp, "small-gicp", "small_gicp", tracking=True),
    Peer("small_gicp VGICP", _vgicp, "small-gicp", "small_gicp", tracking=True),
)
