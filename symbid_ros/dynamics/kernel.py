"""Inertial columns of the regressor, compiled by Numba along the tree of links.

The arithmetic is that of :mod:`symbid_ros.dynamics.inertial_rows` in NumPy. Tiles of ``LANES``
samples pass from the base to the leaves, and every inner loop runs over the samples of a tile, so
that it compiles to SIMD instructions. A tile's arrays are one-dimensional, and their parts lie at
multiples of ``LANES``: from these constant distances the compiler sees that the parts do not
overlap. The forces of a link are multiplied by the axes of the joints between it and the base
alone. The result is *packed*: the structural zeros of K are not computed.

The functions allocate no memory and raise no error, so that their machine code runs without Numba:
:mod:`symbid_ros.dynamics.compiled_kernel` compiles and calls it.
"""

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numba import carray, types  # type: ignore[attr-defined]

from symbid_ros.dynamics.kernel_arrays import LANES, STATE, WRENCH, Loads, Motion, Tree, Windows

# Numbers in a cache line.
LINE = 8

# Places of a link's state in base axes: rotation (3, 3), origin, motion axis of its joint
# (angular, linear) about the base's origin, ω, ω̇, specific force of the origin, S(ω̇) + S(ω)².
ORIGIN, AXIS, ARM = 9 * LANES, 12 * LANES, 15 * LANES
OMEGA, ALPHA, FORCE, LEVER = 18 * LANES, 21 * LANES, 24 * LANES, 27 * LANES
# Places of a link's wrench per unit parameter: moments (3, 10), then forces (3, 4), because second
# moments need no force.
FORCES = 30 * LANES
STATES = STATE * LANES


def _compiled(function: Callable[..., Any]) -> Any:
    """Return a function compiled with fused multiply-add; NaN and infinity keep their meaning."""
    compiler: Any = numba.njit
    return compiler(fastmath={"contract", "nsz"}, error_model="numpy", nogil=True)(function)


@_compiled
def _vector(values, place, s):
    return values[place + s], values[place + LANES + s], values[place + 2 * LANES + s]


@_compiled
def _store(values, place, s, x, y, z):
    values[place + s] = x
    values[place + LANES + s] = y
    values[place + 2 * LANES + s] = z


@_compiled
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@_compiled
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@_compiled
def _multiply(matrix, place, s, v):
    """Return the product of a state's matrix with a vector."""
    return (
        _dot(_vector(matrix, place, s), v),
        _dot(_vector(matrix, place + 3 * LANES, s), v),
        _dot(_vector(matrix, place + 6 * LANES, s), v),
    )


@_compiled
def _sine_and_cosine(x):
    """Return sin x and cos x, to 2e-16 for |x| below 1e5.

    Numba's own call a library for one number at a time. The remainder of x by π/2 is exact to
    three parts of π/2; the polynomials are those of FreeBSD's msun (``k_sin.c``, ``k_cos.c``).
    """
    turn = np.rint(x * 0.6366197723675814)
    r = x - turn * 1.5707963267341256
    r -= turn * 6.077100506303966e-11
    r -= turn * 2.0222662487959506e-21
    z = r * r
    sine = 1.58969099521155010221e-10 * z - 2.50507602534068634195e-8
    sine = (sine * z + 2.75573137070700676789e-6) * z - 1.98412698298579493134e-4
    sine = (sine * z + 8.33333333332248946124e-3) * z - 1.66666666666666324348e-1
    sine = r + r * z * sine
    cosine = -1.13596475577881948265e-11 * z + 2.08757232129817482790e-9
    cosine = (cosine * z - 2.75573143513906633035e-7) * z + 2.48015872894767294178e-5
    cosine = (cosine * z - 1.38888888888741095749e-3) * z + 4.16666666666666019037e-2
    cosine = 1.0 - (0.5 * z - z * z * cosine)
    quadrant = turn - 4.0 * np.floor(0.25 * turn)
    is_odd = (quadrant == 1.0) | (quadrant == 3.0)
    first, second = (cosine, sine) if is_odd else (sine, cosine)
    first = -first if quadrant >= 2.0 else first
    second = -second if (quadrant == 1.0) | (quadrant == 2.0) else second
    return first, second


@_compiled
def _rotate(link, s, w, alpha):
    """Write ω, ω̇ and S(ω̇) + S(ω)² of a link."""
    (x, y, z), (a, b, c) = w, alpha
    _store(link, OMEGA, s, x, y, z)
    _store(link, ALPHA, s, a, b, c)
    _store(link, LEVER, s, -y * y - z * z, x * y - c, x * z + b)
    _store(link, LEVER + 3 * LANES, s, x * y + c, -x * x - z * z, y * z - a)
    _store(link, LEVER + 6 * LANES, s, x * z - b, y * z + a, -x * x - y * y)


@_compiled
def _place_base(base, motion, first, count):
    """Write the state of the base; lanes beyond ``count`` repeat the last sample."""
    for s in range(LANES):
        n = first + min(s, count - 1)
        for i in range(9):
            base[i * LANES + s] = 1.0 if i % 4 == 0 else 0.0
        for i in range(3):
            base[ORIGIN + i * LANES + s] = 0.0
            base[FORCE + i * LANES + s] = motion.force[n, i]
        w = motion.omega[n, 0], motion.omega[n, 1], motion.omega[n, 2]
        alpha = motion.alpha[n, 0], motion.alpha[n, 1], motion.alpha[n, 2]
        _rotate(base, s, w, alpha)


@_compiled
def _move_link(parent, child, tree, j, lanes):
    """Write the state of the link that joint j carries, from its parent's."""
    pose = tree.pose[j]
    turns = tree.revolute[j]
    slides = 1.0 - turns
    for s in range(LANES):
        x, y = _sine_and_cosine(lanes[s])
        for i in range(3):
            row = _vector(parent, 3 * i * LANES, s)
            for k in range(3):
                column = (
                    pose[k, 0] + pose[k, 1] * x + pose[k, 2] * y,
                    pose[5 + k, 0] + pose[5 + k, 1] * x + pose[5 + k, 2] * y,
                    pose[10 + k, 0] + pose[10 + k, 1] * x + pose[10 + k, 2] * y,
                )
                child[(3 * i + k) * LANES + s] = _dot(row, column)
    for s in range(LANES):
        z, v, a = _vector(lanes, 0, s)
        offset = (
            pose[3, 0] + pose[3, 3] * z,
            pose[8, 0] + pose[8, 3] * z,
            pose[13, 0] + pose[13, 3] * z,
        )
        lever = _multiply(parent, 0, s, offset)
        axis = _multiply(parent, 0, s, (pose[4, 0], pose[9, 0], pose[14, 0]))
        p, w = _vector(parent, ORIGIN, s), _vector(parent, OMEGA, s)
        alpha, force = _vector(parent, ALPHA, s), _vector(parent, FORCE, s)
        origin = p[0] + lever[0], p[1] + lever[1], p[2] + lever[2]
        arm = _cross(origin, axis)
        spin = axis[0] * v, axis[1] * v, axis[2] * v
        change = _cross(w, spin)
        step = _multiply(parent, LEVER, s, lever)
        _store(child, ORIGIN, s, origin[0], origin[1], origin[2])
        _store(child, AXIS, s, turns * axis[0], turns * axis[1], turns * axis[2])
        for i in range(3):
            child[ARM + i * LANES + s] = turns * arm[i] + slides * axis[i]
            slide = slides * (axis[i] * a + 2.0 * change[i])
            child[FORCE + i * LANES + s] = force[i] + step[i] + slide
        _rotate(
            child,
            s,
            (w[0] + turns * spin[0], w[1] + turns * spin[1], w[2] + turns * spin[2]),
            (
                alpha[0] + turns * (axis[0] * a + change[0]),
                alpha[1] + turns * (axis[1] * a + change[1]),
                alpha[2] + turns * (axis[2] * a + change[2]),
            ),
        )


@_compiled
def _link_wrench(link, wrench):
    """Write ∫ (x × u; u) dm per unit parameter, as ``body_integrals`` in NumPy."""
    for s in range(LANES):
        for i in range(3):
            row = _vector(link, LEVER + 3 * i * LANES, s)
            wrench[FORCES + 4 * i * LANES + s] = link[FORCE + i * LANES + s]
            for k in range(3):
                column = (
                    link[k * LANES + s],
                    link[(3 + k) * LANES + s],
                    link[(6 + k) * LANES + s],
                )
                wrench[FORCES + (4 * i + 1 + k) * LANES + s] = _dot(row, column)
    for axis in range(3):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        place = 10 * axis * LANES
        for s in range(LANES):
            p, q = link[ORIGIN + i * LANES + s], link[ORIGIN + j * LANES + s]
            f, g = wrench[FORCES + 4 * i * LANES + s], wrench[FORCES + 4 * j * LANES + s]
            x, y = _vector(link, 3 * i * LANES, s), _vector(link, 3 * j * LANES, s)
            u = _vector(wrench, FORCES + (4 * i + 1) * LANES, s)
            v = _vector(wrench, FORCES + (4 * j + 1) * LANES, s)
            wrench[place + s] = p * g - q * f
            for k in range(3):
                first = x[k] * g - y[k] * f + p * v[k] - q * u[k]
                wrench[place + (1 + k) * LANES + s] = first
            a = 0.5 * (x[0] * v[0] - y[0] * u[0])
            b = 0.5 * (x[1] * v[1] - y[1] * u[1])
            c = 0.5 * (x[2] * v[2] - y[2] * u[2])
            ab = y[0] * u[1] - x[0] * v[1] + y[1] * u[0] - x[1] * v[0]
            ac = y[0] * u[2] - x[0] * v[2] + y[2] * u[0] - x[2] * v[0]
            bc = y[1] * u[2] - x[1] * v[2] + y[2] * u[1] - x[2] * v[1]
            _store(wrench, place + 4 * LANES, s, b + c - a, ab, ac)
            _store(wrench, place + 7 * LANES, s, a + c - b, bc, a + b - c)


@_compiled
def _joint_row(joint, wrench, out):
    """Write the ten entries of a revolute joint's row in a link's columns."""
    for s in range(LANES):
        x, y, z = _vector(joint, AXIS, s)
        a, b, c = _vector(joint, ARM, s)
        for k in range(10):
            row = k * LANES + s
            moment = x * wrench[row] + y * wrench[10 * LANES + row] + z * wrench[20 * LANES + row]
            if k < 4:
                row += FORCES
                moment += (
                    a * wrench[row] + b * wrench[4 * LANES + row] + c * wrench[8 * LANES + row]
                )
            out[k * LANES + s] = moment


@_compiled
def _slide_row(joint, wrench, out):
    """Write the four non-zero entries of a prismatic joint's row in a link's columns."""
    for s in range(LANES):
        a, b, c = _vector(joint, ARM, s)
        for k in range(4):
            row = FORCES + k * LANES + s
            force = a * wrench[row] + b * wrench[4 * LANES + row] + c * wrench[8 * LANES + row]
            out[k * LANES + s] = force


@_compiled
def _fill_tile(tree, motion, first, count, states, lanes, wrench, tile):
    """Write the packed rows of the samples ``first`` to ``first + count`` to a tile."""
    links = len(tree.parent) + 1
    ranked = tree.ranked
    _place_base(states[0], motion, first, count)
    for link in range(links):
        state = states[link]
        if link > 0:
            j = link - 1
            for s in range(LANES):
                n = first + min(s, count - 1)
                displacement = motion.position[n, j] - tree.reference[j]
                _store(lanes, 0, s, displacement, motion.velocity[n, j], motion.acceleration[n, j])
            _move_link(states[tree.parent[j]], state, tree, j, lanes)
        rank = tree.rank[link]
        if rank < 0:
            continue
        _link_wrench(state, wrench)
        if tree.floating:
            for i in range(3):
                place = 10 * (i * ranked + rank) * LANES
                tile[place : place + 10 * LANES] = wrench[10 * i * LANES : 10 * (i + 1) * LANES]
                place = (30 * ranked + 4 * (i * ranked + rank)) * LANES
                source = FORCES + 4 * i * LANES
                tile[place : place + 4 * LANES] = wrench[source : source + 4 * LANES]
        for pair in range(tree.pair_start[link], tree.pair_start[link + 1]):
            j = tree.pair_joint[pair]
            out = tile[tree.pair_place[pair] * LANES :]
            if tree.revolute[j] == 1.0:
                _joint_row(states[j + 1], wrench, out)
            else:
                _slide_row(states[j + 1], wrench, out)


@_compiled
def _add_loads(tree, loads, first, count, states, y):
    """Write the generalised force of a tile's efforts and wrenches to y (N, n)."""
    base = 6 if tree.floating else 0
    joints = len(tree.parent)
    for s in range(count):
        n = first + s
        for i in range(base):
            y[n, i] = 0.0
        for j in range(joints):
            y[n, base + j] = loads.effort[n, j]
    for f in range(len(loads.link)):
        state, mount, lever = states[loads.carrier[f]], loads.rotation[f], loads.translation[f]
        for s in range(count):
            n = first + s
            wrench = loads.wrench[n, f]
            m, v = (wrench[0], wrench[1], wrench[2]), (wrench[3], wrench[4], wrench[5])
            force = _dot(mount[0], v), _dot(mount[1], v), _dot(mount[2], v)
            turned = _cross((lever[0], lever[1], lever[2]), force)
            moment = (
                _dot(mount[0], m) + turned[0],
                _dot(mount[1], m) + turned[1],
                _dot(mount[2], m) + turned[2],
            )
            force = _multiply(state, 0, s, force)
            moment = _multiply(state, 0, s, moment)
            turned = _cross(_vector(state, ORIGIN, s), force)
            moment = moment[0] + turned[0], moment[1] + turned[1], moment[2] + turned[2]
            for i in range(base // 2):
                y[n, i] += moment[i]
                y[n, 3 + i] += force[i]
            for j in range(joints):
                if loads.path[j, loads.link[f]]:
                    joint = states[j + 1]
                    y[n, base + j] += _dot(_vector(joint, AXIS, s), moment)
                    y[n, base + j] += _dot(_vector(joint, ARM, s), force)


@_compiled
def _scatter(tile, first, count, index, rows, columns):
    """Write a tile to flat rows (N c,) of c columns, zero beside the columns ``index``."""
    flat = rows[first * columns : (first + count) * columns]
    if columns > len(index):
        flat[:] = 0.0
    for start in range(0, count - LINE + 1, LINE):
        part = flat[start * columns :]
        for k in range(len(index)):
            place = np.uint64(index[k])
            for s in range(LINE):
                part[place + np.uint64(s * columns)] = tile[k * LANES + start + s]
    for s in range(count - count % LINE, count):
        for k in range(len(index)):
            flat[s * columns + index[k]] = tile[k * LANES + s]


@numba.njit(fastmath={"contract", "reassoc", "nsz"})
def _weighted_sum(weights, values):
    """Return the sum over a tile, in the order that SIMD instructions need."""
    total = 0.0
    for s in range(LANES):
        total += weights[s] * values[s]
    return total


@_compiled
def _add_windows(tile, first, count, windows, weights, means):
    """Add a tile's weighted samples to the means (W, w) of the windows that overlap it."""
    width = means.shape[1]
    for window in range(len(windows.first)):
        begin = windows.first[window]
        end = begin + windows.start[window + 1] - windows.start[window]
        if end <= first or begin >= first + count:
            continue
        weights[:] = 0.0
        shift = windows.start[window] - begin
        for n in range(max(begin, first), min(end, first + count)):
            weights[n - first] = windows.weight[shift + n]
        for k in range(width):
            means[window, k] += _weighted_sum(weights, tile[k * LANES : (k + 1) * LANES])


@_compiled
def _add_forces(tile, first, count, row, phi, totals, forces):
    """Write the products (V, N, n) of a tile's rows with parameters (V, w) of the packed columns.

    ``row`` (w,) are the coordinates of the packed columns.
    """
    dof = forces.shape[2]
    for v in range(len(phi)):
        totals[:] = 0.0
        for k in range(len(row)):
            value = phi[v, k]
            if value != 0.0:
                total = totals[row[k] * LANES : (row[k] + 1) * LANES]
                column = tile[k * LANES : (k + 1) * LANES]
                for s in range(LANES):
                    total[s] += value * column[s]
        for s in range(count):
            for i in range(dof):
                forces[v, first + s, i] = totals[i * LANES + s]


@_compiled
def _evaluate(
    tree, motion, loads, index, rows, columns, windows, means, row, phi, forces, y, states, scratch
):
    """Write flat rows (N c,) or the means (W, w) of their packed columns, forces and y (N, n).

    Without columns c or windows W the respective result is omitted. ``index`` (w,) are the columns
    of the packed ones in ``rows``. Forces (V, N, n) are the products with parameters (V, w).
    """
    end = 4 * LANES
    lanes, weights = scratch[: 3 * LANES], scratch[3 * LANES : end]
    wrench = scratch[end : end + WRENCH * LANES]
    end += WRENCH * LANES
    tile = scratch[end : end + len(index) * LANES]
    totals = scratch[end + len(index) * LANES :]
    means[:] = 0.0
    for first in range(0, len(y), LANES):
        count = min(LANES, len(y) - first)
        _fill_tile(tree, motion, first, count, states, lanes, wrench, tile)
        _add_loads(tree, loads, first, count, states, y)
        if columns > 0:
            _scatter(tile, first, count, index, rows, columns)
        if len(means) > 0:
            _add_windows(tile, first, count, windows, weights, means)
        if len(phi) > 0:
            _add_forces(tile, first, count, row, phi, totals, forces)


def _evaluate_at(
    parent, pose, reference, revolute, rank, pair_start, pair_joint, pair_place,
    position, velocity, acceleration, omega, alpha, force,
    effort, wrench, link, carrier, rotation, translation, path,
    first, start, weight,
    index, rows, means, row, phi, forces, y, states, scratch,
    sizes,
):  # fmt: skip
    """Evaluate arrays at addresses, which are as in :mod:`symbid_ros.dynamics.compiled_kernel`."""
    numbers = carray(sizes, (14,))
    N, J, F, P, S = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    W, w, m, c, V = numbers[5], numbers[6], numbers[7], numbers[8], numbers[9]
    n, size, ranked, floating = numbers[10], numbers[11], numbers[12], numbers[13]
    tree = Tree(
        carray(parent, (J,)),
        carray(pose, (J, 15, 4)),
        carray(reference, (J,)),
        carray(revolute, (J,)),
        carray(rank, (J + 1,)),
        ranked,
        floating != 0,
        carray(pair_start, (J + 2,)),
        carray(pair_joint, (P,)),
        carray(pair_place, (P,)),
    )
    motion = Motion(
        carray(position, (N, J)),
        carray(velocity, (N, J)),
        carray(acceleration, (N, J)),
        carray(omega, (N, 3)),
        carray(alpha, (N, 3)),
        carray(force, (N, 3)),
    )
    loads = Loads(
        carray(effort, (N, J)),
        carray(wrench, (N, F, 6)),
        carray(link, (F,)),
        carray(carrier, (F,)),
        carray(rotation, (F, 3, 3)),
        carray(translation, (F, 3)),
        carray(path, (J, J + 1)),
    )
    windows = Windows(carray(first, (W,)), carray(start, (W + 1,)), carray(weight, (S,)))
    _evaluate(
        tree,
        motion,
        loads,
        carray(index, (w,)),
        carray(rows, (N * c,)),
        c,
        windows,
        carray(means, (W, m)),
        carray(row, (w,)),
        carray(phi, (V, w)),
        carray(forces, (V, N, n)),
        carray(y, (N, n)),
        carray(states, (J + 1, STATES)),
        carray(scratch, (size,)),
    )


def compile_to_llvm(kinds: str) -> tuple[str, str]:
    """Return the kernel as LLVM's assembly, and the name of its function of addresses.

    Parameters
    ----------
    kinds : str
        Of each array: "d" for float64, "q" for int64 and "?" for bool.
    """
    kind = {"d": types.float64, "q": types.int64, "?": types.boolean}
    compiler: Any = numba.cfunc
    signature = types.void(*[types.CPointer(kind[one]) for one in kinds])
    compiled = compiler(signature, error_model="numpy")(_evaluate_at)
    return compiled.inspect_llvm(), compiled.native_name
