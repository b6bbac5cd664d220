"""Blocks that are freed and taken again do not go by way of the system."""

import subprocess
import sys

import pytest

from popl_rl.memory import keep_freed_memory

# As PyTorch takes them, which takes seconds to import.
BLOCKS = """
import ctypes, resource, sys
from popl_rl.memory import keep_freed_memory

if sys.argv[1] == "kept":
    keep_freed_memory()
libc, block, size = ctypes.CDLL(None), ctypes.c_void_p(), ctypes.c_size_t(40_000_000)
libc.free.argtypes = [ctypes.c_void_p]
for _ in range(30):
    assert libc.posix_memalign(ctypes.byref(block), ctypes.c_size_t(64), size) == 0
    ctypes.memset(block.value, 1, size.value)
    libc.free(block)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt)
"""


@pytest.mark.skipif(not keep_freed_memory(), reason="there is no such setting here")
def test_a_block_that_is_taken_again_costs_no_pages():
    faults = {}
    for how in ("returned", "kept"):
        command = [sys.executable, "-c", BLOCKS, how]
        faults[how] = int(subprocess.run(command, capture_output=True, check=True).stdout)
    assert faults["returned"] - faults["kept"] > 25 * 40_000_000 / 4096 / 2
