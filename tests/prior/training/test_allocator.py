import subprocess
import sys

import pytest

SCRIPT = """
import resource, sys
import numpy as np
from unghost.prior.training.allocator import keep_freed_memory
kept = keep_freed_memory() if sys.argv[1] == "keep" else None
def step():
    np.ones(12_000_000, dtype=np.float64)  # 96 MB: more than glibc keeps by itself
step()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(4):
    step()
print(kept, resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the C library of Linux")
def test_what_is_freed_costs_no_page_faults_again():
    """In processes of their own: the setting is for good."""
    faults = {}
    for way in ("keep", "leave"):
        run = subprocess.run([sys.executable, "-c", SCRIPT, way], capture_output=True, text=True, check=True)
        kept, count = run.stdout.split()
        faults[way] = int(count)
        if kept == "False":
            pytest.skip("not glibc")
    assert faults["keep"] < 100
    assert faults["leave"] > faults["keep"] + 100  # even with huge pages
