"""The page on sweeps: every task of its Slurm array is a run of its own, with flags that there are."""

from __future__ import annotations

import re
import shlex
import subprocess
from pathlib import Path

import pytest

from edqn_jax.cli.train import parse_train

PAGE = (Path(__file__).parents[2] / "docs" / "sweeps.md").read_text(encoding="utf-8")


@pytest.mark.whole
def test_each_task_of_the_array_trains_one_point_of_the_grid() -> None:
    (script,) = re.findall(r"```bash\n(.*?)```", PAGE, re.DOTALL)
    script = script.replace("exec .venv/bin/python train.py", "echo")
    first, last = map(int, re.findall(r"--array=(\d+)-(\d+)", script)[0])
    found = []
    for number in range(first, last + 1):
        task = {"SLURM_ARRAY_TASK_ID": str(number), "PATH": "/usr/bin:/bin"}
        said = subprocess.run(["bash", "-euc", script], capture_output=True, text=True, check=True, env=task).stdout
        options, config = parse_train(shlex.split(said))
        assert options.distributed == "never"
        found.append((str(options.run_dir), config.agent.learning_rate, config.agent.n_step))
    assert len(set(found)) == len({folder for folder, *_ in found}) == 9
    assert {rate for _, rate, _ in found} == {3e-4, 1e-3, 3e-3} and {step for *_, step in found} == {1, 3, 5}
