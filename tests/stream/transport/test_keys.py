import re

import pytest
import zenoh

from coview_stream.errors import ConfigError
from coview_stream.stream.transport.keys import PRESETS, check_disjoint, check_expression, matches, robot_keys

POSE_HASH = "RIHS01_26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e"


def test_native_keys_are_as_documented():
    keys = robot_keys("native", "coview", "rover1")
    assert keys.cloud == "coview/rover1/in/cloud"
    assert keys.odometry == "coview/rover1/in/odom"
    assert keys.pose == "coview/rover1/out/pose"
    assert keys.status == "coview/rover1/out/status"
    assert keys.alive == "coview/rover1/alive"
    assert (keys.relocalize, keys.reset) == ("coview/rover1/rpc/relocalize", "coview/rover1/rpc/reset")
    assert (keys.hint, keys.pose_format, keys.rmw) == (None, "json", False)


def test_ros2dds_uses_topic_names_and_native_service_keys():
    keys = robot_keys("ros2dds", "site/hall3", "bot1")
    assert (keys.cloud, keys.odometry, keys.pose) == ("bot1/points", "bot1/odom", "bot1/coview/pose")
    assert keys.status == "site/hall3/bot1/out/status"
    assert (keys.hint, keys.pose_format) == ("cdr", "cdr")
    assert not keys.rmw


def test_rmw_zenoh_reads_any_release_and_writes_the_published_hash():
    keys = robot_keys("rmw_zenoh", "coview", "bot1", domain=7)
    golden = "RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5"
    for ending in (golden, "TypeHashNotSupported"):
        assert matches(keys.cloud, f"7/bot1/points/sensor_msgs::msg::dds_::PointCloud2_/{ending}")
        assert matches(keys.odometry, f"7/bot1/odom/nav_msgs::msg::dds_::Odometry_/{ending}")
    assert not matches(keys.cloud, f"0/bot1/points/sensor_msgs::msg::dds_::PointCloud2_/{golden}")
    typed = "7/bot1/coview/pose/geometry_msgs::msg::dds_::PoseWithCovarianceStamped_"
    assert keys.pose == f"{typed}/{POSE_HASH}"
    assert keys.rmw
    humble = robot_keys("rmw_zenoh", "coview", "bot1", domain=7, humble=True)
    assert humble.pose == f"{typed}/TypeHashNotSupported"


def test_keelson_never_reads_its_own_pose_as_odometry():
    keys = robot_keys("keelson", "rise", "masslab")
    assert matches(keys.cloud, "rise/@v0/masslab/pubsub/point_cloud/lidar/bow")
    assert matches(keys.odometry, "rise/@v0/masslab/pubsub/frame_transform/odometry")
    assert keys.pose == "rise/@v0/masslab/pubsub/frame_transform/coview"
    assert not matches(keys.odometry, keys.pose)


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_makes_keys_that_zenoh_accepts(preset):
    keys = robot_keys(preset, "a/b", "rover 1")
    for key in (keys.cloud, keys.odometry, keys.pose, keys.status, keys.alive, keys.relocalize, keys.reset):
        assert str(zenoh.KeyExpr(key)) == key


def test_overrides_fill_placeholders_once():
    keys = robot_keys(
        "native", "fleet", "r1", cloud="{domain}/{robot}/**", odometry="/x"[1:], pose="{base}/p", domain=3
    )
    assert (keys.cloud, keys.odometry, keys.pose) == ("3/r1/**", "x", "fleet/p")
    assert robot_keys("native", "fleet", "{domain}").cloud == "fleet/{domain}/in/cloud"


def test_a_ros_pose_key_keeps_the_convention():
    keys = robot_keys(
        "rmw_zenoh", "coview", "r1", pose="{domain}/{robot}/located/my_msgs::msg::dds_::Pose_/{pose_hash}"
    )
    assert keys.pose == f"0/r1/located/my_msgs::msg::dds_::Pose_/{POSE_HASH}"
    for wrong in ("{base}/pose", "7/pose/type", "x/topic/type/hash"):
        with pytest.raises(ConfigError, match=r"--pose-key.*rmw_zenoh"):
            robot_keys("rmw_zenoh", "coview", "r1", pose=wrong)


@pytest.mark.parametrize("robot", ["", "a/b", "a*", "a$", "a?", "#1", "@home", "tab\t"])
def test_bad_robot_name_names_the_option(robot):
    with pytest.raises(ConfigError, match="--robot"):
        robot_keys("native", "coview", robot)


@pytest.mark.parametrize("base", ["", "/a", "a/", "a//b", "a/*", "@v0/x", "a/$*"])
def test_bad_base_names_the_option(base):
    with pytest.raises(ConfigError, match="--base"):
        robot_keys("native", base, "rover1")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"cloud": "a//b"}, "--cloud-key"),
        ({"odometry": "a/{what}"}, "--odometry-key.*{what}.*robot"),
        ({"pose": "{base}/*/pose"}, "--pose-key.*wildcard"),
        ({"domain": 233}, "--domain"),
    ],
)
def test_bad_key_override_names_the_option(options, message):
    with pytest.raises(ConfigError, match=message):
        robot_keys("native", "coview", "rover1", **options)


def test_unknown_preset_lists_the_known_ones():
    with pytest.raises(ConfigError, match="native, ros2dds, rmw_zenoh, keelson"):
        robot_keys("ros1", "coview", "rover1")


EXPRESSIONS = [
    "a", "a/b", "*", "**", "a/*", "a/**", "*/**", "**/b", "a/**/b", "a/$*x", "a/x$*y$*", "a/@v0/b", "a/@v0/**",
    "@v0", "a b/c",
]  # fmt: skip
WRONG = ["", "/a", "a/", "a//b", "a*", "*a", "a/***", "a/$*", "a/$b", "a$*$*", "a/**/**", "a/**/*", "a?", "#", "$"]


@pytest.mark.parametrize("text", EXPRESSIONS + WRONG)
def test_key_expression_validity_agrees_with_zenoh(text):
    try:
        zenoh.KeyExpr(text)
        valid = True
    except zenoh.ZError:
        valid = False
    assert valid == (text in EXPRESSIONS)
    if valid:
        assert check_expression(text, "key") == text
    else:
        with pytest.raises(ConfigError, match="key"):
            check_expression(text, "key")


def fleet(preset="native", names=("r1", "r2"), **given):
    return [robot_keys(preset, "coview", name, **given) for name in names]


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_has_disjoint_robot_keys(preset):
    check_disjoint(fleet(preset, ("r1", "r2", "r10")))


def test_wildcard_keys_of_one_robot_are_accepted():
    check_disjoint(fleet(names=["r1"], cloud="**/cloud", odometry="*/odom"))
    check_disjoint(fleet(cloud="site/*/{robot}/**", odometry="{robot}$*/odom", pose="poses/{robot}"))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"cloud": "lidar/points"}, "--cloud-key.*r1.*r2.*use {robot} in --cloud-key"),
        ({"cloud": "**/cloud"}, "--cloud-key.*r1.*r2.*use {robot} in --cloud-key"),
        ({"odometry": "*/odom"}, "--odometry-key.*r1.*r2.*use {robot} in --odometry-key"),
        ({"cloud": "a/{robot}/*", "odometry": "a/*/odom"}, "--cloud-key and --odometry-key"),
        ({"pose": "pose"}, "--pose-key.*r1 and r2.*use {robot} in --pose-key"),
        ({"pose": "coview/{robot}/in/odom"}, "--pose-key.*robot r1.*input of r1.*--odometry-key"),
        ({"cloud": "{robot}/**", "pose": "{robot}/pose"}, "--pose-key.*robot r1.*input of r1.*--cloud-key"),
    ],
)
def test_overlapping_keys_are_refused(given, message):
    with pytest.raises(ConfigError, match=re.sub(r"([{}])", r"\\\1", message)):
        check_disjoint(fleet(**given))


def test_pose_key_read_by_another_robot_is_refused():
    first = robot_keys("native", "coview", "r1", pose="coview/r2/in/odom")
    with pytest.raises(ConfigError, match=r"poses of robot r1 .* input of r2"):
        check_disjoint([first, robot_keys("native", "coview", "r2")])
