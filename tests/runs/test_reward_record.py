"""Names and digests of the kinds of callables that a reward function may be."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from edqn_jax.config import Config
from edqn_jax.runs.provenance import reward_record


def bonus(transition, number: Any = 0.0):
    return transition.configured + number


def enclosed(number):
    def inner(transition):
        return transition.configured + number

    return inner


def anonymous(number):
    return lambda transition: transition.configured + number


@dataclasses.dataclass
class Bonus:
    number: float

    def __call__(self, transition):
        return transition.configured + self.number

    def doubled(self, transition):
        return transition.configured + 2 * self.number

    @classmethod
    def plain(cls, transition):
        return transition.configured


class Broken:
    def __call__(self, transition):
        return transition.configured

    def __repr__(self):
        raise RuntimeError("no text")


def record(reward: Callable) -> tuple[str, str | None]:
    found = reward_record(Config(), reward)
    return found["name"] or "", found["source_sha256"]


MADE = {
    "bonus": lambda n: functools.partial(bonus, number=n),
    "bonus of an array": lambda n: functools.partial(bonus, number=jnp.full(2000, n)),
    "bonus, nested and jitted": lambda n: functools.partial(functools.partial(jax.jit(bonus)), number=n),
    "enclosed.<locals>.inner": enclosed,
    "anonymous.<locals>.<lambda>": anonymous,
    "Bonus": Bonus,
    "Bonus.doubled": lambda n: Bonus(n).doubled,
}
"""Makes the reward function of each name with a number."""


@pytest.mark.parametrize("name", MADE)
def test_a_digest_tells_bound_values_apart(name):
    (first, digest), again, (other, changed) = (record(MADE[name](number)) for number in (1.0, 1.0, 2.0))
    assert first == other and first.startswith(name.split(" ")[0].strip(","))
    assert (first, digest) == again
    assert digest is not None and changed is not None and digest != changed


def test_a_lambda_is_named_with_its_place():
    name, _ = record(anonymous(1.0))
    line = anonymous(1.0).__code__.co_firstlineno
    assert name.endswith(f"<lambda> (test_reward_record.py:{line})")


def test_methods_of_one_class_have_digests_of_their_own():
    bound, of_class, called = record(Bonus(1.0).doubled), record(Bonus.plain), record(Bonus(1.0))
    assert of_class[0] == "Bonus.plain"
    assert len({digest for _, digest in (bound, of_class, called)}) == 3


def test_a_large_array_counts_in_full():
    one, other = (functools.partial(bonus, number=jnp.zeros(5000).at[2500].set(n)) for n in (0.0, 1.0))
    assert record(one)[1] != record(other)[1]


def test_what_cannot_be_read_has_a_name_and_no_digest():
    assert record(functools.partial(bonus, number=Broken())) == ("bonus", None)
    assert record(len) == ("len", None)
    assert record(Broken())[1] is not None  # its class has a source
