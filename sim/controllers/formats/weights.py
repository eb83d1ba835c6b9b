"""Weights alone, of any format."""

from pathlib import Path
from typing import Any

from sim.controllers.formats.network import find_widths, load_network
from sim.controllers.formats.source import BLIND_TERMS, Source, make_term, make_terms
from sim.files.settings import to_toml


def read_weights_alone(path: Path, source: Source) -> Path:
    """Leaves nearly all settings for the user to fill in, and says what belongs there."""
    network: Any = load_network(path, "cpu", None, label="it")
    width, count = find_widths(network)
    if activation := getattr(getattr(network, "head", network), "activation", None):
        source.set(activation=activation)
    pose = f"an angle of each joint [rad], its pose at action 0: {', '.join(source.joints)}"
    home = source.robot_file.home
    source.set(default_joint_pos=home, reason="" if home else pose)
    if not source.model.nu or not source.model.actuator_biasprm[:, 1].any():
        for name, unit in (("stiffness", "N m/rad"), ("damping", "N m s/rad")):
            source.set(**{name: None}, reason=f"a gain of each joint, or one number [{unit}]")
    source.set(physics_dt=0.005, decimation=4, reason="50 control steps a second, as most controllers have")
    source.set(action_scale=None, reason="radians per unit of action, one or one a joint")
    if count not in (None, len(source.joints)):
        source.set(joints=None, reason=f"the {count} joints that it moves, in its order")
    example = to_toml([make_term("lin_vel", at=source.find_imu()), *make_terms(BLIND_TERMS, {})])
    source.set(observation=None, reason=f"its {width or 'all'} columns in its order, with scale; of {example}")
    return path
