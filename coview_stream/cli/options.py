"""Options that several commands share, and their meaning: runs, search, network, odometry, kept state."""

from __future__ import annotations

import argparse
import contextlib
import inspect
import logging
import math
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from coview_stream.errors import ConfigError, CoViewError, InputError, MapError

if TYPE_CHECKING:
    from coview_stream.config import AcceptanceConfig
    from coview_stream.config.mount import Mount
    from coview_stream.config.odometry import LidarOdometryConfig
    from coview_stream.localization.search.hints import PlaceGuess

_SHORT = {"dead_reckoning_timeout": "coast"}
"""Options whose names differ from their fields'."""


def documented_fields(kind: type[Any]) -> dict[str, str]:
    """Return the text of each field in a configuration's docstring."""
    _, _, attributes = (inspect.getdoc(kind) or "").partition("\nAttributes:\n")
    attributes = re.split(r"^\S", attributes, maxsplit=1, flags=re.MULTILINE)[0]
    field = re.compile(r"^    (\w+): (.*?)(?=^    \w+: |\Z)", re.MULTILINE | re.DOTALL)
    return {name: " ".join(text.split()) for name, text in field.findall(attributes)}


def role_free(text: str) -> str:
    """Return a docstring's text with roles and double backticks as plain code."""
    return re.sub(r":\w+:`~?([^`]+)`", r"`\1`", text).replace("``", "`")


class HelpAll(argparse.Action):
    """Print the help with the rare options, and exit."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        """Print the help and exit."""
        print(parser.format_help(everything=True), end="")  # type: ignore[call-arg]  # the command's own parser
        parser.exit()


def hide_rare(parser: argparse.ArgumentParser, *names: str) -> None:
    """Hide options from ``--help``, given their destinations, and declare ``--help-all``."""
    for action in parser._actions:
        if action.dest in names:
            action.rare = True  # type: ignore[attr-defined]  # read by the command's parser
    parser.add_argument("--help-all", action=HelpAll, nargs=0, help="show every option")


def add_fields(group: argparse._ActionsContainer, kind: type[Any], units: Mapping[str, str]) -> None:
    """Declare configuration fields as options, with their documentation and defaults; None if not given."""
    defaults, texts = kind(), documented_fields(kind)
    for name, unit in units.items():
        default = getattr(defaults, name)
        group.add_argument(
            f"--{_SHORT.get(name, name).replace('_', '-')}", dest=name, type=type(default), metavar=unit,
            help=f"{role_free(texts[name]).rstrip('.')} ({f'{default:g}' if isinstance(default, float) else default})",
        )  # fmt: skip


def fill_from_settings(
    args: argparse.Namespace, settings: Mapping[str, Any], path: Path | str, parser: argparse.ArgumentParser,
    tables: Collection[str],
) -> dict[str, dict[str, Any]]:  # fmt: skip
    """Set the options that the command line does not give from ``settings``, by name, and return the tables in these.

    ``args.in_file`` gets the options in the settings, ``args.from_file`` those set from them, by key and destination.
    ``path`` names the settings in errors.

    Raises:
        ConfigError: an unknown key, or a value that the option does not accept.
    """
    from coview_stream.config.settings_file import unknown_key

    actions: dict[str, argparse.Action] = {}
    for action in parser._actions:
        names = [option[2:] for option in action.option_strings if option.startswith("--")]
        names = names or [str(action.metavar).lower(), action.dest]
        if action.dest not in ("help", "help_all", "config"):
            actions |= {name.replace("-", "_"): action for name in names}
    given = set[argparse.Action]()
    for action in actions.values():
        value = getattr(args, action.dest)
        if not (value is None or value is False or value == []):  # 0 is a value
            given.add(action)
    for group in parser._mutually_exclusive_groups:  # a given option excludes the others of its group
        if given.intersection(group._group_actions):
            given.update(group._group_actions)
    file_tables: dict[str, dict[str, Any]] = {}
    args.in_file, args.from_file = set[str](), set[str]()
    for key, value in settings.items():
        name = key.replace("-", "_")
        if name in tables and (isinstance(value, dict) or name not in actions):
            if not isinstance(value, dict):
                raise ConfigError(f"{path}: {key} is {value!r}; write a table [{key}]")
            file_tables[name] = value
            continue
        if name not in actions:
            raise ConfigError(f"{path}: {unknown_key(key, [*tables, *actions])}")
        action = actions[name]
        args.in_file.add(action.dest)
        if action not in given:
            args.from_file |= {name, action.dest}
            setattr(args, action.dest, _value_of(action, value, f"{path}: {key}"))
    return file_tables


@contextlib.contextmanager
def blaming_file(args: argparse.Namespace) -> Iterator[None]:
    """Name the file and the key in an error about an option that ``--config`` has set."""
    try:
        yield
    except CoViewError as error:
        if isinstance(error, MapError) and "map" in args.from_file:
            raise MapError(f"{args.config}: site: {error}") from error
        subject = re.match(r"(?:--)?([a-z][a-z_-]*)", str(error))
        if subject is None or subject[1].replace("-", "_") not in args.from_file:
            raise
        raise type(error)(f"{args.config}: {str(error).removeprefix('--')}") from error


def _value_of(action: argparse.Action, value: Any, where: str) -> Any:
    """Return a settings file's value as the command line would give it."""
    if action.nargs == 0 or (action.nargs == "?" and value is True):
        if not isinstance(value, bool):
            raise ConfigError(f"{where} is {value!r}; write true or false")
        return (True if action.nargs == 0 else action.const) if value else action.default
    several = action.nargs in ("+", "*") or isinstance(action, argparse._AppendAction)
    items = value if isinstance(value, list) and several else [value]
    out = []
    for item in items:
        kind = action.type if callable(action.type) else str
        if isinstance(item, dict | list | bool):
            raise ConfigError(f"{where} is {value!r}; write {'texts' if several else 'one value'}")
        if action.dest == "map" and not isinstance(item, str):
            raise ConfigError(f"{where} is {item!r} ({type(item).__name__}); write the map as a text")
        try:
            out.append(kind(str(item)))
        except (argparse.ArgumentTypeError, ValueError) as error:
            raise ConfigError(f"{where} is {item!r}: {error}") from error
        if action.choices is not None and out[-1] not in action.choices:
            raise ConfigError(f"{where} is {item!r}; choose one of {', '.join(map(str, action.choices))}")
    return out if several else out[0]


def host_port(option: str, example: str) -> Callable[[str], str]:
    """Return the argument type for ``HOST:PORT``."""

    def check(text: str) -> str:
        if not text.rpartition(":")[2].isdecimal():  # for example the map after an option without value
            raise argparse.ArgumentTypeError(f"{text!r} is not HOST:PORT; write {option}={example}")
        return text

    return check


ROBOT, KISS_ICP = "robot", "kiss-icp"
"""Sources of odometry, as ``serve --odometry`` names them."""


def _delay(text: str) -> float:
    from coview_stream.config.localizer import MAX_DELAY

    seconds = float(text)
    if not abs(seconds) <= MAX_DELAY:
        raise argparse.ArgumentTypeError(f"{text}: give seconds, from -{MAX_DELAY:g} to {MAX_DELAY:g}")
    return seconds


SHARED: dict[str, dict[str, Any]] = {
    "run_path": {"type": Path, "metavar": "RUN", "help": "run directory, cloud file, or rosbag2, mcap, bag"},
    "--cloud-topic": {"metavar": "TOPIC", "help": "clouds of a recording with several such topics"},
    "--odometry-topic": {"metavar": "TOPIC", "help": "odometry of a recording with several such topics"},
    "--preset": {"default": "native", "help": "keys: native, ros2dds, rmw_zenoh or keelson (native)"},
    "--progress": {"action": "store_true", "help": "draw progress bars even without a terminal"},
    "--json": {"action": "store_true", "help": "print JSON"},
    "--quiet": {"action": "store_true", "help": "log errors only"},
    "--reloc": {
        "choices": ("auto", "coview", "learned"),
        "default": "auto",
        "help": "place recognition: co-view descriptors, learned features, or both where the map has them (auto)",
    },
    "--risk": {
        "default": 1e-4,
        "metavar": "P",
        "help": "probability of a wrong place below which a pose is given, 1e-6 to 0.5 (1e-4)",
    },
    "--mount": {
        "metavar": "R,P,Y[,X,Y,Z]",
        "help": "pose of the lidar on the body: degrees, metres; --mount=180,0,0: upside down (of a bag: /tf_static)",
    },
    "--cloud-delay": {
        "type": _delay,
        "metavar": "S",
        "help": "seconds that clouds are stamped later than odometry, if known; negative: odometry is late (0)",
    },
    "--verify-key": {
        "type": Path,
        "metavar": "NAME.pub",
        "help": "refuse a map that this key has not signed (build --sign)",
    },
    "--gravity": {
        "metavar": "ground|level|X,Y,Z",
        "help": "for kiss-icp, down: by the ground, along the body's -z, or a vector in its frame, as in "
        "--gravity=-0.1,0,-9.8 (ground)",
    },
}
"""Options that several commands share, as arguments for argparse."""


def add_shared(parser: argparse._ActionsContainer, *names: str) -> None:
    """Declare some of :data:`SHARED`."""
    for name in names:
        parser.add_argument(name, **SHARED[name])


def add_network(parser: argparse.ArgumentParser, default: str = "--connect tcp/127.0.0.1:7447") -> None:
    """Declare ``--connect``, ``--listen``, ``--zenoh-config`` and ``--base``; without them ``default`` applies."""
    network = parser.add_argument_group(f"network (with none of these: {default})")
    network.add_argument("--connect", action="append", default=[], metavar="EP", help="tcp/HOST:PORT to connect to")
    network.add_argument("--listen", action="append", default=[], metavar="EP", help="endpoint to wait for others on")
    network.add_argument("--zenoh-config", type=Path, metavar="FILE", help="zenoh JSON5: TLS, users, ACL, ...")
    network.add_argument("--base", default="coview", metavar="KEY", help="first part of the keys (coview)")


def add_world(parser: argparse.ArgumentParser, size: float, length: float) -> None:
    """Declare the simulated-world options of ``demo`` and ``simulate``, with their defaults in metres."""
    parser.add_argument(
        "--scene", default="town", help="town, campus, village, industrial, depot (with a hall) or forest (town)"
    )
    parser.add_argument(
        "--sensor",
        default="vlp16",
        help="vlp16, vlp16-inclined (and turning), os64, os64-2048, mid360, bpearl (a hemisphere) or blk360 (on a "
        "tripod: the robot stands while it scans) (vlp16)",
    )
    parser.add_argument("--seed", type=int, default=1, help="equal seeds give equal worlds (1)")
    parser.add_argument("--size", type=float, default=size, help=f"side of the map, metres ({size:g})")
    parser.add_argument("--length", type=float, default=length, help=f"distance driven, metres ({length:g})")


def check_codec(option: str, name: str | None, known: Iterable[str]) -> None:
    """Refuse an encoding without a codec (ConfigError); None is always valid."""
    if name is not None and name not in known:
        raise ConfigError(f"{option} {name!r} is unknown; choose one of {', '.join(known)}")


def add_initial(parser: argparse._ActionsContainer, of_robots: bool = False) -> None:
    """Declare ``--initial``, a guess of the place; ``of_robots``: one per robot, by name."""
    parser.add_argument(
        "--initial",
        action="append" if of_robots else "store",
        default=[] if of_robots else None,
        metavar="NAME=X,Y[,YAW]" if of_robots else "X,Y[,YAW]",
        help="a guess of the place (map coordinates, degrees): tried, never trusted",
    )
    parser.add_argument(
        "--within", type=float, metavar="METRES", help="metres around --initial that are searched, 50 or more"
    )


def initial_guess(text: str | None, within: float | None = None) -> PlaceGuess | None:
    """Return the guess in ``X,Y[,YAW]``, metres and degrees; with several maps ``MAP:X,Y[,YAW]``; None for None.

    ConfigError for other texts, and for ``within`` alone or out of range.
    """
    from coview_stream.geometry.validation import MAX_COORDINATE
    from coview_stream.localization.search.hints import MIN_WITHIN, PlaceGuess

    if text is None:
        if within is not None:
            raise ConfigError("--within needs --initial: it is a radius around that place")
        return None
    if within is not None and not MIN_WITHIN <= within < MAX_COORDINATE:
        raise ConfigError(f"--within {within:g}: give metres, {MIN_WITHIN:g} or more")
    of, _, place = text.rpartition(":")
    try:
        numbers = [float(part) for part in place.split(",")]
        if len(numbers) not in (2, 3):
            raise ValueError
    except ValueError:
        raise ConfigError(f"--initial {text!r}: give X,Y or X,Y,YAW (metres in the map, degrees)") from None
    yaw = math.radians(numbers[2]) if len(numbers) == 3 else None
    try:
        return PlaceGuess(numbers[0], numbers[1], yaw, map=of or None, within=within)
    except ConfigError as error:
        raise ConfigError(f"--initial {text!r}: {error}") from error


def initial_guesses(texts: Iterable[str], robots: Iterable[str], within: float | None = None) -> dict[str, PlaceGuess]:
    """Return the guesses in ``NAME=X,Y[,YAW]`` by robot; ConfigError for a bad guess or an unknown robot."""
    out: dict[str, PlaceGuess] = {}
    known = list(robots)
    if not (texts := list(texts)):
        initial_guess(None, within)
    for text in texts:
        name, sign, place = text.rpartition("=")
        if not sign and len(known) == 1:
            name = known[0]
        if name not in known:
            raise ConfigError(f"--initial {text!r}: write NAME=X,Y[,YAW], with one of {', '.join(known)}")
        guess = initial_guess(place, within)
        assert guess is not None  # there is a text
        out[name] = guess
    return out


def acceptance_config(risk: str | float) -> AcceptanceConfig:
    """Return the limits of a fix for ``--risk``; ConfigError if it is not a number from 1e-6 to below a half."""
    from coview_stream.config.localizer import LEAST_RISK, AcceptanceConfig

    try:
        value = float(risk)
    except ValueError:
        value = math.nan
    if not LEAST_RISK <= value < 0.5:
        raise ConfigError(f"--risk {risk}: give the probability of a wrong place, in [1e-6, 0.5), such as 1e-4")
    return AcceptanceConfig(risk=value)


def check_picture(option: str, path: Path | None) -> None:
    """Refuse a picture that is a directory, or in a missing one (ConfigError); None is always valid."""
    if path is None:
        return
    if path.is_dir():
        raise ConfigError(f"{option} {path}: is a directory; name the picture, such as {path / 'picture.png'}")
    if not path.parent.is_dir():
        raise ConfigError(f"{option} {path}: {path.parent} is not a directory; make it first")


def mount_of(args: argparse.Namespace) -> Mount | None:
    """Return ``--mount``, None if not given; ConfigError if it is not three or six numbers in range."""
    from coview_stream.config.mount import parse_mount

    return None if args.mount is None else parse_mount(args.mount)


def lidar_config(
    odometry: str, gravity: str | None, max_speed: float = 50.0, delay: float | None = None
) -> LidarOdometryConfig | None:
    """Return how odometry is computed from the clouds; None if ``odometry`` is not kiss-icp.

    ``max_speed`` is the robot's, metres per second. ConfigError if ``gravity`` is not a direction or is given with
    other odometry, or if ``delay`` is given with kiss-icp.
    """
    from coview_stream.config.odometry import LidarOdometryConfig, parse_gravity

    if odometry == KISS_ICP and delay:
        raise ConfigError(f"--cloud-delay goes with a clock of odometry's own: that of {KISS_ICP} is the clouds'")
    if odometry != KISS_ICP:
        if gravity is not None:
            raise ConfigError(f"--gravity goes with --odometry {KISS_ICP}: other odometry is gravity aligned")
        return None
    down = parse_gravity("ground" if gravity is None else gravity)
    return LidarOdometryConfig(gravity=down, max_speed=max_speed)


def add_state(parser: argparse.ArgumentParser) -> None:
    """Declare ``--state`` and ``--no-state``."""
    either = parser.add_mutually_exclusive_group()
    either.add_argument(
        "--state", metavar="DIR", help="last poses, tried at the next start (default: $XDG_STATE_HOME/coview-stream)"
    )
    either.add_argument("--no-state", action="store_true", help="keep nothing, read nothing")


def state_folder(args: argparse.Namespace) -> Path | None:
    """Return the folder of the last poses after a trial write, and log it; None for nowhere.

    A wrong ``--state`` is refused at the start, not while driving. A default folder that is missing or not writable is
    only logged: a service without a home must run, and a disk may be mounted later.

    Raises:
        InputError: ``--state`` names a directory that cannot be written. ConfigError: it is empty.
    """
    from coview_stream.stream.node.last_place import default_folder, try_out

    if args.no_state:
        return None
    if args.state == "":
        raise ConfigError("--state '': name a directory, or leave it out, or use --no-state")
    log = logging.getLogger("coview_stream.node")
    try:
        folder = default_folder() if args.state is None else Path(args.state)
        try_out(folder)
    except ConfigError as error:
        log.warning("%s", error)
        return None
    except OSError as error:
        text = f"{folder}: the last poses cannot be kept here ({error.strerror or error})"
        if args.state is not None:
            raise InputError(f"--state {text}; name a directory that can be written, or use --no-state") from error
        log.warning("%s; use --state DIR or --no-state", text)
    else:
        log.info("the last poses are kept in %s", folder)
    return folder
