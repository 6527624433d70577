"""The check of a release sees what is missing and what should not be there."""

from __future__ import annotations

import runpy
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CHECK = runpy.run_path(str(ROOT / "scripts" / "check_release.py"))
WANTED = CHECK["expected"](ROOT)
WHEEL = {*WANTED, "edqn_jax-0.1.0.dist-info/METADATA", "edqn_jax-0.1.0.dist-info/licenses/LICENSE"}


@pytest.mark.parametrize(
    "name",
    [
        "edqn_jax/scenes/paper.xml",
        "edqn_jax/sim/physics/skydio_x2.xml",
        "edqn_jax/py.typed",
        "edqn_jax/policies/pretrained/config.yaml",
        "edqn_jax/policies/pretrained-looks/config.yaml",
        "edqn_jax/policies/pretrained-late/config.yaml",
        "edqn_jax/policies/pretrained-body/config.yaml",
        "edqn_jax-0.1.0.dist-info/licenses/LICENSE",
    ],
)
def test_a_wheel_that_lacks_a_file_is_refused(name: str) -> None:
    CHECK["check_wheel"](WHEEL, WANTED)
    with pytest.raises(CHECK["ReleaseError"], match=f"the wheel lacks .*{Path(name).name}"):
        CHECK["check_wheel"](WHEEL - {name}, WANTED)


def test_a_wheel_with_tests_is_refused() -> None:
    with pytest.raises(CHECK["ReleaseError"], match="should not hold tests/test_api.py"):
        CHECK["check_wheel"](WHEEL | {"tests/test_api.py"}, WANTED)


def test_a_wheel_may_have_the_library_in_c() -> None:
    built = {f"edqn_jax/native/built/{name}" for name in ("edqn-x86-64-v3.so", "compiler.txt")}
    CHECK["check_wheel"](WHEEL | built, WANTED)
    with pytest.raises(CHECK["ReleaseError"], match="should not hold edqn_jax/native/built/other.so"):
        CHECK["check_wheel"](WHEEL | built | {"edqn_jax/native/built/other.so"}, WANTED)


@pytest.mark.parametrize("name", ["edqn_jax-0.1.0-py3-none-any.whl", "edqn_jax-0.1.0-py3-none-linux_x86_64.whl"])
def test_a_wheel_with_the_library_is_of_one_platform_and_one_without_of_any(name: str, tmp_path: Path) -> None:
    of_one = "linux" in name
    for held in (True, False):
        with zipfile.ZipFile(tmp_path / name, "w") as archive:
            archive.writestr("edqn_jax/native/built/edqn-x86-64-v3.so" if held else "edqn_jax/version.py", "")
        if held is of_one:
            assert CHECK["has_library"](tmp_path / name) is held
        else:
            with pytest.raises(CHECK["ReleaseError"], match=f"has {'a' if held else 'no'} library in C"):
                CHECK["has_library"](tmp_path / name)


def test_a_version_that_the_changelog_does_not_know_is_no_release() -> None:
    with pytest.raises(CHECK["ReleaseError"], match=r"no section \[99.0.0\]"):
        CHECK["check_changelog"](ROOT, "99.0.0")
