"""What a signal does to a command: while it works, while it is asked to stop, and while it compiles."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest

from edqn_jax.cli.process.signals import ONE_S

SOON_S = 60
"""Seconds after which a process that should have ended at once hangs."""

WORK = """
import hashlib, sys, threading
from edqn_jax.cli.process.signals import listen_to_signals

def unheard():
    "Gives no signal handler of Python's a chance, as XLA while it compiles."
    print("ready", flush=True)
    hashlib.pbkdf2_hmac("sha256", b"", b"", 2**31 - 1)

with listen_to_signals() as stops:
    if sys.argv[1] == "obeyed":
        with stops.obey_signals(lambda text: print(text, flush=True)):
            unheard()
    unheard()
"""


@contextlib.contextmanager
def working(phase: str) -> Iterator[subprocess.Popen[str]]:
    words = [sys.executable, "-c", WORK, phase]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None and process.stdout.readline() == "ready\n"
            yield process
        finally:
            process.kill()


@pytest.mark.parametrize(
    ("number", "code", "says"), [(signal.SIGINT, 130, "interrupted"), (signal.SIGTERM, 143, "terminated")]
)
def test_the_first_signal_ends_what_has_nothing_to_save(number: int, code: int, says: str) -> None:
    with working("alone") as process:
        process.send_signal(number)
        assert process.communicate(timeout=SOON_S) == ("", f"edqn: {says}\n")
    assert process.returncode == code


def test_a_second_signal_ends_what_obeys_the_first() -> None:
    with working("obeyed") as process:
        process.send_signal(signal.SIGTERM)
        assert process.stdout is not None
        assert process.stdout.readline() == "terminated: stopping after this chunk; a second signal ends at once\n"
        process.send_signal(signal.SIGTERM)  # as `timeout` does, to the process and to its group
        time.sleep(1.5 * ONE_S)
        assert process.poll() is None
        process.send_signal(signal.SIGINT)
        assert process.communicate(timeout=SOON_S)[1] == "edqn: interrupted\n"
    assert process.returncode == 130
