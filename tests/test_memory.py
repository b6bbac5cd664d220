"""Blocks that are freed and taken again do not go by way of the system."""

import subprocess
import sys

import pytest

from popl_rl.memory import keep_freed_memory

BLOCKS = """
import resource
import torch
from popl_rl.memory import keep_freed_memory

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(30):
        torch.ones(20_000_000)  # 80 MB
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

print(faults())
keep_freed_memory()
print(faults())
"""


@pytest.mark.skipif(not keep_freed_memory(), reason="there is no such setting here")
def test_a_block_that_is_taken_again_costs_no_pages():
    command = [sys.executable, "-c", BLOCKS]
    returned, kept = map(
        int, subprocess.run(command, capture_output=True, check=True).stdout.split()
    )
    assert returned - kept > 25 * 80_000_000 / 4096 / 2
