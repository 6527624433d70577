/* Constants of the camera in Python that the camera in C reads; `tests/sim/camera/test_native.py` holds them equal. */

#ifndef EDQN_CONSTANTS_H
#define EDQN_CONSTANTS_H

#define TINY 1e-9f                /* scene/shapes/kind.py */
#define HORIZON_M 1e5f            /* scene/shapes/plane.py */
#define NEAR_M 0.05f              /* coverage.py, as the next three */
#define FAR_U 1e3f
#define LEVEL_FACE 1e9f
#define DEPTH_OF_LAYERS 3
#define MOST_PLANES 8             /* native.py */
#define CLEAR_M 0.01f             /* shadows.py */
#define EDGE 0.015625f            /* surfaces.py, as the next */
#define OVERTONE 0.5f
#define SURFACE_NUMBERS 22        /* scene/surface.py, as the rest */
#define KIND 0
#define CONTRAST 1
#define SHARES 2
#define PHASES 6

#endif
