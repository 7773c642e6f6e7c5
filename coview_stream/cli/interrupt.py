"""Ctrl-C: a command ends with 130, even if a library drops the exception or turns it into another one."""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import sys
import threading
from collections.abc import Iterator
from importlib.machinery import ExtensionFileLoader
from types import FrameType

_AGAIN = 0.5  # seconds until an interrupt without effect is raised again
_SOON = 0.02  # seconds until the import of a native module is checked again


class Interrupt:
    """Handler of SIGINT, which raises KeyboardInterrupt until the block of :func:`interruptible` ends.

    One exception is not enough: ``__del__`` and callbacks drop it, and a native module whose import it aborts turns it
    into an ImportError, as if the module were not installed.

    Attributes:
        seen: whether SIGINT has come.
    """

    def __init__(self) -> None:
        self.seen = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Raise KeyboardInterrupt, but never while a native module is imported; an alarm repeats it if dropped."""
        self.seen = True
        importing = _imports_native(frame)
        signal.setitimer(signal.ITIMER_REAL, _SOON if importing else _AGAIN, _AGAIN)
        if not importing and (number == signal.SIGINT or not _unwinding()):
            raise KeyboardInterrupt

    def unraisable(self, args: sys.UnraisableHookArgs, /) -> None:
        """Report an exception that could not be raised, except KeyboardInterrupt, which is raised again."""
        if not issubclass(args.exc_type, KeyboardInterrupt):
            sys.__unraisablehook__(args)

    def leave(self) -> None:
        """End the process without interpreter teardown, which crashes while threads compute."""
        if self.seen:
            with contextlib.suppress(OSError, ValueError):
                sys.stdout.flush()
                sys.stderr.flush()
            os._exit(130)


@contextlib.contextmanager
def interruptible(whole_process: bool) -> Iterator[Interrupt]:
    """Handle SIGINT in the block; leave it alone on other threads, and where it is ignored or has another handler.

    With ``whole_process`` this is the command's process: after the block SIGINT may end everything.
    """
    interrupt = Interrupt()
    possible = hasattr(signal, "SIGALRM") and threading.current_thread() is threading.main_thread()
    if not possible or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield interrupt
        return
    if whole_process:
        atexit.register(interrupt.leave)  # registered first: runs after all others
    alarm, hook = signal.signal(signal.SIGALRM, interrupt), sys.unraisablehook
    sys.unraisablehook = interrupt.unraisable
    signal.signal(signal.SIGINT, interrupt)
    try:
        yield interrupt
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGINT, signal.SIG_DFL if whole_process else signal.default_int_handler)
        signal.signal(signal.SIGALRM, alarm)
        sys.unraisablehook = hook


def _unwinding() -> bool:
    """Whether the interrupted code is cleanup after a KeyboardInterrupt."""
    error = sys.exception()
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__context__
    return error is not None


def _imports_native(frame: FrameType | None) -> bool:
    """Whether a native module that is being imported runs the interrupted code."""
    while frame is not None:
        if isinstance(frame.f_locals.get("self"), ExtensionFileLoader):
            return True
        frame = frame.f_back
    return False
