"""What README shows of code of one's own works as it stands there."""

import re

import pytest
import torch

from sim.policy.loaders import load_policy
from sim.robots.robot import get_robot
from tests.dry_run import ROOT, run_by
from tests.sim.dogs import mjcf
from tests.sim.policy.test_loaders import rsl_rl_actor, save_checkpoint

README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks_of(title: str, kind: str) -> list[str]:
    """Code blocks of a section, python or none."""
    section = re.split(r"^## ", README.split(f"\n## {title}\n")[1], flags=re.MULTILINE)[0]
    blocks = re.findall(r"^```(\w*)\n(.*?)^```$", section, re.MULTILINE | re.DOTALL)
    return [text for name, text in blocks if name == kind]


def test_the_robot_of_readme_is_read(tmp_path):
    (text,) = blocks_of("Bring your own robot", "python")
    (tmp_path / "dog.py").write_text(text)
    (tmp_path / "dog.xml").write_text(mjcf())
    dog = get_robot(str(tmp_path / "dog.py"))
    assert (dog.name, dog.num_joints, dog.observation_size) == ("dog", 8, 51)


def test_the_adapter_of_readme_adapts(tmp_path, anymal):
    (text,) = blocks_of("Bring your own controller", "python")
    (tmp_path / "row.py").write_text(text)
    actor = rsl_rl_actor(3 * 3 + 3 * 12)
    policy = load_policy(
        f"{tmp_path}/row.py:adapt@{save_checkpoint(tmp_path / 'm.pt', actor.state_dict())}", anymal, "cpu"
    )
    row = torch.randn(5, 235, generator=torch.Generator().manual_seed(0))
    hind_first = [6, 7, 8, 9, 10, 11, 0, 1, 2, 3, 4, 5]
    default = torch.tensor(anymal.default_joint_pos)
    parts = [4 * row[:, 3:6], row[:, 6:9], row[:, 9:12] / torch.tensor([2.0, 2.0, 0.25])]
    parts += [(row[:, 12:24] + default)[:, hind_first], 20 * row[:, 24:36][:, hind_first], row[:, 36:48][:, hind_first]]
    with torch.inference_mode():
        theirs = actor.mlp(torch.cat(parts, dim=1))
        expected = torch.empty(5, 12)
        expected[:, hind_first] = theirs
        torch.testing.assert_close(policy(row), expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("line", [
    line.partition("#")[0].strip()
    for block in blocks_of("Bring your own robot", "")
    for line in block.splitlines()
    if line.startswith("make ")
])  # fmt: skip
def test_commands_of_readme_are_taken(line):
    command = run_by(line)
    assert command[1] == "-m" and "mine/dog.py" in command
    for given in line.split()[3:]:
        name, value = given.split("=")
        assert f"--{name.lower()}={value}" in command
