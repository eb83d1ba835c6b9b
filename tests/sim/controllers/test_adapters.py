"""Controllers of one's own: code in a file, adapters for another observation, and what their names mean."""

import hashlib

import numpy as np
import pytest
import torch

from sim.controllers.adapters import read_row
from sim.controllers.formats.onnx import export_onnx
from sim.controllers.formats.rsl_rl import MlpPolicy
from sim.controllers.loaders import load_policy
from sim.controllers.spec import ControllerSpec, controller_hash, describe_controllers, label_suffix, parse_controllers
from tests.builders import OBSERVATIONS, rsl_rl_actor, save_checkpoint

JOINTS = 12
ADAPTER = "def adapt(actor, robot): "


@pytest.fixture
def write(tmp_path):
    return lambda text, name="mine.py": (tmp_path / name).write_text(text) and tmp_path / name


def test_a_row_is_read_in_physical_units(anymal):
    """What it has beside the terms of a description, whose numbers are tested there."""
    sensed = read_row(torch.arange(OBSERVATIONS, dtype=torch.float32)[None], anymal)
    np.testing.assert_allclose(sensed.joint_pos[0], np.arange(12, 24) + np.array(anymal.default_joint_pos), rtol=1e-6)
    np.testing.assert_array_equal(sensed.last_action[0], np.arange(36, 48))
    # Of 17 x 11 points that 0.8 m ahead and 0.3 m to the left is [16, 8]: height = column / 5 + 0.5.
    assert float(sensed.scan[0, 16, 8]) == pytest.approx((48 + 16 * 11 + 8) / 5 + 0.5)
    with pytest.raises(ValueError, match="row"):
        read_row(torch.zeros(2, 48), anymal)


@pytest.mark.parametrize("kind", ["pt", "onnx"])
def test_an_adapter_is_given_a_file_of_any_sizes_and_the_robot(tmp_path, write, anymal, kind):
    state, path = rsl_rl_actor(9, 6).state_dict(), tmp_path / f"theirs.{kind}"
    save_checkpoint(path, state) if kind == "pt" else export_onnx(MlpPolicy(state), path)
    code = write(ADAPTER + "return lambda row: robot.action_scale * actor(row[:, 3:12]).repeat(1, 2)")
    rows = torch.randn(5, OBSERVATIONS, generator=torch.Generator().manual_seed(3))
    with torch.inference_mode():
        actions = load_policy(f"{code}:adapt@{path}", anymal, "cpu")(rows)
        expected = anymal.action_scale * MlpPolicy(state)(rows[:, 3:12]).repeat(1, 2)
    torch.testing.assert_close(actions, expected, rtol=1e-5, atol=1e-6)


def test_code_in_a_file_is_a_controller(write, anymal):
    write("import torch\nSHARE = 0.125\n", "neighbour_of_mine.py")
    path = write(
        "import torch, neighbour_of_mine\n"
        "def act(row):\n    return torch.full((len(row), 12), neighbour_of_mine.SHARE, device=row.device)\n"
        "class Legs:\n    faultline_factory = True\n"
        "    def __init__(self, robot, device):\n        self.joints, self.device = robot.num_joints, device\n"
        "    def __call__(self, row):\n        return torch.zeros(len(row), self.joints, device=self.device)\n"
    )
    assert (load_policy(f"{path}:act", anymal, "cpu")(torch.zeros(2, OBSERVATIONS)) == 0.125).all()
    assert load_policy(f"{path}:Legs", anymal, "cpu").joints == JOINTS
    path.write_text(path.read_text().replace("neighbour_of_mine.SHARE", "0.5"))
    assert (load_policy(f"{path}:act", anymal, "cpu")(torch.zeros(2, OBSERVATIONS)) == 0.5).all()  # as it is now


@pytest.mark.parametrize(
    ("source", "call", "words"),
    [
        ("def act(:", "act", "cannot be imported"),
        ("act = 3", "act", "int"),
        ("class act: pass", "act", "faultline_factory"),
        ("def act(robot, device): pass", "act", "'device'"),
        ("def act(o): raise SystemExit", "act", r"mine\.py, line 1\)"),
        ("def act(o): return o[:, :12] * float('nan')", "act", "not finite"),
        (ADAPTER + "raise KeyError('gone')", "adapt@{}", r"gone.*mine\.py, line 1\)"),
        (ADAPTER + "return 3", "adapt@{}", "int"),
        (ADAPTER + "return actor", "adapt@{}", "48 columns, robot 'anymal' gives 235"),
    ],
)
def test_code_that_fails_is_named(tmp_path, write, anymal, source, call, words):
    actor = save_checkpoint(tmp_path / "small.pt", rsl_rl_actor(48).state_dict())
    with pytest.raises(ValueError, match=rf"policy '.*{words}"):
        load_policy(f"{write(source)}:{call.format(actor)}", anymal, "cpu")


@pytest.mark.parametrize(
    ("text", "module", "name", "file", "label"),
    [
        ("a/C-G@7.pt", None, None, "a/C-G@7.pt", "C-G@7.pt"),
        ("/a b/mine.py:Class.act", "/a b/mine.py", "Class.act", None, "mine.py:Class.act"),
        ("c/mine.py:adapt@d/model:7.pt", "c/mine.py", "adapt", "d/model:7.pt", "mine.py:adapt@model:7.pt"),
    ],
)
def test_names_are_taken_apart(tmp_path, text, module, name, file, label):
    spec = ControllerSpec.parse(text)
    assert (spec.module, spec.name, spec.file, spec.label) == (module, name, file, label)
    assert str(spec) == text
    assert spec.runs_code == (module is not None)
    (tmp_path / "mine.py:act").write_bytes(b"x")  # a file of that name is a file
    assert ControllerSpec.parse(tmp_path / "mine.py:act").module is None


def test_the_hash_is_of_all_that_is_in_files(tmp_path, write):
    file, code = tmp_path / "m.pt", write("x = 1")
    file.write_bytes(b"weights")
    plain = controller_hash(file)
    assert plain == hashlib.sha256(b"weights").hexdigest()
    digests = [controller_hash(text) for text in (f"{code}:a", f"{code}:b", f"{code}:a@{file}")]
    assert len({plain, *digests}) == 4 and None not in digests
    code.write_text("x = 2")
    assert controller_hash(f"{code}:a") != digests[0]
    assert controller_hash("builtins:abs") is None  # no file
    assert controller_hash(f"{code}:a@{tmp_path / 'gone.pt'}") is None


def test_controllers_have_names(anymal, tmp_path):
    shipped = str(anymal.policy_file)
    assert parse_controllers([], anymal) == {"base": shipped}
    given = ["C-G@1=a b/c.pt base=shipped", "mine=m.py:act"]
    assert parse_controllers(given, anymal) == {"C-G@1": "a b/c.pt", "base": shipped, "mine": "m.py:act"}
    for wrong in ("a.pt", "a=", "a=x a=y", "a/b=x"):
        with pytest.raises(ValueError, match="policies"):
            parse_controllers([wrong], anymal)
    copy = tmp_path / "C-G 1.pt"
    copy.write_bytes(anymal.policy_file.read_bytes())
    about = describe_controllers({"mine": str(copy), "other": "a.pt"}, anymal)
    assert [about[name]["policy"] for name in about] == ["shipped", "a.pt"]
    assert label_suffix(str(copy)) == "-C-G-1"
    assert label_suffix(str(tmp_path / "go2" / "controller.toml")) == "-go2"
