"""The ``coview-stream`` command: one thin module per subcommand, one line per error.

A command module has ``HELP: str``, ``add_arguments(parser)`` and ``run(args) -> int``. Heavy libraries are imported
inside ``run``, because ``coview-stream --help`` must answer at once.

Exit codes: 0 done; 1 could not localize (files are still written), no subscriber (replay), a check failed (doctor),
something was left out (build); 2 bad usage or input; 130 interrupted; 141 the reader of a pipe went away.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import itertools
import os
import re
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn, TextIO

from coview_stream.cli.interrupt import interruptible
from coview_stream.errors import (
    ConfigError,
    CoViewError,
    CoViewWarning,
    did_you_mean,
    naming_missing_libraries,
    printable,
)
from coview_stream.version import __version__

PROGRAM = "coview-stream"

COMMANDS = (
    *("demo", "build", "info", "convert", "locate", "fuse", "eval", "simulate", "airborne"),
    *("serve", "serve-map", "replay", "watch", "doctor", "train", "keygen", "help"),
)
"""Names in the order of ``--help``."""

_MODULES = {"eval": "evaluate", "serve-map": "serve_map"}  # a module called eval would shadow the builtin

_COMPLETE_FILE = {"bash": "_shtab_compgen_files", "zsh": "_files", "fish": "(__fish_complete_path (commandline -ct))"}
"""File name completion, which ``shtab coview_stream.cli.build_parser`` reads from an argument."""

_MEANT = {"--unit": "--crs", "--units": "--crs", "--feet": "--crs", "--lidar": "--sensor", "--topic": "--cloud-topic"}
"""Options that people try, and the ones that they mean."""

_EXTRAS = {"build": "build", "airborne": "build", "simulate": "build", "demo": "all", "train": "learn-train"}
"""Extras with a command's libraries; other commands name missing ones themselves."""


class _Parser(argparse.ArgumentParser):
    """Parser that raises bad usage as an error, like other bad input, instead of printing it and exiting."""

    def format_help(self, everything: bool = False) -> str:
        """Return the help, without the rare options unless ``everything`` is set."""
        hidden = [] if everything else [action for action in self._actions if getattr(action, "rare", False)]
        texts = [action.help for action in hidden]
        for action in hidden:
            action.help = argparse.SUPPRESS
        try:
            return super().format_help()
        finally:
            for action, text in zip(hidden, texts, strict=True):
                action.help = text

    def error(self, message: str) -> NoReturn:
        # prog includes the subcommand, whose help is the one to read
        raise ConfigError(f"{message}; see `{self.prog} --help`")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code; ``argv`` defaults to the process's arguments.

    Errors of this package and the system become one line on stderr and exit code 2; others are bugs and are raised.
    """
    # our matrices are small: BLAS threads cost more than they gain, above all beside other programs
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.stdout = sys.stdout or _null()  # None if the caller closed it
    sys.stderr = sys.stderr or _null()
    try:
        with interruptible(whole_process=argv is None) as interrupt, warnings.catch_warnings():
            warnings.simplefilter("always", CoViewWarning)
            warnings.showwarning = _show_warning
            try:
                code, message = _main(argv)
            except Exception:
                if not interrupt.seen:
                    raise
            if interrupt.seen:  # also if the exception was dropped
                raise KeyboardInterrupt
    except KeyboardInterrupt:
        code, message = 130, ""
    if message is not None:
        print(message and f"{PROGRAM}: error: {printable(' '.join(message.split()))}", file=sys.stderr)
    return code


def _main(argv: Sequence[str] | None) -> tuple[int, str | None]:
    """Return the exit code and the error."""
    try:
        code = _dispatch(sys.argv[1:] if argv is None else list(argv))
        sys.stdout.flush()  # a closed pipe must show up here, not at interpreter shutdown
        return code, None
    except CoViewError as error:
        return 2, str(error)
    except MemoryError:
        return 2, "out of memory; use a smaller map or a coarser voxel size"
    except BrokenPipeError:
        with contextlib.suppress(OSError, ValueError):  # otherwise the interpreter reports the closed pipe at exit
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141, None
    except OSError as error:
        reason = error.strerror or str(error) or type(error).__name__
        return 2, f"{error.filename}: {reason}" if error.filename else reason


def _joined(argv: Sequence[str]) -> list[str]:
    """Return the arguments with ``--option -1,2`` as ``--option=-1,2``: argparse takes the value for an option."""
    found: list[str] = []
    for word in argv:
        before = found[-1] if found else ""
        if re.fullmatch(r"-[\d.][^ ]*,.*", word) and re.fullmatch(r"--[a-z-]+", before):
            found[-1] = f"{before}={word}"
        else:
            found.append(word)
    return found


def build_parser(only: str | None = None) -> argparse.ArgumentParser:
    """Return the parser with all commands, or with one, which does not import the modules of the others."""
    parser = _Parser(
        prog=PROGRAM,
        description="Tells a robot where it is on a base map, by lidar: no GPU, no GNSS, no initial guess.",
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True, title="commands")
    for name in COMMANDS if only is None else (only,):
        module = importlib.import_module(f"{__name__}.{_MODULES.get(name, name)}")
        sub = commands.add_parser(name, help=module.HELP, description=module.HELP)
        module.add_arguments(sub)
        sub.set_defaults(run=module.run)
        for action in sub._actions:
            if action.type is Path or not action.option_strings or "FILE" in str(action.metavar):
                action.complete = _COMPLETE_FILE  # type: ignore[attr-defined]  # read by shtab
    return parser


def _check_options(words: list[str], known: list[str], command: str) -> None:
    """Refuse a long option before ``--`` and ``--ros-args`` that does not begin one of the command's (ConfigError)."""
    for word in itertools.takewhile(lambda word: word not in ("--", "--ros-args"), words):
        option = word.partition("=")[0]
        if option.startswith("--") and not any(name.startswith(option) for name in known):
            meant = _MEANT.get(option, "")
            near = did_you_mean(meant if meant in known else option, [name for name in known if name.startswith("--")])
            end = "" if near.endswith("?") else ";"
            raise ConfigError(
                f"{command} has no option {option}; {near}{end} `{PROGRAM} {command} --help` explains them"
            )


def _dispatch(argv: list[str]) -> int:
    name = argv[0] if argv else "help"  # alone: the list of commands
    if name not in COMMANDS and not name.startswith("-"):
        raise ConfigError(f"there is no command {name!r}; {did_you_mean(name, COMMANDS)} `{PROGRAM} help` lists them")
    parser = build_parser(name if name in COMMANDS else None)
    if name in COMMANDS:  # before argparse, which reports other mistakes first
        (commands,) = (action.choices for action in parser._actions if action.dest == "command")
        _check_options(argv[1:], [option for a in commands[name]._actions for option in a.option_strings], name)  # type: ignore[index]  # a dictionary
    try:
        args, rest = parser.parse_known_args(_joined(argv or [name]))
    except SystemExit as done:  # --help and --version
        return int(done.code or 0)
    if rest:
        raise ConfigError(f"unrecognized arguments: {' '.join(rest)}; see `{PROGRAM} {args.command} --help`")
    with naming_missing_libraries(f"{PROGRAM} {args.command}", _EXTRAS.get(args.command)):
        return int(args.run(args))


def _null() -> TextIO:
    return Path(os.devnull).open("w", encoding="utf-8")


def _show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: object = None,
    line: object = None,
) -> None:
    """Print our own warnings as one line, others as Python does."""
    if issubclass(category, CoViewWarning):
        print(f"{PROGRAM}: warning: {printable(' '.join(str(message).split()))}", file=sys.stderr)
    else:
        print(warnings.formatwarning(message, category, filename, lineno), file=sys.stderr, end="")
