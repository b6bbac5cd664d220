"""Blocks that are freed and taken again do not go by way of the system."""

import subprocess
import sys

import pytest

from popl_rl.memory import keep_freed_memory

BLOCKS = """
import resource, sys
import torch
from popl_rl.memory import keep_freed_memory

if sys.argv[1] == "kept":
    keep_freed_memory()
for _ in range(30):
    torch.ones(20_000_000)  # 80 MB
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt)
"""


@pytest.mark.skipif(not keep_freed_memory(), reason="there is no such setting here")
def test_a_block_that_is_taken_again_costs_no_pages():
    faults = {}
    for how in ("returned", "kept"):
        command = [sys.executable, "-c", BLOCKS, how]
        faults[how] = int(subprocess.run(command, capture_output=True, check=True).stdout)
    assert faults["returned"] - faults["kept"] > 25 * 80_000_000 / 4096 / 2
