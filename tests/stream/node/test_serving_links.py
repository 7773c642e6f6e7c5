"""Links that go bad between a node, a router and a robot, with real processes: found again, and no pose is false."""

import os
import sys
import time

import numpy as np
import pytest
from bad_link import BadLink
from serving import FALSE
from zenoh_routers import Router

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")]

SECONDS = {"slow": 2.0, "thin": 3.0, "lossy": 3.0, "flapping": 4.5, "silent": 7.0, "cut": 2.0, "corrupt": 5.0}
ENDS = [("node", SECONDS), ("robot", ("thin", "silent", "corrupt"))]


@pytest.mark.parametrize(("end", "modes"), ENDS if os.environ.get("COVIEW_NIGHTLY") else ENDS[:1])
def test_links_that_go_bad_cost_no_more_than_the_time_that_they_are_bad(serve, end, modes):
    with Router() as router, BadLink(router.endpoint) as link:
        ends = {"router": router.endpoint, "robots_router": router.endpoint}
        ends["router" if end == "node" else "robots_router"] = link.endpoint
        service = serve(**ends)
        service.tracks(60.0)
        garbled = []
        for mode in modes:
            begin = time.monotonic()
            link.mode(mode)
            time.sleep(SECONDS[mode])
            link.mode("open")
            if mode == "corrupt":  # messages on their way may still be spoilt
                garbled.append((begin, time.monotonic() + 1.0))
                time.sleep(1.0)
            service.tracks(60.0)
        assert service.process.poll() is None
        times = np.array([at for at, _ in service.poses])
        whole = ~np.any([(times >= begin) & (times < until) for begin, until in garbled], axis=0)
        poses = [pose for (_, pose), good in zip(list(service.poses), whole, strict=False) if good]
        off = [np.linalg.norm(p.T_map_body[:3, 3] - service.truth[p.stamp_ns][:3, 3]) for p in poses]
        assert max(off) < FALSE
        assert service.robot()["counters"]["engine_restarts"] == 0
        assert service.end() == 0
