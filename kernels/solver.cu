struct Point { float cost, slope, curve; };
struct Spring { float stiffness, damping, impedance; };
constexpr int NV = $dofs, DIM = $dimensions, MOST = $contacts, KEPT = $kept, LD = $stride, CHUNK = $chunk;
constexpr int MINE = (NV + LANES - 1) / LANES;  // dofs of a lane: its own number, and every LANES further
constexpr bool HAS_LOSSES = $losses;
constexpr float MINVAL = ${minval}f, EPS = 8.0f * 1.1920929e-07f;
enum { SATISFIED, QUADRATIC, CONE };
struct alignas(16) Four { float of[4]; };
struct alignas(16) Contact {
    float jacobian[DIM][LD], jaref[DIM], jv[DIM], force[DIM], d[DIM], friction[DIM];  // friction 0: of the cone
    int state;
};
using Mine = float[MINE];
using Row = float[NV];  // of a matrix
using Rows = Row[MINE];
using Vec = wp::vec_t<3, float>;
using Vec2 = wp::vec_t<2, float>;
using Vec5 = wp::vec_t<5, float>;
float* inertia = memory;  // NV x NV, rows LD apart as all are
float* vector = inertia + NV * LD;  // over dofs, for whoever multiplies it
float* part = vector + LD;  // CHUNK x DIM x NV; two rows of a matrix that is factorised
float* coefficient = part + CHUNK * DIM * LD;  // CHUNK x DIM x DIM
Contact* kept = (Contact*)(coefficient + (CHUNK * DIM * DIM + 3) / 4 * 4);
constexpr int WORDS = (NV + 1 + CHUNK * DIM) * LD + (CHUNK * DIM * DIM + 3) / 4 * 4 + KEPT * sizeof(Contact) / 4;
static_assert(WORDS == $words, "the words of kernels/solver.py must be those used here");
Contact* others = MOST > KEPT ? (Contact*)&wp::index(problem.others, world, 0) : kept;
auto contact = [&](int c) -> Contact& { return c < KEPT ? kept[c] : others[c - KEPT]; };
const int found = problem.contacts.count.data[world], num_contacts = wp::min(found, MOST);
const float dt = wp::index(problem.timestep, world % problem.timestep.shape[0]);
const float root_impratio = wp::index(problem.impratio_invsqrt, world % problem.impratio_invsqrt.shape[0]);
const float least = wp::index(problem.tolerance, world % problem.tolerance.shape[0]);
const float ls_least = wp::index(problem.ls_tolerance, world % problem.ls_tolerance.shape[0]);
float* qvel = &wp::index(robots.qvel, world, 0);
float* qpos = &wp::index(robots.qpos, world, 0);
auto safe = [](float x, float y) { return x / (y != 0.0f ? y : MINVAL); };
auto product = [](const float* x, const float* y) {
    float sum = 0.0f;
    #pragma unroll
    for (int k = 0; k < LD; k += 4) {
        const Four a = *(const Four*)(x + k), b = *(const Four*)(y + k);
        for (int j = 0; j < 4; ++j) sum += a.of[j] * b.of[j];
    }
    return sum;
};
auto write_vector = [&](const Mine& values) {
    sync();
    #pragma unroll ALL
    for (int m = 0; m < MINE; ++m) {
        const int i = lane + m * LANES;
        if (i < NV) vector[i] = values[m];
    }
    sync();
};
auto times_inertia = [&](Mine& out) {  // of the vector
    #pragma unroll ALL
    for (int m = 0; m < MINE; ++m) {
        const int i = lane + m * LANES;
        out[m] = i < NV ? product(inertia + i * LD, vector) : 0.0f;
    }
};
auto read_inertia = [&](Row& row, int i, float more) {  // a row, with more on the diagonal
    #pragma unroll ALL
    for (int j = 0; j < NV; j += 4) {
        const Four four = *(const Four*)(inertia + wp::min(i, NV - 1) * LD + j);
        #pragma unroll
        for (int k = 0; k < 4; ++k) {
            if (j + k < NV) row[j + k] = four.of[k] + (i == j + k ? more : 0.0f);
        }
    }
};
// MuJoCo's "solver parameters": what solref and solimp make of a distance.
auto spring_at = [&](const Vec2& solref, const Vec5& solimp, float x) {
    const float time = wp::max(solref[0], 2.0f * dt), low = wp::clamp(solimp[0], ${least_imp}f, ${most_imp}f);
    const float high = wp::clamp(solimp[1], ${least_imp}f, ${most_imp}f), share = wp::abs(x) / wp::max(solimp[2], MINVAL);
    Spring s;
    s.stiffness = solref[0] <= 0.0f ? -solref[0] / (high * high)
                                    : 1.0f / wp::max(MINVAL, high * high * time * time * solref[1] * solref[1]);
    s.damping = solref[1] <= 0.0f ? -solref[1] / high : 2.0f / wp::max(MINVAL, high * time);
    if (low == high || solimp[2] <= MINVAL) {
        s.impedance = 0.5f * (low + high);
    } else if (share >= 1.0f) {
        s.impedance = high;
    } else {
        const float middle = wp::clamp(solimp[3], ${least_imp}f, ${most_imp}f), power = wp::max(1.0f, solimp[4]);
        const bool below = share <= middle;
        const float whole = below ? middle : 1.0f - middle, rest = (below ? share : 1.0f - share) / whole;
        const float y = whole * (power == 2.0f ? rest * rest : rest <= 0.0f ? 0.0f : wp::pow(rest, power));
        s.impedance = wp::clamp(low + (below ? y : 1.0f - y) * (high - low), low, high);
    }
    return s;
};
auto stiffness_of = [](float weight, float impedance) {  // D
    return 1.0f / wp::max(weight * (1.0f - impedance) / impedance, MINVAL);
};
auto frame_of = [](const Vec& normal, Vec (&frame)[3]) {  // normal and two tangents
    const Vec axis = wp::abs(normal[1]) < 0.5f ? Vec(0.0f, 1.0f, 0.0f) : Vec(0.0f, 0.0f, 1.0f);
    frame[0] = wp::normalize(normal);
    frame[1] = wp::normalize(axis - frame[0] * wp::dot(frame[0], axis));
    frame[2] = wp::cross(frame[0], frame[1]);
};

// Force and state of each contact at the present residuals, and what all constraints do to the joints.
float qacc[MINE], momentum[MINE], gradient[MINE], search[MINE], constraint[MINE], smooth[MINE];
float limit_d[MINE], limit_aref[MINE], side[MINE];  // of a joint beyond its limit: the way back; else d is 0
float loss[MINE], loss_d[MINE], loss_aref[MINE];    // of a joint with friction
auto update_forces = [&]() {
    #pragma unroll 1
    for (int c = lane; c < num_contacts; c += LANES) {
        Contact& at = contact(c);
        const float mu = at.friction[0], n = at.jaref[0] * mu;
        float u[DIM], tt = 0.0f;
        #pragma unroll
        for (int k = 1; k < DIM; ++k) {
            u[k] = at.jaref[k] * at.friction[k];
            tt += u[k] * u[k];
        }
        const float t = tt <= 0.0f ? 0.0f : wp::sqrt(tt);
        if (n >= mu * t || (t <= 0.0f && n >= 0.0f)) {
            for (int k = 0; k < DIM; ++k) at.force[k] = 0.0f;
            at.state = SATISFIED;
        } else if (mu * n + t <= 0.0f || (t <= 0.0f && n < 0.0f)) {
            for (int k = 0; k < DIM; ++k) at.force[k] = -at.d[k] * at.jaref[k];
            at.state = QUADRATIC;
        } else {
            const float normal = -safe(at.d[0], mu * mu * (1.0f + mu * mu)) * (n - mu * t) * mu;
            at.force[0] = normal;
            #pragma unroll
            for (int k = 1; k < DIM; ++k) at.force[k] = -safe(normal, t) * (u[k] * at.friction[k]);
            at.state = CONE;
        }
    }
    sync();
    #pragma unroll ALL
    for (int m = 0; m < MINE; ++m) {
        const int i = lane + m * LANES;
        float sum = 0.0f;
        #pragma unroll 1
        for (int c = 0; c < num_contacts; ++c) {
            const Contact& at = contact(c);
            if (i >= NV || at.state == SATISFIED) continue;
            #pragma unroll
            for (int k = 0; k < DIM; ++k) sum += at.jacobian[k][i] * at.force[k];
        }
        const float x = side[m] * qacc[m] - limit_aref[m];
        if (x < 0.0f) sum -= side[m] * limit_d[m] * x;
        if (HAS_LOSSES) sum -= wp::clamp(loss_d[m] * (qacc[m] - loss_aref[m]), -loss[m], loss[m]);
        constraint[m] = sum;
    }
};

// Makes y the solution x of h x = y; of h each lane has its rows, which are spent: L D L^T, a column of all rows at a time. The
// row that all need goes through shared memory, a number from each lane since h is symmetric.
auto solve = [&](Rows& h, Mine& y) {
    constexpr bool ONE = LANES == 1;  // which starts where there is work; loops of many must have bounds to be unrolled
    float inverse[MINE];
    #pragma unroll ALL
    for (int k = 0; k < NV; ++k) {
        float* row = part + k % 2 * LD;  // while slower lanes still read the former one
        #pragma unroll ALL
        for (int m = ONE ? k : 0; m < MINE; ++m) {
            if (lane + m * LANES < NV) row[lane + m * LANES] = h[m][k];
        }
        sync();
        const float pivot = 1.0f / row[k], y_k = from(y[k / LANES], k % LANES);
        #pragma unroll ALL
        for (int m = ONE ? k : 0; m < MINE; ++m) {
            const int i = lane + m * LANES;
            if (i == k) inverse[m] = pivot;
            const float below = i > k ? h[m][k] * pivot : 0.0f;
            y[m] -= below * y_k;
            #pragma unroll ALL
            for (int j = ONE ? k / 4 * 4 : 0; j < NV; j += 4) {
                if (j + 3 <= k) continue;
                const Four four = *(const Four*)(row + j);
                #pragma unroll
                for (int n = 0; n < 4; ++n) {
                    if (j + n > k && j + n < NV) h[m][j + n] -= below * four.of[n];
                }
            }
        }
    }
    #pragma unroll ALL
    for (int k = NV - 1; k >= 0; --k) {
        const float x = from(y[k / LANES] * inverse[k / LANES], k % LANES);
        #pragma unroll ALL
        for (int m = 0; m < (ONE ? k + 1 : MINE); ++m) {
            const int i = lane + m * LANES;
            y[m] = i == k ? x : i < k ? y[m] - h[m][k] * x : y[m];
        }
    }
};

// Adds what contacts make of the Hessian to the rows of h.
//
// The Hessian is M, what joints at their limits and with friction add to its diagonal, and a sum of squares of rows g. A contact
// that sticks gives sqrt(D) J of each of its rows. One on the side of its cone, of normal row a = mu J_0, tangent rows
// z_k = friction_k J_k and unit tangent residual e, gives
//     sqrt(dm) (a - mu sum_k e_k z_k)      and      sqrt(dm (mu^2 - mu n / t)) (what of z is at right angles to e),
// the latter as rows of the reflection that turns e into an axis.
auto add_contacts = [&](Rows& h) {
    #pragma unroll 1
    for (int begin = 0; begin < num_contacts; begin += CHUNK) {
        const int count = wp::min(CHUNK, num_contacts - begin);
        #pragma unroll 1
        for (int s = lane; s < count; s += LANES) {
            const Contact& at = contact(begin + s);
            float* to = coefficient + s * DIM * DIM;
            if (at.state != CONE) {
                #pragma unroll
                for (int k = 0; k < DIM * DIM; ++k) to[k] = k % (DIM + 1) == 0 ? wp::sqrt(at.d[k / DIM]) : 0.0f;
                continue;
            }
            const float mu = at.friction[0], dm = safe(at.d[0], mu * mu * (1.0f + mu * mu));
            float e[DIM], tt = 0.0f;
            #pragma unroll
            for (int k = 1; k < DIM; ++k) {
                e[k] = at.jaref[k] * at.friction[k];
                tt += e[k] * e[k];
            }
            const float t = wp::max(wp::sqrt(tt), MINVAL), root = wp::sqrt(dm);
            const float weight = wp::sqrt(dm * wp::max(0.0f, mu * mu - mu * (at.jaref[0] * mu) / t));
            #pragma unroll
            for (int k = 1; k < DIM; ++k) e[k] /= t;
            const float sign = e[1] < 0.0f ? -1.0f : 1.0f;
            #pragma unroll
            for (int row = 0; row < DIM; ++row) {
                to[row * DIM] = row == 0 ? root * mu : 0.0f;
                #pragma unroll
                for (int k = 1; k < DIM; ++k) {
                    float entry = -root * mu * e[k];
                    if (row > 0 && row < DIM - 1) {
                        const float v = k == 1 ? e[1] + sign : e[k];
                        entry = weight * ((k == row + 1 ? 1.0f : 0.0f) - e[row + 1] * v / (1.0f + wp::abs(e[1])));
                    } else if (row > 0) {
                        entry = 0.0f;
                    }
                    to[row * DIM + k] = entry * at.friction[k];
                }
            }
        }
        sync();
        #pragma unroll 1
        for (int s = 0; s < count; ++s) {
            const Contact& at = contact(begin + s);
            if (at.state == SATISFIED) continue;
            #pragma unroll 1
            for (int i = lane; i < LD; i += LANES) {
                #pragma unroll
                for (int row = 0; row < DIM; ++row) {
                    float sum = 0.0f;
                    #pragma unroll
                    for (int k = 0; k < DIM; ++k) sum += coefficient[(s * DIM + row) * DIM + k] * at.jacobian[k][i];
                    part[(s * DIM + row) * LD + i] = sum;
                }
            }
        }
        sync();
        #pragma unroll 1
        for (int s = 0; s < count; ++s) {
            if (contact(begin + s).state == SATISFIED) continue;
            #pragma unroll
            for (int row = 0; row < DIM; ++row) {
                const float* of = part + (s * DIM + row) * LD;
                #pragma unroll ALL
                for (int m = 0; m < MINE; ++m) {
                    const int i = lane + m * LANES;
                    const float own = i < NV ? of[i] : 0.0f;
                    #pragma unroll ALL
                    for (int j = 0; j < NV; j += 4) {
                        const Four four = *(const Four*)(of + j);
                        #pragma unroll
                        for (int k = 0; k < 4; ++k) {
                            if (j + k < NV) h[m][j + k] += own * four.of[k];
                        }
                    }
                }
            }
        }
        sync();
    }
};

// Cost, slope and curvature along the search direction. Costs at a step are told from those at 0.
struct Line {  // of a contact
    int state0;
    float cost0, q0, q1, q2, mu, u0, v0, uu, uv, vv, dm, t0, r0;
};
auto read_contact = [&](const Contact& at) {
    Line line;
    line.mu = at.friction[0];
    line.u0 = at.jaref[0] * line.mu;
    line.v0 = at.jv[0] * line.mu;
    line.q0 = line.q1 = line.q2 = line.uu = line.uv = line.vv = 0.0f;
    #pragma unroll
    for (int k = 0; k < DIM; ++k) {
        const float x = at.jaref[k], y = at.jv[k], dx = at.d[k] * x, dy = at.d[k] * y;
        line.q0 += 0.5f * x * dx;
        line.q1 += y * dx;
        line.q2 += 0.5f * y * dy;
        if (k == 0) continue;
        const float u = x * at.friction[k], v = y * at.friction[k];
        line.uu += u * u;
        line.uv += u * v;
        line.vv += v * v;
    }
    line.dm = at.d[0] / (line.mu * line.mu * (1.0f + line.mu * line.mu));
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
auto cone_gap = [](const Line& line, float n, float t) {  // of the quadratic's cost over the cone's
    const float boundary = line.mu * n + t;
    return 0.5f * line.dm * boundary * boundary;
};
auto contact_at = [&](const Line& line, float alpha) {
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
auto limit_at = [](float d, float x0, float v, float alpha) {
    const float x = x0 + alpha * v, curve = d * v * v, slope = d * v * x0;
    if (x >= 0.0f) return Point{x0 < 0.0f ? -0.5f * d * x0 * x0 : 0.0f, 0.0f, 0.0f};
    if (x0 < 0.0f) return Point{alpha * (slope + 0.5f * alpha * curve), slope + alpha * curve, curve};
    return Point{0.5f * d * x * x, d * v * x, curve};
};
auto loss_at = [](float d, float most, float x, float v) {
    const float range = most / d;
    if (-range < x && x < range) return Point{0.5f * d * x * x, v * d * x, v * v * d};
    const float sign = x < 0.0f ? -1.0f : 1.0f;
    return Point{most * (sign * x - 0.5f * range), sign * most * v, 0.0f};
};
constexpr int READ = LANES == 1 ? MOST : 1;  // one thread reads contacts once a search; of a warp each lane its first
Line lines[READ];
float gauss_slope, gauss_curve;  // of the inertia: a parabola
// With `first` contacts are read, and the constraints' cost at 0 is found.
auto line_at = [&](float alpha, bool first, float& cost0) {
    Point sum = {0.0f, 0.0f, 0.0f};
    float before = 0.0f;
    auto add = [&](const Point& p) {
        sum.cost += p.cost;
        sum.slope += p.slope;
        sum.curve += p.curve;
    };
    #pragma unroll 1
    for (int c = lane; c < num_contacts; c += LANES) {
        Line& own = lines[LANES == 1 ? c % READ : 0];
        Line line = own;
        if (first || (LANES > 1 && c != lane)) line = read_contact(contact(c));
        if (first && (LANES == 1 || c == lane)) own = line;
        before += line.cost0;
        add(contact_at(line, alpha));
    }
    #pragma unroll ALL
    for (int m = 0; m < MINE; ++m) {
        if (limit_d[m] > 0.0f) {
            const float x = side[m] * qacc[m] - limit_aref[m];
            if (x < 0.0f) before += 0.5f * limit_d[m] * x * x;
            add(limit_at(limit_d[m], x, side[m] * search[m], alpha));
        }
        if (HAS_LOSSES && loss[m] > 0.0f) {
            const float x = qacc[m] - loss_aref[m], cost = loss_at(loss_d[m], loss[m], x, 0.0f).cost;
            before += cost;
            sum.cost -= cost;
            add(loss_at(loss_d[m], loss[m], x + alpha * search[m], search[m]));
        }
    }
    if (first) cost0 = total(before);
    return Point{
        total(sum.cost) + alpha * (alpha * gauss_curve + gauss_slope),
        total(sum.slope) + 2.0f * alpha * gauss_curve + gauss_slope,
        total(sum.curve) + 2.0f * gauss_curve
    };
};
// Newton steps from both ends of a bracket and its middle, until the slope is all but 0. False where the cap stopped it.
auto search_line = [&](const Mine& mv, float search_dot, float scale, float& alpha, float& gained) {
    float slope = 0.0f, curve = 0.0f;
    #pragma unroll ALL
    for (int m = 0; m < MINE; ++m) {
        slope += search[m] * (momentum[m] - smooth[m]);
        curve += 0.5f * search[m] * mv[m];
    }
    gauss_slope = total(slope);
    gauss_curve = total(curve);
    const float flat = wp::max(least * ls_least * wp::sqrt(search_dot) / scale, 1e-6f);
    auto between = [](const Point& x, const Point& y) {
        return (x.slope < y.slope && y.slope < 0.0f) || (x.slope > y.slope && y.slope > 0.0f);
    };
    Point start, low, high, p0, p1;  // of a round: from the low end, from the high one, from the middle
    float low_alpha = 0.0f, high_alpha = 0.0f, at0 = 0.0f, at1 = 0.0f, at = 0.0f, accepted = 0.0f;
    float best = 0.0f, best_alpha = 0.0f, cost0 = 0.0f;
    alpha = gained = 0.0f;
    #pragma unroll 1
    for (int round = -2, k = 0; round < problem.most_line_iterations;) {
        Point p = line_at(at, round == -2, cost0);
        if (round == -2) {
            const float size = wp::sqrt(2.0f * wp::max(cost0, 0.0f) * wp::max(p.curve - 2.0f * gauss_curve, 0.0f))
                + wp::abs(gauss_slope);
            accepted = wp::max(flat, EPS * size);  // slopes below are those of rounding
            if (wp::abs(p.slope) < EPS * size) return true;
            p.cost = 0.0f;
            start = low = high = p;
            at = -safe(p.slope, p.curve);  // the Newton step alone
            ++round;
            continue;
        }
        if (wp::abs(p.slope) < accepted && p.cost < best) {
            best = p.cost;
            best_alpha = at;
        }
        if (round == -1) {
            if (p.slope < start.slope) { low = p; low_alpha = at; }
            else { high = p; high_alpha = at; }
        } else if (k == 0) {
            p0 = p;
            at = at1;
            k = 1;
            continue;
        } else if (k == 1) {
            p1 = p;
            at = 0.5f * (low_alpha + high_alpha);
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
            raise(p0, at0);
            raise(p, at);
            raise(p1, at1);
            lower(p1, at1, true);
            lower(p, at, false);
            lower(p0, at0, false);
            if (low.cost < 0.0f || high.cost < 0.0f) {
                const bool is_low = low.cost < high.cost;
                alpha = is_low ? low_alpha : high_alpha;
                gained = -(is_low ? low.cost : high.cost);
            }
            if (!moved || (low.cost < 0.0f && low.slope < 0.0f && low.slope > -flat)
                || (high.cost < 0.0f && high.slope > 0.0f && high.slope < flat)) return true;
        }
        at = at0 = low_alpha - safe(low.slope, low.curve);
        at1 = high_alpha - safe(high.slope, high.curve);
        k = 0;
        ++round;
    }
    return false;
};

// What there is: inertia, joints at their limits, joints with friction, contacts.
#pragma unroll 1
for (int m = lane; m < (NV + 1) * LD; m += LANES) inertia[m] = 0.0f;  // with the vector
sync();
#pragma unroll 1
for (int m = lane; m < $inertia; m += LANES) {
    const int i = problem.inertia_row.data[m], j = problem.inertia_col.data[m];
    inertia[i * LD + j] = inertia[j * LD + i] = wp::index(robots.inertia, world, m);
}
float trace = 0.0f, speed[MINE];
sync();
#pragma unroll ALL
for (int m = 0; m < MINE; ++m) {
    const int i = lane + m * LANES;
    qacc[m] = constraint[m] = smooth[m] = limit_d[m] = limit_aref[m] = side[m] = 0.0f;
    momentum[m] = gradient[m] = search[m] = speed[m] = loss[m] = loss_d[m] = loss_aref[m] = 0.0f;
    if (i >= NV) continue;
    trace += inertia[i * LD + i];
    qacc[m] = wp::index(problem.qacc_warmstart, world, i);
    smooth[m] = wp::index(robots.qfrc_smooth, world, i);
    speed[m] = qvel[i];
    const int joint = problem.dof_joint.data[i];
    const float weight = of_model(problem.dof_weight, i);
    if (problem.joint_limited.data[joint]) {
        const Vec2 range = of_model(problem.joint_range, joint);
        const float q = qpos[problem.joint_qpos.data[joint]], low = q - range[0], high = range[1] - q;
        const float beyond = wp::min(low, high) - of_model(problem.joint_margin, joint);
        if (beyond < 0.0f) {
            const Spring s = spring_at(
                of_model(problem.joint_solref, joint), of_model(problem.joint_solimp, joint), beyond);
            side[m] = low < high ? 1.0f : -1.0f;
            limit_d[m] = stiffness_of(weight, s.impedance);
            limit_aref[m] = -s.stiffness * s.impedance * beyond - s.damping * side[m] * speed[m];
        }
    }
    if (HAS_LOSSES && of_model(problem.frictionloss, i) > 0.0f) {
        const Spring s = spring_at(of_model(problem.dof_solref, i), of_model(problem.dof_solimp, i), 0.0f);
        loss[m] = of_model(problem.frictionloss, i);
        loss_d[m] = stiffness_of(weight, s.impedance);
        loss_aref[m] = -s.damping * speed[m];
    }
}
const float scale = 1.0f / wp::max(MINVAL, total(trace));
#pragma unroll 1
for (int begin = 0; begin < num_contacts; begin += LANES) {  // each lane reads a contact, all look at all
    const int own = wp::min(begin + lane, num_contacts - 1), shape = wp::index(problem.contacts.shape, world, own);
    const int body = problem.surfaces.body.data[shape], condim = problem.surfaces.condim.data[shape];
    const Vec normal = wp::index(problem.contacts.normal, world, own);
    const Vec place = wp::index(problem.contacts.point, world, own)
        - wp::index(robots.subtree_com, world, problem.body_root.data[body]);
    auto of_lane = [&](const Vec& v, int s) { return Vec(from(v[0], s), from(v[1], s), from(v[2], s)); };
    #pragma unroll 1
    for (int s = 0; s < wp::min(LANES, num_contacts - begin); ++s) {
        Contact& to = contact(begin + s);
        const Vec offset = of_lane(place, s);
        const int touching = (int)from((float)body, s), dim = (int)from((float)condim, s);
        Vec frame[3];
        frame_of(of_lane(normal, s), frame);
        #pragma unroll 1
        for (int i = lane; i < LD; i += LANES) {
            Vec turned, moved;
            if (i < NV && wp::index(problem.is_ancestor, touching, i)) {
                const auto& motion = wp::index(robots.cdof, world, i);
                turned = Vec(motion[0], motion[1], motion[2]);
                moved = Vec(motion[3], motion[4], motion[5]) + wp::cross(turned, offset);
            }
            #pragma unroll
            for (int k = 0; k < DIM; ++k) {
                to.jacobian[k][i] = k >= dim ? 0.0f : k < 3 ? wp::dot(frame[k], moved) : wp::dot(frame[k % 3], turned);
            }
        }
    }
}
write_vector(speed);
#pragma unroll 1
for (int c = lane; c < num_contacts; c += LANES) {
    Contact& to = contact(c);
    const int shape = wp::index(problem.contacts.shape, world, c), dim = problem.surfaces.condim.data[shape];
    Vec2 solref = of_model(problem.surfaces.solref, shape);
    Vec5 solimp = of_model(problem.surfaces.solimp, shape);
    const Vec5& friction = of_model(problem.surfaces.friction, shape);
    const float factor = wp::index(problem.contacts.friction, world, c);
    const float soft = wp::index(problem.contacts.time_constant, world, c);
    if (soft > wp::max(solref[0], 0.0f)) {  // of constant impedance
        solref = Vec2(soft, 1.0f);
        solimp[0] = solimp[1];
    }
    const float distance = wp::index(problem.contacts.distance, world, c);
    const Spring s = spring_at(solref, solimp, distance);
    const auto& weights = of_model(problem.body_weight, problem.surfaces.body.data[shape]);
    const float d = stiffness_of(weights[0] + of_model(problem.body_weight, 0)[0], s.impedance);
    #pragma unroll
    for (int k = 0; k < DIM; ++k) {
        const float mu = friction[wp::max(k, 1) - 1] * (k <= 2 ? factor : 1.0f), first = friction[0] * factor;
        const float ratio = mu / (first * root_impratio);
        to.d[k] = k == 0 ? d : d * ratio * ratio;
        to.friction[k] = k == 0 ? mu * root_impratio : k < dim ? mu : 0.0f;
        to.jaref[k] = s.damping * product(to.jacobian[k], vector);
    }
    to.jaref[0] += s.stiffness * s.impedance * distance;
}
write_vector(qacc);
#pragma unroll 1
for (int c = lane; c < num_contacts; c += LANES) {
    Contact& to = contact(c);
    #pragma unroll
    for (int k = 0; k < DIM; ++k) to.jaref[k] += product(to.jacobian[k], vector);
}
times_inertia(momentum);

int iteration = 0, bits = found > MOST ? $too_many_contacts : 0;
float alpha = 0.0f, gained = 0.0f;
bool done = false;
while (true) {
    float squares = 0.0f;
    if (!done) {
        update_forces();
        #pragma unroll ALL
        for (int m = 0; m < MINE; ++m) {
            gradient[m] = momentum[m] - smooth[m] - constraint[m];
            squares += gradient[m] * gradient[m];
        }
        squares = total(squares);
        // mujoco_warp's test, made before the Hessian that a robot that is done would not need.
        done = iteration > 0 && (alpha == 0.0f || (scale * gained > 0.0f && scale * gained < least)
            || scale * wp::sqrt(squares) < least);
    }
    // Newton's direction; at the end velocities by the forces found, those of joints as they change over the step (MuJoCo's
    // implicitfast). Both in one place: a kernel that does not fit into the instruction cache is slow.
    float h[MINE][NV], solved[MINE];
    #pragma unroll ALL
    for (int m = 0; m < MINE; ++m) {
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
        for (int m = 0; m < MINE; ++m) speed[m] += solved[m] * dt;
        break;
    }
    float dot = 0.0f, along = 0.0f;
    #pragma unroll ALL
    for (int m = 0; m < MINE; ++m) {
        search[m] = lane + m * LANES < NV ? -solved[m] : 0.0f;
        dot += search[m] * search[m];
        along -= gradient[m] * search[m];
    }
    const float search_dot = total(dot), decrement = total(along);
    done = iteration > 0 && scale * 0.5f * decrement < least;
    if (!done && iteration == problem.most_iterations) {
        bits |= $too_many;
        done = true;
    }
    if (done) continue;
    write_vector(search);
    float mv[MINE];
    times_inertia(mv);
    #pragma unroll 1
    for (int r = lane; r < num_contacts * DIM; r += LANES) {
        Contact& at = contact(r / DIM);
        at.jv[r % DIM] = product(at.jacobian[r % DIM], vector);
    }
    sync();
    if (!search_line(mv, search_dot, scale, alpha, gained)) bits |= $too_many_on_line;
    #pragma unroll ALL
    for (int m = 0; m < MINE; ++m) {
        qacc[m] += alpha * search[m];
        momentum[m] += alpha * mv[m];
    }
    sync();
    #pragma unroll 1
    for (int r = lane; r < num_contacts * DIM; r += LANES) {
        Contact& at = contact(r / DIM);
        at.jaref[r % DIM] += alpha * at.jv[r % DIM];
    }
    sync();
    ++iteration;
}
#pragma unroll 1
for (int c = lane; c < num_contacts; c += LANES) {
    const Contact& at = contact(c);
    Vec frame[3];
    frame_of(wp::index(problem.contacts.normal, world, c), frame);
    wp::index(problem.contacts.force, world, c) =
        frame[0] * at.force[0] + frame[1] * at.force[1] + frame[2] * at.force[2];
}

#pragma unroll ALL
for (int m = 0; m < MINE; ++m) {
    const int i = lane + m * LANES;
    if (i >= NV) continue;
    wp::index(problem.qacc_warmstart, world, i) = qacc[m];
    qvel[i] = speed[m];
}
write_vector(speed);
#pragma unroll 1
for (int j = lane; j < problem.joint_type.shape[0]; j += LANES) {
    const float* v = vector + problem.joint_dof.data[j];
    float* q = qpos + problem.joint_qpos.data[j];
    if (problem.joint_type.data[j] != $free) {
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
    problem.iterations.data[world] = iteration;
    problem.overflow.data[world] = bits;
}
