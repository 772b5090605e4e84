import resource
import subprocess
import sys

SCRIPT = """
import resource, sys, torch
from tom.machine.memory import keep_freed_memory
assert keep_freed_memory()
torch.set_num_threads(1)
def work():
    return [torch.relu(torch.ones(2048, 256)) for _ in range(4)]
for _ in range(3):
    work()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(50):
    work()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def test_memory_that_is_freed_is_not_fetched_page_by_page_again():
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True
    )
    pages_of_one_round = 4 * 2048 * 256 * 4 // resource.getpagesize()
    assert int(done.stdout) < 5 * pages_of_one_round  # 50 of them otherwise
