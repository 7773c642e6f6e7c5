# mypy: ignore-errors
"""Taichi source of icp.py: one iteration per launch, with its searches spread over the threads.

A partner is searched only when it may have changed, and is stored beside its point, so that an iteration with few
searches reads memory in order. Waking the threads, even a single one, costs as much as an iteration over some hundred
points. One thread therefore does all work after the search, and a single worker does everything itself.
"""

from coview_kernels import runtime
from coview_kernels._ti_nearest import walk
from coview_kernels.launch import SPAN

ti = runtime.library()

FLOATS = ti.types.ndarray(ti.f32, 1)
DOUBLES = ti.types.ndarray(ti.f64, 1)
WHOLES = ti.types.ndarray(ti.i32, 1)

SERIAL = runtime.workers() == 1
SLACK = 1e-9  # metres: more than rounding adds to a bound
MAX_SHARE = 5.0  # greatest weight of a point of the rarer kind
SCATTER = 2.0  # distance between points that form no surface, in widths of the weights
MARGIN = 0.15  # metres by which a search exceeds its limit, to serve later poses; 0.05 to 0.3 are as fast
BLOCK = 6  # 2^6 points per thread in turn, as points with long searches come in clusters

# memory of a point: position at the last search (3); from there all map points but its partner are at least this far
SAFE, PLACE = 3, 4
# partner of a point: position (3) and normal (3); far away if there is none
PARTNER = 6
# bins of squared distances, 64 per octave from 2^-20 square metres up: a row for each kind of point in each chunk,
# preceded by the bin of every point
FIRST_BIN, BINS = 107 << 6, 2048
# settings; see icp.py
ITERATIONS, SCALES, MIN_PAIRS, PRIOR = 8, 9, 10, 11
PIVOT, MEAN, BELIEF, FIRST = 12, 15, 27, 63
# and for each scale radius, width of the weights, the shift and turn that end it, number of points used, and share of
# the pairs that is kept
RADIUS, WIDTH, SHIFT, TURN, POINTS, KEEP, EACH = 0, 1, 2, 3, 4, 5, 6
# state: pose by rows (12), then these, the information (36), the sums of a step (30), and six working values
SCALE, ROUND, TOTAL, STATUS, CONVERGED, INFORMATION, SUMS, OFF = 12, 13, 14, 15, 16, 17, 53, 83
DONE, LOST = 1, 2  # statuses; 0 while it goes on


@ti.func
def placed(T: ti.template(), p):
    x, y, z = p[0], p[1], p[2]
    return ti.Vector([T[4 * d] * x + T[4 * d + 1] * y + T[4 * d + 2] * z + T[4 * d + 3] for d in ti.static(range(3))])


@ti.func
def floats(array: ti.template(), at):
    return ti.Vector([ti.cast(array[at + d], ti.f64) for d in ti.static(range(3))])


@ti.func
def pair(
    frame, starts: ti.template(), rows: ti.template(), normals: ti.template(), at, i, radius,
    memory: ti.template(), partners: ti.template(),
) -> ti.f64:  # fmt: skip
    """Update the partner of point ``i``, now ``at``; return its squared distance."""
    drift = (at - ti.Vector([memory[PLACE * i], memory[PLACE * i + 1], memory[PLACE * i + 2]])).norm()
    safe = ti.max(memory[PLACE * i + SAFE] - drift - SLACK, 0.0)
    near = (at - floats(partners, PARTNER * i)).norm_sqr()
    # by the triangle inequality no other point is nearer than safe: the partner stays, or there is still none
    if safe * safe < ti.min(near, radius * radius):
        # the old partner is a bound already
        limit = ti.min(ti.sqrt(near), radius) + MARGIN
        best, found, beyond = walk(frame, starts, rows, at[0], at[1], at[2], limit * limit, MARGIN)
        for d in ti.static(range(3)):
            memory[PLACE * i + d] = at[d]
        memory[PLACE * i + SAFE] = ti.sqrt(beyond)
        near = best
        if found >= 0:
            normal = 3 * rows[4 * found + 3]
            for d in ti.static(range(3)):
                partners[PARTNER * i + d] = ti.bit_cast(rows[4 * found + d], ti.f32)
                partners[PARTNER * i + 3 + d] = normals[normal + d]
        else:
            partners[PARTNER * i] = 1e18
            near = 1e36
    return near


@ti.func
def trim(keep, chunks, n, first, bins: ti.template()):
    """Return, for each kind of point, the farthest bin kept and the weight of each pair kept."""
    last = ti.Vector([-1, -1])
    share = ti.Vector.zero(ti.f64, 2)
    for c in range(1, chunks):
        for b in range(first, first + 2 * BINS):
            bins[b] = bins[b] + bins[b + 2 * c * BINS]
    for kind in range(2):  # not unrolled, which would take a tenth of a second to compile in every process
        mine = first + kind * BINS
        found = 0
        for b in range(mine, mine + BINS):
            found += bins[b]
        kept = 0
        while kept < found and kept < ti.max(1, ti.cast(keep * found, ti.i32)):
            last[kind] += 1
            kept += bins[mine + last[kind]]
        share[kind] = ti.min(0.5 * n / ti.max(1, kept), MAX_SHARE)
    return last, share


def _place(row, column):
    """Return the index in the sums of an element of the triangle, whose last column is b."""
    return 7 * row - row * (row - 1) // 2 + column - row


@ti.func
def add_up(
    T, about, width, n, last, share, source: ti.template(), kinds: ti.template(),
    partners: ti.template(), bins: ti.template(), state: ti.template(),
):  # fmt: skip
    """Write to the state: triangle of H by rows (21), b (6), sums of w r^2 and of w, pairs.

    A pair whose partner lies on a surface constrains the direction of its normal; a pair in scatter, all three axes.
    """
    acc, M = ti.Vector.zero(ti.f64, 30), ti.Matrix.zero(ti.f64, 3, 3)
    for i in range(n):
        if bins[i] <= (last[1] if kinds[i] > 0 else last[0]):
            at = placed(T, floats(source, 3 * i))
            gap = at - floats(partners, PARTNER * i)
            normal = floats(partners, PARTNER * i + 3)
            planarity = normal.norm()
            normal /= ti.max(planarity, 1e-9)
            planarity = ti.min(planarity, 1.0)
            r = normal.dot(gap)
            ratio = r / width
            own = share[1] if kinds[i] > 0 else share[0]
            w = own * planarity / (1.0 + ratio * ratio)
            length = gap.norm_sqr()
            v = own * (1.0 - planarity) / (SCATTER * SCATTER + length / (width * width))
            # W = w n n^T + v I weighs the gap; a rotation moves the point by its cross product with the arm
            arm, pull = at - about, w * r * normal + v * gap
            torque = arm.cross(pull)
            for column in ti.static(range(3)):
                W = w * normal[column] * normal
                W[column] += v
                cross = arm.cross(W)
                for row in ti.static(range(3)):
                    acc[ti.static(_place(row, 3 + column))] += cross[row]
                    M[row, column] = cross[row]
                    if ti.static(row <= column):
                        acc[ti.static(_place(3 + row, 3 + column))] += W[row]
            for row in ti.static(range(3)):
                lever = arm.cross(ti.Vector([M[row, 0], M[row, 1], M[row, 2]]))
                for column in ti.static(range(row, 3)):
                    acc[ti.static(_place(row, column))] += lever[column]
                acc[ti.static(_place(row, 6))] += torque[row]
                acc[ti.static(_place(3 + row, 6))] += pull[row]
            acc[27] += w * r * r + v * length
            acc[28] += w + 3.0 * v
            acc[29] += 1.0
    for k in ti.static(range(30)):
        state[SUMS + k] = acc[k]


@ti.func
def solve(pivot, about, settings: ti.template(), state: ti.template(), system: ti.template()):
    """Fuse the sums with the prior into ``state``'s information; write the increment to the system's last column."""
    variance = state[SUMS + 27] / state[SUMS + 28] + 1e-6
    k = SUMS
    for a in range(6):
        for b in range(a, 7):
            system[a, b] = state[k] / variance
            k += 1
        for b in range(6):
            state[INFORMATION + 6 * a + b] = system[ti.min(a, b), ti.max(a, b)]
    if settings[PRIOR] > 0:
        mean = placed(ti.Vector([settings[MEAN + k] for k in ti.static(range(12))]), pivot)
        # half the sum of the columns' cross products is the sine part of T mean^-1
        turn = ti.Vector.zero(ti.f64, 3)
        for d in range(3):
            m = ti.Vector([settings[MEAN + d], settings[MEAN + 4 + d], settings[MEAN + 8 + d]])
            turn += 0.5 * m.cross(ti.Vector([state[d], state[4 + d], state[8 + d]]))
        for d in ti.static(range(3)):
            state[OFF + d] = turn[d]
            state[OFF + 3 + d] = about[d] - mean[d]
        for a in range(6):
            for b in range(6):
                belief = settings[BELIEF + 6 * a + b]
                state[INFORMATION + 6 * a + b] = state[INFORMATION + 6 * a + b] + belief
                system[a, 6] = system[a, 6] + belief * state[OFF + b]
    for a in range(6):
        for b in range(6):
            system[a, b] = state[INFORMATION + 6 * a + b]
        system[a, a] = system[a, a] + 1e-6
    eliminate(system)


@ti.func
def eliminate(system: ti.template()):
    """Gauss-Jordan elimination with pivots, as the matrix may be almost singular."""
    n = system.shape[0]  # unknown to the compiler, which would otherwise unroll all loops
    for c in range(n):
        top = c
        for a in range(c + 1, n):
            if ti.abs(system[a, c]) > ti.abs(system[top, c]):
                top = a
        for b in range(c, n + 1):
            swap = system[c, b]
            system[c, b] = system[top, b]
            system[top, b] = swap
        for a in range(n):
            if a != c:
                share = system[a, c] / system[c, c]
                for b in range(c, n + 1):
                    system[a, b] = system[a, b] - share * system[c, b]
    for c in range(n):
        system[c, 6] = -system[c, 6] / system[c, c]


@ti.func
def advance(about, settings: ti.template(), state: ti.template(), system: ti.template()):
    """Apply the increment to the pose, about ``about``, and set scale and status."""
    turn = ti.Vector([system[d, 6] for d in ti.static(range(3))])
    shift = ti.Vector([system[d, 6] for d in ti.static(range(3, 6))])
    angle = turn.norm()
    sine, rest = ti.cast(1.0, ti.f64), ti.cast(0.5, ti.f64)
    if angle > 1e-5:
        half = ti.sin(0.5 * angle) / angle
        sine, rest = ti.sin(angle) / angle, 2.0 * half * half
    for column in range(4):
        v = ti.Vector([state[column], state[4 + column], state[8 + column]])
        if column == 3:
            v -= about
        side = turn.cross(v)
        v += sine * side + rest * turn.cross(side)
        if column == 3:
            v += about + shift
        for d in ti.static(range(3)):
            state[4 * d + column] = v[d]
    state[TOTAL] = state[TOTAL] + 1
    state[ROUND] = state[ROUND] + 1
    state[CONVERGED] = 0.0
    scale = FIRST + EACH * ti.cast(state[SCALE], ti.i32)
    if shift.norm() < settings[scale + SHIFT] and angle < settings[scale + TURN]:
        state[CONVERGED] = 1.0
    if state[CONVERGED] > 0 or state[ROUND] >= settings[ITERATIONS]:
        state[ROUND] = 0
        state[SCALE] = state[SCALE] + 1
        if state[SCALE] >= settings[SCALES]:
            state[STATUS] = DONE


@runtime.kernel
def align(
    settings: DOUBLES, starts: WHOLES, rows: WHOLES, normals: FLOATS, source: FLOATS, kinds: WHOLES, memory: DOUBLES,
    partners: FLOATS, bins: WHOLES, system: ti.types.ndarray(ti.f64, 2), state: DOUBLES, chunks: ti.i32,
):  # fmt: skip
    """Take one step from the state's pose; the status says whether another step should follow.

    Coarse scales use the first points only; ``kinds`` is 0 or 1.
    """
    ti.loop_config(serialize=SERIAL)
    for q in range(chunks * SPAN):
        if q % SPAN == 0:
            c = q // SPAN
            frame = ti.Vector([settings[k] for k in ti.static(range(8))])
            T = ti.Vector([state[k] for k in ti.static(range(12))])
            scale = FIRST + EACH * ti.cast(state[SCALE], ti.i32)
            radius = settings[scale + RADIUS]
            n = ti.cast(settings[scale + POINTS], ti.i32)
            mine = kinds.shape[0] + 2 * c * BINS
            for b in range(mine, mine + 2 * BINS):
                bins[b] = 0
            for k in range(n // chunks + (2 << BLOCK)):
                i = (((k >> BLOCK) * chunks + c) << BLOCK) + (k & ((1 << BLOCK) - 1))
                if i < n:
                    at = placed(T, floats(source, 3 * i))
                    near = pair(frame, starts, rows, normals, at, i, radius, memory, partners)
                    b = BINS
                    if near < radius * radius:
                        octave = (ti.bit_cast(ti.cast(near, ti.f32), ti.i32) >> 17) - FIRST_BIN
                        b = ti.min(ti.max(octave, 0), BINS - 1)
                        place = mine + b + kinds[i] * BINS
                        bins[place] = bins[place] + 1  # += would be atomic
                    bins[i] = b
    ti.loop_config(serialize=True)
    for _ in range(1):
        T = ti.Vector([state[k] for k in ti.static(range(12))])
        scale = FIRST + EACH * ti.cast(state[SCALE], ti.i32)
        pivot = ti.Vector([settings[PIVOT + d] for d in ti.static(range(3))])
        about = placed(T, pivot)
        n = ti.cast(settings[scale + POINTS], ti.i32)
        last, share = trim(settings[scale + KEEP], chunks, n, kinds.shape[0], bins)
        add_up(
            T, about, settings[scale + WIDTH], n, last, share, source, kinds, partners, bins, state,
        )  # fmt: skip
        if state[SUMS + 29] < settings[MIN_PAIRS]:
            state[STATUS] = LOST
        else:
            solve(pivot, about, settings, state, system)
            advance(about, settings, state, system)
