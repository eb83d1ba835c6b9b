"""What trainings and vendors leave becomes a robot and a controller, which load and mean the same."""

import datetime
import functools
import hashlib
import json
import re

import numpy as np
import onnx
import pytest
import torch
import yaml

from sim.controllers.described import read_controller
from sim.controllers.imports import import_controller
from sim.controllers.loaders import load_policy
from sim.robots.find import get_robot
from tests.sim.controllers.test_onnx import linear, parse
from tests.sim.dogs import JOINTS, mjcf

RIGHT_FIRST = ["FR_hip", "FR_knee", "FL_hip", "FL_knee", "HR_hip", "HR_knee", "HL_hip", "HL_knee"]
POSE = [0.6, -1.2, 0.5, -1.1] * 2  # of the right and the left legs
IN_FILE = (0.5, -1.1, 0.6, -1.2) * 2
BLIND_WITH_CLOCK = ["ang_vel", "gravity", "command", "joint_pos", "joint_vel", "last_action", "clock"]
HIPS_FIRST = tuple(f"{leg}_{joint}" for joint in ("hip", "knee") for leg in ("FL", "FR", "HL", "HR"))
RL_SAR = {
    "model_name": "policy.pt", "observations": ["ang_vel", "gravity_vec", "commands", "dof_pos", "dof_vel", "actions"],
    "observations_history": [0, 1], "observations_history_priority": "time", "clip_obs": 100.0,
    "clip_actions_lower": [-9.0] * 8, "clip_actions_upper": [9.0] * 8, "rl_kp": [20, 30] * 4, "rl_kd": [0.5] * 8,
    "fixed_kp": [80.0] * 8, "action_scale": [0.125, 0.25] * 4, "wheel_indices": [], "ang_vel_scale": 0.25,
    "dof_pos_scale": 1.0, "commands_scale": [2.0, 2.0, 0.25], "torque_limits": [23.5] * 8, "default_dof_pos": POSE,
    "joint_mapping": [2, 3, 0, 1, 6, 7, 4, 5],
}  # fmt: skip
DEPLOYMENT = {
    "policy_path": "{LEGGED_GYM_ROOT_DIR}/pre_train/policy.pt", "simulation_dt": 0.002, "control_decimation": 10,
    "kps": [100, 150] * 4, "kds": [2] * 8, "default_angles": [0.6, -1.2] * 4, "ang_vel_scale": 0.25,
    "dof_pos_scale": 1.0, "dof_vel_scale": 0.05, "action_scale": 0.25, "cmd_scale": [2.0, 2.0, 0.25], "num_actions": 8,
    "num_obs": 35, "cmd_init": [0.5, 0, 0],
}  # fmt: skip
MJLAB = {
    "joint_names": ",".join(JOINTS), "joint_stiffness": ",".join(["20.000"] * 8),
    "joint_damping": ",".join(["1.0"] * 8),
    "default_joint_pos": ",".join(["0.600", "-1.200"] * 4), "action_scale": ",".join(["0.373", "0.249"] * 4),
    "observation_names": "base_lin_vel,base_ang_vel,projected_gravity,command,joint_pos,joint_vel,actions",
    "observation_terms_scale": "1.0,0.2,1.0,1.0,1.0,1.0,1.0", "observation_terms_history_length": "0,3,0,0,0,0,0",
    "observation_terms_clip": "-5.0;5.0,-inf;inf,-inf;inf,-inf;inf,-inf;inf,-inf;inf,-inf;inf", "run_path": "local",
    "command_names": "twist",
}  # fmt: skip
LEGGED_GYM = {
    "asset": {"file": "{LEGGED_GYM_ROOT_DIR}/dog.urdf"}, "sim": {"dt": 0.005},
    "init_state": {"default_joint_angles": dict(zip(RIGHT_FIRST, POSE, strict=True))},
    "control": {"stiffness": {"hip": 20.0, "knee": 30.0, "HR_knee": 35.0}, "damping": {"_": 0.5}, "action_scale": 0.25,
                "decimation": 4},
    "terrain": {"measured_points_x": [-0.1, 0.1], "measured_points_y": [0.0]},
    "normalization": {"clip_observations": 100.0, "clip_actions": 10.0, "obs_scales": {
        "lin_vel": 2.0, "ang_vel": 0.25, "dof_pos": 1.0, "dof_vel": 0.05, "height_measurements": 5.0}},
}  # fmt: skip
ISAAC = """
sim: {dt: 0.005, gravity: !!python/tuple [0.0, 0.0, -9.81]}
decimation: 4
scene:
  robot:
    init_state:
      pos: !!python/tuple [0.0, 0.0, 0.4]
      joint_pos: {.*_hip: 0.6, F._knee: -1.2, H._knee: -1.1}
    actuators:
      hips: {class_type: 'isaaclab.actuators.actuator_pd:DCMotor', joint_names_expr: [.*_hip], effort_limit: 20.0,
             velocity_limit: 30.0, stiffness: {.*: 25.0}, damping: 0.5}
      knees: {class_type: 'isaaclab.actuators:ImplicitActuator', joint_names_expr: [.*_knee], effort_limit: null,
              effort_limit_sim: 30.0, velocity_limit_sim: 21.0, stiffness: 35.0, damping: 0.5}
  height_scanner:
    ray_alignment: yaw
    offset: {pos: !!python/tuple [0.1, 0.0, 20.0]}
    pattern_cfg: {func: 'isaaclab:grid_pattern', resolution: 0.2, size: [0.4, 0.2], ordering: xy}
actions:
  joint_pos: {class_type: 'isaaclab:JointPositionAction', joint_names: [.*], scale: {.*_hip: 0.125, .*_knee: 0.25},
              preserve_order: false, use_default_offset: true, clip: null}
commands:
  base_velocity: {ranges: {lin_vel_x: !!python/tuple [-0.5, 0.5]}}
observations:
  policy:
    concatenate_terms: true
    history_length: null
    base_lin_vel: {func: 'isaaclab.envs.mdp.observations:base_lin_vel', scale: 2.0, clip: null, history_length: 0}
    velocity_commands: {func: 'isaaclab.envs.mdp.observations:generated_commands', params: {command_name: it}}
    joint_pos:
      func: isaaclab.envs.mdp.observations:joint_pos_rel
      params: {asset_cfg: {joint_names: null, joint_ids: !!python/object/apply:builtins.slice [null, null, null]}}
    actions: {func: 'isaaclab.envs.mdp.observations:last_action'}
    height_scan: {func: 'isaaclab.envs.mdp.observations:height_scan', clip: !!python/tuple [-1.0, 1.0],
                  params: {sensor_cfg: {name: height_scanner}, offset: 0.4}}
"""
DEPLOY = """
joint_ids_map: [2, 0, 6, 4, 3, 1, 7, 5]
step_dt: 0.02
stiffness: [20, 21, 22, 23, 24, 25, 26, 27]
damping: [1, 1, 1, 1, 1, 1, 1, 1]
default_joint_pos: [0.5, 0.6, 0.5, 0.6, -1.1, -1.2, -1.1, -1.2]
commands: {it: {ranges: {lin_vel_x: [-0.5, 0.6], lin_vel_y: [-0.4, 0.3], ang_vel_z: [-0.2, 0.2]}}}
actions:
  JointPositionAction: {clip: null, joint_names: [.*], scale: [0.3, 0.3, 0.3, 0.3, 0.2, 0.2, 0.2, 0.2],
    offset: [0.5, 0.6, 0.5, 0.6, -1.1, -1.2, -1.1, -1.2], joint_ids: !!python/object/apply:builtins.slice [null, null]}
observations:
  base_ang_vel: {params: {}, clip: [-9, 9], scale: [0.2, 0.2, 0.2], history_length: 3}
  velocity_commands: {params: {command_name: it}, clip: null, scale: [1, 1, 1], history_length: 3}
  joint_pos_rel: {params: {}, clip: null, scale: [1, 1, 1, 1, 1, 1, 1, 1], history_length: 3}
  joint_vel_rel: {params: {asset_cfg: {joint_ids: [0, 4]}}, clip: null, scale: [1, 1], history_length: 3}
  gait_phase: {params: {period: 0.6}, clip: null, scale: [1, 1], history_length: 3}
"""
HOLOSOMA = {
    "dof_names": [*JOINTS], "kp": [40.0] * 8, "kd": [2.0] * 8, "iteration": 9,
    "command_ranges": {"lin_vel_x": [-1, 1], "lin_vel_y": [-0.4, 0.4], "ang_vel_yaw": [-0.5, 0.5]},
    "experiment_config": {
        "robot": {
            "init_state": {"default_joint_angles": dict(zip(JOINTS, [0.6, -1.2] * 4, strict=True))},
            "control": {"action_scale": 0.3, "action_clip_value": 50.0}, "dof_armature_list": [0.02] * 8,
        },
        "simulator": {"config": {"sim": {"fps": 500, "control_decimation": 10}}},
        "command": {"setup_terms": {"locomotion_gait": {"params": {"gait_period": 0.9}}}},
        "observation": {"groups": {"actor_obs": {"history_length": 2, "terms": {
            "sin_phase": {}, "projected_gravity": {}, "dof_vel": {"scale": 0.1}, "dof_pos": {}, "cos_phase": {},
            "command_lin_vel": {}, "command_ang_vel": {"scale": 0.5}, "base_ang_vel": {}, "actions": {},
        }}}},
    },
}  # fmt: skip
SCAN = """
sim: {mujoco: {timestep: 0.002}}
decimation: 10
scene: {sensors: [{name: terrain, ray_alignment: yaw, frame: {type: body, name: trunk, entity: robot},
  pattern: {size: !!python/tuple [0.4, 0.2], resolution: 0.2}}]}
observations: {actor: {terms: {height_scan: {params: {sensor_name: terrain, offset: 0.1}}}}}
"""
BOOSTER = {
    "common": {"dt": 0.002, "default_qpos": [9, 0, *[0.6, -1.2] * 4], "stiffness": [9, 9, *[200, 50] * 4],
               "damping": [9, 9, *[5, 3] * 4], "torque_limit": [9, 9, *[30, 20] * 4]},
    "policy": {"policy_path": "./models/it.pt", "num_actions": 8, "num_observations": 35, "gait_frequency": 2.0,
               "control": {"action_scale": 0.5, "decimation": 10},
               "normalization": {"gravity": 1, "lin_vel": 1, "ang_vel": 0.5, "dof_pos": 1, "dof_vel": 0.1,
                                 "clip_actions": 1.0}},
}  # fmt: skip


def write(file, content):
    """Settings as YAML, or a layer of so many columns; returns the file."""
    file.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(content, int):
        torch.jit.script(torch.nn.Linear(content, 8)).save(str(file))
    else:
        file.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return file


def rl_sar(folder, width=2 * 33, **changes):
    base = {"dt": 0.005, "decimation": 4, "joint_names": list(JOINTS), "rl_kp": [1.0] * 8, "num_of_dofs": 8}
    write(folder / "base.yaml", {"dog": base})
    write(folder / "lab" / "config.yaml", {"dog/lab": RL_SAR | changes})
    write(folder / "lab" / "policy.pt", width)
    return folder / "lab"


def deployment(folder, **changes):
    write(folder / "policy.pt", 35)
    return write(folder / "dog.yaml", DEPLOYMENT | changes)


def legged_gym(folder, width=36, row=None, **control):
    write(folder / "policy_1.pt", width)
    env = {"num_observations": width, "num_one_step_observations": row}
    return write(folder / "cfg.json", json.dumps(LEGGED_GYM | {"env": env, "control": LEGGED_GYM["control"] | control}))


def mjlab(folder, width=42, **changes):
    model = linear(width, 8, batch=1)
    onnx.helper.set_model_props(model, MJLAB | changes)
    onnx.save(model, folder / "run.onnx", save_as_external_data=True, location="run.data", size_threshold=0)
    return folder / "run.onnx"


def holosoma(folder, width=2 * 37, **changes):
    model = linear(width, 8, batch=1)
    content = {name: json.dumps(value) for name, value in (HOLOSOMA | changes).items() if value is not None}
    onnx.helper.set_model_props(model, content)
    onnx.save(model, folder / "loco.onnx")
    return folder / "loco.onnx"


def booster(folder, trained=False, **changes):
    policy, common = BOOSTER["policy"] | changes, BOOSTER["common"]
    write(folder / "deploy" / "models" / "it.pt", 35)
    if not trained:
        return write(folder / "deploy" / "configs" / "it.yaml", {"common": common, "policy": policy})
    content = {
        "env": policy, "sim": {"dt": 0.002}, "asset": {"mujoco_file": "no.xml"}, "commands": {"gait_frequency": [1, 3]},
        "init_state": {"default_joint_angles": {"hip": 0.6, "knee": -1.2}}, "normalization": policy["normalization"],
        "control": policy["control"] | {"stiffness": {"hip": 200, "knee": 50}, "damping": {"hip": 5, "default": 3}},
    }  # fmt: skip
    return write(folder / "envs" / "it.yaml", content)


def isaac_lab(folder, old="", new=""):
    assert old in ISAAC
    write(folder / "params" / "env.yaml", ISAAC.replace(old, new))
    write(folder / "params" / "agent.yaml", {"clip_actions": 5.0, "policy": {"activation": "relu"}})
    write(folder / "exported" / "policy.pt", 3 + 3 + 8 + 8 + 6)
    return folder


def deploy(folder, *changes):
    text = DEPLOY
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    write(folder / "params" / "deploy.yaml", text)
    (folder / "exported").mkdir()
    onnx.save(linear(3 * 18, 8, batch=1), folder / "exported" / "policy.onnx")
    return folder


def leapp(folder, kp="gains", **changes):
    """Targets that follow half of the angle off a pose, of joints in another order, and a state."""
    text = f"""(float[1, 4] quat_w, float[1, 8] joint_pos, float[1, 8] past)
        => (float[1, 8] targets, float[1, 8] past_out, float[1, 8] kp, float[1, 8] kd) {{
        kp = Add({kp}, half)
        kd = Identity(gains)
        past_out = Add(past, half)
        off = Sub(joint_pos, pose)
        action = Mul(off, half)
        targets = Add(action, pose)
    }}"""
    model = parse(text, pose=np.float32(POSE), half=np.float32([0.5]), gains=np.full((1, 8), 20.0, "f4"))
    onnx.save(model, folder / "policy.onnx")
    kinds = {"quat_w": "state/body/rotation", "joint_pos": "state/joint/position", "past": None,
             "targets": "target/joint/position", "past_out": None, "kp": "kp", "kd": "kd"}  # fmt: skip
    names = {"quat_w": [list("xyzw")]}
    about = {name: {"kind": kind, "is_state": kind is None} for name, kind in kinds.items()}
    items = [{"name": name, "element_names": names.get(name, [RIGHT_FIRST]), **of} for name, of in about.items()]
    digest = hashlib.sha256((folder / "policy.onnx").read_bytes()).hexdigest()
    parameters = {"model_path": "policy.onnx", "sha256sum": digest}
    model = {"inputs": items[:3], "outputs": items[3:], "parameters": parameters} | changes
    pipeline = {"feedback_flow": {"it/past_out": ["it/past"]}, "configs": {"frequency": 25.0}}
    return write(folder / "it.yaml", {"models": {"it": model}, "pipeline": pipeline})


def imported(source, tmp_path, old="", new=""):
    """The robot and the description that are written of a source, as they load."""
    model = tmp_path / "model" / "dog.xml"
    model.parent.mkdir(exist_ok=True)
    text = mjcf(drive='<motor joint="{0}"/>').replace(old or "?", new)
    model.write_text(text.replace("<freejoint", '<site name="imu" pos="0.1 0 0"/><freejoint', 1))
    out = tmp_path / "mine" / "dog"
    import_controller(source, model, out)
    robot = get_robot(str(out / "robot.toml"))
    load_policy(robot.policy_file, robot, "cpu")
    return robot, read_controller(out / "controller.toml")


def test_rl_sar_is_read_over_the_base_of_its_robot(tmp_path):
    source = rl_sar(tmp_path / "policy", 2 * 35, observations=[*RL_SAR["observations"], "g1_phase"])
    robot, controller = imported(source, tmp_path)
    assert (robot.name, robot.default_joint_pos, robot.stiffness) == ("dog", IN_FILE, (20, 30) * 4)
    assert (robot.damping, robot.effort_limit, robot.control_dt) == ((0.5,) * 8, (23.5,) * 8, 0.02)
    assert (controller.joints, controller.action_scale) == (tuple(RIGHT_FIRST), (0.125, 0.25) * 4)
    assert (controller.action_clip, controller.observation_clip) == (9.0, 100.0)
    assert vars(controller.history) == {"length": 2, "newest": "first", "by": "row", "fill": "zeros"}
    assert [term.term for term in controller.observation] == BLIND_WITH_CLOCK
    assert [term.scale for term in controller.observation] == [0.25, 1.0, (2.0, 2.0, 0.25), 1.0, 1.0, 1.0, 1.0]
    assert controller.observation[-1].period_s == 0.8


def test_a_deployment_of_unitree_has_its_scripts_observation(tmp_path):
    robot, controller = imported(deployment(tmp_path), tmp_path)
    assert (robot.physics_dt, robot.decimation, robot.stiffness) == (0.002, 10, (100, 150) * 4)
    assert [term.term for term in controller.observation] == BLIND_WITH_CLOCK
    assert (controller.joints, controller.observation[-1].period_s) == (None, 0.8)
    with pytest.raises(ValueError, match="--out"):  # which is not written over
        imported(tmp_path / "dog.yaml", tmp_path)


def test_weights_and_the_model_of_a_deployment_may_be_in_folders_above(tmp_path):
    source = write(tmp_path / "deploy" / "dog.yaml", DEPLOYMENT | {"xml_path": "{LEGGED_GYM_ROOT_DIR}/model/scene.xml"})
    write(tmp_path / "pre_train" / "policy.pt", 35)
    write(tmp_path / "model" / "scene.xml", '<mujoco><include file="dog.xml"/></mujoco>')
    write(tmp_path / "model" / "dog.xml", mjcf(drive='<motor joint="{0}"/>'))
    import_controller(source, None, tmp_path / "mine" / "dog")
    assert get_robot(str(tmp_path / "mine" / "dog" / "robot.toml")).model_file.name == "dog.xml"
    (tmp_path / "model" / "scene.xml").unlink()
    with pytest.raises(ValueError, match="--model must name"):
        import_controller(source, None, tmp_path / "mine" / "cat")


BLIND = BLIND_WITH_CLOCK[:-1]


@pytest.mark.parametrize(
    ("width", "row", "terms"),
    [
        (33, None, BLIND),
        (35, None, BLIND_WITH_CLOCK),
        (36, None, ["lin_vel", *BLIND]),
        (38, None, ["lin_vel", *BLIND, "scan"]),
        (99, 33, ["command", "ang_vel", "gravity", *BLIND[3:]]),
    ],
)
def test_the_width_of_a_training_of_legged_gym_says_what_it_sees(tmp_path, width, row, terms):
    robot, controller = imported(legged_gym(tmp_path / "run", width, row), tmp_path)
    assert [term.term for term in controller.observation] == terms
    scales = {"lin_vel": 2.0, "ang_vel": 0.25, "command": (2.0, 2.0, 0.25), "joint_vel": 0.05, "scan": 5.0}
    assert [term.scale for term in controller.observation] == [scales.get(term, 1.0) for term in terms]
    assert (controller.history is None, controller.joints, controller.action_clip) == (row is None, None, 10.0)
    assert (robot.default_joint_pos, robot.damping) == (IN_FILE, (0.5,) * 8)
    assert robot.stiffness == (20.0, 30.0) * 3 + (20.0, 35.0)  # HR is the last; its own name comes later


def test_the_metadata_of_mjlab_are_read(tmp_path):
    robot, controller = imported(mjlab(tmp_path), tmp_path)
    assert (robot.stiffness, robot.default_joint_pos) == ((20.0,) * 8, (0.6, -1.2) * 4)
    assert controller.action_scale == (0.373, 0.249) * 4
    first, second, *_ = controller.observation
    assert (first.at, first.clip, first.history, second.scale, second.history) == ((0.1, 0, 0), (-5, 5), 1, 0.2, 3)
    assert vars(controller.history) == {"length": 3, "newest": "last", "by": "term", "fill": "first"}


def test_a_deploy_yaml_numbers_joints_by_their_motors(tmp_path):
    robot, controller = imported(deploy(tmp_path / "v0"), tmp_path)
    assert (controller.joints, controller.action_scale) == (HIPS_FIRST, (0.3,) * 4 + (0.2,) * 4)
    # The first motors are those of the right legs, in the file are the left ones.
    assert robot.stiffness == (22, 23, 20, 21, 26, 27, 24, 25)
    assert (robot.default_joint_pos, robot.speed, robot.control_dt) == (IN_FILE, 0.6, 0.02)
    ang_vel, command, joint_pos, joint_vel, clock = controller.observation
    assert (ang_vel.clip, ang_vel.scale, command.limit) == ((-9, 9), 0.2, (0.6, 0.4, 0.2))
    assert (joint_pos.joints, joint_vel.joints, clock.period_s) == (None, ("FL_hip", "FL_knee"), 0.6)
    assert vars(controller.history) == {"length": 3, "newest": "last", "by": "term", "fill": "first"}


def test_a_deploy_yaml_may_have_mjlabs_order_missing_motors_and_whole_rows(tmp_path):
    changes = [
        ("[2, 0, 6, 4, 3, 1, 7, 5]", "[2, 3, 0, 1, 12, 13, 10, 11]"),
        ("!!python/object/apply:builtins.slice [null, null]", "null"),
        ("[0.5, 0.6, 0.5, 0.6, -1.1, -1.2, -1.1, -1.2]", "[0.5, -1.1, 0.6, -1.2, 0.5, -1.1, 0.6, -1.2]"),
        ("offset: [0.5", "offset: [0.4"),
        ("observations:", "observations:\n  use_gym_history: true"),
    ]
    robot, controller = imported(deploy(tmp_path / "v0", *changes), tmp_path)
    assert controller.joints == JOINTS and robot.stiffness == (22, 23, 20, 21, 26, 27, 24, 25)
    assert controller.action_offset == (0.4, -1.1, 0.6, -1.2, 0.5, -1.1, 0.6, -1.2)
    assert controller.history.by == "row"


@pytest.mark.parametrize("has_env", [True, False])
def test_the_scan_of_mjlab_is_that_of_its_env_yaml_or_filled_in(tmp_path, has_env, capsys):
    scan = {"observation_names": "joint_pos,height_scan", "observation_terms_scale": "1.0;0.5;1;1;1;1;1;1,0.2"}
    more = {f"observation_terms_{name}": ",".join([text] * 2) for name, text in (("history_length", "0"), ("clip", ""))}
    source = mjlab(tmp_path, width=8 + 6, **scan, **more)
    if not has_env:
        with pytest.raises(ValueError, match="scan_x"):
            imported(source, tmp_path)
        assert "Fill in scan_x, scan_y" in capsys.readouterr().out
        return
    write(tmp_path / "params" / "env.yaml", SCAN)
    robot, controller = imported(source, tmp_path)
    joint_pos, points = controller.observation
    # 0.4 m by 0.2 m in steps of 0.2 m about the trunk.
    assert (points.x, points.y, points.order) == ((-0.2, 0.0, 0.2), (-0.1, 0.1), "x fastest")
    assert (points.offset, points.scale, joint_pos.scale[1], robot.physics_dt) == (0.1, 0.2, 0.5, 0.002)


@pytest.mark.parametrize("trained", [True, False])
def test_both_files_of_booster_have_its_observation(tmp_path, trained):
    robot, controller = imported(booster(tmp_path, trained), tmp_path)
    assert (robot.stiffness, robot.damping, robot.default_joint_pos) == ((200, 50) * 4, (5, 3) * 4, (0.6, -1.2) * 4)
    assert (controller.action_scale, controller.action_clip, robot.control_dt) == (0.5, 1.0, 0.02)
    _, ang_vel, command, clock, _, joint_vel, action = controller.observation
    assert (ang_vel.scale, command.scale, joint_vel.scale, action.term) == (0.5, (1, 1, 0.5), 0.1, "last_action")
    assert (clock.order, clock.period_s) == ("cos sin", 0.5)  # 2 Hz, the mean of 1 and 3


def test_holosoma_sorts_terms_by_name_and_has_a_phase_of_each_foot(tmp_path):
    robot, controller = imported(holosoma(tmp_path), tmp_path, ' armature="0.01"')
    assert (robot.stiffness, robot.armature, robot.default_joint_pos) == ((40.0,) * 8, (0.02,) * 8, (0.6, -1.2) * 4)
    assert (robot.physics_dt, robot.decimation) == (0.002, 10)
    assert (controller.action_scale, controller.action_clip, controller.history.fill) == (0.3, 50.0, "zeros")
    action, _, turn, walk, cosine, _, joint_vel, _, sine = controller.observation
    assert (action.term, turn.order, turn.scale, walk.order) == ("last_action", "yaw_rate", 0.5, "v_x v_y")
    assert (cosine.order, cosine.offset, cosine.period_s, sine.order) == ("cos", (0.0, 0.5), 0.9, "sin")
    assert (joint_vel.scale, walk.limit) == (0.1, (1.0, 0.4, 0.5))


def test_holosomas_humanoids_have_its_usual_configuration(tmp_path):
    names = ["left_hip_pitch_joint", *JOINTS[1:]]
    source = holosoma(tmp_path, 37, dof_names=names, experiment_config=None)
    with pytest.raises(ValueError, match="default_joint_pos is outside of the file's range for FL_knee"):
        imported(source, tmp_path, "FL_hip", "left_hip_pitch_joint")  # 0 rad, as joints that only a dog has
    text = (tmp_path / "mine" / "dog" / "robot.toml").read_text()
    assert "default_joint_pos = [-0.312, 0.0" in text and "no experiment_config" in text


def test_a_run_of_isaac_lab_is_read(tmp_path):
    robot, controller = imported(isaac_lab(tmp_path / "run"), tmp_path)
    assert (robot.default_joint_pos, robot.stiffness) == ((0.6, -1.2) * 2 + (0.6, -1.1) * 2, (25.0, 35.0) * 4)
    assert (robot.effort_limit, robot.speed) == ((20.0, 30.0) * 4, 0.5)
    assert robot.saturation_effort is None and robot.velocity_limit is None  # which without a motor mean nothing here
    assert (controller.joints, controller.action_scale) == (HIPS_FIRST, (0.125,) * 4 + (0.25,) * 4)
    assert [term.term for term in controller.observation] == ["lin_vel", "command", "joint_pos", "last_action", "scan"]
    assert controller.observation[0].at == (0.0, 0.0, 0.0)  # the trunk's centre of mass
    # 0.4 m by 0.2 m in steps of 0.2 m about a point 0.1 m ahead.
    assert (robot.scan_x, robot.scan_y) == ((-0.1, 0.1, 0.3), (-0.1, 0.1))
    scan = controller.observation[-1]
    assert (scan.order, scan.offset, scan.clip, controller.action_clip) == ("x fastest", 0.4, (-1.0, 1.0), 5.0)
    assert "a guess: breadth first" in robot.policy_file.read_text() and "DCMotor" in robot.settings_file.read_text()


def test_motors_and_delays_of_isaac_lab_are_kept_and_descriptors_say_the_order_of_joints(tmp_path, capsys):
    more = "saturation_effort: 25.0, min_delay: 1, max_delay: 6, armature: .01, friction: 1, damping: 0.5}\n      knees"
    run = isaac_lab(tmp_path / "run", "damping: 0.5}\n      knees", more)
    write(run / "exported/x_IO_descriptors.yaml", {"articulations": {"robot": {"joint_names": RIGHT_FIRST}}})
    robot, controller = imported(run, tmp_path)
    assert controller.joints == tuple(RIGHT_FIRST)
    # 1e6 N m at a speed limit of 1e6 rad/s are the knees' ideal drives.
    assert (robot.saturation_effort, robot.velocity_limit) == ((25.0, 1e6) * 4, (30.0, 1e6) * 4)
    assert robot.drive_delay_steps == 2  # (1 + 6 + 0 + 0) / 4 = 1.75
    lines = capsys.readouterr().out
    assert "a guess: the mean of the delays of hips (1 to 6)" in lines and "simulated as PD gains" not in lines
    assert "# armature = ...  # fill in: a value of each joint: FL_hip 0.01" in lines  # of the knees nobody says it
    assert "the friction of hips is left out" in lines


def test_a_run_of_isaac_lab_3_is_read(tmp_path):
    source = isaac_lab(tmp_path / "run", "effort_limit: 20.0", "actuator_effort_limit: 20.0")
    env, agent = source / "params" / "env.yaml", source / "params" / "agent.yaml"
    text = env.read_text().replace("effort_limit_sim: 30.0", "joint_effort_limit: 30.0")
    text = text.replace("sim: {", "sim: {physics: {class_type: 'isaaclab_newton.physics:NewtonManager'}, ")
    text = text.replace("clip: null}\n", "clip: {.*_hip: [0.1, 1.1]}}\n")
    text = text.replace("    height_scan:", "  scan:\n    height_scan:")
    env.write_text(text)
    agent.write_text("{clip_actions: 5.0, obs_groups: {actor: [scan, policy], critic: [policy]}}")
    robot, controller = imported(source, tmp_path)
    assert (robot.effort_limit, controller.joints) == ((20.0, 30.0) * 4, None)  # Newton keeps the order of the file
    assert [term.term for term in controller.observation] == ["scan", "lin_vel", "command", "joint_pos", "last_action"]
    # A hip's target is 0.6 + 0.125 action; a knee's has no range.
    assert controller.action_clip == ((pytest.approx(-4.0), pytest.approx(4.0)), (-5.0, 5.0)) * 4


def test_an_actuator_network_of_isaac_lab_stands_in_place_of_gains(tmp_path):
    old = ISAAC[ISAAC.index("      hips: ") : ISAAC.index("  height_scanner")]
    net = "network_file: 'https://host/nets/go1.pt', pos_scale: -1.0, input_order: pos_vel, input_idx: [0, 1, 2]"
    new = f"      legs: {{class_type: 'isaaclab:ActuatorNetMLP', joint_names_expr: [.*], effort_limit: 20.0, {net}}}\n"
    with pytest.raises(ValueError, match="no gains for FL_hip"):
        imported(isaac_lab(tmp_path / "run", old, new), tmp_path)
    lines = (tmp_path / "mine/dog/robot.toml").read_text()
    assert '{file = "go1.pt", pos_scale = -1.0, input_idx = [0, 1, 2]}, with https://host' in lines
    assert "# stiffness" not in lines and "effort_limit = 20.0" in lines


@pytest.mark.filterwarnings("ignore:policy.*more than actions")
def test_a_policy_of_leapp_is_read(tmp_path):
    robot, controller = imported(leapp(tmp_path), tmp_path)
    assert (robot.stiffness, robot.damping, robot.default_joint_pos) == ((20.5,) * 8, (20.0,) * 8, IN_FILE)
    assert (robot.physics_dt, robot.decimation, controller.joints) == (0.01, 4, tuple(RIGHT_FIRST))
    quat, joint_pos = controller.observation
    assert (quat.term, quat.order, joint_pos.joints, joint_pos.offset) == ("quat", "x y z w", tuple(RIGHT_FIRST), 0.0)


def test_what_nobody_says_is_left_to_be_filled_in_and_other_weights_are_never_taken(tmp_path, capsys):
    state = {"actor.0.weight": torch.zeros(8, 36), "actor.0.bias": torch.zeros(8)}
    torch.save({"model_state_dict": state}, tmp_path / "model_9.pt")
    (tmp_path / "agent.yaml").write_text("policy: {activation: tanh}")
    folder = tmp_path / "mine" / "dog"
    with pytest.raises(ValueError, match="no gains for FL_hip"):
        imported(tmp_path / "model_9.pt", tmp_path)
    assert "Fill in default_joint_pos, stiffness, damping, action_scale, observation" in capsys.readouterr().out
    text = (folder / "controller.toml").read_text()
    assert 'activation = "tanh"' in text and "its 36 columns" in text
    for file in folder.glob("*.toml"):
        file.unlink()
    (folder / "model_9.pt").write_bytes(b"older")
    with pytest.raises(ValueError, match=r"dog/model_9\.pt must be a copy"):
        imported(tmp_path / "model_9.pt", tmp_path)


@pytest.mark.parametrize(
    ("write_source", "change", "named"),
    [
        (rl_sar, {"gait": 3}, "gait"),
        (rl_sar, {"wheel_indices": [3]}, "wheel_indices"),
        (rl_sar, {"observations": ["ang_vel", "ang_vel_world"]}, "ang_vel_world"),
        (rl_sar, {"observations_history": [0, 2]}, "observations_history"),
        (rl_sar, {"observations_history_priority": "step"}, "observations_history_priority must be time or term"),
        (rl_sar, {"model_name": "other.pt"}, "other.pt"),
        (rl_sar, {"rl_kp": [1.0]}, "rl_kp"),
        (rl_sar, {"joint_mapping": [9] * 8}, "must be a controller of rl_sar"),
        (deployment, {"num_obs": 40}, "num_obs"),
        (deployment, {"num_actions": 7}, "num_actions"),
        (deployment, {"action_scale": datetime.date(2020, 1, 1)}, "action_scale"),
        (deployment, {"kds": functools.reduce(lambda values, _: [values] * 9, range(9), [0.0])}, "at most 1,000,000"),
        (deployment, {"kps": "x"}, "stiffness must be numbers, got x"),
        (legged_gym, {"control_type": "T"}, "control_type"),
        (legged_gym, {"hip_scale_reduction": 0.5}, "hip_scale_reduction"),
        (legged_gym, {"stiffness": {"hip": 20.0}}, "none of FL_knee"),
        (legged_gym, {"use_actuator_network": True, "actuator_net_file": "{ROOT}/nets/net.pt"}, "net.pt is not there"),
        (mjlab, {"joint_damping": "much"}, "run.onnx must be a controller of mjlab"),
        (deployment, {"leg_joint2motor_idx": []}, "leg_joint2motor_idx"),
        (mjlab, {"observation_names": "base_lin_vel,camera"}, "camera"),
        (booster, {"num_observations": 36}, "num_observations must be 35"),
        (isaac_lab, {"old": "joint_pos_rel", "new": "joint_pos"}, "joint_pos,"),
        (isaac_lab, {"old": "JointPositionAction", "new": "JointVelocityAction"}, "JointVelocityAction"),
        (isaac_lab, {"old": "{.*_hip: 0.6, F._knee: -1.2, H._knee: -1.1}", "new": "{.*_toe: 1}"}, ".*_toe matches"),
        (isaac_lab, {"old": "decimation: 4", "new": ""}, "it has no 'decimation'"),
        (isaac_lab, {"old": "clip: null}", "new": "clip: {.*_toe: [-1, 1]}}"}, "clip"),
        (isaac_lab, {"old": "init_state:", "new": "joint_ordering: robot_schema\n    init_state:"}, "joint_ordering"),
        (isaac_lab, {"old": "ray_alignment: yaw", "new": "ray_alignment: world"}, "yaw"),
        (lambda folder: deploy(folder, ("gait_phase", "height_scan")), {}, "height_scan"),
        (lambda folder: deploy(folder, (", 7, 5]", ", 7]")), {}, "joint_ids_map"),
        (lambda folder: deploy(folder, (", 7, 5]", ", 7, 7]")), {}, "joint_ids_map"),
        (lambda folder: deploy(folder, ("step_dt:", "gear: 1\nstep_dt:")), {}, "gear"),
        (holosoma, {"experiment_config": None}, "the locomotion of G1 or T1, got 74 columns"),
        (leapp, {"parameters": {"model_path": "policy.onnx", "sha256sum": "0"}}, "policy.onnx must have sha256sum 0"),
        (leapp, {"kp": "joint_pos"}, "kp must be constant"),
        (
            leapp,
            {"inputs": [{"name": name, "kind": "rays"} for name in ("quat_w", "joint_pos", "past")]},
            "quat_w, a rays",
        ),
        (lambda folder: folder, {}, "a run of Isaac Lab (a folder with params/env.yaml), or a deployment of"),
    ],
)
def test_what_is_not_understood_is_refused_by_its_name(tmp_path, write_source, change, named):
    (tmp_path / "source").mkdir()
    source = write_source(tmp_path / "source", **change)
    with pytest.raises(ValueError, match=re.escape(named)):
        imported(source, tmp_path)
    assert not (tmp_path / "mine").exists()
