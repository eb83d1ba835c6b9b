// Quantities are stored body by body or dof by dof. Spatial vectors have the rotation first, and are
// taken at the mass centre of the body's tree, in the world's axes. The world is body 0.
struct Quat { float w, x, y, z; };
struct Six { float v[6]; };
constexpr int NB = $bodies, NV = $dofs, NJ = $joints, LEVELS = $levels;
enum { FREE = $free, SLIDE = $slide, HINGE = $hinge };
using Vec = wp::vec_t<3, float>;
float* position = memory;           // NB x 3
float* rotation = position + NB * 3;  // NB x 4, wxyz
float* centre = rotation + NB * 4;  // NB x 3: mass centres
float* inertia = centre + NB * 3;   // NB x 10; then of all that a body carries
float* velocity = inertia + NB * 10;  // NB x 6
float* force = velocity + NB * 6;   // NB x 6: accelerations; then forces
float* com = force + NB * 6;        // NB x 3: mass centre of a tree, at its root
float* motion = com + NB * 3;       // NV x 6: of each dof; before, at its first dof, a joint's axis and anchor
const float* qpos = &wp::index(robots.qpos, world, 0);
const float* qvel = &wp::index(robots.qvel, world, 0);

auto get = [](const float* array, int k) { return Vec(array[3 * k], array[3 * k + 1], array[3 * k + 2]); };
auto put = [](float* array, int k, const Vec& v) { array[3 * k] = v[0]; array[3 * k + 1] = v[1]; array[3 * k + 2] = v[2]; };
auto get_six = [](const float* array, int k) {
    Six s;
    for (int i = 0; i < 6; ++i) s.v[i] = array[6 * k + i];
    return s;
};
auto put_six = [](float* array, int k, const Six& s) {
    for (int i = 0; i < 6; ++i) array[6 * k + i] = s.v[i];
};
auto get_quat = [&](int k) { return Quat{rotation[4 * k], rotation[4 * k + 1], rotation[4 * k + 2], rotation[4 * k + 3]}; };
auto to_quat = [](const wp::quat_t<float>& q) { return Quat{q.x, q.y, q.z, q.w}; };  // the solver's arrays have wxyz
auto times = [](const Quat& a, const Quat& b) {
    return Quat{
        a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z, a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
        a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x, a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w};
};
auto normal = [](const Quat& q) {
    const float length = wp::sqrt(q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z);
    if (!(length > 0.0f)) return Quat{0.0f, 0.0f, 0.0f, 0.0f};
    return Quat{q.w / length, q.x / length, q.y / length, q.z / length};
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
auto first_joint = [&](int body) { return tree.body_jntadr.data[body]; };
auto num_joints = [&](int body) { return tree.body_jntnum.data[body]; };

// Poses, from the root of each tree outward.
if (lane == 0) {
    put(position, 0, Vec());
    for (int i = 0; i < 4; ++i) rotation[i] = i == 0 ? 1.0f : 0.0f;
    for (int i = 0; i < 6; ++i) velocity[i] = 0.0f;
    const Vec gravity = wp::index(tree.gravity, world % tree.gravity.shape[0]);
    put_six(force, 0, six(Vec(), -gravity));  // as if the world accelerated upward
    for (int i = 0; i < 10; ++i) inertia[i] = 0.0f;
}
sync();
#pragma unroll 1
for (int level = 0; level < LEVELS; ++level) {
    #pragma unroll 1
    for (int n = tree.level_start.data[level] + lane; n < tree.level_start.data[level + 1]; n += LANES) {
        const int body = tree.body_order.data[n], parent = tree.body_parentid.data[body], first = first_joint(body);
        Vec x;
        Quat q;
        if (num_joints(body) > 0 && tree.jnt_type.data[first] == FREE) {
            const float* base = qpos + tree.jnt_qposadr.data[first];
            x = Vec(base[0], base[1], base[2]);
            q = Quat{base[3], base[4], base[5], base[6]};
        } else {
            const Quat q_parent = get_quat(parent);
            x = turn(q_parent, model_value(tree.body_pos, body)) + get(position, parent);
            q = times(q_parent, to_quat(model_value(tree.body_quat, body)));
            #pragma unroll 1
            for (int j = first; j < first + num_joints(body); ++j) {
                const Vec axis = model_value(tree.jnt_axis, j), offset = model_value(tree.jnt_pos, j);
                const Vec anchor = turn(q, offset) + x, turned = turn(q, axis);
                const int column = tree.jnt_qposadr.data[j];
                const float moved = qpos[column] - model_value(tree.qpos0, column);
                if (tree.jnt_type.data[j] == SLIDE) {
                    x += turned * moved;
                } else {
                    const float s = wp::sin(0.5f * moved), c = wp::cos(0.5f * moved);
                    q = times(q, Quat{c, axis[0] * s, axis[1] * s, axis[2] * s});
                    x = anchor - turn(q, offset);
                }
                put_six(motion, tree.jnt_dofadr.data[j], six(turned, anchor));
            }
        }
        q = normal(q);
        put(position, body, x);
        rotation[4 * body] = q.w;
        rotation[4 * body + 1] = q.x;
        rotation[4 * body + 2] = q.y;
        rotation[4 * body + 3] = q.z;
        put(centre, body, x + turn(q, model_value(tree.body_ipos, body)));
        wp::index(robots.xpos, world, body) = x;
        wp::index(robots.xquat, world, body) = wp::quat_t<float>(q.w, q.x, q.y, q.z);
    }
    sync();
}
#pragma unroll 1
for (int n = 0; n < tree.roots.shape[0]; ++n) {
    const int root = tree.roots.data[n];
    Vec sum;
    for (int body = 1 + lane; body < NB; body += LANES) {
        if (tree.body_rootid.data[body] == root) sum += get(centre, body) * model_value(tree.body_mass, body);
    }
    for (int i = 0; i < 3; ++i) sum[i] = total(sum[i]);
    const float mass = model_value(tree.body_subtreemass, root);
    if (mass != 0.0f) sum = sum / mass;
    if (lane == 0) {
        put(com, root, sum);
        wp::index(robots.subtree_com, world, root) = sum;
    }
}
sync();

// Inertias and motions at the mass centre.
#pragma unroll 1
for (int body = 1 + lane; body < NB; body += LANES) {
    const Quat q = times(get_quat(body), to_quat(model_value(tree.body_iquat, body)));
    const Vec x = turn(q, Vec(1.0f, 0.0f, 0.0f)), y = turn(q, Vec(0.0f, 1.0f, 0.0f)), z = turn(q, Vec(0.0f, 0.0f, 1.0f));
    const Vec d = get(centre, body) - get(com, tree.body_rootid.data[body]), moment = model_value(tree.body_inertia, body);
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
}
#pragma unroll 1
for (int j = lane; j < NJ; j += LANES) {
    const int body = tree.jnt_bodyid.data[j], dof = tree.jnt_dofadr.data[j], type = tree.jnt_type.data[j];
    const Vec middle = get(com, tree.body_rootid.data[body]);
    if (type == FREE) {
        const Quat q = get_quat(body);
        const Vec offset = middle - get(position, body);
        for (int i = 0; i < 3; ++i) {
            const Vec axis(i == 0 ? 1.0f : 0.0f, i == 1 ? 1.0f : 0.0f, i == 2 ? 1.0f : 0.0f), turned = turn(q, axis);
            put_six(motion, dof + i, six(Vec(), axis));
            put_six(motion, dof + 3 + i, six(turned, wp::cross(turned, offset)));
        }
    } else {
        const Six joint_line = get_six(motion, dof);
        const Vec axis = rotation_part(joint_line), offset = middle - linear_part(joint_line);
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
    #pragma unroll 1
    for (int n = tree.level_start.data[level] + lane; n < tree.level_start.data[level + 1]; n += LANES) {
        const int body = tree.body_order.data[n], parent = tree.body_parentid.data[body];
        Six v = get_six(velocity, parent), a = get_six(force, parent);
        #pragma unroll 1
        for (int j = first_joint(body); j < first_joint(body) + num_joints(body); ++j) {
            int dof = tree.jnt_dofadr.data[j];
            if (tree.jnt_type.data[j] == FREE) {
                for (int i = 0; i < 3; ++i) add(v, get_six(motion, dof + i), qvel[dof + i]);
                const Six linear = v;
                for (int i = 3; i < 6; ++i) {
                    const Six s = get_six(motion, dof + i);
                    add(a, change_of_motion(linear, s), qvel[dof + i]);
                    add(v, s, qvel[dof + i]);
                }
            } else {
                const Six s = get_six(motion, dof);
                add(a, change_of_motion(v, s), qvel[dof]);
                add(v, s, qvel[dof]);
            }
        }
        put_six(velocity, body, v);
        put_six(force, body, a);
    }
    sync();
}
#pragma unroll 1
for (int body = 1 + lane; body < NB; body += LANES) {
    const Six v = get_six(velocity, body);
    Six f = momentum(inertia + 10 * body, get_six(force, body));
    add(f, change_of_force(v, momentum(inertia + 10 * body, v)), 1.0f);
    put_six(force, body, f);
}
sync();
#pragma unroll 1
for (int k = lane; k < 16; k += LANES) {  // each thread sums one number over all bodies
    float* numbers = k < 6 ? force + k : inertia + k - 6;
    const int stride = k < 6 ? 6 : 10;
    #pragma unroll 1
    for (int n = NB - 2; n >= 0; --n) {
        const int body = tree.body_order.data[n], parent = tree.body_parentid.data[body];
        if (parent > 0) numbers[stride * parent] += numbers[stride * body];
    }
}
sync();

// Inertia of the joints, and the forces on them.
#pragma unroll 1
for (int n = lane; n < NV; n += LANES) {
    const int body = tree.dof_bodyid.data[n], joint = tree.dof_jntid.data[n];
    const Six s = get_six(motion, n), carried = momentum(inertia + 10 * body, s);
    const int start = tree.M_rowadr.data[n];  // a row leaves out ancestors whose entries are always 0
    int column = start + tree.M_rownnz.data[n] - 1;
    wp::index(robots.M, world, column) = model_value(tree.dof_armature, n) + dot(s, carried);
    #pragma unroll 1
    for (int m = tree.dof_parentid.data[n]; column > start; m = tree.dof_parentid.data[m]) {
        wp::index(robots.M, world, --column) = dot(get_six(motion, m), carried);
    }
    const float damping = model_value(tree.dof_damping, n);
    const float strength = robots.strength.shape[0] > 0 ? wp::index(robots.strength, world) : 1.0f;
    float passive = -damping * qvel[n], driven = 0.0f, slope = damping;
    if (tree.jnt_type.data[joint] != FREE) {
        const int coordinate = tree.jnt_qposadr.data[joint];
        passive -= model_value(tree.jnt_stiffness, joint) * (qpos[coordinate] - model_value(tree.qpos_spring, coordinate));
        const int a = tree.dof_actuator.data[n];
        if (a >= 0) {
            const auto& gain = wp::index(tree.actuator_gainprm, world % tree.actuator_gainprm.shape[0], a, 0);
            const float* bias = &wp::index(tree.actuator_biasprm, world % tree.actuator_biasprm.shape[0], a, 0);
            const float gear = model_value(tree.actuator_gear, a)[0];
            float control = wp::index(robots.ctrl, world, a);
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
