"""The page on clusters: its commands parse, and its manifest hangs together."""

from __future__ import annotations

import re
import shlex
import subprocess
from pathlib import Path

import pytest
import yaml

from edqn_jax.cli.train import parse_train
from edqn_jax.devices.launch import how_to_join

PAGE = (Path(__file__).parents[2] / "docs" / "cluster.md").read_text(encoding="utf-8")


def block(language: str) -> str:
    """The only code block of a language."""
    (found,) = re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)
    return found


def flags(command: str, **variables: str) -> list[str]:
    """What a shell would hand to `train.py` of a command that calls it."""
    for name, value in variables.items():
        command = command.replace(f"${name}", value)
    words = shlex.split(command, comments=True)
    return words[words.index("train.py") + 1 :]


def joins(argv: list[str]) -> dict | None:
    options, _ = parse_train(argv)
    several = options.coordinator_address, options.num_processes, options.process_id
    return how_to_join(options.distributed, *several, {})


@pytest.mark.parametrize("number", ["0", "1"])
def test_the_loop_starts_two_processes_that_join(number: str) -> None:
    (line,) = [line for line in block("sh").splitlines() if "train.py" in line]
    arguments = joins(flags(line.removesuffix("&"), i=number))
    assert arguments is not None and (arguments["process_id"], arguments["num_processes"]) == (int(number), 2)


def test_the_slurm_script_is_a_script_and_leaves_the_joining_to_srun() -> None:
    subprocess.run(["bash", "-n"], input=block("bash"), text=True, check=True)
    (line,) = [line for line in block("bash").splitlines() if line.startswith("srun")]
    assert joins(flags(line, SLURM_JOB_ID="7")) is None


def test_the_names_in_the_manifest_go_together() -> None:
    service, job = yaml.safe_load_all(block("yaml"))
    spec = job["spec"]
    pod = spec["template"]["spec"]
    (container,) = pod["containers"]
    (command,) = container["args"]
    assert service["spec"]["clusterIP"] == "None"
    assert service["spec"]["selector"] == {"job-name": job["metadata"]["name"]}
    assert pod["subdomain"] == service["metadata"]["name"]
    arguments = joins(flags(command, JOB_COMPLETION_INDEX="1"))
    assert arguments is not None
    assert arguments["coordinator_address"].split(":")[0] == f"{job['metadata']['name']}-0.{pod['subdomain']}"
    assert spec["completionMode"] == "Indexed"
    assert spec["completions"] == spec["parallelism"] == arguments["num_processes"]
    assert {mount["name"] for mount in container["volumeMounts"]} == {volume["name"] for volume in pod["volumes"]}
