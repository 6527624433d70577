"""Three hundred malformed inputs; `scripts/fuzz.py` tries ten thousand and more."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings

from tests.fuzz.malformed import HANGS, KINDS, Kind, refusal

EXAMPLES = 300


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name.replace(" ", "-"))
def test_what_is_malformed_is_refused_with_a_sentence(kind: Kind) -> None:
    refused = [0]

    @settings(
        max_examples=EXAMPLES * kind.weight // 100,
        derandomize=True,
        database=None,
        deadline=HANGS,
        suppress_health_check=(HealthCheck.too_slow, HealthCheck.data_too_large),
    )
    @given(drawn=kind.inputs)
    def each(drawn: Any) -> None:
        refused[0] += refusal(kind, drawn) is not None

    each()
    assert refused[0] > (0.5 if kind.mostly else 0.0) * EXAMPLES * kind.weight / 100  # else they are not malformed
