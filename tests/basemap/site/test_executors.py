"""Executors of a build's steps: the same results wherever they run, and what fails or dies is named."""

import multiprocessing
import os
import time
from contextlib import closing
from pathlib import Path

import pytest

from coview_stream.basemap.site.executors import DaskExecutor, Executor, ProcessExecutor
from coview_stream.errors import ConfigError, MapError


def step(number):
    if number == 3:
        raise MapError("three is damaged")
    return number * number


def deadly(number):
    if number == 2:
        os._exit(9)
    return number


def told(results):
    return {k: str(r) if isinstance(r, Exception) else r for k, r in results}


EXPECTED = {0: 1, 1: 4, 2: "three is damaged", 3: 16}


def test_steps_in_this_process():
    assert told(Executor().run(step, [1, 2, 3, 4])) == EXPECTED


@pytest.mark.slow
def test_run_that_is_left_ends_its_own_processes_alone():
    stranger = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(60.0,))
    stranger.start()
    with closing(ProcessExecutor(1)) as executor:
        results = executor.run(step, [1, 2, 3, 4])
        next(results)
        results.close()
        assert stranger.is_alive()
        assert told(executor.run(step, [5])) == {0: 25}
        stranger.kill()


@pytest.mark.slow
def test_steps_in_processes_and_one_that_kills_its_process():
    with closing(ProcessExecutor(2)) as executor:
        assert told(executor.run(step, [1, 2, 3, 4])) == EXPECTED
        found = told(executor.run(deadly, [1, 2, 3, 4]))
        assert "its process died" in found.pop(1)
        assert found == {0: 1, 2: 3, 3: 4}
        assert told(executor.run(step, [5])) == {0: 25}  # the next ones have a pool again


@pytest.mark.slow
def test_steps_by_a_cluster_of_dask():
    pytest.importorskip("distributed", reason="pip install 'coview-stream[cluster]'")
    with closing(DaskExecutor("local", 1)) as executor:
        assert told(executor.run(step, [1, 2, 3, 4])) == EXPECTED


def test_numbers_of_workers_and_schedulers_that_do_not_answer():
    for workers in (0, -1, 10_000):
        with pytest.raises(ConfigError, match="workers"):
            ProcessExecutor(workers)
    pytest.importorskip("distributed", reason="pip install 'coview-stream[cluster]'")
    with pytest.raises(ConfigError, match="--dask no-host:nothing"):
        DaskExecutor("no-host:nothing")


def test_environment_is_as_it_was(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    with closing(ProcessExecutor(1)) as executor:
        assert dict(executor.run(Path, [])) == {}
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "MKL_NUM_THREADS" not in os.environ
