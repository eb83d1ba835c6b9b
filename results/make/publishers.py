"""Speeds of public controllers on level ground by their publishers' own code, in plain MuJoCo.

A folder holds the publishers' repositories. Nothing of faultline is used, so that imports can be held against it:
start, command and goal of a crossing are written a second time, and each function follows the files that it names.

A function's ``observe`` gets the state of a control step: lin_vel of the base's origin [m/s] and gyro [rad/s] in the
base frame, quat w x y z, gravity, its direction in the base frame, q [rad] and dq [rad/s] in the publisher's order of
joints, command vx, vy [m/s] and yaw rate [rad/s], action, the network's last, step, and memory of the episode.
"""

import json
import tomllib
import xml.etree.ElementTree as ET
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace as State
from typing import Any

import mujoco
import numpy as np
import onnxruntime
import torch
import yaml
from numpy.typing import NDArray

mj: Any = mujoco  # its types are not written down
Array = NDArray[np.float64]
START, GOAL, RADIUS = np.array([2.0, 4.0]), np.array([14.0, 4.0]), 0.5
"""Of a crossing [m]."""
CONTROL_DT = 0.02
"""Of all of them [s]."""


@dataclass
class Publisher:
    """A controller as its publisher runs it: target [rad] = offset + scale x action, of the joints that it moves."""

    model: Path
    network: Path
    joints: Sequence[str]
    default: Array  # pose at the start [rad]; joints that are not moved hold it
    observe: Callable[[State], Any]  # the network's row, or its inputs by name
    scale: Any
    dt: float  # of the physics [s]
    kp: Any = None  # gains of a PD drive, its torque found each physics step; None: the model's actuators take targets
    kd: Any = None
    effort: Any = np.inf  # largest torque [N m]; the model's limit counts too
    clip: Any = (-np.inf, np.inf)  # of actions
    offset: Any = None  # the default pose if None
    moved: Sequence[int] | None = None  # numbers of the joints that it moves; all if None


def read_mjcf(path: Path) -> tuple[Any, list[Any]]:
    """An MJCF's specification, and the meshes that are not there, as in a clone without large files: it has none."""
    spec = mj.MjSpec.from_file(str(path))
    missing = [mesh for mesh in spec.meshes if not (path.parent / spec.meshdir / mesh.file).is_file()]
    names = {mesh.name or Path(mesh.file).stem for mesh in missing}
    for geom in [geom for geom in spec.geoms if geom.meshname in names]:
        spec.delete(geom)
    for material in spec.materials if missing else ():
        material.textures = [""] * len(material.textures)
    for element in [*missing, *spec.textures] if missing else ():
        spec.delete(element)
    return spec, missing


def load_model(publisher: Publisher) -> Any:
    """The publisher's model on level ground."""
    is_urdf = publisher.model.suffix == ".urdf"
    spec = mj.MjSpec.from_string(_free_urdf(publisher.model)) if is_urdf else read_mjcf(publisher.model)[0]
    for geom in spec.geoms:
        geom.conaffinity *= not is_urdf  # robots do not touch themselves, as in Isaac Lab
    if not any(geom.type == mj.mjtGeom.mjGEOM_PLANE for geom in spec.geoms):
        looks = {"size": (0, 0, 1), "contype": 1, "conaffinity": 1, "condim": 3, "friction": (1, 0.005, 0.0001)}
        spec.worldbody.add_geom(name="floor", type=mj.mjtGeom.mjGEOM_PLANE, margin=0, priority=0, **looks)
    spec.option.timestep = publisher.dt
    return spec.compile()


def _free_urdf(path: Path) -> str:
    root = ET.parse(path).getroot()
    for parent in list(root.iter()):
        for child in list(parent):
            light = child.tag == "inertial" and all(float(mass.get("value", 0)) < 1e-9 for mass in child.iter("mass"))
            if light or child.tag in ("visual", "mujoco"):
                parent.remove(child)
    for mesh in root.iter("mesh"):
        name = mesh.get("filename", "").removeprefix("package://")
        mesh.set("filename", str(next(folder / name for folder in path.parents if (folder / name).is_file())))
    children = {child.get("link") for child in root.iter("child")}
    joint = ET.SubElement(root, "joint", name="floating", type="floating")
    base = next(name for link in root.iter("link") if (name := link.attrib["name"]) not in children)
    ET.SubElement(joint, "child", link=base)
    ET.SubElement(joint, "parent", link="world")
    ET.SubElement(root, "link", name="world")
    ET.SubElement(ET.SubElement(root, "mujoco"), "compiler", strippath="false", fusestatic="true")
    return ET.tostring(root, encoding="unicode")


def walk(publisher: Publisher, *, episodes: int, speed: float, duration_s: float, seed: int = 0) -> dict[str, Any]:
    """Mean speed from the start to where an episode ends [m/s], and the share that reaches the goal."""
    model, rng = load_model(publisher), np.random.default_rng(seed)
    rows = np.array([cross(publisher, model, rng, speed, duration_s) for _ in range(episodes)])
    return {"episodes": episodes, "goal": float(rows[:, 2].mean()), "speed": float((rows[:, 0] / rows[:, 1]).mean())}


def cross(publisher: Publisher, model: Any, rng: np.random.Generator, speed: float, duration_s: float) -> list[float]:
    """Distance from the start at the end of one episode [m], its duration [s], and 1 if it reached the goal."""
    data = mj.MjData(model)
    joints = np.array([model.joint(name).id for name in publisher.joints])
    at, rates = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
    drives = [int(np.flatnonzero(model.actuator_trnid[:, 0] == k)[0]) for k in joints if publisher.kp is None]
    limits = np.where(model.jnt_actfrclimited[joints] == 1, model.jnt_actfrcrange[joints, 1], np.inf)
    limits = np.minimum(limits, publisher.effort)
    yaw = rng.uniform(-0.2, 0.2)
    data.qpos[:7] = *(START + rng.uniform(-0.1, 0.1, 2)), 0.0, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)
    data.qpos[at] = publisher.default * rng.uniform(0.8, 1.2, len(joints))
    mj.mj_forward(model, data)
    solid = (model.geom_bodyid > 0) & (model.geom_contype | model.geom_conaffinity > 0)
    up = data.geom_xmat[solid, 6:]
    lowest = data.geom_xpos[solid, 2] + (up * model.geom_aabb[solid, :3] - abs(up) * model.geom_aabb[solid, 3:]).sum(1)
    data.qpos[2] = height = 0.005 - lowest.min()
    data.qvel[:6] = rng.uniform(-0.2, 0.2, 6)
    targets, moved = publisher.default.copy(), publisher.moved or list(range(len(joints)))
    offset = targets[moved].copy() if publisher.offset is None else publisher.offset
    network, action, memory = load_network(publisher.network), np.zeros(len(moved)), dict[str, Any]()
    decimation, to_world = round(CONTROL_DT / publisher.dt), np.zeros((3, 3))
    for step in range(round(duration_s / publisher.dt)):
        to_goal = GOAL - data.qpos[:2]
        if np.hypot(*to_goal) < RADIUS or data.qpos[2] < 0.5 * height:
            break
        if step % decimation == 0:
            mj.mju_quat2Mat(to_world.ravel(), data.qpos[3:7])
            error = np.arctan2(to_goal[1], to_goal[0]) - np.arctan2(to_world[1, 0], to_world[0, 0])
            error = np.arctan2(np.sin(error), np.cos(error))
            command = np.array([speed * np.cos(error), speed * np.sin(error), np.clip(0.5 * error, -1, 1)])
            body = {"lin_vel": to_world.T @ data.qvel[:3], "gyro": data.qvel[3:6].copy(), "gravity": -to_world[2]}
            body |= {"quat": data.qpos[3:7].copy(), "q": data.qpos[at], "dq": data.qvel[rates]}
            state = State(**body, command=command, action=action, step=step // decimation, memory=memory)
            action = np.clip(network(publisher.observe(state)), *publisher.clip)
            targets[moved] = offset + publisher.scale * action
        if publisher.kp is None:
            data.ctrl[drives] = targets
        else:
            torque = publisher.kp * (targets - data.qpos[at]) - publisher.kd * data.qvel[rates]
            data.qfrc_applied[rates] = np.clip(torque, -limits, limits)
        mj.mj_step(model, data)
    end = data.qpos[:2]
    return [np.hypot(*(end - START)), data.time, np.hypot(*(GOAL - end)) < RADIUS]


def load_network(file: Path) -> Callable[[Any], Array]:
    """A network of one robot that has seen nothing: TorchScript, or ONNX; states of an ONNX are fed back to it."""
    if file.suffix != ".onnx":
        module = torch.jit.load(str(file), map_location="cpu").eval()

        def act(row: Array) -> Array:
            with torch.inference_mode():
                output: Any = module(torch.tensor(row[None], dtype=torch.float32))
            return (output[0] if isinstance(output, tuple) else output)[0].numpy().astype(np.float64)

        return act
    session: Any = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    inputs, names = session.get_inputs(), [output.name for output in session.get_outputs()]
    states = {entry.name: np.zeros(entry.shape, np.float32) for entry in inputs if f"{entry.name}_out" in names}

    def run(row: Any) -> Array:
        row = row if isinstance(row, dict) else {inputs[0].name: row}
        feed = {name: value[None].astype(np.float32) for name, value in row.items()}
        outputs = dict(zip(names, session.run(None, feed | states), strict=True))
        states.update({name: outputs[f"{name}_out"] for name in states})
        return outputs[names[0]][0].astype(np.float64)

    return run


def read_yaml(file: Path) -> Any:
    """A YAML whose tags are ignored and whose values are text."""
    return yaml.load(file.read_text(), Loader=yaml.BaseLoader)


def read_floats(cfg: dict[str, Any], names: str) -> list[Any]:
    """Numbers of a YAML, by names with spaces between."""
    return [np.array(cfg[name], float) for name in names.split()]


def list_driven(model: Path) -> list[str]:
    """Joints of an MJCF in the order of its actuators."""
    return [actuator.target for actuator in mj.MjSpec.from_file(str(model)).actuators]


def rl_sar(robot: str, variant: str, model: str, root: Path) -> Publisher:
    """rl_sar: library/core/rl_sdk/rl_sdk.cpp, observation_buffer.cpp; its Gazebo finds torques in steps of 1 ms."""
    folder = root / "rl_sar/policy" / robot
    cfg = read_yaml(folder / "base.yaml")[robot] | read_yaml(folder / variant / "config.yaml")[f"{robot}/{variant}"]
    default, kp, kd, effort, scale = read_floats(cfg, "default_dof_pos rl_kp rl_kd torque_limits action_scale")
    ang_vel, pos, vel, commands = read_floats(cfg, "ang_vel_scale dof_pos_scale dof_vel_scale commands_scale")
    steps = [int(step) for step in cfg["observations_history"]] or [0]
    joints = [cfg["joint_names"][int(k)] for k in cfg["joint_mapping"]]
    clip = read_floats(cfg, "clip_actions_lower clip_actions_upper")

    def observe(s: State) -> Array:
        terms = {"ang_vel": s.gyro * ang_vel, "gravity_vec": s.gravity, "commands": s.command * commands}
        terms |= {"dof_pos": (s.q - default) * pos, "dof_vel": s.dq * vel, "actions": s.action}
        row = np.concatenate([terms[name] for name in cfg["observations"]]).clip(-100.0, 100.0)
        rows = s.memory.setdefault("rows", deque([0.0 * row] * len(steps), maxlen=len(steps)))
        rows.appendleft(row)
        return np.concatenate([rows[k] for k in steps])

    model_file = root / "robot_lab/source/robot_lab/data/Robots" / model
    network = folder / variant / cfg["model_name"]
    return Publisher(model_file, network, joints, default, observe, scale, 0.001, kp, kd, effort, clip)


def unitree_rl_gym(robot: str, model: str, root: Path) -> Publisher:
    """unitree_rl_gym: deploy/deploy_mujoco/deploy_mujoco.py."""
    root /= "unitree_rl_gym"
    cfg = read_yaml(root / f"deploy/deploy_mujoco/configs/{robot}.yaml")
    default, kp, kd, dt, cmd = read_floats(cfg, "default_angles kps kds simulation_dt cmd_scale")
    ang_vel, pos, vel, scale = read_floats(cfg, "ang_vel_scale dof_pos_scale dof_vel_scale action_scale")

    def observe(s: State) -> Array:
        phase = 2.0 * np.pi * s.step * CONTROL_DT / 0.8
        row = [s.gyro * ang_vel, s.gravity, s.command * cmd, (s.q - default) * pos, s.dq * vel, s.action]
        return np.concatenate([*row, [np.sin(phase), np.cos(phase)]])

    model_file = root / "resources/robots" / model
    network = Path(cfg["policy_path"].replace("{LEGGED_GYM_ROOT_DIR}", str(root)))
    return Publisher(model_file, network, list_driven(model_file), default, observe, scale, float(dt), kp, kd)


def playground(root: Path) -> Publisher:
    """MuJoCo Playground: experimental/sim2sim/play_go1_joystick.py."""
    root /= "playground/mujoco_playground"
    model = root / "_src/locomotion/go1/xmls/scene_mjx_fullcollisions_flat_terrain.xml"
    spec = mj.MjSpec.from_file(str(model))
    default = next(np.array(key.qpos)[7:] for key in spec.keys if key.name == "home")
    imu = next(site.pos for site in spec.sites if site.name == "imu")

    def observe(s: State) -> Array:
        row = [s.lin_vel + np.cross(s.gyro, imu), s.gyro, s.gravity, s.q - default, s.dq, s.action, s.command]
        return np.concatenate(row)

    network = root / "experimental/sim2sim/onnx/go1_policy.onnx"
    return Publisher(model, network, list_driven(model), default, observe, 0.5, 0.004)


def holosoma(robot: str, file: str, root: Path) -> Publisher:
    """holosoma: holosoma_inference/policies/{base,locomotion}.py, config/config_values/{robot,observation,task}.py."""
    root /= "holosoma/src"
    network = root / f"holosoma_inference/holosoma_inference/models/loco/{robot}_29dof/{file}_{robot}_29dof.onnx"
    metadata = onnxruntime.InferenceSession(str(network)).get_modelmeta().custom_metadata_map
    joints, kp, kd = (json.loads(metadata[name]) for name in ("dof_names", "kp", "kd"))
    zero, g1_leg, t1_leg = [0.0] * 3, [-0.312, 0.0, 0.0, 0.669, -0.363, 0.0], [-0.2, 0.0, 0.0, 0.4, -0.25, 0.0]
    g1 = [*g1_leg, *g1_leg, *zero, 0.2, 0.2, 0.0, 0.6, *zero, 0.2, -0.2, 0.0, 0.6, *zero]
    t1 = [0.0, 0.0, 0.2, -1.35, 0.0, -0.5, *zero, 0.2, 1.35, 0.0, 0.5, *zero, 0.0, *t1_leg, *t1_leg]
    default, gyro, vel = (np.array(g1), 0.25, 0.05) if robot == "g1" else (np.array(t1), 1.0, 0.1)

    def observe(s: State) -> Array:  # terms are sorted by name
        phase = 2.0 * np.pi * CONTROL_DT * (s.step + 1) + np.array([0.0, np.pi])
        row = [s.action, s.gyro * gyro, s.command[2:], s.command[:2], np.cos(phase)]
        return np.concatenate([*row, s.q - default, s.dq * vel, s.gravity, np.sin(phase)])

    model, gains = root / f"holosoma/holosoma/data/robots/{robot}/{robot}_29dof.xml", (np.array(kp), np.array(kd))
    return Publisher(model, network, joints, default, observe, 0.25, 0.005, *gains, clip=(-100.0, 100.0))


def booster(root: Path) -> Publisher:
    """Booster: play_mujoco.py with gains of envs/T1.yaml; command and clock of deploy/utils/policy.py."""
    root /= "booster_gym"
    model, cfg = root / "resources/T1/T1_locomotion.xml", read_yaml(root / "envs/T1.yaml")
    joints, control = list_driven(model), cfg["control"]
    tables = (cfg["init_state"]["default_joint_angles"], control["stiffness"], control["damping"])
    default, kp, kd = ([next((float(v) for k, v in t.items() if k in name), 0.0) for name in joints] for t in tables)
    pose = np.array(default)

    def observe(s: State) -> Array:
        smooth = s.memory.setdefault("command", np.zeros(3))
        smooth += np.clip(s.command - smooth, -CONTROL_DT, CONTROL_DT)
        phase = 2.0 * np.pi * CONTROL_DT * s.step
        row = [s.gravity, s.gyro, smooth, [np.cos(phase), np.sin(phase)], s.q - pose, 0.1 * s.dq, s.action]
        return np.concatenate(row)

    network = root / "deploy/models/T1.pt"
    return Publisher(model, network, joints, pose, observe, 1.0, 0.002, np.array(kp), np.array(kd), clip=(-1.0, 1.0))


def unitree_rl_lab(root: Path) -> Publisher:
    """unitree_rl_lab: deploy/include/isaaclab/{envs/mdp/observations.h,manager/*.h}; motors find torques at 1 ms."""
    folder = root / "unitree_rl_lab/deploy/robots/g1/config/policy/velocity/v0"
    cfg = read_yaml(folder / "params/deploy.yaml")
    order = [int(k) for k in cfg["joint_ids_map"]]  # the network's joints among the motors, of which gains are
    default, kp, kd = read_floats(cfg, "default_joint_pos stiffness damping")
    scale, offset = read_floats(cfg["actions"]["JointPositionAction"], "scale offset")
    low, high = np.transpose(read_floats(cfg["commands"]["base_velocity"]["ranges"], "lin_vel_x lin_vel_y ang_vel_z"))

    def observe(s: State) -> Array:
        terms = {"base_ang_vel": s.gyro, "projected_gravity": s.gravity, "last_action": s.action}
        terms |= {"velocity_commands": s.command.clip(low, high), "joint_pos_rel": s.q - default, "joint_vel_rel": s.dq}
        rows = list[Array]()
        for name, term in cfg["observations"].items():
            row, length = terms[name] * np.array(term["scale"], float), int(term["history_length"])
            s.memory.setdefault(name, deque([row] * length, maxlen=length)).append(row)
            rows += s.memory[name]
        return np.concatenate(rows)

    model = root / "holosoma/src/holosoma/holosoma/data/robots/g1/g1_29dof.xml"
    network, joints = folder / "exported/policy.onnx", [list_driven(model)[k] for k in order]
    return Publisher(model, network, joints, default, observe, scale, 0.001, kp[order], kd[order], offset=offset)


def judo(root: Path) -> Publisher:
    """Judo: mujoco_extensions/system/system_class.cpp (setObservation, policyInference), with the arm before it."""
    root /= "judo/judo/models"
    arm = {0: "sh0", 5: "sh1", 10: "el0", 15: "el1", 16: "wr0", 17: "wr1", 18: "f1x"}  # among its joints
    joints = [f"{leg}_{name}" for name in ("hx", "hy", "kn") for leg in ("fl", "fr", "hl", "hr")]
    for number, name in arm.items():
        joints.insert(number, f"arm_{name}")
    pose = np.array([0.0, 0.12, -0.12, 0.12, -0.12, -0.9, *[0.5] * 4, 1.8, *[-1.0] * 4, 0.0, -0.9, 0.0, -1.54])

    def observe(s: State) -> Array:
        row = [s.lin_vel, s.gyro, s.gravity, s.command, pose[list(arm)], np.zeros(12), [0.0, 0.0, 0.52]]
        return np.concatenate([*row, s.q - pose, s.dq, s.action])

    model, network = root / "xml/spot_primitive/robot.xml", root / "policies/spot_locomotion.onnx"
    moved = [k for k in range(19) if k not in arm]
    return Publisher(model, network, joints, pose, observe, 0.2, 0.01, moved=moved)


def robogauge(root: Path) -> Publisher:
    """RoboGauge: robogauge/tasks/robots/go2/{go2,go2_config}.py, simulator/mujoco_simulator.py without noise."""
    root /= "RoboGauge/resources"
    default = np.array([0.1, 0.8, -1.5, -0.1, 0.8, -1.5, 0.1, 1.0, -1.5, -0.1, 1.0, -1.5])

    def observe(s: State) -> Array:
        row = [0.25 * s.gyro, s.gravity, s.command * [2.0, 2.0, 0.25], s.q - default, 0.05 * s.dq, s.action]
        return np.concatenate(row)

    model, network = root / "robots/go2/go2.xml", root / "models/go2/go2_cts_max2_100k.pt"
    effort = np.array([23.7, 23.7, 45.43] * 4)
    return Publisher(model, network, list_driven(model), default, observe, 0.25, 0.002, 20.0, 0.5, effort)


def leapp(root: Path) -> Publisher:
    """grove-g1: src/g1_controllers/src/agile_policy.cpp, config/lowcmd_controllers.yaml; arms and waist are held."""
    folder = root / "grove-g1/workspace/src/g1_controllers/policy"
    network = folder / "unitree_g1_velocity_e2e.onnx"
    (graph,) = read_yaml(network.with_suffix(".yaml"))["models"].values()
    names = {entry["name"]: entry.get("element_names", [[]])[0] for entry in (*graph["inputs"], *graph["outputs"])}
    joints = names["joint_pos"]
    moved = [joints.index(name) for name in names["action_joint_pos"]]
    session: Any = onnxruntime.InferenceSession(str(network), providers=["CPUExecutionProvider"])
    zeros = {entry.name: np.zeros(entry.shape, np.float32) for entry in session.get_inputs()}
    is_waist = np.array([name == "waist_yaw_joint" for name in joints])
    default, kp, kd = np.zeros(29), np.where(is_waist, 10.0, 40.0), np.ones(29)
    default[moved], kp[moved], kd[moved] = (values[0] for values in session.run(None, zeros)[:3])

    def observe(s: State) -> dict[str, Array]:
        row = {"root_link_quat_w": s.quat, "root_ang_vel_b": s.gyro, "velocity_commands": s.command}
        return row | {"joint_pos": s.q, "joint_vel": s.dq}

    model = root / "holosoma/src/holosoma/holosoma/data/robots/g1/g1_29dof.xml"
    return Publisher(model, network, joints, default, observe, 1.0, 0.005, kp, kd, offset=0.0, moved=moved)


LOOPS = (rl_sar, unitree_rl_gym, playground, holosoma, booster, unitree_rl_lab, judo, robogauge, leapp)
_BY_NAME: dict[str, Callable[..., Publisher]] = {loop.__name__: loop for loop in LOOPS}
LEAGUE = tomllib.loads(Path(__file__).with_name("public.toml").read_text())
"""Repositories and controllers."""
PUBLISHERS = {name: partial(_BY_NAME[row["loop"][0]], *row["loop"][1:]) for name, row in LEAGUE["controllers"].items()}
"""Each controller as its publisher runs it, from the folder of the repositories."""
