"""Child process of an :class:`~coview_stream.stream.node.engine_process.EngineProcess`; not for people.

``python -m coview_stream.stream.node.worker FD KIND MAP SHA256 NICE METHOD RELOC``, the last two being those of
registration and of the search.
"""

from __future__ import annotations

import contextlib
import os
import sys
from multiprocessing.connection import Connection


def main(argv: list[str]) -> int:
    """Open the engine, then answer jobs until the parent closes the pipe."""
    descriptor, kind, map_path, sha256, nice = int(argv[0]), argv[1], argv[2], argv[3], int(argv[4])
    pipe = Connection(descriptor)
    with contextlib.suppress(OSError):
        os.nice(nice)
    from coview_kernels import warm_up
    from coview_stream.config import LocalizerConfig, RegistrationConfig
    from coview_stream.errors import CoViewError
    from coview_stream.stream.node.engine_process import attempt
    from coview_stream.stream.node.engines import open_engine

    try:
        method = RegistrationConfig(method=argv[5])  # type: ignore[arg-type]  # any text; it checks
        config = LocalizerConfig(registration=method, reloc=argv[6])  # type: ignore[arg-type]  # likewise
        engine = open_engine(kind, map_path, sha256, config)
        if engine.kernels:
            warm_up(*engine.kernels)
    except CoViewError as error:
        pipe.send(("error", str(error)))
        return 1
    with contextlib.suppress(EOFError, OSError, KeyboardInterrupt):  # the parent is gone, and so are we
        pipe.send(("ready", None))
        try:
            engine.prepare()
        except CoViewError as error:
            pipe.send(("error", str(error)))
            return 1
        pipe.send(("prepared", None))
        while True:
            pipe.send(attempt(engine, pipe.recv()))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
