"""The compiled least-squares iteration behind :func:`fluoromap.monoplane.body_pose.solve_poses`.

Float64, because exact pixels must give the pose of thirty points to nanometres. Importing this module loads numba and its
first call compiles: import it where it is used.
"""

import numpy as np
from numba import njit

_NEAREST_MM = 1.0
_BEHIND_SOURCE = 1e300
_CONVERGED = 1e-9


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _normal_equations(focal, model, offsets, turn, centre, rows, normal):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Fill the lower half of the 7x7 ``normal`` and return r'r.

    It holds J'J, below it J'r, in the corner r'r.
    """
    m = model.shape[1]
    nearest = 2 * _NEAREST_MM
    for i in range(m):
        a, b, c = model[0, i], model[1, i], model[2, i]
        x = turn[0, 0] * a + turn[0, 1] * b + turn[0, 2] * c
        y = turn[1, 0] * a + turn[1, 1] * b + turn[1, 2] * c
        z = turn[2, 0] * a + turn[2, 1] * b + turn[2, 2] * c
        depth = z + centre[2]
        nearest = min(nearest, depth)
        scale = 1.0 / depth
        u = (focal[0] * (x + centre[0]) + focal[1] * (y + centre[1])) * scale
        v = focal[2] * (y + centre[1]) * scale
        # Gradients of u and v by translation; the gradients by rotation are the lever (x, y, z) crossed with them.
        ux, uy, uz = focal[0] * scale, focal[1] * scale, -u * scale
        vy, vz = focal[2] * scale, -v * scale
        j = m + i
        rows[0, i], rows[1, i], rows[2, i] = y * uz - z * uy, z * ux - x * uz, x * uy - y * ux
        rows[3, i], rows[4, i], rows[5, i] = ux, uy, uz
        rows[6, i] = offsets[i, 0] - u
        rows[0, j], rows[1, j], rows[2, j] = y * vz - z * vy, -x * vz, x * vy
        rows[3, j], rows[4, j], rows[5, j] = 0.0, vy, vz
        rows[6, j] = offsets[i, 1] - v
    if nearest < _NEAREST_MM:
        return _BEHIND_SOURCE
    for p in range(7):
        for q in range(p + 1):
            total = 0.0
            for i in range(2 * m):
                total += rows[p, i] * rows[q, i]
            normal[p, q] = total
    return normal[6, 6]


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _step(normal, damping, factor, step):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Solve the damped 6x6 system by Cholesky.

    Return the expected fall of the cost, or -1 where it is singular.
    """
    falls = 0.0
    for p in range(7):
        for q in range(min(p + 1, 6)):
            total = normal[p, q]
            if p == q:
                total += damping * (normal[p, p] + 1e-9)
                floor = 1e-15 * normal[p, p]
            for k in range(q):
                total -= factor[p, k] * factor[q, k]
            if p == q:
                if total <= floor:
                    return -1.0
                factor[p, p] = np.sqrt(total)
            else:
                factor[p, q] = total / factor[q, q]
                if p == 6:
                    falls += factor[6, q] ** 2
    for p in range(5, -1, -1):
        total = factor[6, p]
        for k in range(p + 1, 6):
            total -= factor[k, p] * step[k]
        step[p] = total / factor[p, p]
    return falls


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _apply_step(step, turn, centre, trial_turn, trial_centre):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Write exp([w]x) R and c + t of a step (w, t) into ``trial_turn`` and ``trial_centre``."""
    x, y, z = step[0], step[1], step[2]
    squared = x * x + y * y + z * z
    angle = np.sqrt(squared)
    if angle < 1e-4:
        s, c = 1.0 - squared / 6.0, 0.5 - squared / 24.0
    else:
        s, c = np.sin(angle) / angle, (1.0 - np.cos(angle)) / squared
    for k in range(3):
        a, b, d = turn[0, k], turn[1, k], turn[2, k]
        along = c * (x * a + y * b + z * d)
        stays = 1.0 - c * squared
        trial_turn[0, k] = stays * a + s * (y * d - z * b) + along * x
        trial_turn[1, k] = stays * b + s * (z * a - x * d) + along * y
        trial_turn[2, k] = stays * d + s * (x * b - y * a) + along * z
        trial_centre[k] = centre[k] + step[3 + k]


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def solve_batch(focal, model, offsets, turns, centres, iterations):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Run Levenberg-Marquardt for each of B images.

    Overwrite the start in ``turns`` and ``centres`` by the result.

    focal : (3,) of u over x, u over y, v over y, px. model : (3, m) mm. offsets : (B, m, 2) pixels minus the principal
    point. turns : (B, 3, 3) and centres : (B, 3) in the camera's axes, depth last. A turn that is a reflection stays one.
    """
    rows, factor, step = np.empty((7, 2 * model.shape[1])), np.empty((7, 6)), np.zeros(6)
    normal, trial_normal = np.empty((7, 7)), np.empty((7, 7))
    trial_turn, trial_centre = np.empty((3, 3)), np.empty(3)
    for image in range(offsets.shape[0]):
        turn, centre = turns[image], centres[image]
        for p in range(6):
            step[p] = 0.0
        cost, falls, damping = _BEHIND_SOURCE, 0.0, 1e-7
        # The first round has no step: it computes the cost of the start.
        for _ in range(iterations + 1):
            _apply_step(step, turn, centre, trial_turn, trial_centre)
            trial = _normal_equations(focal, model, offsets[image], trial_turn, trial_centre, rows, trial_normal)
            if trial <= cost and trial < _BEHIND_SOURCE:
                for p in range(3):
                    centre[p] = trial_centre[p]
                    for q in range(3):
                        turn[p, q] = trial_turn[p, q]
                normal, trial_normal = trial_normal, normal
                if falls > 0.0 and falls <= _CONVERGED * cost:
                    break
                cost = trial
                damping *= 0.1
            elif cost == _BEHIND_SOURCE:
                break
            else:
                damping *= 100.0
            falls = _step(normal, damping, factor, step)
            while falls < 0.0:
                damping *= 100.0
                falls = _step(normal, damping, factor, step)
