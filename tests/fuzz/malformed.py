"""Malformed inputs of every kind that a stranger can hand us, and what reads them.

Each kind draws an input and reads it as a command would. It is refused with one sentence, or it is valid after all, as
some are; anything else is a fault.
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import hashlib
import io
import re
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

from edqn_jax.cli import train
from edqn_jax.cli.commands import BAD_INPUT
from edqn_jax.config import Config
from edqn_jax.config.loading import resolve_config
from edqn_jax.config.rules import validate
from edqn_jax.errors import ConfigError, error_sentence
from edqn_jax.learn.policy import Policy
from edqn_jax.runs.checkpoints import states
from edqn_jax.runs.checkpoints.params import POLICY
from edqn_jax.runs.checkpoints.states import Checkpoint
from edqn_jax.runs.policies import load_policy, save_policy
from edqn_jax.sim.scene.mjcf import check_scene, load_world
from tests.support.policies import CONFIG, always

HANGS = datetime.timedelta(seconds=10)
"""No input may take longer to be refused."""

NASTY = (
    *("nan", "inf", "-inf", ".nan", "-.inf", "1e400", "1e-400", "-1", "0", "-0.0", "0x10", "1_0", "1e308", "2**3"),
    *("", " ", "a", "é", "\U0001f600", "\x07", "null", "~", "true", "on", "2020-01-01", "1:30", "\\", "%s", "{}", "[]"),
    *(
        "9" * 400,
        "9" * 5000,
        "1 2",
        "1 2 3",
        "1 2 3 4 5",
        "1,2,3",
        "[[[1]]]",
        "{a: 1}",
        "../../etc/passwd",
        "/dev/zero",
    ),
    *("-" * 50, "&a", "*a", "!!python/object/apply:os.system ['echo']", "!x 1", "<<: 1", "'", '"', "#", "| x", "\t1"),
)
"""Texts that stand where a value should."""

OPTIONS = tuple(
    (group.name, option.name)
    for group in dataclasses.fields(Config)
    for option in dataclasses.fields(getattr(Config(), group.name))
)

nasty = st.one_of(
    st.sampled_from(NASTY),
    st.floats().map(repr),
    st.integers().map(str),
    st.text(st.characters(codec="utf-8"), max_size=8),
)


@dataclasses.dataclass(frozen=True)
class Kind:
    """One kind of input."""

    name: str
    inputs: st.SearchStrategy[Any]
    read: Callable[[Any, Path], None]
    """Reads an input, in an empty folder; raises ConfigError where it is refused."""
    weight: int
    """How many of a hundred examples are of this kind."""
    mostly: bool = True
    """Whether most inputs are malformed: what a stranger has changed and sealed may be sound."""


def refusal(kind: Kind, drawn: Any) -> str | None:
    """Returns the sentence that an input is refused with, None if it is valid.

    Raises:
        AssertionError: if it is refused with anything but a sentence; any other error is a fault, too.
    """
    with tempfile.TemporaryDirectory(prefix="edqn-fuzz-") as name:
        try:
            kind.read(drawn, Path(name))
        except ConfigError as error:
            said = error_sentence(error)
            assert 8 < len(said) < 1000, said
            return said
        return None


# ------------------------------------------------------------------------------------------ options


@st.composite
def option_files(draw: st.DrawFn) -> str:
    """Draws the text of a YAML file of options with something wrong in it, most likely."""
    group, option = draw(st.sampled_from(OPTIONS))
    value = draw(nasty)
    text = draw(
        st.sampled_from(
            [
                f"{group}:\n  {option}: {value}\n",
                f"{group}: {{{option}: {value}}}\n",
                f"{group}:\n  {option}: {value}\n  {option}: 1\n",
                f"{group}:\n  {option}x: 1\n",
                f"{group}: {value}\n",
                f"{value}: {{{option}: 1}}\n",
                f"{group}: {'[' * 400}\n",
                f"{group}: {'{a: ' * 300}\n",
                "a: &a [x, x]\n"
                + "".join(f"{c}: &{c} [*{p}, *{p}]\n" for p, c in zip("abcdefghi", "bcdefghij", strict=True)),
            ]
        )
    )
    return mutated(draw, text)


def mutated(draw: st.DrawFn, text: str) -> str:
    """Returns a text, in every third case with one place cut out, doubled or replaced."""
    if draw(st.integers(0, 2)) or not text:
        return text
    begin = draw(st.integers(0, len(text) - 1))
    end = draw(st.integers(begin, min(len(text), begin + 12)))
    return text[:begin] + draw(st.sampled_from(["", text[begin:end] * 2, *NASTY[:40]])) + text[end:]


def read_options(text: str, folder: Path) -> None:
    file = folder / "options.yaml"
    file.write_bytes(text.encode(errors="surrogateescape"))
    validate(resolve_config("default", file, None, "cpu"))


FLAGS = sorted(train.train_flags() | {"--no", "--world.nam", "-x", "extra"})

flags = st.lists(st.tuples(st.sampled_from(FLAGS), nasty), min_size=1, max_size=3)


def read_flags(drawn: list[tuple[str, str]], folder: Path) -> None:
    """Parses the words of a command; what does not parse ends it with the code of bad input, after a message."""
    del folder
    words = [word for flag, value in drawn for word in (flag, value)]
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            train.parse_train([word for word in words if word not in ("-h", "--help")])
    except SystemExit as ending:
        box = said.getvalue()
        assert ending.code == BAD_INPUT and box.strip() and "Traceback" not in box and len(box) < 20_000, box[:2000]
        raise ConfigError("the words of the command do not parse") from None


# ------------------------------------------------------------------------------------------- worlds

SITES = '<site name="start" pos="1 1 2"/><site name="goal" pos="9 1 2"/>'
VOLUME = '<site name="volume" type="box" pos="5 5 3" size="5 5 3" group="3"/>'
TYPES = ("box", "sphere", "capsule", "cylinder", "plane", "ellipsoid", "mesh", "hfield", "sdf", "x")
ATTRIBUTES = ("pos", "size", "euler", "quat", "axisangle", "zaxis", "fromto", "rgba", "name", "type", "class", "group")
ELEMENTS = (
    *(
        "include",
        "mesh",
        "hfield",
        "texture",
        "body",
        "joint",
        "freejoint",
        "replicate",
        "plugin",
        "composite",
        "frame",
    ),
    *("flexcomp", "attach", "light", "camera", "asset", "default", "compiler", "option", "size", "numeric", "site"),
)


def escaped(text: str) -> str:
    """Returns a text as the value of an attribute of XML."""
    kept = "".join(c for c in text if c >= " " or c == "\t")
    return kept.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")


@st.composite
def worlds(draw: st.DrawFn) -> str:
    """Draws the text of an MJCF file with something wrong in it, most likely."""
    value = escaped(draw(nasty))
    good = '<geom type="box" pos="5 1 2" size="1 1 1"/>'
    attribute = draw(st.sampled_from(ATTRIBUTES))
    bad = draw(
        st.sampled_from(
            [
                f'<geom type="{draw(st.sampled_from(TYPES))}" {attribute}x="{value}"/>',
                f'<geom pos="5 5 2" size=".5 .5 .5" {attribute}="{value}"/>',
                f'<geom type="{draw(st.sampled_from(TYPES))}" size="{value}"/>',
                f'<{draw(st.sampled_from(ELEMENTS))} {attribute}="{value}"/>',
                f'<body><freejoint/><geom size=".1" {attribute}="{value}"/></body>',
                f'<replicate count="{value}" offset="1 0 0">{good}</replicate>',
                f'<site name="start" pos="{value}"/>',
                f'<site name="volume" type="box" pos="5 5 3" size="{value}"/>',
                '<geom type="box" pos="1 1 2" size="1 1 1"/>',
                '<geom name="a" size="1"/><geom name="a" size="1"/>',
                "<geom size='.1'/>" * 501,
                good,
            ]
        )
    )
    sites = draw(st.sampled_from([SITES, SITES[: SITES.index("/>") + 2], "", SITES.replace("9 1 2", value)]))
    body = f"<worldbody>{sites}{draw(st.sampled_from([VOLUME, '']))}{bad}</worldbody>"
    outside = draw(st.sampled_from(["", f"<{draw(st.sampled_from(ELEMENTS))}/>", "<!DOCTYPE a>", "<worldbody/>"]))
    return mutated(draw, f"<mujoco>{outside}{body}</mujoco>")


def read_world(text: str, folder: Path) -> None:
    file = folder / "world.xml"
    file.write_bytes(text.encode(errors="surrogateescape"))
    loaded = load_world(file)
    drone, env = Config().drone, Config().env
    check_scene(loaded.scene, drone.body_radius_m, names=loaded.names, title="it", goal_radius=env.goal_radius_m)


# --------------------------------------------------------------------- policies and checkpoints

_SAVED = Path(tempfile.mkdtemp(prefix="edqn-fuzz-saved-"))
_ARRAYS = {".step": np.arange(3, dtype=np.int32), ".learner.agent.q['a']": np.ones((4, 5), np.float32)}


def saved(kind: str) -> Path:
    """Returns a folder with a saved policy, or with a checkpoint; made once."""
    folder = _SAVED / kind
    if not folder.exists():
        if kind == "policy":
            save_policy(Policy(CONFIG, always((1, 0, 0))), folder)
        else:
            states.save_checkpoint(folder, 7, Checkpoint(_ARRAYS, {"done": 7}, "train: {}\n", {"reward": "null"}), 1)
    return folder


damages = st.tuples(
    st.sampled_from(["flip", "cut", "empty", "delete", "append", "link", "folder", "swap"]),
    st.integers(0, 2**16),
    st.integers(0, 2**24),
)
"""How a file is damaged, which one, and where."""


def damage(folder: Path, how: str, which: int, where: int) -> None:
    """Damages one file below a folder, to the last of them in another way than it was."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    file, other = files[which % len(files)], files[(which + 1) % len(files)]
    held = file.read_bytes()
    if how == "flip" and held:
        place = where % (8 * len(held))
        changed = bytearray(held)
        changed[place // 8] ^= 1 << place % 8
        file.write_bytes(changed)
    elif how == "cut" and held:
        file.write_bytes(held[: where % len(held)])
    elif how == "append":
        file.write_bytes(held + bytes(1 + where % 9))
    elif how == "swap" and held != other.read_bytes():
        file.write_bytes(other.read_bytes())
        other.write_bytes(held)
    elif how == "empty" and held:
        file.write_bytes(b"")
    else:
        file.unlink()
        if how == "link":
            file.symlink_to("/dev/zero")
        elif how == "folder":
            file.mkdir()


def reseal(file: Path) -> None:
    """Makes the seal of a file right, whatever else is wrong with it, where there still is one."""
    held = file.read_bytes() if file.is_file() and not file.is_symlink() else b""
    seal = re.search(rb'"sha256": "([0-9a-f]{64})"', held)
    if seal is not None:
        begins = 8 + int.from_bytes(held[:8], "little")
        opened = held[:begins].replace(seal[1], b"0" * 64, 1) + held[begins:]
        file.write_bytes(held.replace(seal[1], hashlib.sha256(opened).hexdigest().encode(), 1))


def read_damaged(kind: str, sealed: bool) -> Callable[[tuple[str, int, int], Path], None]:
    """Returns what damages a saved folder and reads it; `sealed`: by a stranger, who also makes the checksums right."""

    def read(drawn: tuple[str, int, int], folder: Path) -> None:
        place = folder / kind
        shutil.copytree(saved(kind), place)
        file = place / "checkpoints" / POLICY if kind == "policy" else place / "step-000000007.safetensors"
        damage(file.parent if sealed else place, *drawn)
        if sealed:
            reseal(file)
        if kind == "policy":
            load_policy(place)
        elif states.newest_checkpoint(place, lambda _: None, lambda _: None) is None:
            raise ConfigError("its only file is gone")

    return read


KINDS = (
    Kind("options", option_files(), read_options, 35),
    Kind("flags", flags, read_flags, 5),
    Kind("worlds", worlds(), read_world, 35),
    Kind("damaged policies", damages, read_damaged("policy", False), 7),
    Kind("damaged checkpoints", damages, read_damaged("checkpoint", False), 8),
    Kind("policies of strangers", damages, read_damaged("policy", True), 5, False),
    Kind("checkpoints of strangers", damages, read_damaged("checkpoint", True), 5, False),
)
