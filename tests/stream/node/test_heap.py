"""Heaps of the C library, in processes of their own."""

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library has other heaps"),
]

THREADS = """
import ctypes, sys, threading
from coview_stream.stream.node.heap import bound_heaps, return_free_memory
if sys.argv[1] == "bound":
    bound_heaps(1, map_large=True)
libc = ctypes.CDLL(None)
libc.malloc.restype = libc.fopen.restype = ctypes.c_void_p
libc.malloc_info.argtypes, libc.fclose.argtypes = (ctypes.c_int, ctypes.c_void_p), (ctypes.c_void_p,)
barrier = threading.Barrier(6)
def allocate():
    barrier.wait()
    for _ in range(50):
        libc.malloc(4096)
    barrier.wait()
threads = [threading.Thread(target=allocate) for _ in range(6)]
for thread in threads: thread.start()
for thread in threads: thread.join()
return_free_memory()
file = libc.fopen(sys.argv[2].encode(), b"w")
libc.malloc_info(0, file)
libc.fclose(file)
"""


def heaps(how: str, out: Path, **settings: str) -> int:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))} | settings
    subprocess.run([sys.executable, "-c", THREADS, how, str(out)], env=environment, check=True, timeout=60)
    return out.read_text().count("<heap nr=")


def test_threads_share_one_heap_unless_the_user_says_otherwise(tmp_path):
    assert heaps("bound", tmp_path / "bound") == 1
    assert heaps("free", tmp_path / "free") > 1
    assert heaps("bound", tmp_path / "asked", MALLOC_ARENA_MAX="4") > 1
