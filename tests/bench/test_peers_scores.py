"""The peers are asked fairly and judged as said; whoever is missing or hangs is a line, not the end."""

import json
import math
import pickle
import sys

import numpy as np
import pytest
from bench.peers.method import Peer
from bench.peers.ours import Tracking
from bench.peers.roster import OUR_TRACKING, OURS, PEERS
from bench.peers.start import OFF, started
from bench.peers.trial import Trial, run_trial
from scipy.spatial import cKDTree

from bench.peers import contest, places, summary, trial
from bench.peers import peers as table
from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.sim import SimulationConfig

TINY = SimulationConfig("town", "vlp16", seed=3, size=80.0, length=11.0, density=8.0)


def answer(metres, degrees=0.5, vouched=True, seconds=0.1):
    return {"seconds": seconds, "vouched": vouched, "score": 1.0, "metres": metres, "degrees": degrees}


def tried(name, *answers, scene="town", trouble=""):
    return Trial(name, scene, 5, 1.0, list(answers), trouble)


@pytest.fixture(scope="module")
def asked(tmp_path_factory):
    """Two places of a tiny world, and its map."""
    folder = tmp_path_factory.mktemp("worlds")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(places.WORLDS, "tiny", TINY)
        places.world(folder, "tiny")
        return places.places(folder, "tiny", 2), places.base_map(folder, "tiny")


def test_a_place_is_what_a_robot_saw_on_eight_metres(asked):
    both, site = asked
    for place in both:
        assert len(place.queries) == places.KEYFRAMES
        assert [q.stamp for q in place.queries] == sorted(q.stamp for q in place.queries)
        drive = place.queries[-1].position - place.queries[0].position
        assert 6.0 < np.linalg.norm(drive) < 9.0
        assert place.errors(place.T_map_submap) == pytest.approx((0.0, 0.0), abs=1e-4)
        on_map = place.submap @ place.T_map_submap[:3, :3].T + place.T_map_submap[:3, 3]
        near = on_map[np.linalg.norm(place.submap, axis=1) < 15.0][::50]
        assert np.median(cKDTree(site.points).query(near)[0]) < 0.4
    assert not np.allclose(both[0].T_map_submap, both[1].T_map_submap)


def test_errors_are_of_the_robot_not_of_the_origin(asked):
    place = asked[0][0]
    off = place.T_map_submap @ pose_from(rot_z(np.radians(4.0)), [0.3, 0.0, 0.4])
    assert place.errors(off) == pytest.approx((0.5, 4.0))


def test_tracking_starts_off_and_comes_back(asked):
    both, site = asked
    method = Tracking(site)
    for place in both:
        assert place.errors(started(place)) == pytest.approx((OFF, 3.0))
        found = method.answer(place)
        metres, degrees = place.errors(found.T_map_submap)
        assert metres < 0.2
        assert degrees < 1.0


def test_a_trial_runs_in_a_process_of_its_own(asked, tmp_path):
    both, site = asked
    file, map_file = tmp_path / "places", tmp_path / "tiny.coview"
    file.write_bytes(pickle.dumps(both))
    site.save(map_file)
    peer = next(peer for peer in PEERS if peer.name == OUR_TRACKING)
    done = run_trial(peer, "tiny", 2, map_file, file, 60.0)
    assert done.trouble == ""
    assert done.prepare_s > 0.0
    assert [a["metres"] < 0.2 for a in done.answers] == [True, True]
    broken = run_trial(peer, "tiny", 2, tmp_path / "none.coview", file, 60.0)
    assert "exit code 1" in broken.trouble
    assert "none.coview" in broken.trouble
    assert broken.answers == []


def test_who_is_not_installed_gets_a_line(tmp_path):
    peer = Peer("Nobody", lambda site: None, "no-such-package", "no_such_module")
    assert run_trial(peer, "town", 5, tmp_path, tmp_path, 1.0).trouble == (
        "not installed; pip install no-such-package"
    )


def test_who_hangs_is_ended():
    words = [sys.executable, "-c", "import time; time.sleep(600)"]
    assert trial._finish(words, 0.2) == "ended after 0.2 s"


def test_right_and_vouched_for_are_two_things():
    far = answer(40.0)
    done = tried(
        "X", answer(0.2), answer(2.9), answer(0.1, 5.1), far, answer(0.3, vouched=False), answer(None, None)
    )
    assert done.succeeded() == 2
    assert done.succeeded(1.0) == 1
    assert done.false_accepts() == 3
    assert done.found() == 3
    assert done.median_error() == pytest.approx((1.55, 0.5))
    assert done.milliseconds() == pytest.approx(100.0)
    nothing = tried("X", answer(None, None, vouched=False))
    assert nothing.false_accepts() == 0
    assert math.isnan(nothing.median_error()[0])


def test_rows_put_every_peer_beside_ours():
    ours = [tried(OURS, *[answer(0.1, seconds=0.2)] * 5)]
    theirs = [tried("X", answer(0.1, seconds=1.0), answer(30.0), answer(30.0, vouched=False), answer(0.5))]
    right, time, false = summary.judged(theirs, ours, ours=False)
    assert (right.ours, right.baseline, right.ratio, right.holds) == (100.0, 50.0, 2.0, True)
    assert (time.ours, time.baseline, time.holds) == (pytest.approx(200.0), pytest.approx(100.0), None)
    assert (false.ours, false.holds) == (1, None)
    right, *_ = summary.judged(ours, theirs, ours=False)
    assert right.holds is False
    late = [tried(OURS, answer(50.0), answer(0.1))]
    right, *_ = summary.judged([tried("X", answer(0.1))], late, ours=False)
    assert right.ours == 0.0
    accepts, *_ = summary.judged(ours, ours, ours=True)
    assert accepts.holds is True
    accepts, *_ = summary.judged([tried(OURS, answer(30.0))], ours, ours=True)
    assert accepts.holds is False


def test_a_peer_without_answers_informs_but_ours_fails():
    silent = [tried("X", trouble="not installed; pip install x")]
    (row,) = summary.judged(silent, [tried(OURS, answer(0.1))], ours=False)
    assert row.holds is None
    assert "pip install x" in row.name
    (row,) = summary.judged([tried(OURS, trouble="exit code 1")], [], ours=True)
    assert row.holds is False


def test_the_table_has_a_line_per_trial_and_the_file_every_answer(monkeypatch, capsys, tmp_path):
    trials = [tried(OURS, answer(0.1)), tried("Y", trouble="not installed; pip install y")]
    trials[1].prepare_s = math.nan
    monkeypatch.setattr(table, "contest", lambda *args: iter(trials))
    file = tmp_path / "peers.json"
    assert table.main(["--json", str(file)]) == 0
    out = capsys.readouterr().out
    assert "1 of 5" in out
    assert "Y, town: not installed; pip install y" in out
    assert [t["peer"] for t in json.loads(file.read_text())] == [OURS, "Y"]
    assert table.main(["--only", "Z"]) == 2
    assert "no peer Z" in capsys.readouterr().err


def test_all_peers_answer_the_same_places(asked, monkeypatch, tmp_path):
    both, _ = asked
    seen = []
    monkeypatch.setattr(contest, "isolated", lambda work, *args: work(*args))
    monkeypatch.setattr(contest, "world", lambda folder, scene: folder)
    monkeypatch.setattr(contest, "places", lambda folder, scene, count: both[:count])

    def run(peer, scene, count, map_file, file, limit_s):
        seen.append((peer.name, scene, len(pickle.loads(file.read_bytes()))))
        return tried(peer.name)

    monkeypatch.setattr(contest, "run_trial", run)
    assert len(list(contest.contest(tmp_path, 2, 1.0, PEERS[:2]))) == 4
    assert seen == [(peer.name, scene, 2) for scene in places.WORLDS for peer in PEERS[:2]]
