"""The command line's frame: errors are one line, exit codes keep their promise, nothing heavy loads early."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import coview_stream.cli as cli
from coview_stream.errors import CloudError

# pytest's own import roots, for processes that it starts do not inherit them
ENVIRONMENT = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


def _raise(error):
    raise error


def test_version_and_help_exit_with_zero(capsys):
    assert cli.main(["--version"]) == 0
    assert cli.main(["--help"]) == 0
    out = capsys.readouterr().out
    assert "coview-stream" in out
    assert "COMMAND" in out


@pytest.mark.parametrize("argv", [["no-such-command"], ["--no-such-option"], ["help", "no-such-page"]])
def test_bad_usage_is_one_line_and_exit_two(argv, refused):
    refused(*argv)


@pytest.mark.parametrize(
    ("argv", "near"),
    [
        (["biuld", "site.laz"], "build"),
        (["build", "site.laz", "--ouput", "site.coview"], "--output"),
        (["watch", "--secnds=3"], "--seconds"),
        (["help", "reason"], "reasons"),
    ],
)
def test_misspelt_names_are_answered_by_the_nearest(argv, near, capsys):
    assert cli.main(argv) == 2
    assert f"did you mean '{near}'?" in capsys.readouterr().err


@pytest.mark.parametrize("argv", [["merge"], ["drive"], ["plot"], ["serve", "--verbose"], ["build", "--rviz"]])
def test_names_without_similarity_are_answered_by_all(argv, refused):
    assert "; there are " in refused(*argv)


@pytest.mark.parametrize(("word", "page"), [("ros2", "`coview-stream help wire.md`"), ("nosuch", "there are demo, ")])
def test_help_names_the_page_with_a_word_in_a_title_or_all(word, page, refused):
    assert page in refused("help", word)


def test_help_prints_commands_and_pages(capsys):
    assert cli.main([]) == 0
    commands = capsys.readouterr().out
    assert cli.main(["help"]) == 0
    assert capsys.readouterr().out == commands
    pages = re.search("^pages: (.*)$", commands, re.M)[1].split(", ")
    assert pages == sorted(path.stem for path in (Path(__file__).resolve().parents[2] / "docs").glob("*.md"))
    assert cli.main(["help", "build"]) == 0
    assert "usage: coview-stream build" in capsys.readouterr().out
    for page in pages:
        assert cli.main(["help", f"{page}.md"]) == 0
        printed = capsys.readouterr().out
        assert printed.startswith("# ")
        assert "\n|" not in printed  # rows of a table


def test_shells_complete_commands_options_and_files():
    complete = pytest.importorskip("shtab").complete
    for shell in ("bash", "zsh", "fish"):
        script = complete(cli.build_parser(), shell)
        assert "simulate" in script
        assert "ambiguity" in script
    assert "info_pos_0_COMPGEN=_shtab_compgen_files" in complete(cli.build_parser(), "bash")


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (CloudError("site.laz: truncated\nexport it again"), 2, "site.laz: truncated export it again"),
        (MemoryError(), 2, "out of memory"),
        (PermissionError(13, "Permission denied", "site.coview"), 2, "site.coview: Permission denied"),
        (KeyboardInterrupt(), 130, ""),
    ],
)
def test_errors_are_printed_as_one_line(command, capsys, error, code, text):
    command(lambda args: _raise(error))
    assert cli.main(["info"]) == code
    err = capsys.readouterr().err
    assert text in err
    assert err.count("\n") == 1
    assert "Traceback" not in err


def test_unexpected_exception_keeps_its_traceback(command):
    command(lambda args: _raise(ZeroDivisionError()))
    with pytest.raises(ZeroDivisionError):
        cli.main(["info"])


@pytest.mark.slow
def test_closed_stdout_pipe_is_quiet(world_file):
    reader, writer = os.pipe()
    os.close(reader)
    # a command that prints, for argparse swallows the error while it prints its own help
    command = [sys.executable, "-m", "coview_stream", "info", str(world_file)]
    with os.fdopen(writer) as stdout:
        done = subprocess.run(command, stdout=stdout, stderr=subprocess.PIPE, env=ENVIRONMENT, text=True, check=False)
    assert done.returncode == 141
    assert done.stderr == ""


@pytest.mark.slow
def test_help_imports_no_heavy_library():
    script = (
        "import sys; from coview_stream.cli import main; main(['--help']);"
        "heavy = {'open3d', 'taichi', 'quadrants', 'matplotlib', 'zenoh', 'tqdm'};"
        "print('loaded:', *sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, env=ENVIRONMENT, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "loaded:"


@pytest.mark.parametrize("given", [["--robot", "a", "b"], ["--robot", "a", "--robot", "b"]])
@pytest.mark.parametrize("name", ["serve", "watch", "doctor"])
def test_robots_are_named_together_or_one_by_one(name, given):
    site = ["site.coview"] if name == "serve" else []
    assert cli.build_parser(name).parse_args([name, *site, *given]).robot == ["a", "b"]


@pytest.mark.slow
def test_closed_stdout_is_no_reason_to_fail(world_file):
    command = [sys.executable, "-m", "coview_stream", "info", str(world_file)]
    done = subprocess.run(
        ["/bin/sh", "-c", '"$@" >&-', "sh", *command], capture_output=True, text=True, env=ENVIRONMENT
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr


def test_lists_that_begin_with_a_negative_number_are_values(command):
    given = []

    def add(parser):
        parser.add_argument("--around")
        parser.add_argument("--level", type=float)
        parser.add_argument("--initial", action="append")
        parser.add_argument("site")

    command(lambda args: given.append(args) or 0, add)
    words = ["--around", "-162.5,111,100", "--level", "-3", "--initial", "-.5,-2", "--initial=-1,2", "site"]
    assert cli.main(["info", *words]) == 0
    (args,) = given
    assert (args.around, args.level, args.initial, args.site) == ("-162.5,111,100", -3.0, ["-.5,-2", "-1,2"], "site")
    assert cli.main(["info", "-1,2,3", "site"]) == 2
