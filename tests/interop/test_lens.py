"""Lenses: where pixels look by OpenCV's documented formulas, and calibration files of Kalibr and DSEC."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from edqn_jax.errors import ConfigError
from edqn_jax.interop.deployment.runner import Grid
from edqn_jax.interop.recordings.lens import Lens, read_lens

MATRIX = (250.0, 255.0, 172.0, 133.0)
RADTAN = (-0.36, 0.15, 0.0006, -0.0004)
FISHEYE = (-0.02, 0.004, -0.003, 0.0005)

KALIBR = """
cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.36, 0.15, 0.0006, -0.0004]
  distortion_model: radtan
  intrinsics: [250.0, 255.0, 172.0, 133.0]
  resolution: [346, 260]
  rostopic: /dvs/image_raw
cam1:
  camera_model: pinhole
  distortion_coeffs: [-0.02, 0.004, -0.003, 0.0005]
  distortion_model: equidistant
  intrinsics: [250.0, 255.0, 172.0, 133.0]
  resolution: [346, 260]
"""

DSEC = """
intrinsics:
  cam0:
    camera_matrix: [553.4, 553.4, 346.6, 216.5]
    distortion_coeffs: [-0.09, 0.19, -0.0003, 0.0002]
    distortion_model: radtan
    resolution: [640, 480]
  camRect0:
    camera_matrix: [569.7, 569.7, 335.0, 221.2]
    resolution: [640, 480]
extrinsics:
  T_10: [[1, 0, 0, 0.04], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
"""


def plain_radtan(a: float, b: float, k1: float, k2: float, p1: float, p2: float) -> tuple[float, float]:
    """OpenCV's page 'Camera Calibration and 3D Reconstruction', with k3 to k6 and s1 to s4 of 0."""
    r2 = a**2 + b**2
    radial = 1 + k1 * r2 + k2 * r2**2
    return a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a**2), b * radial + p1 * (r2 + 2 * b**2) + 2 * p2 * a * b


def plain_fisheye(a: float, b: float, k1: float, k2: float, k3: float, k4: float) -> tuple[float, float]:
    """OpenCV's page 'Fisheye camera model'."""
    r = math.sqrt(a**2 + b**2)
    theta = math.atan(r)
    bent = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)
    return bent / r * a, bent / r * b


@pytest.mark.parametrize(
    ("model", "terms", "plain"), [("radtan", RADTAN, plain_radtan), ("equidistant", FISHEYE, plain_fisheye)]
)
def test_what_a_pixel_looks_at_is_seen_in_that_pixel(model, terms, plain):
    towards = Lens((346, 260), MATRIX, model, terms).directions()
    assert towards.shape == (260, 346, 2) and np.isfinite(towards).mean() > 0.99
    fx, fy, cx, cy = MATRIX
    for row, column in np.random.default_rng(0).integers(0, (260, 346), (500, 2)):
        a, b = towards[row, column]
        x, y = plain(a, b, *terms)
        assert (fx * x + cx, fy * y + cy) == pytest.approx((column, row), abs=1e-6)
        assert a * (column - cx) >= 0.0 or abs(column - cx) < 2  # the near one of several solutions


def test_pixels_beyond_what_a_model_describes_look_nowhere():
    towards = Lens((346, 260), (80.0, 80.0, 172.0, 133.0), "radtan", (-0.3, 0.0, 0.0, 0.0)).directions()
    assert np.isnan(towards[0, 0]).all() and np.isfinite(towards[133, 172]).all()
    wide = Lens((346, 260), (80.0, 80.0, 172.0, 133.0), "equidistant", (0.0,) * 4).directions()
    assert np.isnan(wide[0, 0]).all()  # 2.6 rad from ahead
    np.testing.assert_allclose(wide[133, 172 + 60], [np.tan(0.75), 0.0], atol=1e-9)


def test_files_of_kalibr_and_dsec_are_read(tmp_path: Path):
    (tmp_path / "k.yaml").write_text(KALIBR)
    (tmp_path / "d.yaml").write_text(DSEC)
    assert read_lens(str(tmp_path / "k.yaml")) == Lens((346, 260), MATRIX, "radtan", RADTAN)
    assert read_lens(f"{tmp_path / 'k.yaml'}:cam1") == Lens((346, 260), MATRIX, "equidistant", FISHEYE)
    dsec = read_lens(str(tmp_path / "d.yaml"))
    assert (dsec.size, dsec.matrix[2], dsec.coefficients[1]) == ((640, 480), 346.6, 0.19)


@pytest.mark.parametrize(
    ("text", "camera", "says"),
    [
        (None, "", "there is no calibration"),
        ("a: [", "", "is no YAML"),
        ("a: 1", "", "describes none as Kalibr or DSEC do"),
        (KALIBR, ":cam7", "has no camera 'cam7': it has cam0, cam1"),
        (KALIBR.replace("pinhole", "omni"), "", "has the models omni and radtan"),
        (KALIBR.replace("[250.0, 255.0, 172.0, 133.0]", "[250.0, 255.0]"), "", "fx, fy, cx, cy"),
        (KALIBR.replace(", -0.0004]", "]"), "", "as many coefficients as radtan has"),
        (KALIBR.replace("  resolution: [346, 260]", ""), "", "must have a resolution"),
    ],
)
def test_what_is_no_calibration_is_one_sentence(tmp_path: Path, text: str | None, camera: str, says: str):
    if text is not None:
        (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(ConfigError, match=says):
        read_lens(f"{tmp_path / 'a.yaml'}{camera}")


ABOUT = {"width": 32, "height": 24, "horizontal_fov_deg": 60.0}


def test_a_lens_without_distortion_gives_the_grid_of_its_field_of_view():
    fov = math.radians(80.0)
    focal = 173.0 / math.tan(fov / 2)
    plain = Lens((346, 260), (focal, focal, 172.5, 129.5), "none", (0.0,))
    of_lens, of_fov = Grid.of(ABOUT, (346, 260), directions=plain.directions()), Grid.of(ABOUT, (346, 260), 80.0)
    assert np.mean(of_lens.cells != of_fov.cells) < 1e-3  # of pixels on an edge


def test_the_grid_of_a_lens_counts_its_own_pixels_and_leaves_out_what_looks_nowhere():
    bent = Lens((346, 260), MATRIX, "radtan", RADTAN)
    grid = Grid.of(ABOUT, (346, 260), directions=bent.directions())
    row, column = 30, 40
    a, b = bent.directions()[row, column]
    half = math.tan(math.radians(30.0))
    wanted = (math.floor(b * 16 / half + 12), math.floor(a * 16 / half + 16))
    inside = 0 <= wanted[0] < 24 and 0 <= wanted[1] < 32
    assert grid.cells[row, column] == (wanted[0] * 32 + wanted[1] if inside else -1)
    assert grid.pixels.sum() == np.sum(grid.cells >= 0) and grid.pixels.min() >= 1
    nowhere = np.full((260, 346, 2), np.nan)
    nowhere[100:160, 100:200] = bent.directions()[100:160, 100:200]
    part = Grid.of(ABOUT, (346, 260), directions=nowhere)
    assert (part.cells[0] == -1).all() and part.cells[130, 150] == grid.cells[130, 150]


def test_directions_of_another_camera_are_refused():
    with pytest.raises(ValueError, match="260 x 346 x 2 of them for a camera of 346 x 260 pixels, not 4 x 4 x 2"):
        Grid.of(ABOUT, (346, 260), directions=np.zeros((4, 4, 2)))
    with pytest.raises(ValueError, match="without camera_fov_deg"):
        Grid.of(ABOUT, (4, 4), 60.0, np.zeros((4, 4, 2)))
    with pytest.raises(ValueError, match="has fewer in the policy's view"):
        Grid.of(ABOUT, (4, 4), directions=Lens((4, 4), (3.0, 3.0, 1.5, 1.5), "none", ()).directions())
