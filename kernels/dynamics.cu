// Quantities are stored body by body or dof by dof. Spatial vectors have the rotation first, and are
// taken at the mass centre of the body's tree, in the world's axes. The world is body 0.
struct Quat { float w, x, y, z; };
struct alignas(8) Two { float v[2]; };
struct Six { float v[6]; };
constexpr int NB = $bodies, NQ = $coordinates, NV = $dofs, NU = $actuators, NUM_ENTRIES = $inertia;
constexpr int LINKS = (NB - 2 + LANES) / LANES;  // bodies of a lane
constexpr int LEVELS = LANES == 1 ? 1 : $levels;  // one thread has its bodies in order
enum { FREE = $free, SLIDE = $slide, HINGE = $hinge };
using Vec = wp::vec_t<3, float>;
struct Link {  // a body: its parent, the world's row of it, and its pose; at first in the axes of its parent
    int body, parent, root, level, first, num_joints;
    Vec position, centre;
    Quat rotation;
};
float* motion = memory;               // NV x 6: of each dof; before, at its first dof, a joint's axis and anchor
float* carried = motion + NV * 6;     // NV x 6: momentum at unit speed of all that a dof moves
float* inertia = carried + NV * 6;    // NB x 10; then of all that a body carries
float* velocity = inertia + NB * 10;  // NB x 6
float* force = velocity + NB * 6;     // NB x 6: accelerations; then forces
float* position = force + NB * 6;     // NB x 3
float* rotation = position + NB * 3;  // NB x 4, wxyz
float* com = rotation + NB * 4;       // NB x 3: mass centre of a tree, at its root
float* qpos = com + NB * 3;           // NQ, then NV of qvel and NU of ctrl
float *qvel = qpos + NQ, *ctrl = qvel + NV;
static_assert($num_floats % 4 == 0, "the second robot of a block would lie askew");

auto get = [](const float* array, int k) { return Vec(array[3 * k], array[3 * k + 1], array[3 * k + 2]); };
auto put = [](float* array, int k, const Vec& v) { array[3 * k] = v[0]; array[3 * k + 1] = v[1]; array[3 * k + 2] = v[2]; };
auto get_six = [](const float* array, int k) {
    Six s;
    for (int i = 0; i < 6; i += 2) {
        const Two two = *(const Two*)(array + 6 * k + i);
        s.v[i] = two.v[0];
        s.v[i + 1] = two.v[1];
    }
    return s;
};
auto put_six = [](float* array, int k, const Six& s) {
    for (int i = 0; i < 6; i += 2) *(Two*)(array + 6 * k + i) = Two{{s.v[i], s.v[i + 1]}};
};
auto get_quat = [&](int k) { return Quat{rotation[4 * k], rotation[4 * k + 1], rotation[4 * k + 2], rotation[4 * k + 3]}; };
auto to_quat = [](const wp::quat_t<float>& q) { return Quat{q.x, q.y, q.z, q.w}; };  // the solver's arrays have wxyz
auto times = [](const Quat& a, const Quat& b) {
    return Quat{
        a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z, a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
        a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x, a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w};
};
auto normal = [](const Quat& q) {
    const float length = wp::sqrt(q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z), scale = length > 0.0f ? 1.0f / length : 0.0f;
    return Quat{q.w * scale, q.x * scale, q.y * scale, q.z * scale};
};
auto turn = [](const Quat& q, const Vec& v) {
    const Vec u(q.x, q.y, q.z);
    return 2.0f * wp::dot(u, v) * u + (q.w * q.w - wp::dot(u, u)) * v + 2.0f * q.w * wp::cross(u, v);
};
auto rotation_part = [](const Six& s) { return Vec(s.v[0], s.v[1], s.v[2]); };
auto linear_part = [](const Six& s) { return Vec(s.v[3], s.v[4], s.v[5]); };
auto six = [](const Vec& a, const Vec& b) { return Six{{a[0], a[1], a[2], b[0], b[1], b[2]}}; };
auto add = [](Six& to, const Six& s, float scale) {
    for (int i = 0; i < 6; ++i) to.v[i] += s.v[i] * scale;
};
auto dot = [](const Six& a, const Six& b) {
    float sum = 0.0f;
    for (int i = 0; i < 6; ++i) sum += a.v[i] * b.v[i];
    return sum;
};
auto change_of_motion = [&](const Six& velocity, const Six& s) {
    const Vec w = rotation_part(velocity), a = rotation_part(s);
    return six(wp::cross(w, a), wp::cross(linear_part(velocity), a) + wp::cross(w, linear_part(s)));
};
auto change_of_force = [&](const Six& velocity, const Six& f) {
    const Vec w = rotation_part(velocity), b = linear_part(f);
    return six(wp::cross(w, rotation_part(f)) + wp::cross(linear_part(velocity), b), wp::cross(w, b));
};
auto momentum = [](const float* i, const Six& s) {
    const float* v = s.v;
    return Six{
        {i[0] * v[0] + i[3] * v[1] + i[4] * v[2] - i[8] * v[4] + i[7] * v[5],
         i[3] * v[0] + i[1] * v[1] + i[5] * v[2] + i[8] * v[3] - i[6] * v[5],
         i[4] * v[0] + i[5] * v[1] + i[2] * v[2] - i[7] * v[3] + i[6] * v[4], i[8] * v[1] - i[7] * v[2] + i[9] * v[3],
         i[6] * v[2] - i[8] * v[0] + i[9] * v[4], i[7] * v[0] - i[6] * v[1] + i[9] * v[5]}};
};

// State, and poses in the axes of the parent: what lies far away is asked for at once.
constexpr int NUM_FAR = NQ + NV + NU, FAR = (NUM_FAR + LANES - 1) / LANES;
float far[FAR];
#pragma unroll ALL
for (int k = 0; k < FAR; ++k) {
    const int m = lane + k * LANES;
    far[k] = 0.0f;
    if (m < NQ) far[k] = wp::index(robots.qpos, world, m);
    else if (m < NQ + NV) far[k] = wp::index(robots.qvel, world, m - NQ);
    else if (m < NUM_FAR) far[k] = wp::index(robots.ctrl, world, m - NQ - NV);
}
if (lane == 0) {
    put(position, 0, Vec());
    for (int i = 0; i < 4; ++i) rotation[i] = i == 0 ? 1.0f : 0.0f;
    for (int i = 0; i < 6; ++i) velocity[i] = 0.0f;
    const Vec gravity = wp::index(tree.gravity, row_of(tree.gravity));
    put_six(force, 0, six(Vec(), -gravity));  // as if the world accelerated upward
    for (int i = 0; i < 10; ++i) inertia[i] = 0.0f;
}
Link links[LINKS];
#pragma unroll ALL
for (int k = 0; k < LINKS; ++k) {
    Link& link = links[k];
    const int n = lane + k * LANES, body = tree.body_order.data[wp::min(n, NB - 2)];
    link.body = body;
    link.level = n < NB - 1 ? tree.body_level.data[n] : -1;
    link.parent = tree.body_parentid.data[body];
    link.root = tree.body_rootid.data[body];
    link.first = tree.body_jntadr.data[body];
    link.num_joints = tree.body_jntnum.data[body];
    link.position = model_value(tree.body_pos, body);
    link.rotation = to_quat(model_value(tree.body_quat, body));
    link.centre = model_value(tree.body_ipos, body);
}
#pragma unroll ALL
for (int k = 0; k < FAR; ++k) {
    if (lane + k * LANES < NUM_FAR) qpos[lane + k * LANES] = far[k];
}
sync();
#pragma unroll ALL
for (int k = 0; k < LINKS; ++k) {
    Link& link = links[k];
    if (link.level < 0) continue;
    #pragma unroll 1
    for (int j = link.first; j < link.first + link.num_joints; ++j) {
        const int column = tree.jnt_qposadr.data[j], type = tree.jnt_type.data[j];
        if (type == FREE) {  // a child of the world
            link.position = Vec(qpos[column], qpos[column + 1], qpos[column + 2]);
            link.rotation = Quat{qpos[column + 3], qpos[column + 4], qpos[column + 5], qpos[column + 6]};
            continue;
        }
        const Vec axis = model_value(tree.jnt_axis, j), offset = model_value(tree.jnt_pos, j);
        const Vec anchor = turn(link.rotation, offset) + link.position, turned = turn(link.rotation, axis);
        const float moved = qpos[column] - model_value(tree.qpos0, column);
        if (type == SLIDE) {
            link.position += turned * moved;
        } else {
            float s, c;
            find_sine(0.5f * moved, s, c);
            link.rotation = times(link.rotation, Quat{c, axis[0] * s, axis[1] * s, axis[2] * s});
            link.position = anchor - turn(link.rotation, offset);
        }
        put_six(motion, tree.jnt_dofadr.data[j], six(turned, anchor));
    }
}

// Poses in the world, from the root of each tree outward.
#pragma unroll 1
for (int level = 0; level < LEVELS; ++level) {
    #pragma unroll ALL
    for (int k = 0; k < LINKS; ++k) {
        Link& link = links[k];
        if (LANES > 1 && link.level != level) continue;
        const Quat q = get_quat(link.parent);
        const Quat turned = link.rotation = normal(times(q, link.rotation));
        link.position = turn(q, link.position) + get(position, link.parent);
        put(position, link.body, link.position);
        float* numbers = rotation + 4 * link.body;
        numbers[0] = turned.w;
        numbers[1] = turned.x;
        numbers[2] = turned.y;
        numbers[3] = turned.z;
    }
    sync();
}
#pragma unroll ALL
for (int k = 0; k < LINKS; ++k) {
    Link& link = links[k];
    if (link.level < 0) continue;
    const Quat& q = link.rotation;
    link.centre = link.position + turn(q, link.centre);
    wp::index(robots.xpos, world, link.body) = link.position;
    wp::index(robots.xquat, world, link.body) = wp::quat_t<float>(q.w, q.x, q.y, q.z);
}
#pragma unroll 1
for (int n = 0; n < tree.roots.shape[0]; ++n) {
    const int root = tree.roots.data[n];
    Vec sum;
    #pragma unroll ALL
    for (int k = 0; k < LINKS; ++k) {
        const Link& link = links[k];
        if (link.level >= 0 && link.root == root) sum += link.centre * model_value(tree.body_mass, link.body);
    }
    add_lanes(sum[0], sum[1], sum[2]);
    const float mass = model_value(tree.body_subtreemass, root);
    if (mass != 0.0f) sum = sum / mass;
    if (lane == 0) {
        put(com, root, sum);
        wp::index(robots.subtree_com, world, root) = sum;
    }
}
sync();

// Inertias and motions at the mass centre.
#pragma unroll ALL
for (int k = 0; k < LINKS; ++k) {
    const Link& link = links[k];
    if (link.level < 0) continue;
    const int body = link.body;
    const Vec middle = get(com, link.root), d = link.centre - middle, moment = model_value(tree.body_inertia, body);
    const Quat q = times(link.rotation, to_quat(model_value(tree.body_iquat, body)));
    const Vec x = turn(q, Vec(1.0f, 0.0f, 0.0f)), y = turn(q, Vec(0.0f, 1.0f, 0.0f)), z = turn(q, Vec(0.0f, 0.0f, 1.0f));
    const float mass = model_value(tree.body_mass, body);
    auto entry = [&](int i, int j) {
        const float product = i == j ? d[i] * d[j] - wp::dot(d, d) : d[i] * d[j];
        return moment[0] * x[i] * x[j] + moment[1] * y[i] * y[j] + moment[2] * z[i] * z[j] - mass * product;
    };
    float* entries = inertia + 10 * body;
    entries[0] = entry(0, 0);
    entries[1] = entry(1, 1);
    entries[2] = entry(2, 2);
    entries[3] = entry(0, 1);
    entries[4] = entry(0, 2);
    entries[5] = entry(1, 2);
    for (int i = 0; i < 3; ++i) entries[6 + i] = mass * d[i];
    entries[9] = mass;
    #pragma unroll 1
    for (int j = link.first; j < link.first + link.num_joints; ++j) {
        const int dof = tree.jnt_dofadr.data[j], type = tree.jnt_type.data[j];
        if (type == FREE) {
            const Vec offset = middle - link.position;
            #pragma unroll 1
            for (int i = 0; i < 3; ++i) {
                const Vec axis(i == 0 ? 1.0f : 0.0f, i == 1 ? 1.0f : 0.0f, i == 2 ? 1.0f : 0.0f);
                const Vec turned = turn(link.rotation, axis);
                put_six(motion, dof + i, six(Vec(), axis));
                put_six(motion, dof + 3 + i, six(turned, wp::cross(turned, offset)));
            }
            continue;
        }
        const Six line = get_six(motion, dof);
        const Quat above = get_quat(link.parent);
        const Vec axis = turn(above, rotation_part(line));
        const Vec offset = middle - turn(above, linear_part(line)) - get(position, link.parent);
        put_six(motion, dof, type == SLIDE ? six(Vec(), axis) : six(axis, wp::cross(axis, offset)));
    }
}
sync();
#pragma unroll 1
for (int n = lane; n < NV; n += LANES) {
    const Six s = get_six(motion, n);
    wp::vec_t<6, float>& out = wp::index(robots.cdof, world, n);
    for (int i = 0; i < 6; ++i) out[i] = s.v[i];
}

// Velocities and accelerations at zero joint acceleration, outward; then the forces that they need, inward.
#pragma unroll 1
for (int level = 0; level < LEVELS; ++level) {
    #pragma unroll ALL
    for (int k = 0; k < LINKS; ++k) {
        const Link& link = links[k];
        if (LANES > 1 && link.level != level) continue;
        Six v = get_six(velocity, link.parent), a = get_six(force, link.parent);
        #pragma unroll 1
        for (int j = link.first; j < link.first + link.num_joints; ++j) {
            const int dof = tree.jnt_dofadr.data[j];
            const float* speed = qvel + dof;
            if (tree.jnt_type.data[j] == FREE) {  // v is 0 before
                const Vec linear(speed[0], speed[1], speed[2]);
                for (int i = 3; i < 6; ++i) add(v, get_six(motion, dof + i), speed[i]);
                add(a, six(Vec(), wp::cross(linear, rotation_part(v))), 1.0f);
                add(v, six(Vec(), linear), 1.0f);
                continue;
            }
            const Six s = get_six(motion, dof);
            add(a, change_of_motion(v, s), speed[0]);
            add(v, s, speed[0]);
        }
        put_six(velocity, link.body, v);
        put_six(force, link.body, a);
    }
    sync();
}
#pragma unroll ALL
for (int k = 0; k < LINKS; ++k) {
    const int body = links[k].body;
    if (links[k].level < 0) continue;
    const Six v = get_six(velocity, body);
    Six f = momentum(inertia + 10 * body, get_six(force, body));
    add(f, change_of_force(v, momentum(inertia + 10 * body, v)), 1.0f);
    put_six(force, body, f);
}
sync();
#pragma unroll ALL
for (int k = LINKS - 1; k >= 0; --k) {
    #pragma unroll 1
    for (int n = wp::min(LANES, NB - 1 - k * LANES) - 1; n >= 0; --n) {
        const int body = shuffle(links[k].body, n), parent = shuffle(links[k].parent, n);
        #pragma unroll 1
        for (int m = lane; m < 16 && parent > 0; m += LANES) {  // each thread sums one number over all bodies
            float* numbers = m < 6 ? force + m : inertia + m - 6;
            const int stride = m < 6 ? 6 : 10;
            numbers[stride * parent] += numbers[stride * body];
        }
    }
}
sync();

// Inertia of the joints, and the forces on them.
#pragma unroll 1
for (int n = NV - 1 - lane; n >= 0; n -= LANES) {  // a base's dofs, which have less to do, come last
    const int body = tree.dof_bodyid.data[n], joint = tree.dof_jntid.data[n];
    const Six s = get_six(motion, n);
    put_six(carried, n, momentum(inertia + 10 * body, s));
    const float damping = model_value(tree.dof_damping, n);
    const float strength = robots.strength.shape[0] > 0 ? wp::index(robots.strength, world) : 1.0f;
    float passive = -damping * qvel[n], driven = 0.0f, slope = damping;
    if (tree.jnt_type.data[joint] != FREE) {
        const int coordinate = tree.jnt_qposadr.data[joint];
        passive -= model_value(tree.jnt_stiffness, joint) * (qpos[coordinate] - model_value(tree.qpos_spring, coordinate));
        const int a = tree.dof_actuator.data[n];
        if (a >= 0) {
            const auto& gain = wp::index(tree.actuator_gainprm, row_of(tree.actuator_gainprm), a, 0);
            const float* bias = &wp::index(tree.actuator_biasprm, row_of(tree.actuator_biasprm), a, 0);
            const float gear = model_value(tree.actuator_gear, a)[0];
            float control = ctrl[a];
            if (tree.actuator_ctrllimited.data[a]) {
                const auto range = model_value(tree.actuator_ctrlrange, a);
                control = wp::clamp(control, range[0], range[1]);
            }
            float f = gain * control, velocity_gain = 0.0f;
            if (tree.actuator_biastype.data[a] != 0) {
                f += bias[0] + bias[1] * (gear * qpos[coordinate]) + bias[2] * (gear * qvel[n]);
                velocity_gain = bias[2];
            }
            if (tree.actuator_forcelimited.data[a]) {
                const auto range = model_value(tree.actuator_forcerange, a);
                if (f <= range[0] || f >= range[1]) velocity_gain = 0.0f;
                f = wp::clamp(f, range[0], range[1]);
            }
            driven = gear * f;
            slope -= gear * gear * velocity_gain * strength;
        }
        if (tree.jnt_actfrclimited.data[joint]) {
            const auto range = model_value(tree.jnt_actfrcrange, joint);
            driven = wp::clamp(driven, range[0], range[1]);
        }
        driven *= strength;
    }
    wp::index(robots.qfrc_actuator, world, n) = driven;
    wp::index(robots.qfrc_smooth, world, n) = passive - dot(s, get_six(force, body)) + driven;
    wp::index(robots.slope, world, n) = slope;
}
sync();
#pragma unroll 1
for (int m = lane; m < NUM_ENTRIES; m += LANES) {
    const int row = tree.M_hinit_i.data[m], column = tree.M_colind.data[m];
    const float armature = row == column ? model_value(tree.dof_armature, row) : 0.0f;
    wp::index(robots.M, world, m) = armature + dot(get_six(motion, column), get_six(carried, row));
}
