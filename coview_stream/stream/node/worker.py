"""Child process of an :class:`~coview_stream.stream.node.engine_process.EngineProcess`; not for people.

``python -m coview_stream.stream.node.worker FD KIND NICE``; the map to open comes over the pipe.
"""

from __future__ import annotations

import contextlib
import gc
import os
import sys
from collections import deque
from collections.abc import Callable
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path


def main(argv: list[str]) -> int:
    """Load the kernels, open the engine, then answer jobs until the parent closes the pipe.

    Kernels of later jobs are loaded one by one while no job waits: a job that comes meanwhile waits a quarter of a
    second at most with the cache, some seconds on the first run ever.
    """
    descriptor, kind, nice = int(argv[0]), argv[1], int(argv[2])
    pipe = Connection(descriptor)
    with contextlib.suppress(OSError):
        os.nice(nice)
    _set_group_nice(nice)
    from coview_kernels import warm_up
    from coview_stream.errors import CoViewError
    from coview_stream.stream.node.engine_process import attempt
    from coview_stream.stream.node.engines import kernels_of, open_engine

    first, later = kernels_of(kind)
    for name in first:
        if pipe.poll():  # the node waits for its engines, or soon a robot for its search: no more standing back
            _set_group_nice(0)
        warm_up(name)
    steps: deque[Callable[[], None]] = deque(partial(warm_up, name) for name in later)

    def use_pause() -> None:
        while steps and not pipe.poll():
            with contextlib.suppress(CoViewError):  # the job that needs it will say so
                steps.popleft()()

    with contextlib.suppress(EOFError, OSError, KeyboardInterrupt):  # the parent is gone, and so are we
        use_pause()
        opening = pipe.recv()
        _set_group_nice(0)
        try:
            engine = open_engine(kind, *opening)
            pipe.send(("ready", None))
            engine.prepare()
        except CoViewError as error:
            pipe.send(("error", str(error)))
            return 1
        if not gc.isenabled():
            gc.freeze()  # nearly all objects of the start stay: to look through them again would cost every job
            gc.enable()
        pipe.send(("prepared", None))
        _set_group_nice(nice)
        steps.append(engine.prepare_later)
        while True:
            use_pause()
            pipe.send(attempt(engine, pipe.recv()))
    return 0


def _set_group_nice(nice: int) -> None:
    """Set the niceness of this process's session, where Linux groups tasks by session.

    There the process's own niceness only counts among the processes of one session, which this one has for itself.
    """
    with contextlib.suppress(OSError):
        Path("/proc/self/autogroup").write_text(str(nice))


if __name__ == "__main__":
    gc.disable()  # nearly all objects of the start stay: a tenth of the time
    sys.exit(main(sys.argv[1:]))
