import importlib.util
import os
import shutil
import subprocess
import sys
import threading
import time
import weakref
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from kernel_cases import ROOT, run_python
from sockets import until

import coview_kernels
from coview_kernels import backend, polar_bin, reference, runtime, shutdown, submit, warm_up

LIBRARIES = [  # Taichi is installed and does not load where there is no libX11
    name
    for name in ("quadrants", "taichi")
    if importlib.util.find_spec(name)
    and subprocess.run([sys.executable, "-c", f"import {name}"], capture_output=True).returncode == 0
]
needs_library = pytest.mark.skipif(not LIBRARIES, reason="neither taichi nor quadrants is installed")
USE = (
    "import numpy as np, coview_kernels as ck\n"
    "def use():\n"
    "    points = np.ones((5, 3), dtype=np.float32)\n"
    "    assert ck.polar_bin(points, (0, 0, 0), 4, 8, 10.0)[0].count.sum() == 5\n"
    "    assert len(ck.transform_unique(points, np.eye(4), 1.0)[0]) == 1\n"
)


def succeeds(code: str, **environment: str) -> str:
    done = run_python(USE + code, **environment)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stderr == ""
    return done.stdout


def test_public_names_are_sorted_callable_and_no_twins():
    made = [name for name in coview_kernels.__all__ if not name.isupper()]
    assert made == sorted(made)
    assert all(callable(getattr(coview_kernels, name)) for name in made)
    for name in reference.__all__:
        assert getattr(reference, name) is not getattr(coview_kernels, name, None)


@pytest.mark.slow
@needs_library
@pytest.mark.skipif(os.name != "posix", reason="HOME is POSIX")
@pytest.mark.parametrize("known", [True, False])
def test_environment_without_home(known, tmp_path):
    begin = "import os, pwd\nos.environ.pop('HOME', None)\n"
    if known:  # unless the password database names a directory that can be written
        home = f"type('Entry', (), {{'pw_dir': {str(tmp_path)!r}}})"
        begin += f"pwd.getpwuid = lambda user: {home}\n"
    else:
        begin += "def unknown(user): raise KeyError(user)\npwd.getpwuid = unknown\n"
    said = succeeds(begin + "use(); print(ck.backend(), os.environ['HOME'])", TMPDIR=str(tmp_path))
    name, home = said.split()
    assert name in LIBRARIES
    if known:
        assert Path(home).samefile(tmp_path)
    else:  # a folder of this process alone, not /tmp, where others may have put compiled kernels
        assert Path(home).parent.samefile(tmp_path)
        assert list(tmp_path.iterdir()) == []


def test_only_runtime_imports_taichi():
    for path in (ROOT / "kernels").rglob("*.py"):
        if path.name != "runtime.py":
            text = path.read_text()
            assert not any(f"import {name}" in text or f"from {name}" in text for name in ("taichi", "quadrants"))


@pytest.mark.slow
def test_import_loads_no_backend_and_kernels_print_nothing():
    code = "import sys\nassert not {'taichi', 'quadrants', 'scipy'} & set(sys.modules)\n"
    code += "use()\nprint(ck.backend())"
    for name in [*LIBRARIES, "numpy"]:
        assert succeeds(code, COVIEW_KERNELS=name) == name + "\n"
    assert succeeds(code) == (LIBRARIES[0] if LIBRARIES else "numpy") + "\n"


@pytest.mark.slow
def test_unknown_backend_raises():
    done = run_python("import coview_kernels as ck; ck.backend()", COVIEW_KERNELS="cuda")
    assert done.returncode == 1
    assert "COVIEW_KERNELS is 'cuda'" in done.stderr


@pytest.mark.slow
def test_numpy_is_used_where_taichi_is_missing():
    blocked = "import sys\nsys.modules['taichi'] = sys.modules['quadrants'] = None\nuse()\nprint(ck.backend())"
    assert succeeds(blocked) == "numpy\n"
    done = run_python(
        "import sys; sys.modules['taichi'] = None\nimport coview_kernels as ck; ck.backend()", COVIEW_KERNELS="taichi"
    )
    assert "COVIEW_KERNELS=taichi, but it is missing" in done.stderr


def test_submit_returns_raises_and_nests():
    assert submit(divmod, 7, 2) == (3, 1)
    assert submit(lambda: submit(lambda: polar_bin(np.ones((2, 3)), (0, 0, 0), 1, 1, 9.0)))[0].count[0, 0] == 2
    with pytest.raises(ZeroDivisionError):
        submit(divmod, 1, 0)
    assert submit(int) == 0


def test_all_kernels_run_on_one_thread():
    threads = {submit(threading.get_ident) for _ in range(3)}
    assert len(threads) == 1
    assert (threading.get_ident() in threads) == (backend() == "numpy")


def test_many_threads_submit_at_once():
    clouds = [np.random.default_rng(s).normal(0, 20, (2000, 3)).astype(np.float32) for s in range(32)]
    expected = [reference.polar_bin(c, np.zeros(3), 20, 60, 50.0)[0].count for c in clouds]
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(lambda c: polar_bin(c, (0, 0, 0), 20, 60, 50.0)[0].count, clouds))
    np.testing.assert_array_equal(found, expected)


@pytest.mark.slow
def test_first_use_from_many_threads_starts_one_backend():
    code = (
        "from concurrent.futures import ThreadPoolExecutor\nimport threading\n"
        "with ThreadPoolExecutor(6) as pool:\n"
        "    [f.result() for f in [pool.submit(use) for _ in range(24)]]\n"
        "assert sum(t.name == 'coview-kernels' for t in threading.enumerate()) == (ck.backend() != 'numpy')\n"
    )
    assert succeeds(code) == ""


def test_shutdown_is_idempotent_and_the_next_kernel_starts_again():
    warm_up()
    before = backend()
    shutdown()
    shutdown()
    assert not any(t.name == "coview-kernels" for t in threading.enumerate())
    assert polar_bin(np.ones((3, 3)), (0, 0, 0), 1, 1, 9.0)[0].count[0, 0] == 3
    assert backend() == before


@pytest.mark.slow
@pytest.mark.skipif(len(LIBRARIES) < 2, reason="needs both libraries")
def test_prepared_launches_follow_a_change_of_the_library():
    code = (
        "import os\n"
        "x, y = np.meshgrid(np.arange(9.0), np.arange(9.0))\n"
        "many = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)\n"
        "both = set()\n"
        "for name in ('quadrants', 'taichi', 'numpy', 'quadrants'):\n"
        "    os.environ['COVIEW_KERNELS'] = name\n"
        "    ck.shutdown()\n"
        "    both.add(tuple(ck.distinct_poses(many, np.zeros(81), 20, 1.5, 0.1).tolist()))\n"
        "    use()\n"
        "assert len(both) == 1\n"
    )
    succeeds(code)


def test_no_argument_of_the_last_call_is_kept():
    used = np.ones((5, 3), dtype=np.float32)
    submit(lambda points: len(points), used)
    kept = weakref.ref(used)
    del used
    until(lambda: kept() is None)


def test_shutdown_while_other_threads_compute_loses_no_call():
    cloud = np.ones((100, 3), dtype=np.float32)
    with ThreadPoolExecutor(4) as pool:
        calls = [pool.submit(polar_bin, cloud, (0, 0, 0), 4, 8, 9.0) for _ in range(200)]
        for _ in range(3):
            shutdown()
        assert all(call.result(timeout=60)[0].count.sum() == 100 for call in calls)


@pytest.mark.slow
@needs_library
@pytest.mark.parametrize("name", LIBRARIES)
@pytest.mark.parametrize("begun", ["before us", "before us, and launched", "after us"])
def test_host_that_initialises_taichi_keeps_it(name, begun):
    after = begun == "after us"
    begin = f"use()\nassert ck.backend() == {name!r}\n" if after else ""
    fill = "field.fill(3.0)\n" if begun.endswith("launched") else ""
    again = "" if after else "use()\n"  # COVIEW_KERNELS asks for the library that the host has by then
    host = (
        f"import {name} as ti, threading\n{begin}ti.init(arch=ti.cpu)\n"
        f"field = ti.field(ti.f32, shape=4)\n{fill}use()\nassert ck.backend() != {name!r}\n"
        "thread = threading.Thread(target=use)\nthread.start()\nthread.join()\n"
        f"field[1] = 7.0\nck.shutdown()\n{again}assert field[1] == 7.0\nprint('fine')"
    )
    done = run_python(USE + host, **({"COVIEW_KERNELS": name} if after else {}))
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.endswith("fine\n")


@pytest.mark.slow
def test_forked_child_computes_in_numpy():
    code = (
        "import os, warnings\nwarnings.simplefilter('ignore')\nuse()\nchild = os.fork()\n"
        "if child == 0:\n    use()\n    os._exit(0 if ck.backend() == 'numpy' else 3)\n"
        "assert os.waitpid(child, 0)[1] == 0\nuse()\n"
    )
    assert succeeds(code) == ""


@pytest.mark.slow
def test_interpreter_exits_while_another_thread_computes():
    code = (
        "import threading\nuse()\n"
        "def forever():\n    while True:\n        use()\n"
        "threading.Thread(target=forever, daemon=True).start()\nuse()\n"
    )
    done = run_python(USE + code)
    assert done.returncode == 0, done.stdout + done.stderr


def test_import_of_a_kernel_module_off_the_owner_thread_raises():
    assert "runtime.kernels" in run_python("import coview_kernels._ti_voxel_filter").stderr


def test_warm_up_of_an_unknown_kernel_raises():
    with pytest.raises(ValueError, match=r"no kernel nearset; there are .*nearest"):
        warm_up("nearset", "nearest")


def test_coview_threads_bounds_the_workers(monkeypatch, available_cores):
    monkeypatch.delenv("COVIEW_THREADS", raising=False)
    assert 1 <= runtime.workers() <= 16
    available_cores(8)
    for asked, given in (("", 8), ("1", 1), ("3", 3), ("64", 8)):
        monkeypatch.setenv("COVIEW_THREADS", asked)
        assert runtime.workers() == given


@pytest.mark.parametrize("asked", ["0", "-1", "two", "1.5", " "])
def test_invalid_coview_threads_raises(monkeypatch, asked):
    monkeypatch.setenv("COVIEW_THREADS", asked)
    with pytest.raises(ValueError, match=r"COVIEW_THREADS is .+ whole number"):
        runtime.workers()


@pytest.mark.parametrize(("age", "left"), [(0.0, True), (3600.0, False)])
def test_lock_that_a_killed_process_left_on_the_cache_is_removed(tmp_path, age, left):
    lock = tmp_path / "qdcache.lock"
    lock.touch()
    os.utime(lock, (time.time() - age,) * 2)
    runtime._remove_stale_lock(tmp_path)
    assert lock.exists() == left
    runtime._remove_stale_lock(tmp_path)


@pytest.mark.slow
@pytest.mark.skipif("quadrants" not in LIBRARIES, reason="quadrants is not installed")
def test_kernels_are_found_by_their_sources_and_the_constants_that_they_use(tmp_path):
    """The second start reads no kernel; the third one does, as a module has changed that may hold a constant."""
    sources = tmp_path / "kernels"
    shutil.copytree(ROOT / "kernels", sources, ignore=shutil.ignore_patterns("__pycache__"))
    cache = {
        "COVIEW_KERNELS": "quadrants",
        "ENABLE_QUADRANTS_HEADER_PRINT": "0",
        "QD_OFFLINE_CACHE_FILE_PATH": str(tmp_path / "cache"),
    }
    code = (
        f"import sys\nsys.path.insert(0, {str(sources)!r})\n"
        "import quadrants.lang.ast.ast_transformer as reader\n"
        "read = set()\n"
        "name = reader.ASTTransformer.build_Name\n"
        "def counted(ctx, node):\n    read.add(ctx.func.func.__name__)\n    return name(ctx, node)\n"
        "reader.ASTTransformer.build_Name = staticmethod(counted)\n"
    )
    code += USE + "use()\nprint('bins' in read)"
    said = []
    for edit in (None, None, "reference/polar.py"):
        if edit:
            with (sources / "coview_kernels" / edit).open("a") as file:
                file.write("MORE = 1\n")
        done = run_python(code, **cache)
        assert (done.returncode, done.stderr) == (0, "")
        said.append(done.stdout.strip())
    assert said == ["True", "False", "True"]


@pytest.mark.slow
@needs_library
@pytest.mark.parametrize("name", LIBRARIES)
def test_process_that_will_be_killed_has_its_kernels_stored_by_another_one_once(name, tmp_path):
    variable = {"quadrants": "QD", "taichi": "TI"}[name] + "_OFFLINE_CACHE_FILE_PATH"
    code = (
        "import os\nfrom coview_kernels.warm_up import compile_once\n"
        "def end(text=''):\n    os.kill(os.getpid(), 9)\n"
        "compile_once('nearest', say=end)\nend()\n"
    )
    for stored in (True, False):  # the second process has none compiled again
        done = run_python(code, **{"COVIEW_KERNELS": name, variable: str(tmp_path)})
        assert (abs(done.returncode), done.stderr) == (9, "")
        until(lambda: list(tmp_path.rglob("stored-*")), 120.0)
        kernels = [*tmp_path.rglob("*.qdc"), *tmp_path.rglob("*.tic")]
        assert bool(kernels) == stored
        for kernel in kernels:
            kernel.unlink()


@pytest.mark.slow
@pytest.mark.skipif("quadrants" not in LIBRARIES, reason="quadrants is not installed")
def test_a_cache_that_cannot_be_written_is_no_error(tmp_path):
    (tmp_path / "file").touch()
    environment = {"COVIEW_KERNELS": "quadrants", "QD_OFFLINE_CACHE_FILE_PATH": str(tmp_path / "file")}
    done = run_python(USE + "use()", TMPDIR=str(tmp_path), **environment)
    assert (done.returncode, done.stderr) == (0, "")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.slow
@needs_library
@pytest.mark.skipif(os.name != "posix", reason="modes are POSIX")
@pytest.mark.parametrize("name", LIBRARIES)
def test_compiled_kernels_are_kept_only_where_this_user_alone_may_write(name, tmp_path):
    shared, own = tmp_path / "shared", tmp_path / "own"
    shared.mkdir()
    shared.chmod(0o777)
    variable = {"quadrants": "QD", "taichi": "TI"}[name] + "_OFFLINE_CACHE_FILE_PATH"
    for folder in (shared, shared / "below", own):
        succeeds("use()", COVIEW_KERNELS=name, TMPDIR=str(tmp_path), **{variable: str(folder)})
    assert [path for path in shared.rglob("*") if path.is_file()] == []
    assert [path for path in own.rglob("*") if path.is_file()] != []


@pytest.mark.skipif(os.name != "posix", reason="modes are POSIX")
def test_folderis_private_unless_others_may_write_it_or_exchange_it(tmp_path):
    deep = tmp_path / "a" / "b"
    deep.mkdir(parents=True)
    assert runtime.is_private(deep)
    for each in (deep, deep.parent):
        each.chmod(0o777)
        assert not runtime.is_private(deep)
        each.chmod(0o755)
    deep.parent.chmod(0o1777)
    assert runtime.is_private(deep) == (os.geteuid() == 0)  # as in /tmp, which is root's
    deep.parent.chmod(0o755)
    (tmp_path / "link").symlink_to(deep)
    deep.chmod(0o757)
    assert not runtime.is_private(tmp_path / "link")
    if os.geteuid() == 0:
        deep.chmod(0o755)
        os.chown(deep.parent, 12345, -1)
        assert not runtime.is_private(deep)
