"""A robot that the project does not ship: a dog of 13 kg with two joints a leg, as a user would bring it.

:func:`write_dog` writes what docs/robots.md asks of a user: model, settings, and a scripted controller.
"""

from pathlib import Path

import numpy as np
import trimesh

from tests.docs import code_of

LEGS = {"FL": (0.2, 0.12), "FR": (0.2, -0.12), "HL": (-0.2, 0.12), "HR": (-0.2, -0.12)}
JOINTS = tuple(f"{leg}_{joint}" for leg in LEGS for joint in ("hip", "knee"))
TRUNK, THIGH, SHANK, FOOT = (0.25, 0.08, 0.05), (0.03, 0.15), (0.015, 0.13), 0.025
"""Half sizes of the trunk's box; radius and length of thigh and shank; radius of a foot [m]."""
STAND = 0.295
"""Height of the trunk over its feet's soles in the default pose [m]."""
MASS = 8.0 + 4 * (0.8 + 0.3 + 0.1)
DRIVE = '<position name="{0}" joint="{0}" kp="60" kv="2" forcerange="-30 30"/>'


def mjcf(*, drive: str = DRIVE, trunk: str | None = None, asset: str = "") -> str:
    """The dog's MJCF; hips turn forward, knees backward, about the axis to the left."""
    trunk = trunk or f'type="box" size="{" ".join(map(str, TRUNK))}"'
    legs = "".join(
        f"""
      <body name="{leg}_thigh" pos="{x} {y} 0">
        <inertial mass="0.8" pos="0 0 -0.07" diaginertia="0.002 0.002 0.0005"/>
        <joint name="{leg}_hip" axis="0 1 0" range="-1.5 2.5"/>
        <geom name="{leg}_thigh" type="capsule" size="{THIGH[0]}" fromto="0 0 0 0 0 -{THIGH[1]}"/>
        <body name="{leg}_shank" pos="0 0 -0.15">
          <inertial mass="0.3" pos="0 0 -0.07" diaginertia="0.0006 0.0006 0.0001"/>
          <joint name="{leg}_knee" axis="0 1 0" range="-2.6 -0.1"/>
          <geom name="{leg}_shank" type="capsule" size="{SHANK[0]}" fromto="0 0 0 0 0 -{SHANK[1]}"/>
          <body name="{leg}_toe" pos="0 0 -0.15">
            <inertial mass="0.1" pos="0 0 0" diaginertia="0.00005 0.00005 0.00005"/>
            <geom name="{leg}_foot" type="sphere" size="{FOOT}"/>
          </body>
        </body>
      </body>"""
        for leg, (x, y) in LEGS.items()
    )
    return f"""<mujoco model="dog">
  <compiler angle="radian" autolimits="true"/>
  <default>
    <joint type="hinge" armature="0.01"/>
    <geom friction="0.8" solref="0.01 1" contype="1" conaffinity="0"/>
  </default>
  <asset>{asset}</asset>
  <worldbody>
    <body name="trunk" pos="0 0 {STAND}">
      <freejoint name="root"/>
      <inertial mass="8" pos="0 0 0" diaginertia="0.03 0.2 0.2"/>
      <geom name="trunk" {trunk}/>{legs}
    </body>
  </worldbody>
  <actuator>{"".join(drive.format(joint) for joint in JOINTS)}</actuator>
</mujoco>
"""


def urdf(*, trunk: str = '<box size="0.5 0.16 0.1"/>') -> str:
    """The same dog as a URDF without drives, with thighs of MuJoCo's capsules and a visual that is nowhere."""

    def link(name: str, mass: float, inertia: tuple[float, float, float], z: float, shape: str, shape_z: float) -> str:
        ixx, iyy, izz = inertia
        return f"""
  <link name="{name}">
    <inertial>
      <origin xyz="0 0 {z}"/><mass value="{mass}"/>
      <inertia ixx="{ixx}" iyy="{iyy}" izz="{izz}" ixy="0" ixz="0" iyz="0"/>
    </inertial>
    <visual><geometry><mesh filename="package://nowhere/{name}.dae"/></geometry></visual>
    <collision><origin xyz="0 0 {shape_z}"/><geometry>{shape}</geometry></collision>
  </link>"""

    def joint(name: str, parent: str, child: str, at: str, limits: str = "") -> str:
        turns = f'<axis xyz="0 1 0"/><limit {limits} effort="30" velocity="30"/>' if limits else ""
        return f"""
  <joint name="{name}" type="{"revolute" if limits else "fixed"}">
    <parent link="{parent}"/><child link="{child}"/><origin xyz="{at}"/>{turns}
  </joint>"""

    def tube(kind: str, size: tuple[float, float]) -> str:
        return f'<{kind} radius="{size[0]}" length="{size[1]}"/>'

    parts = [link("trunk", 8.0, (0.03, 0.2, 0.2), 0, trunk, 0)]
    for leg, (x, y) in LEGS.items():
        thigh, shank, foot = (f"{leg}_{part}" for part in ("thigh", "shank", "foot"))
        parts += [
            link(thigh, 0.8, (0.002, 0.002, 0.0005), -0.07, tube("capsule", THIGH), -THIGH[1] / 2),
            joint(f"{leg}_hip", "trunk", thigh, f"{x} {y} 0", 'lower="-1.5" upper="2.5"'),
            link(shank, 0.3, (0.0006, 0.0006, 0.0001), -0.07, tube("cylinder", SHANK), -SHANK[1] / 2),
            joint(f"{leg}_knee", thigh, shank, "0 0 -0.15", 'lower="-2.6" upper="-0.1"'),
            link(foot, 0.1, (0.00005,) * 3, 0, f'<sphere radius="{FOOT}"/>', 0),
            joint(f"{leg}_ankle", shank, foot, "0 0 -0.15"),
        ]
    return f'<robot name="dog">{"".join(parts)}\n</robot>\n'


GAINS = """
    stiffness=(60.0,) * 8,
    damping=(2.0,) * 8,
    effort_limit=(30.0,) * 8,
    armature=(0.01,) * 8,"""
CONTROLLER = '''"""A trot by the clock: hips swing, and a leg that swings forward bends its knee."""

import torch


class Trot:
    """Diagonal legs in turn, three times a second."""

    faultline_factory = True

    def __init__(self, robot, device):
        self.robot, self.step = robot, 0
        self.phase = torch.tensor([0.0, 0.5, 0.5, 0.0], device=device)

    def reset(self):
        self.step = 0

    def __call__(self, row):
        turn = 2.0 * torch.pi * (3.0 * self.step * self.robot.control_dt + self.phase)
        self.step += 1
        knee = -0.5 * torch.sin(turn).clamp(min=0.0)
        legs = torch.stack([0.35 * torch.cos(turn) - 0.5 * knee, knee], dim=1)
        return legs.flatten().expand(len(row), -1) / self.robot.action_scale
'''


def write_dog(folder: Path, *, model: str | None = None, suffix: str = "xml", more: str = "") -> Path:
    """Writes dog.xml or dog.urdf, dog.py with ``more`` lines, and dog_trot.py; returns the settings file."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"dog.{suffix}").write_text(mjcf() if model is None else model)
    (folder / "dog_trot.py").write_text(CONTROLLER)
    file = folder / "dog.py"
    (text,) = (code for code in code_of("docs/robots.md", "python") if code.startswith("# mine/dog.py"))
    text = text.replace("dog.xml", f"dog.{suffix}").removesuffix(")\n")
    file.write_text(f"from sim.robots.training import TrainingCfg\n{text}{more}\n)\n")
    return file


def write_toml(folder: Path, text: str = "", model: str | None = None) -> Path:
    """Writes dog.xml and a robot.toml that names it; returns the latter."""
    folder.mkdir()
    (folder / "dog.xml").write_text(model or mjcf())
    file = folder / "robot.toml"
    file.write_text(f'model_file = "dog.xml"\n{text}')
    return file


KINDS = {"mjcf": {}, "urdf": {"model": urdf(), "suffix": "urdf", "more": GAINS}}
"""What :func:`write_dog` takes for each kind of model file."""


def stl(half):
    """A box as a binary STL file."""
    return trimesh.creation.box(2 * np.array(half)).export(file_type="stl")


def with_mesh(folder, kind):
    """The dog with a trunk from an STL file, as a package: dog/meshes, dog/model."""
    package = folder / "dog"
    (package / "meshes").mkdir(parents=True)
    (package / "meshes" / "trunk.stl").write_bytes(stl(TRUNK))
    (package / "model").mkdir()
    if kind == "mjcf":
        text = mjcf(trunk='type="mesh" mesh="trunk"', asset='<mesh name="trunk" file="trunk.stl"/>')
        text = text.replace("<compiler ", '<compiler meshdir="../meshes" ')
        return write_dog(package / "model", model=text)
    text = urdf(trunk='<mesh filename="package://dog/meshes/trunk.stl"/>')
    return write_dog(package / "model", model=text, suffix="urdf", more=GAINS)
