"""Settings from TOML: every field by its name, errors that name file, table, key and remedy."""

import pytest

from coview_stream.config import LocalizerConfig
from coview_stream.config.settings_file import read_settings, with_table
from coview_stream.errors import ConfigError


def settings(tmp_path, text):
    path = tmp_path / "node.toml"
    path.write_text(text)
    return with_table(LocalizerConfig(), read_settings(path), "node.toml")


def test_tables_set_fields_and_leave_the_others(tmp_path):
    config = settings(tmp_path, 'reloc = "coview"\n[acceptance]\nrisk = 1e-5\n[keyframe]\ndistance = 3\n')
    assert (config.reloc, config.acceptance.risk, config.keyframe.distance) == ("coview", 1e-5, 3.0)
    assert config.keyframe.capacity == LocalizerConfig().keyframe.capacity


def test_arrays_are_tuples(tmp_path):
    assert settings(tmp_path, "[registration]\ntrack = [1.0, 0.5]\n").registration.track == (1.0, 0.5)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[keyframe]\ndistnce = 3\n", r"node\.toml\.keyframe: unknown key 'distnce'; did you mean 'distance'\?"),
        ("xyzzy = 3\n", "unknown key .xyzzy.; there are keyframe"),
        ("[acceptance]\nrisk = 2.0\n", r"node\.toml\.acceptance: risk is 2\.0; it must be in"),
        ('[keyframe]\ndistance = "far"\n', "distance is 'far'; it must be a number"),
        ("keyframe = 3\n", "keyframe is 3; write a table of its fields"),
        ("[keyframe\n", "is not valid TOML: .*line 1"),
    ],
)
def test_mistakes_are_named(tmp_path, text, message):
    with pytest.raises(ConfigError, match=message):
        settings(tmp_path, text)


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"none\.toml: No such file"):
        read_settings(tmp_path / "none.toml")
