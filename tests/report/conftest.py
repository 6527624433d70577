"""Worlds that pictures are made of."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import trimesh

from edqn_jax.sim.scene.mjcf import load_scene
from edqn_jax.sim.scene.scene import Scene
from tests.support.meshes import mesh_world


@pytest.fixture
def roofed(tmp_path: Path) -> Scene:
    """A world that is one mesh: a hall of 16 x 8 x 5 m, half a metre thick, in which start and goal are."""
    outer = trimesh.creation.box(bounds=[[2, 1, 0.5], [18, 9, 5.5]])
    inner = trimesh.creation.box(bounds=[[2.5, 1.5, 1.0], [17.5, 8.5, 5.0]])
    vertices = np.concatenate([outer.vertices, inner.vertices])
    faces = np.concatenate([outer.faces, inner.faces[:, ::-1] + 8])
    scene = load_scene(mesh_world(tmp_path, '<geom type="mesh" mesh="hall"/>', hall=(vertices, faces)))
    return dataclasses.replace(scene, start=np.array([4.0, 5.0, 2.5]), goal=np.array([16.0, 5.0, 3.0]))
