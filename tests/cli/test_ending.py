"""A process whose command is done ends, whatever still runs in it, with all that was written and registered."""

from __future__ import annotations

import os
import subprocess
import sys

import jax
import pytest

from edqn_jax.cli.process.ending import end_process

PROGRAM = """
import atexit, threading
import jax
from concurrent.futures import ThreadPoolExecutor
from edqn_jax.cli.process.ending import end_process

from jax._src import api

api.clear_caches = lambda: print("taken apart")  # what JAX calls at the end
jax.numpy.zeros(3).block_until_ready()
ThreadPoolExecutor().submit(threading.Event().wait)
atexit.register(print, "registered")
print("written")
end_process(7)
"""


def test_a_thread_that_never_ends_is_not_waited_for_and_nothing_written_is_lost() -> None:
    on_cpu = os.environ | {"JAX_PLATFORMS": "cpu"}
    ended = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=300, env=on_cpu)
    assert (ended.returncode, ended.stdout, ended.stderr) == (7, "written\nregistered\n", "")


@pytest.mark.parametrize("imported", [True, False])
def test_a_process_of_a_cluster_or_with_code_of_a_user_ends_in_the_usual_way(
    imported: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jax.distributed, "is_initialized", lambda: not imported)
    monkeypatch.setattr("edqn_jax.cli.process.ending.IMPORTED", ["mine.py"] if imported else [])
    with pytest.raises(SystemExit) as ended:
        end_process(3)
    assert ended.value.code == 3
