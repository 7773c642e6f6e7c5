# mypy: ignore-errors
"""Taichi source of icp.py: all iterations in one launch, and partners that are searched for only when they may change.

A launch costs as much as an iteration over 5,000 points, and waking a second thread too. So the first search, which is
half of the work, is spread over the threads, and the iterations follow on one; they return early where the pose still
moves so far that most partners have to be searched for again, and the next launch spreads that.
"""

from coview_kernels import runtime
from coview_kernels._ti_nearest import walk
from coview_kernels.launch import SPAN

ti = runtime.library()

FLOATS = ti.types.ndarray(ti.f32, 1)
DOUBLES = ti.types.ndarray(ti.f64, 1)
WHOLES = ti.types.ndarray(ti.i32, 1)

NONE = 1e300  # square metres: no partner within the radius
SLACK = 1e-9  # metres: more than rounding adds to a bound
MOST_SHARE = 5.0  # weight of a point of the rarer kind
MARGIN = 0.15  # metres that a search looks further than it must, so that it serves later poses; 0.05-0.3 are as fast

# memory of a point: where it was searched for (3), how far all map points but its partner were then at least,
# the partner's row, and the square of its distance now
SAFE, ROW, NEAR = 3, 4, 5
# ranks, a row for either kind of point: how many are kept, how many of them are still to be found, the bits of the
# largest squared distance among them (as float32, which sort as it does), then a histogram
KEPT, LEFT, LAST, BINS = 0, 1, 2, 3
# settings; see icp.py
KEEP, ITERATIONS, SCALES, LEAST, PRIOR, BULK = 8, 9, 10, 11, 12, 13
PIVOT, MEAN, BELIEF, FIRST = 14, 17, 29, 65
# and of each scale radius, width of the weights, and the shift and turn that end it
RADIUS, WIDTH, SHIFT, TURN, EACH = 0, 1, 2, 3, 4
# state: pose by rows (12), then these, the information (36) and the sums of a step (30)
SCALE, ROUND, TOTAL, STATUS, CONVERGED, INFORMATION, SUMS, PAIRED, OFF = 12, 13, 14, 15, 16, 17, 53, 83, 84
RUNNING, DONE, LOST = 0, 1, 2


@ti.func
def placed(T: ti.template(), p):
    x, y, z = p[0], p[1], p[2]
    return ti.Vector(
        [T[4 * d] * x + T[4 * d + 1] * y + T[4 * d + 2] * z + T[4 * d + 3] for d in ti.static(range(3))]
    )


@ti.func
def floats(array: ti.template(), at):
    return ti.Vector([ti.cast(array[at + d], ti.f64) for d in ti.static(range(3))])


@ti.func
def point_of(rows: ti.template(), p):
    return ti.Vector([ti.cast(ti.bit_cast(rows[4 * p + d], ti.f32), ti.f64) for d in ti.static(range(3))])


@ti.func
def pair(frame, starts: ti.template(), rows: ti.template(), at, i, radius, memory: ti.template()) -> ti.i32:
    """Bring the partner of point ``i``, now ``at``, up to date; return whether it had to be searched for."""
    row = ti.cast(memory[6 * i + ROW], ti.i32)
    drift = (at - ti.Vector([memory[6 * i + 0], memory[6 * i + 1], memory[6 * i + 2]])).norm()
    safe = ti.max(memory[6 * i + SAFE] - drift - SLACK, 0.0)
    near = ti.cast(NONE, ti.f64)
    if row >= 0:
        near = (at - point_of(rows, row)).norm_sqr()
    # by the triangle inequality no other point is nearer than safe: the partner stays, or there still is none
    searched = safe * safe < ti.min(near, radius * radius)
    if searched:
        limit = radius + MARGIN
        best, found, beyond = walk(frame, starts, rows, at[0], at[1], at[2], limit * limit, MARGIN)
        near = best if found >= 0 else NONE
        memory[6 * i + 0], memory[6 * i + 1], memory[6 * i + 2] = at[0], at[1], at[2]
        memory[6 * i + SAFE] = ti.sqrt(beyond)
        memory[6 * i + ROW] = found
    memory[6 * i + NEAR] = near if near < radius * radius else NONE
    return searched


@ti.func
def rank(keep, source: ti.template(), memory: ti.template(), ranks: ti.template()):
    """Find how far the farthest kept pair of either kind is, by radix: exact, and no slower where all are equal."""
    for kind in range(2):
        ranks[kind, LAST] = 0
    for level in range(3):
        shift = 20 - 10 * level
        bins = 2048 if level == 0 else 1024
        for kind in range(2):
            for b in range(bins):
                ranks[kind, BINS + b] = 0
        for i in range(source.shape[0] // 4):
            if memory[6 * i + NEAR] < NONE:
                key = ti.bit_cast(ti.cast(memory[6 * i + NEAR], ti.f32), ti.i32)
                kind = ti.cast(source[4 * i + 3], ti.i32)
                b = -1
                if level == 0:
                    b = BINS + (key >> shift)
                elif (key >> (shift + 10)) == ranks[kind, LAST]:
                    b = BINS + ((key >> shift) & 1023)
                if b >= 0:
                    ranks[kind, b] = ranks[kind, b] + 1  # += would be atomic
        for kind in range(2):
            if level == 0:
                found = 0
                for b in range(bins):
                    found += ranks[kind, BINS + b]
                ranks[kind, KEPT] = ti.min(found, ti.max(1, ti.cast(keep * found, ti.i32)))
                ranks[kind, LEFT] = ranks[kind, KEPT]
            left = ranks[kind, LEFT]
            b = BINS
            while ranks[kind, b] < left:
                left -= ranks[kind, b]
                b += 1
            ranks[kind, LEFT] = left
            ranks[kind, LAST] = ranks[kind, LAST] * 1024 + b - BINS
            if level == 2:
                # all that are as far as the last one that is kept are kept too
                ranks[kind, KEPT] = ranks[kind, KEPT] + ranks[kind, b] - left


@ti.func
def add_up(
    T, about, width, rows: ti.template(), normals: ti.template(), source: ti.template(), memory: ti.template(),
    ranks: ti.template(), state: ti.template(),
):  # fmt: skip
    """Leave in the state: triangle of H by rows (21), b (6), sums of w r^2 and of w, pairs."""
    acc = ti.Vector.zero(ti.f64, 30)
    n = source.shape[0] // 4
    last = ti.Vector([ranks[0, LAST], ranks[1, LAST]])
    share = ti.Vector(
        [ti.min(0.5 * n / ti.max(1, ranks[kind, KEPT]), MOST_SHARE) for kind in ti.static(range(2))]
    )
    for i in range(n):
        near = memory[6 * i + NEAR]
        above = source[4 * i + 3] > 0
        most = last[1] if above else last[0]
        if near < NONE and ti.bit_cast(ti.cast(near, ti.f32), ti.i32) <= most:
            row = ti.cast(memory[6 * i + ROW], ti.i32)
            at = placed(T, floats(source, 4 * i))
            normal = floats(normals, 3 * rows[4 * row + 3])
            r = normal.dot(at - point_of(rows, row))
            ratio = r / width
            w = (share[1] if above else share[0]) / (1.0 + ratio * ratio)
            turn = (at - about).cross(normal)
            J = ti.Vector([turn[0], turn[1], turn[2], normal[0], normal[1], normal[2]])
            for a in ti.static(range(6)):
                wa = w * J[a]
                for b in ti.static(range(a, 6)):
                    acc[ti.static(6 * a - a * (a - 1) // 2 + b - a)] += wa * J[b]
                acc[21 + a] += wa * r
            acc[27] += w * r * r
            acc[28] += w
            acc[29] += 1.0
    for k in ti.static(range(30)):
        state[SUMS + k] = acc[k]


@ti.func
def solve(pivot, about, settings: ti.template(), state: ti.template(), system: ti.template()):
    """Fuse the sums with the prior into ``state``'s information; leave the increment in the system's last column."""
    variance = state[SUMS + 27] / state[SUMS + 28] + 1e-6
    k = 0
    for a in range(6):
        for b in range(a, 6):
            state[INFORMATION + 6 * a + b] = state[SUMS + k] / variance
            state[INFORMATION + 6 * b + a] = state[SUMS + k] / variance
            k += 1
        system[a, 6] = -state[SUMS + 21 + a] / variance
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
                system[a, 6] = system[a, 6] - belief * state[OFF + b]
    for a in range(6):
        for b in range(6):
            system[a, b] = state[INFORMATION + 6 * a + b]
        system[a, a] = system[a, a] + 1e-6
    eliminate(system)


@ti.func
def eliminate(system: ti.template()):
    """Gauss-Jordan with pivots, as the matrix may be all but singular."""
    for c in range(6):
        top = c
        for a in range(c + 1, 6):
            if ti.abs(system[a, c]) > ti.abs(system[top, c]):
                top = a
        for b in range(c, 7):
            swap = system[c, b]
            system[c, b] = system[top, b]
            system[top, b] = swap
        for a in range(6):
            if a != c:
                share = system[a, c] / system[c, c]
                for b in range(c, 7):
                    system[a, b] = system[a, b] - share * system[c, b]
    for c in range(6):
        system[c, 6] /= system[c, c]


@ti.func
def advance(about, settings: ti.template(), state: ti.template(), system: ti.template()):
    """Apply the increment to the pose, about ``about``, and see what follows."""
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


@ti.kernel
def align(
    settings: DOUBLES,
    starts: WHOLES,
    rows: WHOLES,
    normals: FLOATS,
    source: FLOATS,
    memory: DOUBLES,
    ranks: ti.types.ndarray(ti.i32, 2),
    system: ti.types.ndarray(ti.f64, 2),
    state: DOUBLES,
    chunks: ti.i32,
):
    """Iterate from the state's pose until the status says why it ended, or until searches should be spread again.

    With more than one chunk: only bring the partners up to date, which the iterations then begin with.
    """
    n = source.shape[0] // 4
    each = (n + chunks - 1) // chunks
    for q in range(chunks * SPAN):
        c = q // SPAN
        frame = ti.Vector([settings[k] for k in ti.static(range(8))])
        again = q % SPAN == 0 and state[STATUS] == RUNNING
        while again:
            T = ti.Vector([state[k] for k in ti.static(range(12))])
            scale = FIRST + EACH * ti.cast(state[SCALE], ti.i32)
            searched = 0
            if state[PAIRED] == 0:
                for i in range(ti.min(n, c * each), ti.min(n, (c + 1) * each)):
                    searched += pair(
                        frame,
                        starts,
                        rows,
                        placed(T, floats(source, 4 * i)),
                        i,
                        settings[scale + RADIUS],
                        memory,
                    )
            again = False
            if chunks == 1:
                state[PAIRED] = 0
                pivot = ti.Vector([settings[PIVOT + d] for d in ti.static(range(3))])
                about = placed(T, pivot)
                rank(settings[KEEP], source, memory, ranks)
                add_up(T, about, settings[scale + WIDTH], rows, normals, source, memory, ranks, state)
                if state[SUMS + 29] < settings[LEAST]:
                    state[STATUS] = LOST
                else:
                    solve(pivot, about, settings, state, system)
                    advance(about, settings, state, system)
                again = state[STATUS] == RUNNING and searched < settings[BULK]
