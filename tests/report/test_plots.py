"""Pictures: each is a PNG that shows something, also where there is little to show."""

import numpy as np
import pytest

from coview_stream.errors import InputError
from coview_stream.report import plots

NO_POINTS = np.zeros((0, 3))


@pytest.fixture
def said(monkeypatch):
    """Notices drawn in place of a plot."""
    notices = []
    monkeypatch.setattr(plots, "draw_notice", lambda axes, text: notices.append(text))
    return notices


@pytest.fixture(scope="module")
def base():
    """A flat square with one block on it, three points a square metre."""
    rng = np.random.default_rng(5)
    points = np.column_stack([rng.uniform(-20, 20, (5000, 2)), np.zeros(5000)])
    points[(np.abs(points[:, :2] - 5) < 4).all(axis=1), 2] = 6.0
    return points


def pixels(path):
    """The picture as (height, width, RGBA) in 0..1; fails if it is not a PNG."""
    from matplotlib import image

    assert path.read_bytes().startswith(b"\x89PNG")
    return image.imread(path)


def has_colour(picture, name):
    """Whether a state's colour is anywhere in the picture."""
    from matplotlib.colors import to_rgb

    return bool((np.abs(picture[:, :, :3] - to_rgb(name)).max(axis=2) < 0.02).any())


@pytest.mark.slow
def test_trajectory_is_coloured_by_state(base, tmp_path):
    line = np.column_stack([np.linspace(-15, 15, 40), np.zeros(40), np.zeros(40)])
    states = ["SEARCHING"] * 10 + ["TRACKING"] * 30
    line[:10] = np.nan
    plots.plot_trajectory(base, line, states, tmp_path / "t.png", truth=np.nan_to_num(line))
    picture = pixels(tmp_path / "t.png")
    assert has_colour(picture, plots.STATE_COLOURS["TRACKING"])
    assert not has_colour(picture, plots.STATE_COLOURS["LOST"])
    line[20:25] = np.nan
    plots.plot_trajectory(base, line, states, tmp_path / "interrupted.png")
    assert has_colour(pixels(tmp_path / "interrupted.png"), plots.STATE_COLOURS["LOST"])


def test_trajectory_plot_without_poses_shows_a_note(base, tmp_path, said):
    plots.plot_trajectory(base, np.full((3, 3), np.nan), ["SEARCHING"] * 3, tmp_path / "none.png")
    plots.plot_trajectory(NO_POINTS, NO_POINTS, [], tmp_path / "empty.png")
    assert [text.split(":")[0] for text in said] == ["not localized", "not localized"]
    pixels(tmp_path / "none.png")
    pixels(tmp_path / "empty.png")


def test_only_probable_places_on_the_map_are_drawn(base, tmp_path, said):
    places = np.array([[5.0, 5, 0, 0, 0.4, 0], [90, 5, 0, 0, 0.3, 0], [5, 9, 0, 0, 0.009, 0]])
    for name, drawn in (("first", places[:1]), ("all", places), ("none", places[1:])):
        plots.plot_trajectory(base, np.full((1, 3), np.nan), ["LOST"], tmp_path / f"{name}.png", places=drawn)
    assert np.array_equal(pixels(tmp_path / "first.png"), pixels(tmp_path / "all.png"))
    assert said == ["no place above 1 %"]


def test_states_and_positions_of_different_length_are_refused(base, tmp_path):
    with pytest.raises(InputError, match="2 states for 3 positions"):
        plots.plot_trajectory(base, np.zeros((3, 3)), ["LOST"] * 2, tmp_path / "t.png")
    assert not (tmp_path / "t.png").exists()


@pytest.mark.slow
def test_false_poses_are_highlighted(tmp_path):
    distance, e_r, e_t = np.arange(50.0), np.full(50, 0.01), np.full(50, 0.05)
    plots.plot_errors(distance, e_t, e_r, tmp_path / "right.png")
    assert not has_colour(pixels(tmp_path / "right.png"), plots.STATE_COLOURS["LOST"])
    e_t[20:25] = 40.0
    plots.plot_errors(distance, e_t, e_r, tmp_path / "false.png")
    assert has_colour(pixels(tmp_path / "false.png"), plots.STATE_COLOURS["LOST"])


def test_error_plot_without_errors_shows_a_note(tmp_path, said):
    plots.plot_errors(np.zeros(0), np.zeros(0), np.zeros(0), tmp_path / "none.png")
    assert said == ["no pose to compare"] * 2
    pixels(tmp_path / "none.png")


@pytest.mark.slow
def test_equal_descriptors_are_drawn_equal_after_shift(tmp_path):
    query = np.random.default_rng(3).random((6, 12))
    query[:, 4] = np.nan
    plots.plot_descriptor_pair(query, np.roll(query, -3, axis=1), 3, tmp_path / "turned.png")
    plots.plot_descriptor_pair(query, query, 0, tmp_path / "same.png")
    turned, same = pixels(tmp_path / "turned.png"), pixels(tmp_path / "same.png")
    below_titles = turned.shape[0] // 6
    np.testing.assert_array_equal(turned[below_titles:], same[below_titles:])
    plots.plot_descriptor_pair(query, query, 3, tmp_path / "wrong.png")
    assert (pixels(tmp_path / "wrong.png")[below_titles:] != same[below_titles:]).any()


def test_descriptors_of_different_shape_are_refused(tmp_path):
    with pytest.raises(InputError, match="differ"):
        plots.plot_descriptor_pair(np.zeros((6, 12)), np.zeros((6, 10)), 0, tmp_path / "d.png")


def test_utm_coordinates_get_a_rounded_plot_offset(base):
    assert not plots.base_shift(base).any()
    assert plots.base_shift(base + np.array([412_345.0, 5_318_765.0, 240.0])).tolist() == [412_300.0, 5_318_800.0, 0.0]


def test_unwritable_plot_names_its_file(tmp_path):
    with pytest.raises(InputError, match=r"missing/map\.png"):
        plots.plot_trajectory(NO_POINTS, NO_POINTS, [], tmp_path / "missing" / "map.png")
