"""``serve --config node.toml``: every option and setting, the command line before the file, mistakes by name."""

import pytest

from coview_stream.cli import build_parser, main, serve
from coview_stream.config.mount import parse_mount
from coview_stream.config.node import NodeConfig
from coview_stream.errors import ConfigError


def options_of(*argv):
    """Return the options of the node that ``serve`` opens for these arguments."""
    args = build_parser("serve").parse_args(["serve", *map(str, argv)])
    return serve.serve_options(args, serve.settings(args))


@pytest.mark.parametrize(
    ("given", "read", "wanted"),
    [
        ([], lambda o: o.localizer.reloc, "auto"),
        (["--reloc", "learned"], lambda o: o.localizer.reloc, "learned"),
        ([], lambda o: o.localizer.acceptance.risk, 1e-4),
        (["--risk", "1e-6"], lambda o: o.localizer.acceptance.risk, 1e-6),
        ([], lambda o: o.node.mount, NodeConfig().mount),
        (["--mount=180,10,90,0.3,-0.2,0.5"], lambda o: o.node.mount, parse_mount("180,10,90,0.3,-0.2,0.5")),
        (["--odometry-timeout", "1.5"], lambda o: (o.node.odometry_timeout, o.node.max_gap), (1.5, 1.5)),
        ([], lambda o: o.network.check_frames, True),
        (["--odometry", "kiss-icp"], lambda o: o.network.check_frames, False),
        (["--max-payload", "99"], lambda o: o.node.max_payload, 99),
        (["--max-outage", "7"], lambda o: o.node.max_outage, 7.0),
        (["--cloud-delay", "-0.1"], lambda o: o.localizer.cloud_delay, -0.1),
        (
            ["--odometry", "kiss-icp", "--gravity", "0,0.1,-9.8", "--max-speed", "9"],
            lambda o: (o.lidar.gravity, o.lidar.max_speed, o.node.max_speed),
            ((0.0, 0.1, -9.8), 9.0, 9.0),
        ),
        (["--preset", "rmw_zenoh", "--humble"], lambda o: o.keys[0].pose.rpartition("/")[2], "TypeHashNotSupported"),
    ],
)
def test_an_option_reaches_the_node(world_file, given, read, wanted):
    assert read(options_of(world_file, "--robot", "r1", "--no-state", *given)) == wanted


def test_a_file_sets_options_and_tables(world_file, tmp_path):
    path = tmp_path / "node.toml"
    path.write_text(
        f'site = "{world_file}"\nrobot = ["a", "b"]\nlisten = "tcp/127.0.0.1:0"\nno_state = true\npose-rate = 20\n'
        'cloud_key = "lidar/{robot}"\nmount = "180,0,0"\n[node]\nmax_outage = 7\n[localizer]\nreloc = "coview"\n'
        "[localizer.acceptance]\nrisk = 1e-5\n"
    )
    options = options_of("--config", path)
    assert [keys.cloud for keys in options.keys] == ["lidar/a", "lidar/b"]
    assert (options.node.pose_rate, options.node.max_outage, options.node.mount.option) == (20.0, 7.0, "180,0,0")
    assert (options.localizer.reloc, options.localizer.acceptance.risk) == ("coview", 1e-5)
    assert options.state is None


def test_the_command_line_goes_before_the_file(world_file, tmp_path):
    path = tmp_path / "node.toml"
    path.write_text(
        'robot = "a"\nbase = "there"\nno_state = true\n[node]\npose_rate = 5\n[localizer.acceptance]\nrisk = 0.01\n'
    )
    options = options_of(world_file, "--config", path, "--base", "coview", "--robot", "b", "--pose-rate", "3")
    assert options.keys[0].pose == "coview/b/out/pose"
    assert (options.node.pose_rate, options.localizer.acceptance.risk) == (3.0, 0.01)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('robt = "a"\n', "unknown key 'robt'; did you mean 'robot'?"),
        ('robot = "a"\npose_rate = "fast"\n', "pose_rate is 'fast'"),
        ('robot = "a"\nquiet = 1\n', "quiet is 1; write true or false"),
        ('robot = "a"\nreloc = "icp"\n', "reloc is 'icp'; choose one of auto, coview, learned"),
        ('robot = "a"\nlocalizer = 3\n', "localizer is 3; write a table [localizer]"),
        ('robot = "a"\n[node]\npose_rte = 3\n', "[node]: unknown key 'pose_rte'; did you mean 'pose_rate'?"),
        ("[node]\n", "--robot is missing"),
        ("robot = 3\nsite = 3\n", "site is 3 (int); write the map as a text"),
        ('robot = "a"\n[localizer]\nsensor_leans = false\n', "sensor_leans cannot be set here"),
        ('robot = "a"\n[node.mount]\nroll = 3\n', "mount cannot be set here: set it above"),
        ('robot = "a"\n[lidar_odometry]\nnonsense = 3\n', "unknown key 'nonsense'"),
        ("cloud_delay = 0.1\n[localizer]\ncloud_delay = 0.2\n", "cloud_delay and [localizer] cloud_delay: set one of"),
        ('robot = "a"\ncloud_delay = 3\n', "cloud_delay is 3: 3: give seconds, from -1 to 1"),
        ("max_outage = 4\n[node]\nmax_outage = 3\n", "max_outage and [node] max_outage: set one of them"),
        ("risk = 1e-3\n[localizer.acceptance]\nrisk = 1e-5\n", "risk and [localizer.acceptance] risk: set one of them"),
    ],
)
def test_mistakes_are_named(text, message, world_file, tmp_path):
    path = tmp_path / "node.toml"
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        options_of(*[] if "site" in text else [world_file], "--config", path, "--no-state")
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("text", "given", "message"),
    [
        ('risk = "low"\n', [], "{path}: risk low: give the probability"),
        ("risk = 0.7\n", ["--risk", "low"], "--risk low: give the probability"),
        ('pose-key = "a/*"\n', [], "{path}: pose-key 'a/*' has a wildcard"),
        ("coast = -3\n", [], "{path}: dead_reckoning_timeout is -3.0"),
        ('site = "none.coview"\n', None, "{path}: site: none.coview: cannot read the map"),
        ('listen = "nonsense"\n', [], "{path}: listen 'nonsense' is not <protocol>/<address>"),
    ],
)
def test_a_refused_value_of_the_file_is_reported_with_file_and_key(text, given, message, world_file, tmp_path, capsys):
    path = tmp_path / "node.toml"
    path.write_text(text)
    site = [str(world_file), *given] if given is not None else []
    assert main(["serve", "--robot", "r1", "--no-state", "--config", str(path), *site]) == 2
    assert capsys.readouterr().err.startswith(f"coview-stream: error: {message.format(path=path)}")


def test_help_fits_a_screen_and_help_all_has_the_rest(capsys):
    assert main(["serve", "--help"]) == 0
    short = capsys.readouterr().out
    assert len(short.splitlines()) <= 50
    assert main(["serve", "--help-all"]) == 0
    everything = capsys.readouterr().out
    for option in ("--cloud-key", "--domain", "--gravity", "--no-deskew", "--reloc", "--max-speed"):
        assert option in everything
        assert option not in short
    for option in ("--robot", "--config", "--state", "--metrics"):
        assert option in short


@pytest.mark.parametrize(
    ("text", "given", "read", "wanted"),
    [
        (
            "[localizer.acceptance]\nmax_doubt_s = 9\n",
            ["--risk", "1e-5"],
            lambda o: o.localizer.acceptance.max_doubt_s,
            9.0,
        ),
        ("domain = 7\npreset = 'rmw_zenoh'\n", ["--domain", "0"], lambda o: o.keys[0].cloud.partition("/")[0], "0"),
        ("no_state = true\n", ["--state", "STATE"], lambda o: o.state is not None, True),
        ("[node]\nmax_gap = 0.2\n", [], lambda o: o.node.max_gap, 0.2),
        (
            "coast = 3\nnode = 'n1'\n",
            [],
            lambda o: (o.node.dead_reckoning_timeout, o.node_keys.health.split("/")[2]),
            (3.0, "n1"),
        ),
        (
            "odometry = 'kiss-icp'\n[lidar_odometry]\ngravity = 'ground'\nmax_speed = 3\nvoxel = 2\n",
            ["--gravity", "level", "--max-speed", "10"],
            lambda o: (o.lidar.gravity, o.lidar.max_speed, o.lidar.voxel),
            ("level", 10.0, 2.0),
        ),
    ],
)
def test_options_given_replace_the_file_and_leave_the_rest(world_file, tmp_path, text, given, read, wanted):
    path = tmp_path / "node.toml"
    path.write_text(text)
    state = [str(tmp_path) if word == "STATE" else word for word in given]
    assert read(options_of(world_file, "--robot", "r1", "--config", path, *state)) == wanted
