struct Point { float cost, slope, curve; };
struct Row {  // what a line search needs of a row, or of a contact at its first row
    int kind, state0;
    float jaref, jv, d, cost0, loss, range, q0, q1, q2, mu, u0, v0, uu, uv, vv, dm, t0, r0;
};
constexpr int NV = $dofs, ROWS = $rows, DIM = $dimensions, LD = NV | 1, CHUNK = $chunk, ENTRIES = NV * (NV + 1) / 2;
constexpr float MINVAL = ${minval}f, EPS = 8.0f * 1.1920929e-07f;
enum { NOTHING, PLAIN, LOSS, CONTACT };
enum { SATISFIED = $satisfied, QUADRATIC = $quadratic, LINEARNEG = $linearneg, LINEARPOS = $linearpos, CONE = $cone };
float* inertia = memory;  // NV x NV, rows LD apart, and so the Hessian and its factor
float* hessian = inertia + NV * LD;
float* part = hessian + NV * LD;  // CHUNK x NV
float* coefficient = part + CHUNK * LD;  // CHUNK x DIM
float* jaref = coefficient + CHUNK * DIM;
float* jv = jaref + ROWS;
float* force = jv + ROWS;
int* state = (int*)(force + ROWS);
int* contact_of = state + ROWS;  // or one of the next line
enum { NO_CONTACT = -1, NO_ROOM = -2 };
float* qacc = (float*)(contact_of + ROWS);
float* momentum = qacc + NV;
float* gradient = momentum + NV;
float* search = gradient + NV;
float* mv = search + NV;
const int num_rows = wp::min(ROWS, problem.num_rows.data[world]), num_equal = problem.num_equalities.data[world];
const int num_fixed = num_equal + problem.num_losses.data[world], num_contacts = problem.num_contacts.data[0];
const float* jacobian = &wp::index(problem.jacobian, world, 0, 0);
const int stride = problem.jacobian.strides[1] / sizeof(float);
const float* d_of = &wp::index(problem.stiffness, world, 0);
const float* smooth = &wp::index(problem.qfrc_smooth, world, 0);
float* constraint = &wp::index(problem.qfrc_constraint, world, 0);
const float root_impratio = wp::index(problem.impratio_invsqrt, world % problem.impratio_invsqrt.shape[0]);
const float least = wp::index(problem.tolerance, world % problem.tolerance.shape[0]);
const float ls_least = wp::index(problem.ls_tolerance, world % problem.ls_tolerance.shape[0]);
auto safe = [](float x, float y) { return x / (y != 0.0f ? y : MINVAL); };
auto first_row = [&](int c) { return wp::index(problem.address, c, 0); };
auto friction_of = [&](int c, int k) { return wp::index(problem.friction, c)[k]; };

// Force and state of every row at the present residuals, and what the forces do to the joints.
auto update_forces = [&]() {
    #pragma unroll 1
    for (int r = lane; r < num_rows; r += LANES) {
        const int c = contact_of[r];
        const float x = jaref[r], d = d_of[r];
        if (c == NO_CONTACT) {
            float f = -d * x;
            int s = QUADRATIC;
            if (r >= num_fixed) {
                if (x >= 0.0f) { f = 0.0f; s = SATISFIED; }
            } else if (r >= num_equal) {
                const float loss = wp::index(problem.frictionloss, world, r), range = safe(loss, d);
                if (x <= -range) { f = loss; s = LINEARNEG; }
                else if (x >= range) { f = -loss; s = LINEARPOS; }
            }
            force[r] = f;
            state[r] = s;
        } else if (c == NO_ROOM) {
            force[r] = 0.0f;
            state[r] = SATISFIED;
        } else if (r == first_row(c)) {
            const int dim = problem.condim.data[c];
            const float mu = friction_of(c, 0) * root_impratio, n = x * mu;
            float tt = 0.0f;
            #pragma unroll 1
            for (int k = 1; k < dim; ++k) {
                const float u = jaref[r + k] * friction_of(c, k - 1);
                tt += u * u;
            }
            const float t = tt <= 0.0f ? 0.0f : wp::sqrt(tt);
            if (n >= mu * t || (t <= 0.0f && n >= 0.0f)) {
                #pragma unroll 1
                for (int k = 0; k < dim; ++k) { force[r + k] = 0.0f; state[r + k] = SATISFIED; }
            } else if (mu * n + t <= 0.0f || (t <= 0.0f && n < 0.0f)) {
                #pragma unroll 1
                for (int k = 0; k < dim; ++k) { force[r + k] = -d_of[r + k] * jaref[r + k]; state[r + k] = QUADRATIC; }
            } else {
                const float normal = -safe(d, mu * mu * (1.0f + mu * mu)) * (n - mu * t) * mu;
                force[r] = normal;
                state[r] = CONE;
                #pragma unroll 1
                for (int k = 1; k < dim; ++k) {
                    const float scale = friction_of(c, k - 1);
                    force[r + k] = -safe(normal, t) * (jaref[r + k] * scale * scale);
                    state[r + k] = CONE;
                }
            }
        }
    }
    sync();
    for (int i = lane; i < NV; i += LANES) {
        float sum = 0.0f;
        #pragma unroll 4
        for (int r = 0; r < num_rows; ++r) sum += jacobian[r * stride + i] * force[r];
        constraint[i] = sum;
    }
};

// `search` times the inverse of `hessian`, whose lower triangle becomes its Cholesky factor.
auto solve_hessian = [&]() {
    #pragma unroll 1
    for (int k = 0; k < NV; ++k) {  // with the forward substitution as it goes
        const float root = wp::sqrt(hessian[k * LD + k]), inverse = 1.0f / root, y = search[k] * inverse;
        sync();
        for (int i = k + lane; i < NV; i += LANES) {
            const float below = i == k ? root : hessian[i * LD + k] * inverse;
            hessian[i * LD + k] = below;
            search[i] = i == k ? y : search[i] - below * y;
        }
        sync();
        for (int i = k + 1 + lane; i < NV; i += LANES) {
            const float below = hessian[i * LD + k];
            #pragma unroll 4
            for (int j = k + 1; j <= i; ++j) hessian[i * LD + j] -= below * hessian[j * LD + k];
        }
        sync();
    }
    #pragma unroll 1
    for (int k = NV - 1; k >= 0; --k) {
        const float x = search[k] / hessian[k * LD + k];
        sync();
        for (int i = lane; i <= k; i += LANES) search[i] = i == k ? x : search[i] - hessian[k * LD + i] * x;
        sync();
    }
};

// Newton's direction at the present gradient. Returns |direction|^2 and the decrement.
//
// The Hessian is M plus a sum of squares of rows g. An active plain row gives sqrt(D) J. A contact on the side of its cone,
// of normal row a = mu J_0, tangent rows z_k = friction_k J_k and unit tangent residual e, gives
//     sqrt(dm) (a - mu sum_k e_k z_k)      and      sqrt(dm (mu^2 - mu n / t)) (what of z is at right angles to e),
// the latter as rows of the reflection that turns e into an axis.
auto find_direction = [&](float& search_dot, float& decrement) {
    constexpr int MINE = (ENTRIES + LANES - 1) / LANES;
    float sums[MINE];
    for (int m = 0; m < MINE; ++m) sums[m] = 0.0f;
    #pragma unroll 1
    for (int begin = 0; begin < num_rows; begin += CHUNK) {
        const int count = wp::min(CHUNK, num_rows - begin);
        #pragma unroll 1
        for (int s = lane; s < count; s += LANES) {
            const int r = begin + s, c = contact_of[r];
            float* of = coefficient + s * DIM;
            #pragma unroll 1
            for (int k = 0; k < DIM; ++k) of[k] = 0.0f;
            if (state[r] == QUADRATIC) of[0] = wp::sqrt(d_of[r]);
            if (state[r] != CONE) continue;
            const int first = first_row(c), dim = problem.condim.data[c], row = r - first;
            const float mu = friction_of(c, 0) * root_impratio, dm = safe(d_of[first], mu * mu * (1.0f + mu * mu));
            float e[DIM], tt = 0.0f;
            #pragma unroll 1
            for (int k = 1; k < dim; ++k) {
                e[k] = jaref[first + k] * friction_of(c, k - 1);
                tt += e[k] * e[k];
            }
            const float t = wp::max(wp::sqrt(tt), MINVAL);
            #pragma unroll 1
            for (int k = 1; k < dim; ++k) e[k] /= t;
            if (row == 0) {
                of[0] = wp::sqrt(dm) * mu;
                #pragma unroll 1
                for (int k = 1; k < dim; ++k) of[k] = -of[0] * e[k] * friction_of(c, k - 1);
            } else if (row < dim - 1) {
                const float weight = wp::sqrt(dm * wp::max(0.0f, mu * mu - mu * (jaref[first] * mu) / t));
                const float sign = e[1] < 0.0f ? -1.0f : 1.0f;
                #pragma unroll 1
                for (int k = 1; k < dim; ++k) {
                    const float v = k == 1 ? e[1] + sign : e[k];
                    const float entry = (k == row + 1 ? 1.0f : 0.0f) - e[row + 1] * v / (1.0f + wp::abs(e[1]));
                    of[k] = weight * entry * friction_of(c, k - 1);
                }
            }
        }
        sync();
        #pragma unroll 1
        for (int m = lane; m < count * NV; m += LANES) {
            const int s = m / NV, i = m % NV, r = begin + s;
            const float* of = coefficient + s * DIM;
            float sum = 0.0f;
            if (state[r] == CONE) {
                const int first = first_row(contact_of[r]), dim = problem.condim.data[contact_of[r]];
                #pragma unroll 1
                for (int k = 0; k < dim; ++k) sum += of[k] * jacobian[(first + k) * stride + i];
            } else if (state[r] == QUADRATIC) {
                sum = of[0] * jacobian[r * stride + i];
            }
            part[s * LD + i] = sum;
        }
        sync();
        for (int m = 0, e = lane; e < ENTRIES; ++m, e += LANES) {
            const int i = problem.tri_col.data[e], j = problem.tri_row.data[e];
            float sum = sums[m];
            #pragma unroll 4
            for (int s = 0; s < count; ++s) sum += part[s * LD + i] * part[s * LD + j];
            sums[m] = sum;
        }
        sync();
    }
    for (int m = 0, e = lane; e < ENTRIES; ++m, e += LANES) {
        const int at = problem.tri_col.data[e] * LD + problem.tri_row.data[e];
        hessian[at] = inertia[at] + sums[m];
    }
    for (int i = lane; i < NV; i += LANES) search[i] = gradient[i];
    sync();
    solve_hessian();
    float dot = 0.0f, along = 0.0f;
    for (int i = lane; i < NV; i += LANES) {
        const float x = search[i];
        dot += x * x;
        along += gradient[i] * x;
        search[i] = -x;
    }
    search_dot = total(dot);
    decrement = total(along);
    sync();
};

// Cost, slope and curvature along the search direction, of one row or contact. Costs at a step are told from those at 0.
auto loss_at = [](const Row& row, float x) {
    if (-row.range < x && x < row.range) return Point{0.5f * row.d * x * x, row.jv * row.d * x, row.jv * row.jv * row.d};
    if (x <= -row.range) return Point{row.loss * (-0.5f * row.range - x), -row.loss * row.jv, 0.0f};
    return Point{row.loss * (-0.5f * row.range + x), row.loss * row.jv, 0.0f};
};
auto read_row = [&](int r) {
    Row row;
    row.kind = NOTHING;
    const int c = contact_of[r];
    if (r < num_equal || c == NO_ROOM) return row;
    row.jaref = jaref[r];
    row.jv = jv[r];
    row.d = d_of[r];
    if (r < num_fixed) {
        row.kind = LOSS;
        row.loss = wp::index(problem.frictionloss, world, r);
        row.range = safe(row.loss, row.d);
        row.cost0 = loss_at(row, row.jaref).cost;
    } else if (c == NO_CONTACT) {
        row.kind = PLAIN;
        row.cost0 = row.jaref < 0.0f ? 0.5f * row.d * row.jaref * row.jaref : 0.0f;
    } else if (r == first_row(c)) {
        row.kind = CONTACT;
        const int dim = problem.condim.data[c];
        row.mu = friction_of(c, 0) * root_impratio;
        row.u0 = row.jaref * row.mu;
        row.v0 = row.jv * row.mu;
        row.q0 = row.q1 = row.q2 = row.uu = row.uv = row.vv = 0.0f;
        #pragma unroll 1
        for (int k = 0; k < dim; ++k) {
            const float x = jaref[r + k], y = jv[r + k], dx = d_of[r + k] * x, dy = d_of[r + k] * y;
            row.q0 += 0.5f * x * dx;
            row.q1 += y * dx;
            row.q2 += 0.5f * y * dy;
            if (k == 0) continue;
            const float u = x * friction_of(c, k - 1), v = y * friction_of(c, k - 1);
            row.uu += u * u;
            row.uv += u * v;
            row.vv += v * v;
        }
        row.dm = row.d / (row.mu * row.mu * (1.0f + row.mu * row.mu));
        row.t0 = row.uu <= 0.0f ? 0.0f : wp::sqrt(row.uu);
        row.r0 = row.cost0 = 0.0f;
        row.state0 = SATISFIED;
        if (row.uu <= 0.0f ? row.u0 < 0.0f : row.u0 < row.mu * row.t0 && row.mu * row.u0 + row.t0 <= 0.0f) {
            row.cost0 = row.q0;
            row.state0 = QUADRATIC;
        } else if (row.uu > 0.0f && row.u0 < row.mu * row.t0) {
            row.r0 = row.u0 - row.mu * row.t0;
            row.cost0 = 0.5f * row.dm * row.r0 * row.r0;
            row.state0 = CONE;
        }
    }
    return row;
};
auto at_zero = [&](const Row& row) {
    if (row.kind == LOSS) return loss_at(row, row.jaref);
    if (row.kind == PLAIN && row.jaref < 0.0f) {
        return Point{row.cost0, row.jv * row.d * row.jaref, row.jv * row.jv * row.d};
    }
    if (row.kind == CONTACT && row.state0 == QUADRATIC) return Point{row.q0, row.q1, 2.0f * row.q2};
    if (row.kind == CONTACT && row.state0 == CONE) {
        const float t1 = row.uv / row.t0, t2 = (row.vv - t1 * t1) / row.t0, r1 = row.v0 - row.mu * t1;
        return Point{row.cost0, row.dm * row.r0 * r1, row.dm * (r1 * r1 - row.mu * row.r0 * t2)};
    }
    return Point{0.0f, 0.0f, 0.0f};
};
auto cone_gap = [](const Row& row, float n, float t) {  // of the quadratic's cost over the cone's
    const float boundary = row.mu * n + t;
    return 0.5f * row.dm * boundary * boundary;
};
auto contact_at = [&](const Row& row, float alpha) {
    const float n = row.u0 + alpha * row.v0, more = alpha * (2.0f * row.uv + alpha * row.vv), tt = row.uu + more;
    const float t = tt <= 0.0f ? 0.0f : wp::sqrt(tt);
    if (tt <= 0.0f ? n < 0.0f : n < row.mu * t && row.mu * n + t <= 0.0f) {
        float cost = alpha * (alpha * row.q2 + row.q1);
        if (row.state0 == CONE) cost += cone_gap(row, row.u0, row.t0);
        if (row.state0 == SATISFIED) cost = 0.5f * row.dm * (1.0f + row.mu * row.mu) * (n * n + wp::max(tt, 0.0f));
        return Point{cost, 2.0f * alpha * row.q2 + row.q1, 2.0f * row.q2};
    }
    if (tt <= 0.0f || n >= row.mu * t) return Point{-row.cost0, 0.0f, 0.0f};
    const float t1 = (row.uv + alpha * row.vv) / t, t2 = (row.vv - t1 * t1) / t;
    const float rest = n - row.mu * t, r1 = row.v0 - row.mu * t1;
    float cost = 0.5f * row.dm * rest * rest;
    if (row.state0 == CONE) {  // t - t0 without cancellation
        const float change = alpha * row.v0 - row.mu * (more / (t + row.t0));
        cost = 0.5f * row.dm * change * (2.0f * row.r0 + change);
    } else if (row.state0 == QUADRATIC) {
        cost = alpha * (alpha * row.q2 + row.q1) - cone_gap(row, n, t);
    }
    return Point{cost, row.dm * rest * r1, row.dm * (r1 * r1 - rest * row.mu * t2)};
};
auto row_at = [&](const Row& row, float alpha) {
    if (row.kind == CONTACT) return contact_at(row, alpha);
    if (row.kind == NOTHING) return Point{0.0f, 0.0f, 0.0f};
    const float x = row.jaref + alpha * row.jv;
    if (row.kind == LOSS) {
        const Point p = loss_at(row, x);
        return Point{p.cost - row.cost0, p.slope, p.curve};
    }
    if (x >= 0.0f) return Point{-row.cost0, 0.0f, 0.0f};
    const float curve = row.jv * row.jv * row.d, slope = row.jv * row.d * row.jaref;
    const float offset = row.jaref < 0.0f ? 0.0f : 0.5f * row.d * row.jaref * row.jaref;
    return Point{alpha * (slope + 0.5f * alpha * curve) + offset, slope + alpha * curve, curve};
};
constexpr int KEPT = LANES == 1 ? ROWS : 0;  // one thread reads a row once a search; 32 have one each, and no room
Row rows[KEPT + 1];
float gauss_slope, gauss_curve;  // of the inertia and of equalities: a parabola
auto line_at = [&](float alpha) {
    Point sum = {0.0f, 0.0f, 0.0f};
    #pragma unroll 1
    for (int r = lane; r < num_rows; r += LANES) {
        const Point p = row_at(KEPT > 0 ? rows[r] : read_row(r), alpha);
        sum.cost += p.cost;
        sum.slope += p.slope;
        sum.curve += p.curve;
    }
    return Point{
        total(sum.cost) + alpha * (alpha * gauss_curve + gauss_slope),
        total(sum.slope) + 2.0f * alpha * gauss_curve + gauss_slope,
        total(sum.curve) + 2.0f * gauss_curve
    };
};
// Newton steps from both ends of a bracket and its middle, until the slope is all but 0. False where the cap stopped it.
auto search_line = [&](float search_dot, float scale, float& alpha, float& gained) {
    Point start = {0.0f, 0.0f, 0.0f};
    float slope = 0.0f, curve = 0.0f;
    #pragma unroll 1
    for (int r = lane; r < num_rows; r += LANES) {
        const Row row = read_row(r);
        if (KEPT > 0) rows[r] = row;
        const Point p = at_zero(row);
        start.cost += p.cost;
        start.slope += p.slope;
        start.curve += p.curve;
        if (r < num_equal) {
            slope += jv[r] * d_of[r] * jaref[r];
            curve += 0.5f * jv[r] * jv[r] * d_of[r];
        }
    }
    for (int i = lane; i < NV; i += LANES) {
        slope += search[i] * (momentum[i] - smooth[i]);
        curve += 0.5f * search[i] * mv[i];
    }
    gauss_slope = total(slope);
    gauss_curve = total(curve);
    start = {total(start.cost), total(start.slope), total(start.curve)};
    const float size = wp::sqrt(2.0f * wp::max(start.cost, 0.0f) * wp::max(start.curve, 0.0f)) + wp::abs(gauss_slope);
    const float flat = wp::max(least * ls_least * wp::sqrt(search_dot) / scale, 1e-6f);
    const float accepted = wp::max(flat, EPS * size);  // slopes below are those of rounding
    start = {0.0f, start.slope + gauss_slope, start.curve + 2.0f * gauss_curve};
    alpha = gained = 0.0f;
    if (wp::abs(start.slope) < EPS * size) return true;

    auto between = [](const Point& x, const Point& y) {
        return (x.slope < y.slope && y.slope < 0.0f) || (x.slope > y.slope && y.slope > 0.0f);
    };
    Point low = start, high = start, p[3];
    float low_alpha = 0.0f, high_alpha = 0.0f, at[3] = {-safe(start.slope, start.curve), 0.0f, 0.0f};
    #pragma unroll 1
    for (int iteration = 0; iteration <= problem.most_line_iterations; ++iteration) {
        const int tries = iteration == 0 ? 1 : 3;  // the Newton step alone, then both ends' and the middle
        int best = -1;
        #pragma unroll 1
        for (int k = 0; k < tries; ++k) {
            p[k] = line_at(at[k]);
            const bool good = wp::abs(p[k].slope) < accepted && p[k].cost < 0.0f;
            if (good && (best < 0 || p[k].cost < p[best].cost)) best = k;
        }
        if (best >= 0) {
            alpha = at[best];
            gained = -p[best].cost;
            return true;
        }
        if (iteration == 0) {
            if (p[0].slope < start.slope) { low = p[0]; low_alpha = at[0]; }
            else { high = p[0]; high_alpha = at[0]; }
        } else {
            bool moved = false;
            auto raise = [&](int k) {
                if (between(low, p[k])) { low = p[k]; low_alpha = at[k]; moved = true; }
            };
            auto lower = [&](int k) {
                const bool crosses = k == 1 && high.slope < 0.0f && p[k].slope > 0.0f;
                if (between(high, p[k]) || crosses) { high = p[k]; high_alpha = at[k]; moved = true; }
            };
            raise(0); raise(2); raise(1);
            lower(1); lower(2); lower(0);
            if (low.cost < 0.0f || high.cost < 0.0f) {
                const bool is_low = low.cost < high.cost;
                alpha = is_low ? low_alpha : high_alpha;
                gained = -(is_low ? low.cost : high.cost);
            }
            if (!moved || (low.cost < 0.0f && low.slope < 0.0f && low.slope > -flat)
                || (high.cost < 0.0f && high.slope > 0.0f && high.slope < flat)) return true;
        }
        at[0] = low_alpha - safe(low.slope, low.curve);
        at[1] = high_alpha - safe(high.slope, high.curve);
        at[2] = 0.5f * (low_alpha + high_alpha);
    }
    return false;
};

#pragma unroll 1
for (int m = lane; m < NV * LD; m += LANES) inertia[m] = 0.0f;
sync();
#pragma unroll 1
for (int m = lane; m < $inertia; m += LANES) {
    const int i = problem.inertia_row.data[m], j = problem.inertia_col.data[m];
    inertia[i * LD + j] = inertia[j * LD + i] = wp::index(problem.inertia, world, m);
}
for (int i = lane; i < NV; i += LANES) {
    qacc[i] = num_rows > 0 ? wp::index(problem.qacc_warmstart, world, i) : 0.0f;
}
sync();
float trace = 0.0f;
for (int i = lane; i < NV; i += LANES) {
    trace += inertia[i * LD + i];
    float sum = 0.0f;
    for (int j = 0; j < NV; ++j) sum += inertia[i * LD + j] * qacc[j];
    momentum[i] = sum;
}
const float scale = 1.0f / wp::max(MINVAL, total(trace));
#pragma unroll 1
for (int r = lane; r < num_rows; r += LANES) {
    float sum = -wp::index(problem.aref, world, r);
    for (int i = 0; i < NV; ++i) sum += jacobian[r * stride + i] * qacc[i];
    jaref[r] = sum;
    contact_of[r] = NO_CONTACT;
    if (wp::index(problem.row_type, world, r) == $elliptic) {
        const int c = wp::index(problem.row_id, world, r);
        contact_of[r] = c < num_contacts && first_row(c) >= 0 ? c : NO_ROOM;
    }
}
sync();
float search_dot, decrement, alpha, gained;
int iteration = 0, bits = 0;
if (num_rows == 0) {  // nothing to iterate: the inertia takes all forces
    for (int i = lane; i < NV; i += LANES) {
        for (int j = 0; j <= i; ++j) hessian[i * LD + j] = inertia[i * LD + j];
        search[i] = momentum[i] = smooth[i];
        constraint[i] = 0.0f;
    }
    sync();
    solve_hessian();
    for (int i = lane; i < NV; i += LANES) qacc[i] = search[i];
    iteration = 1;
}
while (num_rows > 0) {
    update_forces();
    float squares = 0.0f;
    for (int i = lane; i < NV; i += LANES) {
        const float g = momentum[i] - smooth[i] - constraint[i];
        gradient[i] = g;
        squares += g * g;
    }
    squares = total(squares);
    // mujoco_warp's test, made before the Hessian that a robot that is done would not need.
    if (iteration > 0 && (alpha == 0.0f || (scale * gained > 0.0f && scale * gained < least)
        || scale * wp::sqrt(squares) < least)) break;
    find_direction(search_dot, decrement);
    if (iteration > 0 && scale * 0.5f * decrement < least) break;
    if (iteration == problem.most_iterations) {
        bits |= $too_many;
        break;
    }
    for (int i = lane; i < NV; i += LANES) {
        float sum = 0.0f;
        for (int j = 0; j < NV; ++j) sum += inertia[i * LD + j] * search[j];
        mv[i] = sum;
    }
    #pragma unroll 1
    for (int r = lane; r < num_rows; r += LANES) {
        float sum = 0.0f;
        for (int i = 0; i < NV; ++i) sum += jacobian[r * stride + i] * search[i];
        jv[r] = sum;
    }
    sync();
    if (!search_line(search_dot, scale, alpha, gained)) bits |= $too_many_on_line;
    sync();
    for (int i = lane; i < NV; i += LANES) {
        qacc[i] += alpha * search[i];
        momentum[i] += alpha * mv[i];
    }
    #pragma unroll 1
    for (int r = lane; r < num_rows; r += LANES) jaref[r] += alpha * jv[r];
    sync();
    ++iteration;
}
for (int i = lane; i < NV; i += LANES) {
    wp::index(problem.qacc, world, i) = qacc[i];
    wp::index(problem.momentum, world, i) = momentum[i];
}
#pragma unroll 1
for (int r = lane; r < num_rows; r += LANES) {
    wp::index(problem.force, world, r) = force[r];
    wp::index(problem.state, world, r) = state[r];
}
if ($step) {
    // Velocities by the forces found, those of joints as they change over the step (MuJoCo's implicitfast); then positions.
    const float dt = wp::index(motion.timestep, world % motion.timestep.shape[0]);
    float* qvel = &wp::index(motion.qvel, world, 0);
    float* qpos = &wp::index(motion.qpos, world, 0);
    sync();
    for (int i = lane; i < NV; i += LANES) {
        for (int j = 0; j <= i; ++j) hessian[i * LD + j] = inertia[i * LD + j];
        hessian[i * LD + i] += dt * wp::index(motion.slope, world, i);
        search[i] = momentum[i];
        wp::index(problem.qacc_warmstart, world, i) = qacc[i];
    }
    sync();
    solve_hessian();
    for (int i = lane; i < NV; i += LANES) {
        search[i] = qvel[i] + search[i] * dt;
        qvel[i] = search[i];
    }
    sync();
    #pragma unroll 1
    for (int j = lane; j < motion.joint_type.shape[0]; j += LANES) {
        const float* v = search + motion.joint_dof.data[j];
        float* q = qpos + motion.joint_qpos.data[j];
        if (motion.joint_type.data[j] != $free) {
            q[0] += dt * v[0];
            continue;
        }
        for (int i = 0; i < 3; ++i) q[i] += dt * v[i];
        // Approximate sines of small angles would be too coarse for what adds up over a crossing: series, to rounding below 1.
        const float square = 0.25f * dt * dt * (v[3] * v[3] + v[4] * v[4] + v[5] * v[5]), half = wp::sqrt(square);
        float s = 1.0f, c = 1.0f;  // s over half
        if (square < 1.0f) {
            s -= square / 6.0f * (1.0f - square / 20.0f * (1.0f - square / 42.0f * (1.0f - square / 72.0f)));
            c -= square / 2.0f * (1.0f - square / 12.0f * (1.0f - square / 30.0f * (1.0f - square / 56.0f)));
        } else {
            s = wp::sin(half) / half;
            c = wp::cos(half);
        }
        s *= 0.5f * dt;
        const float length = wp::sqrt(q[3] * q[3] + q[4] * q[4] + q[5] * q[5] + q[6] * q[6]);
        const float w = q[3] / length, x = q[4] / length, y = q[5] / length, z = q[6] / length;
        const float a = s * v[3], b = s * v[4], d = s * v[5];
        const float turned[4] = {
            w * c - x * a - y * b - z * d, w * a + x * c + y * d - z * b, w * b - x * d + y * c + z * a,
            w * d + x * b - y * a + z * c};
        const float now = wp::sqrt(
            turned[0] * turned[0] + turned[1] * turned[1] + turned[2] * turned[2] + turned[3] * turned[3]);
        for (int i = 0; i < 4; ++i) q[3 + i] = turned[i] / now;
    }
    if (problem.num_rows.data[world] > ROWS) bits |= $too_many_rows;
    if (num_contacts > motion.most_contacts) bits |= $too_many_contacts;
}
if (lane == 0) {
    problem.iterations.data[world] = iteration;
    problem.overflow.data[world] |= bits;
}
