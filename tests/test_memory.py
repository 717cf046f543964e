"""keep_memory, each time in a process of its own: what it sets lasts as long as the process."""

import os
import platform
import subprocess
import sys

import pytest

pytestmark = pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="glibc alone has mallopt")

PROGRAM = """
import sys
import numpy as np
from jaxtrapolate.runtime.memory import keep_memory, memory_kept

def resident():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096 / 2**20

assert not memory_kept()
if "keep" in sys.argv:
    print(keep_memory(), keep_memory(), memory_kept())
before = resident()
block = np.ones(200 * 2**20, np.uint8)
held = resident() - before
del block
print(round(held), round(resident() - before))
"""


def run(*arguments, **environment):
    without = {k: v for k, v in os.environ.items() if not k.startswith(("MALLOC_", "GLIBC_TUNABLES"))}
    call = [sys.executable, "-c", PROGRAM, *arguments]
    done = subprocess.run(call, env=without | environment, capture_output=True, text=True, check=True)
    *said, memory = done.stdout.splitlines()
    return said, [int(v) for v in memory.split()]


def test_freed_memory_goes_back_by_default():
    said, (held, left) = run()
    assert said == []
    assert held > 190
    assert left < 10


def test_freed_memory_is_kept():
    said, (held, left) = run("keep")
    assert said == ["True True True"]
    assert held > 190
    assert left > 190


@pytest.mark.parametrize("name, value", [("MALLOC_ARENA_MAX", "2"), ("GLIBC_TUNABLES", "glibc.malloc.arena_max=2")])
def test_settings_of_the_environment_stay(name, value):
    said, (held, left) = run("keep", **{name: value})
    assert said == ["False False False"]
    assert held > 190
    assert left < 10
