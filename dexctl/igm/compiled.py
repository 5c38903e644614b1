"""The in-grasp step as one compiled loop (numba, extra `fast`): the same sums as `plain.py`.

A step is some thousand multiplications; called array by array, numpy spends ten times longer on
the calls than on the sums. Installed with the extra `fast`, controllers take this path by
themselves, for one hand and for batches; tests hold it to the plain path.
"""

from __future__ import annotations

import numpy as np
from numba import njit, types

TOLERANCE = 1e-9  # on variables, as in dexctl.grasp.box_qp
ROUNDS = 300  # as there
TIE, LOST, DUAL = 1e-11, 4e-15, 1e-15  # as in dexctl.grasp.stability_solver
UNIT_TOLERANCE, FARTHEST, FALLEN = 0.02, 1e3, 1e7  # as in dexctl.controller
SHORTEST = 1e-3  # floor of the characteristic length [m]
FREE, LOWER, UPPER = 0, -1, 1


def _compiled(signature=None):
    """`njit`, kept on disk between runs where a folder for it can be written."""

    def decorate(function):
        try:
            return njit(signature, cache=True, nogil=True)(function)
        except RuntimeError:  # numba found no place for its cache
            return njit(signature, nogil=True)(function)

    return decorate


@_compiled()
def _box(hessian, linear, lower, upper, c, j, at, rows, tolerance):
    """Principal pivoting for one box QP, in place (see box_qp).

    ``c`` is the solution without bounds where c_j is held at one; j is -1 for none.
    """
    k = len(c)
    free = np.empty(k, np.int64)
    at[:] = FREE
    if j >= 0:
        at[j] = UPPER
    for count in range(ROUNDS):
        width = 0
        for i in range(k):
            if at[i] == FREE:
                free[width] = i
                width += 1
        for a in range(width if count else 0):
            line = hessian[free[a]]
            right = linear
            for m in range(k):
                if at[m] != FREE:
                    right -= line[m] * c[m]
            for b in range(width):
                rows[a, b] = line[free[b]]
            rows[a, width] = right
            for b in range(a):
                factor = rows[a, b] / rows[b, b]
                for m in range(b + 1, width + 1):
                    rows[a, m] -= factor * rows[b, m]
        for a in range(width - 1 if count else -1, -1, -1):
            value = rows[a, width]
            for m in range(a + 1, width):
                value -= rows[a, m] * c[free[m]]
            c[free[a]] = value / rows[a, a]
        pick, worst, move = -1, 0.0, FREE
        for i in range(k):
            if at[i] == FREE:
                excess = max(c[i] - upper[i], lower[i] - c[i])
                side = UPPER if c[i] > upper[i] else LOWER
                if excess <= TOLERANCE:
                    continue
            else:
                if upper[i] == lower[i]:
                    continue
                multiplier = -linear
                for m in range(k):
                    multiplier += hessian[i, m] * c[m]
                excess = at[i] * multiplier
                side = FREE
                if excess <= tolerance:
                    continue
                excess /= linear
            if pick < 0 or (excess > worst and count < 3 * k + 4):
                pick, worst, move = i, excess, side
        if pick < 0:
            break
        at[pick] = move
        if move != FREE:
            c[pick] = upper[pick] if move == UPPER else lower[pick]
    for i in range(k):
        c[i] = min(max(c[i], lower[i]), upper[i])


@_compiled()
def _invert(matrix, k):
    """Inverse of the symmetric positive definite (k, k) matrix, by Cholesky."""
    low = np.zeros((k, k))
    for i in range(k):
        for j in range(i + 1):
            total = matrix[i, j]
            for c in range(j):
                total -= low[i, c] * low[j, c]
            low[i, j] = np.sqrt(total) if i == j else total / low[j, j]
    for i in range(k):  # low becomes its own inverse
        low[i, i] = 1.0 / low[i, i]
        for j in range(i):
            total = 0.0
            for c in range(j, i):
                total -= low[i, c] * low[c, j]
            low[i, j] = total * low[i, i]
    out = np.empty((k, k))
    for i in range(k):
        for j in range(i + 1):
            total = 0.0
            for c in range(i, k):
                total += low[c, i] * low[c, j]
            out[i, j] = total
            out[j, i] = total
    return out


@_compiled()
def _stable_forces(wrench, active, k, low, high, rho, forces):
    """The stability QP of one hand into ``forces`` (m,); returns the contact held at one."""
    forces[:] = 0.0
    if k == 0:
        return -1
    gram = np.empty((k, k))
    lower, upper = np.empty(k), np.empty(k)
    for a in range(k):
        i = active[a]
        lower[a], upper[a] = low[i], high[i]
        for b in range(a + 1):
            total = 0.0
            for c in range(6):
                total += wrench[i, c] * wrench[active[b], c]
            gram[a, b] = total
            gram[b, a] = total
        gram[a, a] += rho
    table = _invert(gram, k)
    free = np.zeros(k)
    size = 0.0
    any_one = False
    for a in range(k):
        size = max(size, gram[a, a])
        any_one = any_one or upper[a] == 1.0
        for b in range(k):
            table[a, b] *= rho
            free[a] += table[a, b]
    at, rows = np.empty(k, np.int64), np.empty((k, k + 1))
    dual = TOLERANCE * rho + DUAL * size
    if not any_one:
        _box(gram, rho, lower, upper, free, -1, at, rows, dual)
        for a in range(k):
            forces[active[a]] = free[a]
        return -1
    # in objectives over rho: room for what round-off does to closed forms, and for equal ones
    lost, tie = LOST * k * k * size / rho, TIE * size / rho
    bound, value = np.full(k, np.inf), np.full(k, np.inf)
    found = np.empty((k, k))
    for j in range(k):
        if upper[j] == 1.0:
            bound[j] = k - free.sum() + (1.0 - free[j]) ** 2 / table[j, j]
    best = np.inf
    for turn in range(k + 1):  # the lowest bound first
        j = np.argmin(bound) if turn == 0 else turn - 1
        if value[j] < np.inf or bound[j] == np.inf:
            continue
        if bound[j] > best + tie + lost * (1.0 + best):
            continue
        c = found[j]
        step = (1.0 - free[j]) / table[j, j]
        for a in range(k):
            c[a] = free[a] + step * table[j, a]
        c[j] = 1.0
        least = lower[j]
        lower[j] = 1.0
        _box(gram, rho, lower, upper, c, j, at, rows, dual)
        lower[j] = least
        total = 0.0
        for a in range(k):
            line = 0.0
            for b in range(k):
                line += gram[a, b] * c[b]
            total += c[a] * (line / rho - 2.0) + 1.0
        value[j] = total
        best = min(best, total)
    for j in range(k):
        if value[j] <= best + tie:
            for a in range(k):
                forces[active[a]] = found[j, a]
            return active[j]
    return -1


@_compiled()
def _way(
    axle,
    k,
    joints,
    q,
    joint_limits,
    lever,
    origin,
    twist,
    normal,
    tip,
    damping,
    reach_margin,
    link_limit,
    q_target,
    column,
    rate,
):
    """As in `reach.Reach`, for a finger of ``k`` joints: how far it can go along the wanted twist
    [m], what it pushes along its turn, and what it presses with, by the speed of that.
    """
    x, y, z = lever[0] + origin[0], lever[1] + origin[1], lever[2] + origin[2]
    vx = twist[0] + twist[4] * lever[2] - twist[5] * lever[1]
    vy = twist[1] + twist[5] * lever[0] - twist[3] * lever[2]
    vz = twist[2] + twist[3] * lever[1] - twist[4] * lever[0]
    speed = np.sqrt(vx * vx + vy * vy + vz * vz)
    if speed <= 1e-9:
        return np.inf, 0.0, 0.0
    xx = yy = zz = damping**2
    xy = xz = yz = 0.0
    for j in range(k):
        lx, ly, lz, wx, wy, wz = axle[j]
        rx, ry, rz = lx + wy * z - wz * y, ly + wz * x - wx * z, lz + wx * y - wy * x
        column[j, 0], column[j, 1], column[j, 2] = rx, ry, rz
        xx += rx * rx
        yy += ry * ry
        zz += rz * rz
        xy += rx * ry
        xz += rx * rz
        yz += ry * rz
    c00, c01, c02 = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    c11, c12, c22 = xx * zz - xz * xz, xy * xz - yz * xx, xx * yy - xy * xy
    share = 1.0 / (xx * c00 + xy * c01 + xz * c02)
    sx = (c00 * vx + c01 * vy + c02 * vz) * share
    sy = (c01 * vx + c11 * vy + c12 * vz) * share
    sz = (c02 * vx + c12 * vy + c22 * vz) * share
    size = sx * vx + sy * vy + sz * vz
    time = np.inf
    px = py = pz = 0.0  # velocity of the contact
    ix = iy = iz = 0.0  # how far its set-point is ahead
    for j in range(k):
        rate[j] = column[j, 0] * sx + column[j, 1] * sy + column[j, 2] * sz
        px += rate[j] * column[j, 0]
        py += rate[j] * column[j, 1]
        pz += rate[j] * column[j, 2]
        lead = q_target[joints[j]] - q[joints[j]]
        ix += lead * column[j, 0]
        iy += lead * column[j, 1]
        iz += lead * column[j, 2]
        if rate[j] != 0.0:
            end = joint_limits[1 if rate[j] > 0 else 0, joints[j]]
            time = min(time, (end - q[joints[j]]) / rate[j])
    growth = 0.0
    ax = ay = az = bx = by = bz = 0.0  # twist of what carries the joint: linear, angular
    for j in range(k):
        lx, ly, lz, wx, wy, wz = axle[j]
        # the joint's axis, carried along
        dx = by * wz - bz * wy
        dy = bz * wx - bx * wz
        dz = bx * wy - by * wx
        cx = by * lz - bz * ly + ay * wz - az * wy + dy * z - dz * y
        cy = bz * lx - bx * lz + az * wx - ax * wz + dz * x - dx * z
        cz = bx * ly - by * lx + ax * wy - ay * wx + dx * y - dy * x
        cx += wy * pz - wz * py
        cy += wz * px - wx * pz
        cz += wx * py - wy * px
        growth -= 2.0 * rate[j] * (cx * sx + cy * sy + cz * sz)
        ax += rate[j] * lx
        ay += rate[j] * ly
        az += rate[j] * lz
        bx += rate[j] * wx
        by += rate[j] * wy
        bz += rate[j] * wz
    if growth > 0.0:
        time = min(time, size / growth)
    way = speed * time - reach_margin
    lx, ly, lz, wx, wy, wz = axle[k - 1]
    mx = lx + wy * tip[2] - wz * tip[1]
    my = ly + wz * tip[0] - wx * tip[2]
    mz = lz + wx * tip[1] - wy * tip[0]
    ex, ey, ez = wy * mz - wz * my, wz * mx - wx * mz, wx * my - wy * mx
    length = max(np.sqrt(ex * ex + ey * ey + ez * ez), 1e-12)
    lean = (normal[0] * ex + normal[1] * ey + normal[2] * ez) / length
    rolling = (twist[3] - bx) * (normal[1] * ez - normal[2] * ey)
    rolling += (twist[4] - by) * (normal[2] * ex - normal[0] * ez)
    rolling += (twist[5] - bz) * (normal[0] * ey - normal[1] * ex)
    rolling /= length
    if rolling > 0.0:
        way = min(way, speed * (link_limit - lean) / rolling)
    fx = (c00 * ix + c01 * iy + c02 * iz) * share
    fy = (c01 * ix + c11 * iy + c12 * iz) * share
    fz = (c02 * ix + c12 * iy + c22 * iz) * share
    vx = twist[4] * lever[2] - twist[5] * lever[1]
    vy = twist[5] * lever[0] - twist[3] * lever[2]
    vz = twist[3] * lever[1] - twist[4] * lever[0]
    pressed = max(fx * normal[0] + fy * normal[1] + fz * normal[2], 0.0)
    pressed *= np.sqrt(vx * vx + vy * vy + vz * vz)
    return way, fx * vx + fy * vy + fz * vz, pressed


def _read(kind, dimensions):
    """An array that is only read, however it lies in memory: one signature takes them all."""
    return types.Array(kind, dimensions, "A", readonly=True)


_F1, _F2, _F3, _F4 = (_read(types.float64, n) for n in (1, 2, 3, 4))
_I1, _I2 = (_read(types.int64, n) for n in (1, 2))
_B1, _B2 = (_read(types.boolean, n) for n in (1, 2))
# with its signature given it is compiled when imported, not in the middle of a control loop
_HAND_AND_CONTACTS = (_F4, _F3, _I2, _I1, _F2, _F2, _B2, _B2, _F3, _F3, _F2)
_OBJECT_AND_WANTED = (_F2, _F2, _F2, _F2, _B1, _F2, _F2, _F2)
_SETTINGS = (_F1, types.UniTuple(types.float64, 19), _F2)


@_compiled((_F1, _F1, _F2, _F2, _F1, _B1, _F1, _F1))
def sound(q, q_target, position, normal, force, touch, object_position, quaternion):
    """Whether the state of one hand moves no motor wrongly: see `dexctl.controller.check_sound`."""
    size = 0.0
    for i in range(len(q)):
        size += q[i] ** 2 + q_target[i] ** 2
    square = 0.0
    for c in range(3):
        square += object_position[c] ** 2
    if not (size <= FARTHEST**2 and square <= FALLEN**2):
        return False
    square = 0.0
    for c in range(4):
        square += quaternion[c] ** 2
    if not abs(square - 1.0) <= UNIT_TOLERANCE:
        return False
    for i in range(len(touch)):
        if touch[i]:
            square, far = 0.0, force[i]
            for c in range(3):
                square += normal[i, c] ** 2
                far += position[i, c] ** 2
            unit = abs(square - 1.0) <= UNIT_TOLERANCE
            if not (unit and far <= FARTHEST**2 and force[i] >= 0.0):
                return False
    return True


@_compiled((*_HAND_AND_CONTACTS, *_OBJECT_AND_WANTED, *_SETTINGS))
def in_grasp_step(
    finger_twist,
    tips,
    joints,
    counts,
    q,
    q_target,
    touch,
    closing,
    position,
    normal,
    force,
    object_position,
    object_quaternion,
    reference_position,
    reference_axis,
    known,
    wanted,
    max_force,
    yielding,
    axis,
    settings,
    joint_limits,
):
    """N in-grasp steps; arguments and results as in `plain.in_grasp_step`, with N in front.

    ``object_position`` and ``object_quaternion`` have no rows where nothing tracks the object.
    """
    count, m = touch.shape
    n = joints.shape[1]
    (grip, gain, rho, least, friction, length, damping, dt) = settings[:8]
    (height_gain, centring_gain, tilt_gain, closing_speed, closing_lead) = settings[8:13]
    (max_lead, reach_distance, reach_margin, link_limit, slip_limit, slip_way) = settings[13:]
    change = np.zeros(q.shape)
    desired = np.zeros((count, m))
    residual = np.zeros(count)
    held = np.empty(count, np.int64)
    origin = np.zeros((count, 3))
    reach = np.ones(count)
    lever, push, wrench = np.empty((m, 3)), np.zeros((m, 3)), np.zeros((m, 6))
    active, low, high = np.empty(m, np.int64), np.empty(m), np.empty(m)
    nothing, rate = np.zeros(3), np.empty(n)
    jacobian, velocity, twist = np.empty((n, 3)), np.empty(3), np.empty(6)
    tracked, oriented = len(object_position) > 0, len(object_quaternion) > 0

    for e in range(count):
        k = 0
        for i in range(m):
            if touch[e, i]:
                active[k] = i
                k += 1
        for c in range(3):
            if tracked:
                origin[e, c] = object_position[e, c]
            elif k > 0:
                for a in range(k):
                    origin[e, c] += position[e, active[a], c] / k
            else:
                for i in range(m):
                    origin[e, c] += tips[e, i, c] / m
        # unit wrenches of the pushes
        mean = 0.0
        for i in range(m):
            square, along = 0.0, 0.0
            for c in range(3):
                lever[i, c] = (position[e, i, c] if touch[e, i] else tips[e, i, c]) - origin[e, c]
                push[i, c] = 0.0
                if touch[e, i]:
                    square += lever[i, c] ** 2
                    along -= lever[i, c] * normal[e, i, c]
            low[i] = high[i] = 0.0
            if not touch[e, i]:
                continue
            mean += np.sqrt(square) / k
            high[i] = max_force[e, i]
            low[i] = min(least, high[i])
            aside = 0.0
            for c in range(3):
                aside += (-lever[i, c] - along * normal[e, i, c]) ** 2
            size = np.sqrt(aside)
            slope = min(size / max(along, 1e-9), friction)
            for c in range(3):
                push[i, c] = normal[e, i, c]
                if friction > 0:
                    towards = -lever[i, c] - along * normal[e, i, c]
                    push[i, c] += slope * towards / max(size, 1e-9)
                    push[i, c] /= np.sqrt(1.0 + slope * slope)
        scale = 1.0 / (length if length > 0 else max(mean, SHORTEST))
        for a in range(k):
            i = active[a]
            for c in range(3):
                u, v = (c + 1) % 3, (c + 2) % 3
                wrench[i, c] = push[i, c]
                wrench[i, 3 + c] = (lever[i, u] * push[i, v] - lever[i, v] * push[i, u]) * scale
        held[e] = _stable_forces(wrench, active, k, low, high, rho, desired[e])
        square = 0.0
        for c in range(6):
            net = 0.0
            for a in range(k):
                net += desired[e, active[a]] * wrench[active[a], c]
            square += net * net
        residual[e] = np.sqrt(square)

        # wanted twist, and what pulls the object back to where it was
        for c in range(6):
            twist[c] = wanted[e, c]
        if reach_distance > 0:
            pushed = bears = 0.0
            for i in range(m):
                if touch[e, i] or closing[e, i]:
                    way, along, pressed = _way(
                        finger_twist[e, i],
                        counts[i],
                        joints[i],
                        q[e],
                        joint_limits,
                        lever[i],
                        origin[e],
                        twist,
                        normal[e, i] if touch[e, i] else nothing,
                        tips[e, i],
                        damping,
                        reach_margin,
                        link_limit,
                        q_target[e],
                        jacobian,
                        rate,
                    )
                    reach[e] = min(reach[e], max(way / reach_distance, 0.0))
                    if touch[e, i]:
                        pushed += along
                        bears += pressed
            if slip_limit > 0 and pushed > 0:
                left = slip_limit * bears - pushed
                if left <= 0.0:
                    reach[e] = 0.0
                else:
                    reach[e] = min(reach[e], left / (slip_way * bears))
            for c in range(6):
                twist[c] *= reach[e]
        if known[e]:
            along = 0.0
            for c in range(3):
                along += (reference_position[e, c] - origin[e, c]) * axis[c]
            for c in range(3):
                off = reference_position[e, c] - origin[e, c]
                twist[c] += height_gain * along * axis[c] + centring_gain * (off - along * axis[c])
            if oriented and tilt_gain > 0:
                w, x, y, z = object_quaternion[e]
                bx, by, bz = reference_axis[e]
                tx = 2.0 * (y * bz - z * by)
                ty = 2.0 * (z * bx - x * bz)
                tz = 2.0 * (x * by - y * bx)
                cx = bx + w * tx + y * tz - z * ty
                cy = by + w * ty + z * tx - x * tz
                cz = bz + w * tz + x * ty - y * tx
                twist[3] += tilt_gain * (cy * axis[2] - cz * axis[1])
                twist[4] += tilt_gain * (cz * axis[0] - cx * axis[2])
                twist[5] += tilt_gain * (cx * axis[1] - cy * axis[0])

        fastest = 1.0
        for i in range(m):
            desired[e, i] *= grip
            if not (touch[e, i] or closing[e, i]):
                continue
            for j in range(counts[i]):
                t = finger_twist[e, i, j]
                for c in range(3):
                    u, v = (c + 1) % 3, (c + 2) % 3
                    pu, pv = lever[i, u] + origin[e, u], lever[i, v] + origin[e, v]
                    jacobian[j, c] = t[c] + t[3 + u] * pv - t[3 + v] * pu
            if touch[e, i]:
                press = gain * (desired[e, i] - force[e, i])
                for c in range(3):
                    velocity[c] = press * push[i, c]
                if yielding[e, i] > 0:
                    speed = -np.expm1(-yielding[e, i] * dt) / dt
                    for c in range(3):
                        for j in range(counts[i]):
                            lead = q_target[e, joints[i, j]] - q[e, joints[i, j]]
                            velocity[c] -= speed * lead * jacobian[j, c]
                for c in range(3):
                    u, v = (c + 1) % 3, (c + 2) % 3
                    velocity[c] += (
                        twist[c] + twist[3 + u] * lever[i, v] - twist[3 + v] * lever[i, u]
                    )
            else:
                along = 0.0
                for c in range(3):
                    along += lever[i, c] * axis[c]
                square = 0.0
                for c in range(3):
                    velocity[c] = lever[i, c] - along * axis[c]
                    square += velocity[c] ** 2
                size = max(np.sqrt(square), 1e-9)
                ahead = 0.0
                for j in range(counts[i]):
                    lead = q_target[e, joints[i, j]] - q[e, joints[i, j]]
                    for c in range(3):
                        ahead -= lead * jacobian[j, c] * velocity[c] / size
                speed = closing_speed * min(max(1.0 - ahead / closing_lead, -1.0), 1.0)
                for c in range(3):
                    velocity[c] *= -speed / size

            # dq = J^T (J J^T + damping^2 I)^-1 v dt, the 3 x 3 system by cofactors
            xx = yy = zz = damping**2
            xy = xz = yz = 0.0
            for j in range(counts[i]):
                rx, ry, rz = jacobian[j]
                xx += rx * rx
                yy += ry * ry
                zz += rz * rz
                xy += rx * ry
                xz += rx * rz
                yz += ry * rz
            c00, c01, c02 = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
            c11, c12, c22 = xx * zz - xz * xz, xy * xz - yz * xx, xx * yy - xy * xy
            vx, vy, vz = velocity
            share = dt / (xx * c00 + xy * c01 + xz * c02)
            sx = (c00 * vx + c01 * vy + c02 * vz) * share
            sy = (c01 * vx + c11 * vy + c12 * vz) * share
            sz = (c02 * vx + c12 * vy + c22 * vz) * share
            for j in range(counts[i]):
                move = jacobian[j, 0] * sx + jacobian[j, 1] * sy + jacobian[j, 2] * sz
                change[e, joints[i, j]] = move
                fastest = max(fastest, abs(move) / joint_limits[2, joints[i, j]])

        # limits of speed, of lead and of range, as in dexctl.limits
        for d in range(q.shape[1]):
            if change[e, d] == 0.0:
                continue
            lower, upper = joint_limits[0, d], joint_limits[1, d]
            goal = q_target[e, d] + change[e, d] / fastest
            bottom = min(max(q[e, d] - max_lead, lower), upper)
            top = min(q[e, d] + max_lead, upper)
            goal = max(min(max(goal, bottom), top), lower)
            step = joint_limits[2, d]
            change[e, d] = min(max(goal - q_target[e, d], -step), step)
    return change, desired, residual, held, origin, reach
