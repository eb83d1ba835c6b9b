struct Point { float cost, slope, curve; };
struct Spring { float stiffness, damping, impedance; };
constexpr int NV = $dofs, DIM = $dimensions, NUM_SHARED = $num_shared, LD = $stride, CHUNK = $chunk;
constexpr int PER_LANE = (NV + LANES - 1) / LANES;  // a lane has dof `lane` and every LANES-th after it
constexpr bool HAS_LOSSES = $losses, SPILLS = $spills;  // SPILLS: there may be more contacts than fit into shared memory
constexpr float MINVAL = ${minval}f, EPS = 8.0f * 1.1920929e-07f;
enum { SATISFIED, QUADRATIC, CONE };
struct alignas(16) Float4 { float v[4]; };
struct alignas(16) Contact {
    float jacobian[DIM][LD], jaref[DIM], jv[DIM], force[DIM], d[DIM], friction[DIM];  // friction[0]: the cone's mu
    int state, slot;  // slot: where it lies in problem.contacts
};
using LaneVector = float[PER_LANE];
using Row = float[LANES == 1 ? LD : NV];  // one row of a matrix; with its end a CPU takes four numbers at once
using LaneRows = Row[PER_LANE];
using Vec = wp::vec_t<3, float>;
using Vec2 = wp::vec_t<2, float>;
using Vec5 = wp::vec_t<5, float>;
float* inertia = memory;  // NV x NV, rows LD apart as all are
float* vector = inertia + NV * LD;  // operand of products, one number a dof
float* part = vector + LD;  // CHUNK x DIM x NV; also rows of a factorisation
float* coefficient = part + $part_rows * LD;  // CHUNK x DIM x DIM
Contact* shared_contacts = (Contact*)(coefficient + (CHUNK * DIM * DIM + 3) / 4 * 4);
constexpr int NUM_FLOATS = (NV + 1 + $part_rows) * LD + (CHUNK * DIM * DIM + 3) / 4 * 4 + NUM_SHARED * sizeof(Contact) / 4;
static_assert(NUM_FLOATS == $num_floats, "kernels/solver.py counts memory otherwise");
Contact* spilled_contacts = (Contact*)&wp::index(problem.spilled_contacts, world, 0);
auto get_contact = [&](int c) -> Contact& {
    return !SPILLS || c < NUM_SHARED ? shared_contacts[c] : spilled_contacts[c - NUM_SHARED];
};
const int capacity = problem.contacts.shape.shape[1];  // no constant: robots with room for more have one kernel
const int num_found = problem.contacts.count.data[world], num_contacts = wp::min(num_found, capacity);
const float dt = wp::index(problem.timestep, row_of(problem.timestep));
const float root_impratio = wp::index(problem.impratio_invsqrt, row_of(problem.impratio_invsqrt));
const float tolerance = wp::index(problem.tolerance, row_of(problem.tolerance));
const float ls_tolerance = wp::index(problem.ls_tolerance, row_of(problem.ls_tolerance));
float* qvel = &wp::index(robots.qvel, world, 0);
float* qpos = &wp::index(robots.qpos, world, 0);
auto safe = [](float x, float y) { return x / (y != 0.0f ? y : MINVAL); };
auto product = [](const float* x, const float* y) {
    float sum = 0.0f;
    #pragma unroll
    for (int k = 0; k < LD; k += 4) {
        const Float4 a = *(const Float4*)(x + k), b = *(const Float4*)(y + k);
        for (int j = 0; j < 4; ++j) sum += a.v[j] * b.v[j];
    }
    return sum;
};
auto write_vector = [&](const LaneVector& values) {
    sync();
    #pragma unroll ALL
    for (int m = 0; m < PER_LANE; ++m) {
        const int i = lane + m * LANES;
        if (i < NV) vector[i] = values[m];
    }
    sync();
};
auto times_inertia = [&](LaneVector& out) {  // out = inertia * vector
    #pragma unroll ALL
    for (int m = 0; m < PER_LANE; ++m) {
        const int i = lane + m * LANES;
        out[m] = i < NV ? product(inertia + i * LD, vector) : 0.0f;
    }
};
auto read_inertia = [&](Row& row, int i, float more) {  // a row, with more on the diagonal
    #pragma unroll ALL
    for (int j = 0; j < NV; j += 4) {
        const Float4 four = *(const Float4*)(inertia + wp::min(i, NV - 1) * LD + j);
        #pragma unroll
        for (int k = 0; k < 4; ++k) {
            if (LANES == 1 || j + k < NV) row[j + k] = four.v[k] + (i == j + k ? more : 0.0f);
        }
    }
};
// Stiffness, damping and impedance at a distance, from solref and solimp (MuJoCo, "Solver parameters").
auto make_spring = [&](const Vec2& solref, const Vec5& solimp, float x) {
    const float time = wp::max(solref[0], 2.0f * dt), low = wp::clamp(solimp[0], ${min_imp}f, ${max_imp}f);
    const float high = wp::clamp(solimp[1], ${min_imp}f, ${max_imp}f), share = wp::abs(x) / wp::max(solimp[2], MINVAL);
    Spring s;
    s.stiffness = solref[0] <= 0.0f ? -solref[0] / (high * high)
                                    : 1.0f / wp::max(MINVAL, high * high * time * time * solref[1] * solref[1]);
    s.damping = solref[1] <= 0.0f ? -solref[1] / high : 2.0f / wp::max(MINVAL, high * time);
    if (low == high || solimp[2] <= MINVAL) {
        s.impedance = 0.5f * (low + high);
    } else if (share >= 1.0f) {
        s.impedance = high;
    } else {
        const float middle = wp::clamp(solimp[3], ${min_imp}f, ${max_imp}f), power = wp::max(1.0f, solimp[4]);
        const bool below = share <= middle;
        const float whole = below ? middle : 1.0f - middle, rest = (below ? share : 1.0f - share) / whole;
        const float y = whole * (power == 2.0f ? rest * rest : rest <= 0.0f ? 0.0f : wp::pow(rest, power));
        s.impedance = wp::clamp(low + (below ? y : 1.0f - y) * (high - low), low, high);
    }
    return s;
};
auto compute_stiffness = [](float weight, float impedance) {  // D
    return 1.0f / wp::max(weight * (1.0f - impedance) / impedance, MINVAL);
};
auto make_frame = [](const Vec& normal, Vec (&frame)[3]) {  // normal and two tangents
    const Vec axis = wp::abs(normal[1]) < 0.5f ? Vec(0.0f, 1.0f, 0.0f) : Vec(0.0f, 0.0f, 1.0f);
    frame[0] = wp::normalize(normal);
    frame[1] = wp::normalize(axis - frame[0] * wp::dot(frame[0], axis));
    frame[2] = wp::cross(frame[0], frame[1]);
};

// Computes force and state of each contact at the present residuals, and the generalised force of all constraints.
float qacc[PER_LANE], momentum[PER_LANE], gradient[PER_LANE], search[PER_LANE], constraint[PER_LANE], smooth[PER_LANE];
float limit_d[PER_LANE], limit_aref[PER_LANE], side[PER_LANE];  // joint limits; side points back, d is 0 within
float loss[PER_LANE], loss_d[PER_LANE], loss_aref[PER_LANE];    // joint friction
auto update_forces = [&]() {
    #pragma unroll 1
    for (int c = lane; c < num_contacts; c += LANES) {
        Contact& contact = get_contact(c);
        const float mu = contact.friction[0], n = contact.jaref[0] * mu;
        float u[DIM], tt = 0.0f;
        #pragma unroll
        for (int k = 1; k < DIM; ++k) {
            u[k] = contact.jaref[k] * contact.friction[k];
            tt += u[k] * u[k];
        }
        const float t = tt <= 0.0f ? 0.0f : wp::sqrt(tt);
        if (n >= mu * t || (t <= 0.0f && n >= 0.0f)) {
            for (int k = 0; k < DIM; ++k) contact.force[k] = 0.0f;
            contact.state = SATISFIED;
        } else if (mu * n + t <= 0.0f || (t <= 0.0f && n < 0.0f)) {
            for (int k = 0; k < DIM; ++k) contact.force[k] = -contact.d[k] * contact.jaref[k];
            contact.state = QUADRATIC;
        } else {
            const float normal = -safe(contact.d[0], mu * mu * (1.0f + mu * mu)) * (n - mu * t) * mu;
            contact.force[0] = normal;
            #pragma unroll
            for (int k = 1; k < DIM; ++k) contact.force[k] = -safe(normal, t) * (u[k] * contact.friction[k]);
            contact.state = CONE;
        }
    }
    sync();
    #pragma unroll ALL
    for (int m = 0; m < PER_LANE; ++m) {
        const int i = lane + m * LANES;
        float sum = 0.0f;
        #pragma unroll 1
        for (int c = 0; c < num_contacts; ++c) {
            const Contact& contact = get_contact(c);
            if (i >= NV || contact.state == SATISFIED) continue;
            #pragma unroll
            for (int k = 0; k < DIM; ++k) sum += contact.jacobian[k][i] * contact.force[k];
        }
        const float x = side[m] * qacc[m] - limit_aref[m];
        if (x < 0.0f) sum -= side[m] * limit_d[m] * x;
        if (HAS_LOSSES) sum -= wp::clamp(loss_d[m] * (qacc[m] - loss_aref[m]), -loss[m], loss[m]);
        constraint[m] = sum;
    }
};

// Solves h x = y in place by L^T D L; h is overwritten. Each lane holds its rows. The ground touches one branch of a robot's
// tree at a time, so that h is as sparse as the inertia: a dof changes its ancestors alone (Featherstone, "Rigid Body Dynamics
// Algorithms", 6.4), and branches are worked on side by side. From the leaves on a step eliminates ends of branches, or ends and
// their parents (kernels/solver.py, `elimination`): a warp waits for its memory once a step. Rows of pivots go through shared
// memory: h is symmetric, so each lane writes one number of each. Loops of a warp need constant bounds to be unrolled.
constexpr int STEPS = $steps, CHAINS = $chains, PARENT[] = {$parents};
constexpr int STEP[] = {$step}, END[] = {$ends}, NEXT[] = {$nexts}, ROW[] = {$rows};
constexpr bool IS_LEAF[] = {$leaves}, IS_ABOVE[][NV] = {$above};
auto solve = [&](LaneRows& h, LaneVector& y) {
    float inverse[PER_LANE];
    if (LANES == 1) {
        for (int k = NV - 1; k >= 0; --k) {
            inverse[k] = 1.0f / h[k][k];
            for (int i = PARENT[k]; i >= 0; i = PARENT[i]) {
                const float share = h[k][i] * inverse[k];
                y[i] -= share * y[k];
                for (int j = 0; j <= i; j += 4) {
                    const Float4 four = *(const Float4*)(h[k] + j);
                    for (int n = 0; n < 4; ++n) h[i][j + n] -= share * four.v[n];
                }
            }
        }
        for (int k = 0; k < NV; ++k) {
            for (int i = PARENT[k]; i >= 0; i = PARENT[i]) y[k] -= h[k][i] * y[i];
            y[k] *= inverse[k];
        }
        return;
    }
    bool open[PER_LANE];  // not eliminated; in the second half, not solved
    #pragma unroll
    for (int m = 0; m < PER_LANE; ++m) open[m] = true;
    sync();  // the last rows of a former call may be read still
    #pragma unroll
    for (int s = 0; s < STEPS; ++s) {
        #pragma unroll
        for (int c = 0; c < CHAINS; ++c) {
            if (STEP[c] != s) continue;
            #pragma unroll
            for (int m = 0; m < PER_LANE; ++m) {
                const int i = lane + m * LANES;
                if (i >= NV) continue;
                part[ROW[c] * LD + i] = h[m][END[c]];
                if (NEXT[c] >= 0) part[(ROW[c] + 1) * LD + i] = h[m][NEXT[c]];
            }
        }
        float of_end[CHAINS], of_next[CHAINS];  // first of all branches, so that none waits for another
        #pragma unroll
        for (int c = 0; c < CHAINS; ++c) {
            if (STEP[c] != s) continue;
            of_end[c] = shuffle(y[END[c] / LANES], END[c] % LANES);
            of_next[c] = NEXT[c] < 0 ? 0.0f : shuffle(y[NEXT[c] / LANES], NEXT[c] % LANES);
        }
        sync();
        #pragma unroll
        for (int c = 0; c < CHAINS; ++c) {
            if (STEP[c] != s) continue;
            const int k = END[c], next_k = NEXT[c], last = next_k < 0 ? k : next_k;
            const float *row = part + ROW[c] * LD, *next = row + LD;
            const float pivot = 1.0f / row[k], y_k = of_end[c];
            float beside = 0.0f, share = 0.0f, next_pivot = 0.0f;
            if (next_k >= 0) {
                beside = row[next_k];
                share = beside * pivot;
                next_pivot = 1.0f / (next[next_k] - share * beside);
            }
            const float y_next = of_next[c] - share * y_k;
            #pragma unroll
            for (int m = 0; m < PER_LANE; ++m) {
                const int i = lane + m * LANES;
                if (i == k) inverse[m] = pivot;
                if (i == next_k) inverse[m] = next_pivot;
                const float below = open[m] && i != k ? h[m][k] * pivot : 0.0f;
                open[m] = open[m] && i != k && i != next_k;
                const float below_next = open[m] && next_k >= 0 ? (h[m][last] - below * beside) * next_pivot : 0.0f;
                const float of_row = below - below_next * share;
                y[m] -= below * y_k + below_next * y_next;
                #pragma unroll
                for (int j = 0; j < NV; j += 4) {
                    bool any = false;
                    #pragma unroll
                    for (int n = 0; n < 4; ++n) any = any || (j + n < NV && IS_ABOVE[last][j + n]);
                    if (!any) continue;
                    const Float4 four = *(const Float4*)(row + j), next_four = next_k < 0 ? four : *(const Float4*)(next + j);
                    #pragma unroll
                    for (int n = 0; n < 4; ++n) {
                        if (j + n < NV && IS_ABOVE[last][j + n]) h[m][j + n] -= of_row * four.v[n] + below_next * next_four.v[n];
                    }
                }
            }
        }
    }
    #pragma unroll
    for (int m = 0; m < PER_LANE; ++m) open[m] = true;
    #pragma unroll
    for (int s = 2 * STEPS - 1; s >= 0; --s) {  // from the roots on: in each step parents, then ends
        const int* of_step = s % 2 == 1 ? NEXT : END;
        float x[CHAINS];
        #pragma unroll
        for (int c = 0; c < CHAINS; ++c) {
            if (STEP[c] != s / 2) continue;
            const int k = wp::max(of_step[c], 0);
            x[c] = shuffle(y[k / LANES] * inverse[k / LANES], k % LANES);
        }
        #pragma unroll
        for (int c = 0; c < CHAINS; ++c) {
            if (STEP[c] != s / 2) continue;
            const int k = of_step[c];
            if (k < 0 || IS_LEAF[k]) continue;
            #pragma unroll
            for (int m = 0; m < PER_LANE; ++m) {
                open[m] = open[m] && lane + m * LANES != k;
                if (open[m]) y[m] -= h[m][k] * x[c];
            }
        }
    }
    #pragma unroll
    for (int m = 0; m < PER_LANE; ++m) y[m] *= inverse[m];
};

// Adds the contacts' part of the Hessian to the rows of h.
//
// The Hessian is M, plus a diagonal from joint limits and joint friction, plus a sum of squares of rows g. A sticking contact
// has the rows g = sqrt(D) J. A contact on the side of its cone has normal row a = mu J_0, tangent rows z_k = friction_k J_k and
// unit tangent residual e. Its rows are
//     sqrt(dm) (a - mu sum_k e_k z_k)      and      sqrt(dm (mu^2 - mu n / t)) (the part of z at right angles to e).
// The latter are rows of the reflection that turns e into an axis.
auto add_contacts = [&](LaneRows& h) {
    #pragma unroll 1
    for (int begin = 0; begin < num_contacts; begin += CHUNK) {
        const int count = wp::min(CHUNK, num_contacts - begin);
        #pragma unroll 1
        for (int s = lane; s < count; s += LANES) {
            const Contact& contact = get_contact(begin + s);
            float* rows = coefficient + s * DIM * DIM;
            if (contact.state != CONE) {
                #pragma unroll
                for (int k = 0; k < DIM * DIM; ++k) rows[k] = k % (DIM + 1) == 0 ? wp::sqrt(contact.d[k / DIM]) : 0.0f;
                continue;
            }
            const float mu = contact.friction[0], dm = safe(contact.d[0], mu * mu * (1.0f + mu * mu));
            float e[DIM], tt = 0.0f;
            #pragma unroll
            for (int k = 1; k < DIM; ++k) {
                e[k] = contact.jaref[k] * contact.friction[k];
                tt += e[k] * e[k];
            }
            const float t = wp::max(wp::sqrt(tt), MINVAL), root = wp::sqrt(dm);
            const float weight = wp::sqrt(dm * wp::max(0.0f, mu * mu - mu * (contact.jaref[0] * mu) / t));
            #pragma unroll
            for (int k = 1; k < DIM; ++k) e[k] /= t;
            const float sign = e[1] < 0.0f ? -1.0f : 1.0f;
            #pragma unroll
            for (int row = 0; row < DIM; ++row) {
                rows[row * DIM] = row == 0 ? root * mu : 0.0f;
                #pragma unroll
                for (int k = 1; k < DIM; ++k) {
                    float entry = -root * mu * e[k];
                    if (row > 0 && row < DIM - 1) {
                        const float v = k == 1 ? e[1] + sign : e[k];
                        entry = weight * ((k == row + 1 ? 1.0f : 0.0f) - e[row + 1] * v / (1.0f + wp::abs(e[1])));
                    } else if (row > 0) {
                        entry = 0.0f;
                    }
                    rows[row * DIM + k] = entry * contact.friction[k];
                }
            }
        }
        sync();
        #pragma unroll 1
        for (int s = 0; s < count; ++s) {
            const Contact& contact = get_contact(begin + s);
            if (contact.state == SATISFIED) continue;
            #pragma unroll 1
            for (int i = lane; i < LD; i += LANES) {
                #pragma unroll
                for (int row = 0; row < DIM; ++row) {
                    float sum = 0.0f;
                    #pragma unroll
                    for (int k = 0; k < DIM; ++k) sum += coefficient[(s * DIM + row) * DIM + k] * contact.jacobian[k][i];
                    part[(s * DIM + row) * LD + i] = sum;
                }
            }
        }
        sync();
        #pragma unroll 1
        for (int s = 0; s < count; ++s) {
            if (get_contact(begin + s).state == SATISFIED) continue;
            #pragma unroll
            for (int row = 0; row < DIM; ++row) {
                const float* row_values = part + (s * DIM + row) * LD;
                #pragma unroll ALL
                for (int m = 0; m < PER_LANE; ++m) {
                    const int i = lane + m * LANES;
                    const float value = i < NV ? row_values[i] : 0.0f;
                    #pragma unroll ALL
                    for (int j = 0; j < NV; j += 4) {
                        const Float4 four = *(const Float4*)(row_values + j);
                        #pragma unroll
                        for (int k = 0; k < 4; ++k) {
                            if (LANES == 1 || j + k < NV) h[m][j + k] += value * four.v[k];
                        }
                    }
                }
            }
        }
        sync();
    }
};

// Cost, slope and curvature along the search direction. Costs are relative to the cost at 0.
struct Line {  // a contact along the search direction
    int state0;
    float cost0, q0, q1, q2, mu, u0, v0, uu, uv, vv, dm, t0, r0;
};
auto read_contact = [&](const Contact& contact) {
    Line line;
    line.mu = contact.friction[0];
    line.u0 = contact.jaref[0] * line.mu;
    line.v0 = contact.jv[0] * line.mu;
    line.q0 = line.q1 = line.q2 = line.uu = line.uv = line.vv = 0.0f;
    #pragma unroll
    for (int k = 0; k < DIM; ++k) {
        const float x = contact.jaref[k], y = contact.jv[k], dx = contact.d[k] * x, dy = contact.d[k] * y;
        line.q0 += 0.5f * x * dx;
        line.q1 += y * dx;
        line.q2 += 0.5f * y * dy;
        if (k == 0) continue;
        const float u = x * contact.friction[k], v = y * contact.friction[k];
        line.uu += u * u;
        line.uv += u * v;
        line.vv += v * v;
    }
    line.dm = contact.d[0] / (line.mu * line.mu * (1.0f + line.mu * line.mu));
    line.t0 = line.uu <= 0.0f ? 0.0f : wp::sqrt(line.uu);
    line.r0 = line.cost0 = 0.0f;
    line.state0 = SATISFIED;
    if (line.uu <= 0.0f ? line.u0 < 0.0f : line.u0 < line.mu * line.t0 && line.mu * line.u0 + line.t0 <= 0.0f) {
        line.cost0 = line.q0;
        line.state0 = QUADRATIC;
    } else if (line.uu > 0.0f && line.u0 < line.mu * line.t0) {
        line.r0 = line.u0 - line.mu * line.t0;
        line.cost0 = 0.5f * line.dm * line.r0 * line.r0;
        line.state0 = CONE;
    }
    return line;
};
auto cone_gap = [](const Line& line, float n, float t) {  // cost of the quadratic less cost of the cone
    const float boundary = line.mu * n + t;
    return 0.5f * line.dm * boundary * boundary;
};
auto evaluate_contact = [&](const Line& line, float alpha) {
    const float n = line.u0 + alpha * line.v0, more = alpha * (2.0f * line.uv + alpha * line.vv), tt = line.uu + more;
    const float t = tt <= 0.0f ? 0.0f : wp::sqrt(tt);
    if (tt <= 0.0f ? n < 0.0f : n < line.mu * t && line.mu * n + t <= 0.0f) {
        float cost = alpha * (alpha * line.q2 + line.q1);
        if (line.state0 == CONE) cost += cone_gap(line, line.u0, line.t0);
        if (line.state0 == SATISFIED) cost = 0.5f * line.dm * (1.0f + line.mu * line.mu) * (n * n + wp::max(tt, 0.0f));
        return Point{cost, 2.0f * alpha * line.q2 + line.q1, 2.0f * line.q2};
    }
    if (tt <= 0.0f || n >= line.mu * t) return Point{-line.cost0, 0.0f, 0.0f};
    const float t1 = (line.uv + alpha * line.vv) / t, t2 = (line.vv - t1 * t1) / t;
    const float rest = n - line.mu * t, r1 = line.v0 - line.mu * t1;
    float cost = 0.5f * line.dm * rest * rest;
    if (line.state0 == CONE) {  // t - t0 without cancellation
        const float change = alpha * line.v0 - line.mu * (more / (t + line.t0));
        cost = 0.5f * line.dm * change * (2.0f * line.r0 + change);
    } else if (line.state0 == QUADRATIC) {
        cost = alpha * (alpha * line.q2 + line.q1) - cone_gap(line, n, t);
    }
    return Point{cost, line.dm * rest * r1, line.dm * (r1 * r1 - rest * line.mu * t2)};
};
auto evaluate_limit = [](float d, float x0, float v, float alpha) {
    const float x = x0 + alpha * v, curve = d * v * v, slope = d * v * x0;
    if (x >= 0.0f) return Point{x0 < 0.0f ? -0.5f * d * x0 * x0 : 0.0f, 0.0f, 0.0f};
    if (x0 < 0.0f) return Point{alpha * (slope + 0.5f * alpha * curve), slope + alpha * curve, curve};
    return Point{0.5f * d * x * x, d * v * x, curve};
};
auto evaluate_loss = [](float d, float max_force, float x, float v) {
    const float range = max_force / d;
    if (-range < x && x < range) return Point{0.5f * d * x * x, v * d * x, v * v * d};
    const float sign = x < 0.0f ? -1.0f : 1.0f;
    return Point{max_force * (sign * x - 0.5f * range), sign * max_force * v, 0.0f};
};
constexpr int READ = LANES == 1 ? 64 : 1;  // contacts of a search that a CPU keeps; a lane keeps its first
Line lines[READ];
float gauss_slope, gauss_curve;  // inertia gives a parabola
// `first`, at 0, reads the contacts, computes the constraints' cost, and adds up the lanes' parts of the parabola.
auto evaluate_line = [&](float alpha, bool first, float& cost0) {
    Point sum = {0.0f, 0.0f, 0.0f};
    float before = 0.0f;
    auto add = [&](const Point& p) {
        sum.cost += p.cost;
        sum.slope += p.slope;
        sum.curve += p.curve;
    };
    #pragma unroll 1
    for (int c = lane; c < num_contacts; c += LANES) {
        const bool kept = LANES == 1 ? c < READ : c == lane;
        Line& stored = lines[LANES == 1 ? c % READ : 0];
        Line line = stored;
        if (first || !kept) line = read_contact(get_contact(c));
        if (first && kept) stored = line;
        before += line.cost0;
        add(evaluate_contact(line, alpha));
    }
    #pragma unroll ALL
    for (int m = 0; m < PER_LANE; ++m) {
        if (limit_d[m] > 0.0f) {
            const float x = side[m] * qacc[m] - limit_aref[m];
            if (x < 0.0f) before += 0.5f * limit_d[m] * x * x;
            add(evaluate_limit(limit_d[m], x, side[m] * search[m], alpha));
        }
        if (HAS_LOSSES && loss[m] > 0.0f) {
            const float x = qacc[m] - loss_aref[m], cost = evaluate_loss(loss_d[m], loss[m], x, 0.0f).cost;
            before += cost;
            sum.cost -= cost;
            add(evaluate_loss(loss_d[m], loss[m], x + alpha * search[m], search[m]));
        }
    }
    if (first) {
        add_lanes(before, sum.slope, sum.curve, gauss_slope, gauss_curve);
        cost0 = before;
    } else {
        add_lanes(sum.cost, sum.slope, sum.curve);
    }
    return Point{
        sum.cost + alpha * (alpha * gauss_curve + gauss_slope), sum.slope + 2.0f * alpha * gauss_curve + gauss_slope,
        sum.curve + 2.0f * gauss_curve
    };
};
// Newton steps from both ends of a bracket and from its middle, until the slope is nearly 0. Returns false at the iteration cap.
auto search_line = [&](const LaneVector& mv, float search_dot, float scale, float& alpha, float& gained) {
    gauss_slope = gauss_curve = 0.0f;
    #pragma unroll ALL
    for (int m = 0; m < PER_LANE; ++m) {
        gauss_slope += search[m] * (momentum[m] - smooth[m]);
        gauss_curve += 0.5f * search[m] * mv[m];
    }
    const float flat = wp::max(tolerance * ls_tolerance * wp::sqrt(search_dot) / scale, 1e-6f);
    auto between = [](const Point& x, const Point& y) {
        return (x.slope < y.slope && y.slope < 0.0f) || (x.slope > y.slope && y.slope > 0.0f);
    };
    Point start, low, high, p0, p1;  // p0 and p1: steps of a round from the low and the high end
    float low_alpha = 0.0f, high_alpha = 0.0f, trial_low = 0.0f, trial_high = 0.0f, trial = 0.0f, accepted = 0.0f;
    float best = 0.0f, best_alpha = 0.0f, cost0 = 0.0f;
    alpha = gained = 0.0f;
    #pragma unroll 1
    for (int round = -2, k = 0; round < problem.ls_iterations;) {
        Point p = evaluate_line(trial, round == -2, cost0);
        if (round == -2) {
            const float size = wp::sqrt(2.0f * wp::max(cost0, 0.0f) * wp::max(p.curve - 2.0f * gauss_curve, 0.0f))
                + wp::abs(gauss_slope);
            accepted = wp::max(flat, EPS * size);  // smaller slopes are rounding errors
            if (wp::abs(p.slope) < EPS * size) return true;
            p.cost = 0.0f;
            start = low = high = p;
            trial = -safe(p.slope, p.curve);  // the Newton step alone
            ++round;
            continue;
        }
        if (wp::abs(p.slope) < accepted && p.cost < best) {
            best = p.cost;
            best_alpha = trial;
        }
        if (round == -1) {
            if (p.slope < start.slope) { low = p; low_alpha = trial; }
            else { high = p; high_alpha = trial; }
        } else if (k == 0) {
            p0 = p;
            trial = trial_high;
            k = 1;
            continue;
        } else if (k == 1) {
            p1 = p;
            trial = 0.5f * (low_alpha + high_alpha);
            k = 2;
            continue;
        }
        if (best < 0.0f) {
            alpha = best_alpha;
            gained = -best;
            return true;
        }
        if (round >= 0) {
            bool moved = false;
            auto raise = [&](const Point& q, float x) {
                if (between(low, q)) { low = q; low_alpha = x; moved = true; }
            };
            auto lower = [&](const Point& q, float x, bool crosses) {
                if (between(high, q) || (crosses && high.slope < 0.0f && q.slope > 0.0f)) {
                    high = q;
                    high_alpha = x;
                    moved = true;
                }
            };
            raise(p0, trial_low);
            raise(p, trial);
            raise(p1, trial_high);
            lower(p1, trial_high, true);
            lower(p, trial, false);
            lower(p0, trial_low, false);
            if (low.cost < 0.0f || high.cost < 0.0f) {
                const bool is_low = low.cost < high.cost;
                alpha = is_low ? low_alpha : high_alpha;
                gained = -(is_low ? low.cost : high.cost);
            }
            if (!moved || (low.cost < 0.0f && low.slope < 0.0f && low.slope > -flat)
                || (high.cost < 0.0f && high.slope > 0.0f && high.slope < flat)) return true;
        }
        trial = trial_low = low_alpha - safe(low.slope, low.curve);
        trial_high = high_alpha - safe(high.slope, high.curve);
        k = 0;
        ++round;
    }
    return false;
};

// Read inertia, joint limits, joint friction and contacts. What lies far away is asked for first and waited for once.
constexpr int NUM_ENTRIES = $inertia, AT_ONCE = LANES == 1 ? 1 : (NUM_ENTRIES + LANES - 1) / LANES;
constexpr int PER_ROW = (LD + LANES - 1) / LANES;
struct Found {  // a contact, as the lane reads it that has its slot
    int slot, shape, rank;
    float factor, soft, distance;
    Vec normal, point;
};
float entries[AT_ONCE], speed[PER_LANE], trace = 0.0f;
int rows[AT_ONCE], columns[AT_ONCE];
Vec turning[PER_LANE], moving[PER_LANE];  // of a dof
auto read_entries = [&](int begin) {
    #pragma unroll
    for (int k = 0; k < AT_ONCE; ++k) {
        const int m = wp::min(begin + lane + k * LANES, NUM_ENTRIES - 1);
        entries[k] = wp::index(robots.M, world, m);
        rows[k] = problem.M_hinit_i.data[m];
        columns[k] = problem.M_colind.data[m];
    }
};
auto read_found = [&](int begin) {
    const int slot = wp::max(wp::min(begin + lane, num_contacts - 1), 0);
    return Found{
        slot, wp::index(problem.contacts.shape, world, slot), wp::index(problem.contacts.rank, world, slot),
        wp::index(problem.contacts.friction, world, slot), wp::index(problem.contacts.time_constant, world, slot),
        wp::index(problem.contacts.distance, world, slot), wp::index(problem.contacts.normal, world, slot),
        wp::index(problem.contacts.point, world, slot)};
};
#pragma unroll ALL
for (int m = 0; m < PER_LANE; ++m) {
    const int i = wp::min(lane + m * LANES, NV - 1);
    qacc[m] = wp::index(problem.qacc_warmstart, world, i);
    smooth[m] = wp::index(robots.qfrc_smooth, world, i);
    speed[m] = qvel[i];
    const auto& motion = wp::index(robots.cdof, world, i);
    turning[m] = Vec(motion[0], motion[1], motion[2]);
    moving[m] = Vec(motion[3], motion[4], motion[5]);
}
read_entries(0);
Found found = read_found(0);
#pragma unroll 1
for (int m = 4 * lane; m < (NV + 1) * LD; m += 4 * LANES) *(Float4*)(inertia + m) = Float4{};  // with the vector
sync();
#pragma unroll 1
for (int begin = 0; begin < NUM_ENTRIES; begin += AT_ONCE * LANES) {
    if (begin > 0) read_entries(begin);
    #pragma unroll
    for (int k = 0; k < AT_ONCE; ++k) {
        inertia[rows[k] * LD + columns[k]] = inertia[columns[k] * LD + rows[k]] = entries[k];
    }
}
sync();
#pragma unroll ALL
for (int m = 0; m < PER_LANE; ++m) {
    const int i = lane + m * LANES;
    constraint[m] = limit_d[m] = limit_aref[m] = side[m] = 0.0f;
    momentum[m] = gradient[m] = search[m] = loss[m] = loss_d[m] = loss_aref[m] = 0.0f;
    if (i >= NV) {
        qacc[m] = smooth[m] = speed[m] = 0.0f;
        continue;
    }
    trace += inertia[i * LD + i];
    const int joint = problem.dof_jntid.data[i];
    const float weight = model_value(problem.dof_invweight0, i);
    if (problem.jnt_limited.data[joint]) {
        const Vec2 range = model_value(problem.jnt_range, joint);
        const float q = qpos[problem.jnt_qposadr.data[joint]], low = q - range[0], high = range[1] - q;
        const float beyond = wp::min(low, high) - model_value(problem.jnt_margin, joint);
        if (beyond < 0.0f) {
            const Spring s = make_spring(
                model_value(problem.jnt_solref, joint), model_value(problem.jnt_solimp, joint), beyond);
            side[m] = low < high ? 1.0f : -1.0f;
            limit_d[m] = compute_stiffness(weight, s.impedance);
            limit_aref[m] = -s.stiffness * s.impedance * beyond - s.damping * side[m] * speed[m];
        }
    }
    if (HAS_LOSSES && model_value(problem.dof_frictionloss, i) > 0.0f) {
        const Spring s = make_spring(model_value(problem.dof_solref, i), model_value(problem.dof_solimp, i), 0.0f);
        loss[m] = model_value(problem.dof_frictionloss, i);
        loss_d[m] = compute_stiffness(weight, s.impedance);
        loss_aref[m] = -s.damping * speed[m];
    }
}
add_lanes(trace);
const float scale = 1.0f / wp::max(MINVAL, trace);
#pragma unroll 1
for (int begin = 0; begin < num_contacts; begin += LANES) {
    if (begin > 0) found = read_found(begin);
    int place = 0;  // in the order of ranks, so that sums over contacts repeat
    #pragma unroll 1
    for (int c = 0; c < num_contacts; ++c) {
        const bool here = begin <= c && c < begin + LANES;
        const int other = here ? shuffle(found.rank, c - begin) : wp::index(problem.contacts.rank, world, c);
        place += other < found.rank || (other == found.rank && c < found.slot);
    }
    const int shape = found.shape, body = problem.surfaces.body.data[shape], dim = problem.surfaces.condim.data[shape];
    const Vec arm = found.point - wp::index(robots.subtree_com, world, problem.body_rootid.data[body]);
    Vec frame[3];
    make_frame(found.normal, frame);
    if (begin + lane < num_contacts) {
        Contact& contact = get_contact(place);
        Vec2 solref = model_value(problem.surfaces.solref, shape);
        Vec5 solimp = model_value(problem.surfaces.solimp, shape);
        const Vec5& friction = model_value(problem.surfaces.friction, shape);
        if (found.soft > wp::max(solref[0], 0.0f)) {  // soft ground has constant impedance
            solref = Vec2(found.soft, 1.0f);
            solimp[0] = solimp[1];
        }
        const Spring s = make_spring(solref, solimp, found.distance);
        const float weight = model_value(problem.body_invweight0, body)[0] + model_value(problem.body_invweight0, 0)[0];
        const float d = compute_stiffness(weight, s.impedance), first = friction[0] * found.factor;
        #pragma unroll
        for (int k = 0; k < DIM; ++k) {
            const float mu = friction[wp::max(k, 1) - 1] * (k <= 2 ? found.factor : 1.0f), ratio = mu / (first * root_impratio);
            contact.d[k] = k == 0 ? d : d * ratio * ratio;
            contact.friction[k] = k == 0 ? mu * root_impratio : k < dim ? mu : 0.0f;
        }
        contact.slot = found.slot;
        contact.jv[0] = s.damping;  // until the Jacobian is there
        contact.force[0] = s.stiffness * s.impedance * found.distance;
    }
    auto shuffle_vector = [&](const Vec& v, int s) { return Vec(shuffle(v[0], s), shuffle(v[1], s), shuffle(v[2], s)); };
    #pragma unroll 1
    for (int s = 0; s < wp::min(LANES, num_contacts - begin); ++s) {
        Contact& contact = get_contact(shuffle(place, s));
        const int touching = shuffle(body, s), rows_of_it = shuffle(dim, s);
        const Vec offset = shuffle_vector(arm, s);
        const Vec axes[3] = {shuffle_vector(frame[0], s), shuffle_vector(frame[1], s), shuffle_vector(frame[2], s)};
        #pragma unroll ALL
        for (int m = 0; m < PER_ROW; ++m) {
            const int i = lane + m * LANES;
            if (i >= LD) continue;
            Vec turned, moved;
            if (i < NV && wp::index(problem.body_isdofancestor, touching, i)) {
                turned = turning[wp::min(m, PER_LANE - 1)];
                moved = moving[wp::min(m, PER_LANE - 1)] + wp::cross(turned, offset);
            }
            #pragma unroll
            for (int k = 0; k < DIM; ++k) {
                contact.jacobian[k][i] = k >= rows_of_it ? 0.0f : wp::dot(axes[k % 3], k < 3 ? moved : turned);
            }
        }
    }
}
#pragma unroll ALL
for (int m = 0; m < PER_ROW; ++m) {
    const int i = lane + m * LANES;
    if (i < LD) part[i] = i < NV ? speed[wp::min(m, PER_LANE - 1)] : 0.0f;
}
write_vector(qacc);
#pragma unroll 1
for (int r = lane; r < num_contacts * DIM; r += LANES) {
    Contact& contact = get_contact(r / DIM);
    const float *row = contact.jacobian[r % DIM], push = r % DIM == 0 ? contact.force[0] : 0.0f;
    contact.jaref[r % DIM] = contact.jv[0] * product(row, part) + push + product(row, vector);
}
sync();
times_inertia(momentum);

int iteration = 0, bits = num_found > capacity ? $too_many_contacts : 0;
float alpha = 0.0f, gained = 0.0f;
bool done = false;
while (true) {
    float squares = 0.0f;
    if (!done) {
        update_forces();
        #pragma unroll ALL
        for (int m = 0; m < PER_LANE; ++m) {
            gradient[m] = momentum[m] - smooth[m] - constraint[m];
            squares += gradient[m] * gradient[m];
        }
        add_lanes(squares);
        // mujoco_warp's test, made before the Hessian that a robot that is done would not need.
        done = iteration > 0 && (alpha == 0.0f || (scale * gained > 0.0f && scale * gained < tolerance)
            || scale * wp::sqrt(squares) < tolerance);
    }
    // Newton's direction; in the last pass the change of the velocities (MuJoCo's implicitfast). The code for both is the same
    // code: a kernel that does not fit into the instruction cache is slow.
    LaneRows h;
    float solved[PER_LANE];
    #pragma unroll ALL
    for (int m = 0; m < PER_LANE; ++m) {
        const int i = lane + m * LANES;
        float more = 0.0f;
        if (done) {
            more = i < NV ? dt * wp::index(robots.slope, world, i) : 0.0f;
        } else {
            if (side[m] * qacc[m] < limit_aref[m]) more = limit_d[m];
            if (HAS_LOSSES && wp::abs(loss_d[m] * (qacc[m] - loss_aref[m])) < loss[m]) more += loss_d[m];
        }
        solved[m] = done ? momentum[m] : gradient[m];
        read_inertia(h[m], i, more);
    }
    if (!done) add_contacts(h);
    solve(h, solved);
    if (done) {
        #pragma unroll ALL
        for (int m = 0; m < PER_LANE; ++m) speed[m] += solved[m] * dt;
        break;
    }
    float dot = 0.0f, along = 0.0f;
    #pragma unroll ALL
    for (int m = 0; m < PER_LANE; ++m) {
        search[m] = lane + m * LANES < NV ? -solved[m] : 0.0f;
        dot += search[m] * search[m];
        along -= gradient[m] * search[m];
    }
    add_lanes(dot, along);
    done = iteration > 0 && scale * 0.5f * along < tolerance;
    if (!done && iteration == problem.iterations) {
        bits |= $too_many;
        done = true;
    }
    if (done) continue;
    write_vector(search);
    float mv[PER_LANE];
    times_inertia(mv);
    #pragma unroll 1
    for (int r = lane; r < num_contacts * DIM; r += LANES) {
        Contact& contact = get_contact(r / DIM);
        contact.jv[r % DIM] = product(contact.jacobian[r % DIM], vector);
    }
    sync();
    if (!search_line(mv, dot, scale, alpha, gained)) bits |= $too_many_on_line;
    #pragma unroll ALL
    for (int m = 0; m < PER_LANE; ++m) {
        qacc[m] += alpha * search[m];
        momentum[m] += alpha * mv[m];
    }
    sync();
    #pragma unroll 1
    for (int r = lane; r < num_contacts * DIM; r += LANES) {
        Contact& contact = get_contact(r / DIM);
        contact.jaref[r % DIM] += alpha * contact.jv[r % DIM];
    }
    sync();
    ++iteration;
}
#pragma unroll 1
for (int c = lane; c < num_contacts; c += LANES) {
    const Contact& contact = get_contact(c);
    Vec frame[3];
    make_frame(wp::index(problem.contacts.normal, world, contact.slot), frame);
    wp::index(problem.contacts.force, world, contact.slot) =
        frame[0] * contact.force[0] + frame[1] * contact.force[1] + frame[2] * contact.force[2];
}

#pragma unroll ALL
for (int m = 0; m < PER_LANE; ++m) {
    const int i = lane + m * LANES;
    if (i >= NV) continue;
    wp::index(problem.qacc_warmstart, world, i) = qacc[m];
    qvel[i] = speed[m];
}
write_vector(speed);
#pragma unroll 1
for (int j = lane; j < problem.jnt_type.shape[0]; j += LANES) {
    const float* v = vector + problem.jnt_dofadr.data[j];
    float* q = qpos + problem.jnt_qposadr.data[j];
    if (problem.jnt_type.data[j] != $free) {
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
if (lane == 0) {
    problem.solver_niter.data[world] = iteration;
    problem.overflow.data[world] = bits;
}
