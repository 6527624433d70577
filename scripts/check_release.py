"""Builds the wheel and the sdist and checks them as a user meets them, in fresh environments outside of the checkout.

    python scripts/check_release.py                  # with this Python, and with the newest other one that is found
    python scripts/check_release.py --python python3.13
    python scripts/check_release.py --final --out dist

Checks which files both hold, that wheels built from checkout and sdist hold the same, and that a wheel has the library
in C where there is a compiler, and can be built where there is none. Then, for each Python, installs the wheel and runs
`edqn`, loads the pretrained policy, makes the paper's world and flies once, without a compiler. Needs the extra
`release`.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import tomllib
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path

ROOT = Path(__file__).parents[1]

IN_BOTH = (
    *("sim/physics/skydio_x2.xml", "py.typed"),
    *(
        f"policies/{config.parent.name}/{file}"
        for config in sorted((ROOT / "edqn_jax" / "policies").glob("*/config.yaml"))
        for file in ("config.yaml", "README.md")
    ),
)
"""Files of the package that are not Python, beside worlds and checkpoints."""

LIBRARY = re.compile(r"edqn_jax/native/built/(edqn-[\w-]+\.so|compiler\.txt)")
"""Files of the library in C, which a wheel has that was built where there is a compiler."""

FLIES = """
import sys
from pathlib import Path
import edqn_jax
assert not Path(edqn_jax.__file__).is_relative_to(sys.argv[1]), "this is the checkout, not what was installed"
policy = edqn_jax.load_policy("pretrained")
state, observation = edqn_jax.make("paper").reset()
from edqn_jax.native.shipped import shipped_library
from edqn_jax.sim.camera.native import is_available
assert is_available("cpu") or shipped_library() is None, "the library in C of the wheel cannot be used"
evaluation = edqn_jax.evaluate(policy, "paper")
print(f"one flight of the pretrained policy through the paper's map: {evaluation.outcomes[0]}")
"""
"""What is run with what was installed; its argument is the checkout."""


class ReleaseError(Exception):
    """Something of the release is not as it should be."""


def expected(root: Path) -> set[str]:
    """Returns the files that a wheel must hold, of those that git tracks in a checkout, by their names in it."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=root, capture_output=True, text=True, check=True).stdout
    tracked = [name for name in listed.split("\0") if name]
    package = {name for name in tracked if name.startswith("edqn_jax/")}
    worlds = {f"edqn_jax/{name}" for name in tracked if name.startswith("scenes/")}
    return package | worlds


def check_wheel(names: Iterable[str], wanted: set[str]) -> None:
    """Raises if a wheel of these names does not hold exactly what it should.

    Raises:
        ReleaseError: names files that are missing, or that should not be there.
    """
    held = {name for name in names if not name.endswith("/")}
    inside = {name for name in held if ".dist-info/" not in name}
    wanted = wanted | {f"edqn_jax/{name}" for name in IN_BOTH}
    if missing := sorted(wanted - inside):
        raise ReleaseError(f"the wheel lacks {', '.join(missing)}")
    if surplus := sorted(name for name in inside - wanted if not LIBRARY.fullmatch(name)):
        raise ReleaseError(f"the wheel should not hold {', '.join(surplus)}")
    if not any(re.search(r"\.dist-info/(licenses/)?LICENSE$", name) for name in held):
        raise ReleaseError("the wheel lacks LICENSE")


def check_sdist(names: Iterable[str], version: str) -> None:
    """Raises if an sdist of these names lacks what is needed to build, test and read it.

    Raises:
        ReleaseError: names what is missing.
    """
    root = f"edqn_jax-{version}/"
    held = [name.removeprefix(root) for name in names]
    needed = ["LICENSE", "README.md", "CHANGELOG.md", "CITATION.cff", "pyproject.toml", "train.py"]
    needed += [f"edqn_jax/{name}" for name in IN_BOTH]
    missing = [name for name in needed if name not in held]
    missing += [
        folder
        for folder in ("scenes/examples/", "tests/", "benchmarks/", "examples/", "scripts/", "edqn_jax/policies/")
        if not any(name.startswith(folder) for name in held)
    ]
    if missing:
        raise ReleaseError(f"the sdist lacks {', '.join(missing)}")


def check_changelog(root: Path, version: str) -> None:
    """Raises if the changelog or the citation does not know the version.

    Raises:
        ReleaseError: says which.
    """
    if f"## [{version}]" not in (root / "CHANGELOG.md").read_text(encoding="utf-8"):
        raise ReleaseError(f"CHANGELOG.md has no section [{version}]")
    if not re.search(rf"^version: \"?{re.escape(version)}\"?$", (root / "CITATION.cff").read_text(), re.MULTILINE):
        raise ReleaseError(f"CITATION.cff does not name version {version}")


def build(root: Path, folder: Path) -> tuple[Path, Path]:
    """Builds the sdist, and the wheel from it; returns wheel and sdist."""
    _run([sys.executable, "-m", "build", "--outdir", str(folder), str(root)])
    (wheel,), (sdist,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    return wheel, sdist


def names_of(file: Path) -> list[str]:
    """Returns the names of the files in a wheel or an sdist."""
    if file.suffix == ".whl":
        with zipfile.ZipFile(file) as archive:
            return archive.namelist()
    with tarfile.open(file) as archive:
        return [member.name for member in archive if member.isfile()]


def has_library(wheel: Path) -> bool:
    """Returns whether a wheel has the library in C.

    Raises:
        ReleaseError: if its name says otherwise: only with the library is it of one platform.
    """
    held = any(LIBRARY.fullmatch(name) for name in names_of(wheel))
    if wheel.stem.endswith("-any") is held:
        raise ReleaseError(f"{wheel.name} has {'a' if held else 'no'} library in C")
    return held


def check_libraries(wheel: Path, folder: Path) -> None:
    """Raises if a wheel lacks the library in C although there is a compiler, or cannot be built without one.

    Raises:
        ReleaseError: says which.
    """
    if has_library(wheel) is not (shutil.which("cc") is not None):
        raise ReleaseError(f"{wheel.name} has the library in C where there is no compiler, or none where there is one")
    if has_library(_wheel_of_the_checkout(folder, {"CC": "no-such-compiler"})):
        raise ReleaseError("a wheel that was built without a compiler has a library in C")


def try_out(wheel: Path, python: str, version: str, folder: Path) -> None:
    """Installs the wheel for a Python into a fresh environment, and uses it outside of the checkout.

    Nothing but Python is on the path then, so what is in C comes from the wheel.

    Raises:
        ReleaseError: if a command fails or the version is another.
    """
    _run([python, "-m", "venv", str(folder / "venv")])
    bin_ = folder / "venv" / "bin"
    _run([str(bin_ / "pip"), "install", "--quiet", "--disable-pip-version-check", str(wheel)])
    alone = {"PATH": str(bin_), "CC": ""}
    said = _run([str(bin_ / "edqn"), "--version"], folder, quiet=True, variables=alone)
    if said.splitlines()[0] != f"edqn-jax {version}":
        raise ReleaseError(f"edqn --version says '{said.splitlines()[0]}', not 'edqn-jax {version}'")
    print(f"{python}: {', '.join(said.splitlines())}", flush=True)
    if has_library(wheel) and not re.search(r"^library in C: for \S+, in the package$", said, re.MULTILINE):
        raise ReleaseError("edqn --version does not say that the library in C is in the package")
    _run([str(bin_ / "python"), "-c", FLIES, str(ROOT)], folder, variables=alone)
    _run(
        [str(bin_ / "edqn"), "evaluate", "pretrained", "--world", "sparse", "--json", "figures.json"],
        folder,
        quiet=True,
        variables=alone,
    )
    if not (folder / "figures.json").is_file():
        raise ReleaseError("edqn evaluate wrote no figures.json")


def newer_pythons() -> list[str]:
    """Returns commands of Pythons from 3.12 on that can run, the newest first."""
    found = []
    for minor in range(19, 11, -1):
        name = f"python3.{minor}"
        places = [shutil.which(name), *sorted(map(str, Path.home().glob(f".pyenv/versions/3.{minor}.*/bin/{name}")))]
        found += [place for place in places if place is not None and _can_run(place)][:1]
    return found


def _can_run(python: str) -> bool:
    return subprocess.run([python, "-c", "import venv, ssl"], capture_output=True, check=False).returncode == 0


def _run(
    words: list[str], folder: Path | None = None, quiet: bool = False, variables: Mapping[str, str] | None = None
) -> str:
    """Runs a command outside of the checkout, with variables of the environment, and returns what it printed.

    Raises:
        ReleaseError: with what it said, if it fails.
    """
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    environment |= variables or {}
    done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise ReleaseError(f"{' '.join(words[:4])} failed:\n{done.stdout}{done.stderr}")
    if not quiet and done.stdout and folder is not None:
        print(done.stdout, end="", flush=True)
    return done.stdout


def main(argv: list[str] | None = None) -> int:
    """Checks the release; returns 0, or 1 after a sentence that says what is wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", action="append", help="try this Python (default: this one and the newest other)")
    parser.add_argument("--final", action="store_true", help="also check that changelog and citation have the version")
    parser.add_argument("--out", type=Path, help="leave wheel and sdist in this folder")
    args = parser.parse_args(argv)
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    pythons = args.python
    if pythons is None:
        newer = newer_pythons()
        pythons = [sys.executable, *[name for name in newer[:1] if sys.version_info < (3, 12)]]
        if not newer and sys.version_info < (3, 12):
            print("no Python 3.12 or later was found: only this one is tried", flush=True)
    try:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            wheel, sdist = build(ROOT, folder / "dist")
            check_wheel(names_of(wheel), expected(ROOT))
            check_sdist(names_of(sdist), version)
            if args.final:
                check_changelog(ROOT, version)
            again = _wheel_of_the_checkout(folder / "direct")
            if set(names_of(again)) != set(names_of(wheel)):
                apart = sorted(set(names_of(again)) ^ set(names_of(wheel)))
                raise ReleaseError(f"wheels of checkout and sdist differ in {', '.join(apart)}")
            check_libraries(wheel, folder / "without")
            print(f"{wheel.name}: {len(names_of(wheel))} files, the same from checkout and sdist", flush=True)
            for number, python in enumerate(pythons):
                place = folder / str(number)
                place.mkdir()
                try_out(wheel, python, version, place)
            if args.out is not None:
                args.out.mkdir(parents=True, exist_ok=True)
                for file in (wheel, sdist):
                    shutil.copy(file, args.out)
    except ReleaseError as error:
        print(f"check_release: {error}", file=sys.stderr)
        return 1
    return 0


def _wheel_of_the_checkout(folder: Path, variables: Mapping[str, str] | None = None) -> Path:
    _run([sys.executable, "-m", "build", "--wheel", "--outdir", str(folder), str(ROOT)], variables=variables)
    (wheel,) = folder.glob("*.whl")
    return wheel


if __name__ == "__main__":
    sys.exit(main())
