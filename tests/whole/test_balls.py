"""A whole run in worlds in which balls are thrown: trained on two devices, flown, drawn, verified by C MuJoCo."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from edqn_jax.config import WorldConfig
from edqn_jax.evaluation.missions import run_missions
from edqn_jax.interop.recordings.flight_events import flight_recording
from edqn_jax.report.gallery import prepare_gallery
from edqn_jax.runs.directory import RunDirectory
from edqn_jax.runs.record import train_run
from edqn_jax.runs.stopping import Stop
from edqn_jax.runs.verification.verify import verify_run
from edqn_jax.training.progress import Progress
from tests.support.configs import TINY_RUN

WORLD = WorldConfig(name="sparse", flown="", pool_size=2, missions=8, balls=3)
BALLS = dataclasses.replace(TINY_RUN, world=WORLD, train=dataclasses.replace(TINY_RUN.train, devices=2))


@pytest.mark.slow
def test_a_run_among_balls_is_drawn_and_verified(tmp_path: Path) -> None:
    run = RunDirectory(tmp_path / "run")
    train_run(BALLS, run, Progress(), Stop(), drawing=prepare_gallery)
    summary = json.loads(run.summary_file.read_text())
    assert [finding for finding in verify_run(run.path) if not finding.right] == []
    assert summary["devices"][1] and (run.figures / "path.png").is_file()
    flown = {name: np.asarray(column) for name, column in run.read_trajectory().items()}
    mission = run_missions(BALLS).final.env_params
    one = dataclasses.replace(mission, missions=_first(mission.missions))
    assert len(flight_recording(BALLS, one, flown).events)


def _first(missions):
    return dataclasses.replace(missions, start=missions.start[:1], goal=missions.goal[:1], scene=missions.scene[:1])
