"""Tries malformed inputs of every kind: options, flags, worlds, policies, checkpoints.

    python scripts/fuzz.py                                    # 10,000 that are refused, some minutes
    python scripts/fuzz.py --refused 100000 --seed 1

The inputs are drawn by hypothesis, which also finds the smallest one of those that make a fault: an error that is no
sentence, a sentence of several lines, or more than ten seconds. Exit code 1 if there is one. Three hundred of them are
tried by the tests.
"""

from __future__ import annotations

import argparse
import collections
import sys
import time
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, Phase, given, seed, settings

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tests.fuzz.malformed import HANGS, KINDS, Kind, refusal  # noqa: E402

AT_ONCE = 250
"""Examples of one round of hypothesis: many short rounds are as random as a long one, and need less memory."""


def main(argv: Sequence[str] | None = None) -> int:
    """Returns 0 if there was no fault, else 1."""
    parser = argparse.ArgumentParser(
        prog="python scripts/fuzz.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--refused", type=int, default=10_000, help="inputs to see refused (default 10000)")
    parser.add_argument("--seed", type=int, default=0, help="of the inputs (default 0)")
    args = parser.parse_args(argv)
    total, slowest, faults = collections.Counter[str](), 0.0, 0
    for kind in KINDS:
        wanted, rounds = args.refused * kind.weight // 100, 0
        refused, valid = 0, 0
        while refused < wanted:
            rounds += 1
            counts, seconds, fault = one_round(kind, 1000 * args.seed + rounds)
            refused, valid, slowest = refused + counts["refused"], valid + counts["valid"], max(slowest, seconds)
            if fault:
                faults += 1
                print(fault, file=sys.stderr, flush=True)
                if faults > 9:
                    return 1
        total.update(refused=refused, valid=valid)
        print(f"{kind.name}: {refused:,} refused, {valid:,} valid", flush=True)
    print(f"{total['refused']:,} refused with a sentence, the slowest after {slowest:.2f} s; {faults} faults")
    return 1 if faults else 0


def one_round(kind: Kind, number: int) -> tuple[collections.Counter[str], float, str]:
    """Returns how many inputs were refused and valid, the most seconds that one took, and a fault as text."""
    counts, slowest = collections.Counter[str](), [0.0]

    @seed(number)
    @settings(
        max_examples=AT_ONCE,
        database=None,
        deadline=HANGS,
        suppress_health_check=(HealthCheck.too_slow, HealthCheck.data_too_large),
        phases=[Phase.generate, Phase.shrink],
    )
    @given(drawn=kind.inputs)
    def each(drawn: Any) -> None:
        began = time.perf_counter()
        counts["valid" if refusal(kind, drawn) is None else "refused"] += 1
        slowest[0] = max(slowest[0], time.perf_counter() - began)

    try:
        each()
    except Exception:
        return counts, slowest[0], f"{kind.name}, round {number}:\n{traceback.format_exc()}"
    return counts, slowest[0], ""


if __name__ == "__main__":
    sys.exit(main())
