"""Controllers as data: what the network of a description sees, what its actions mean, and what is refused."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from sim.controllers.described import Described, read_controller, read_speed_limits
from sim.controllers.loaders import load_policy, prepare_torch
from sim.controllers.spec import ControllerSpec, controller_hash
from tests.builders import ACTIONS, OBSERVATIONS, rows_of, rsl_rl_actor, save_checkpoint
from tests.sim.controllers.test_loaders import recurrent_actor, runner_on

OURS = """{term = "lin_vel", scale = 2.0}, {term = "ang_vel", scale = 0.25}, {term = "gravity"},
  {term = "command", scale = [2, 2, 0.25]}, {term = "joint_pos"}, {term = "joint_vel", scale = 0.05},
  {term = "last_action"}, {term = "scan", order = "y fastest", offset = 0.5, scale = 5}"""


@pytest.fixture
def describe(tmp_path):
    """Writes a description of these terms and further lines."""

    def write(terms, *lines, policy="weights.pt"):
        scale = [] if any(line.startswith("action_scale") for line in lines) else ["action_scale = 0.5"]
        text = "\n".join([f'policy = "{policy}"', *scale, *lines, f"observation = [{terms}]"])
        return (tmp_path / "controller.toml").write_text(text) and tmp_path / "controller.toml"

    return write


@pytest.fixture
def seen_by(describe, anymal):
    """What a network sees of rows, step after step, that answers with ``output`` of each; robots begin at the first."""

    def run(steps, terms, *lines, output=lambda seen, n: torch.zeros(len(seen), n), robot=anymal):
        policy, seen = Described(read_controller(describe(terms, *lines)), robot, "it"), []
        policy.use(lambda rows: seen.append(rows) or output(rows, policy.num_actions), torch.device("cpu"))
        policy.reset(torch.ones(len(steps[0]), dtype=torch.bool))
        actions = [policy(step) for step in steps]
        return torch.stack(seen), torch.stack(actions)

    return run


def test_the_shipped_controller_is_the_same_described(anymal, describe):
    policy = load_policy(describe(OURS, policy=anymal.policy_file), anymal, "cpu")
    shipped, rows = load_policy(anymal.policy_file, anymal, "cpu"), rows_of(9)
    rows[:, 36:48] = 0.0  # it has its own last action, which begins with 0
    with torch.inference_mode():
        for _ in range(3):
            # Columns are divided by their scale and multiplied again: some ulps, through four layers.
            torch.testing.assert_close(policy(rows), shipped(rows), rtol=1e-4, atol=1e-4)
            rows[:, 36:48] = shipped(rows)


def test_terms_in_numbers(anymal, seen_by):
    row = torch.zeros(1, OBSERVATIONS)
    row[0, :12] = torch.tensor([2.0, 0, 0, 0, 0, 0.25, 0, 0, -1, 2.0, -4.0, 0.5])  # 1 m/s ahead, turning 1 rad/s
    row[0, 12:24], row[0, 24:36] = torch.arange(12) / 10, 0.05 * torch.arange(12)
    row[0, 48:] = 5 * torch.linspace(-0.5, 0.5, 187)
    joints = 'joints = ["RF_HAA", "LF_KFE"]'
    seen, _ = seen_by(
        [row, row],
        '{term = "lin_vel", at = [0.5, 0.2, 0.0]}, {term = "command", limit = [0.75, 1.5, 1.0], scale = [1, 2, 3]},'
        '{term = "joint_pos", scale = 10.0, clip = [-1.0, 0.4]}, {term = "joint_vel", joints = ["RH_KFE"]},'
        '{term = "clock", period_s = 0.08},'
        '{term = "scan", order = "x fastest", x = [0.8, -0.8], y = [0.5], offset = 0.25, clip = 0.5, scale = 0.1}',
        joints, "default = [0.1, -0.5]",
    )  # fmt: skip
    pose = anymal.default_joint_pos
    expected = [
        1.0 - 0.2, 0.5, 0.0,  # at (.5, .2) a turn of 1 rad/s adds (-.2, .5)
        0.75, 2 * -1.5, 3 * 1.0,
        10 * min(pose[3] + 0.3 - 0.1, 0.4), 10 * max(min(pose[2] + 0.2 + 0.5, 0.4), -1.0),
        11.0,
        0.0, 1.0,
        # Height is column / 5 + 0.5: 1.0 at the last point (.8, .5), and (0, 10) is the eleventh of 187.
        0.1 * 0.5, 0.1 * (-0.5 + 10 / 186 + 0.5 - 0.25),
    ]  # fmt: skip
    np.testing.assert_allclose(seen[0, 0], expected, atol=1e-6)
    np.testing.assert_allclose(seen[1, 0, 9:11], [math.sin(math.pi / 2), math.cos(math.pi / 2)], atol=1e-6)  # 20 ms on


@pytest.mark.parametrize(
    ("terms", "limits"),
    [
        ('{term = "command", limit = [0.4, 9, 9], clip = [0.2, 0.8]}, {term = "gravity", clip = 0.1}', (0.2, 0.4)),
        ('{term = "command", clip = [-0.5, 0.6]}, {term = "command", limit = 0.7, order = "v_x"}', (-0.5, 0.6)),
        ('{term = "command", limit = 0.7, order = "yaw_rate"}', (-math.inf, math.inf)),
    ],
)
def test_speeds_that_a_controller_is_told(tmp_path, terms, limits):
    file = tmp_path / "controller.toml"
    file.write_text(f'policy = "policy.pt"\naction_scale = 0.5\nobservation = [{terms}]\n')
    assert read_speed_limits(str(file)) == limits
    assert read_speed_limits("walk.py:act") == read_speed_limits("policy.pt") == (-math.inf, math.inf)


@pytest.fixture
def sensing(anymal):
    """ANYmal with all senses, and its row: pitched by asin(.6), a quaternion of yaw 90 degrees, 100, 4, 6 and 0 N."""
    pose, contacts = [2.0, 4.0, 0.6, 0.5**0.5, 0.0, 0.0, 0.5**0.5], [1.0, 0.04, 0.06, 0.0]
    senses = [*pose, *contacts, *(0.01 * np.arange(12))]
    row = torch.tensor([[*[0.0] * 6, 0.6, 0.0, -0.8, *[0.0] * (OBSERVATIONS - 9), *senses]])
    return replace(anymal, senses=("pose", "contacts", "torques")), row


@pytest.mark.parametrize(
    ("term", "expected"),
    [
        ('"constant", value = [0.3, 2], scale = 2.0', [0.6, 4.0]),
        ('"heading"', [math.pi / 2]),
        ('"rpy", axes = "yaw pitch roll"', [math.pi / 2, math.asin(0.6), 0.0]),
        ('"quat", order = "w x y z"', [0.5**0.5, 0, 0, 0.5**0.5]),
        ('"quat", order = "x y z w"', [0, 0, 0.5**0.5, 0.5**0.5]),
        ('"base_pos"', [2.0, 4.0, 0.6]),
        ('"contacts"', [100.0, 4.0, 6.0, 0.0]),
        ('"contacts", threshold = 5', [1, 0, 1, 0]),
        ('"torques", joints = ["LF_KFE"]', [2.0]),
        ('"clock", period_s = 0.08, offset = [0, 0.25]', [0, 1, 1, 0]),
        ('"clock", period_s = 0.08, offset = [0, 0.25], order = "cos sin"', [1, 0, 0, 1]),
        ('"clock", period_s = 0.08, offset = [0.5, 0.25, 0], order = "sin"', [0, 1, 0]),
    ],
)
def test_what_a_robot_senses_in_numbers(sensing, seen_by, term, expected):
    seen, _ = seen_by([sensing[1]], f"{{term = {term}}}", robot=sensing[0])
    np.testing.assert_allclose(seen[0, 0], expected, atol=1e-5)


def test_joints_beside_those_that_move_hold_or_wander(anymal, seen_by):
    rows = [torch.zeros(2, OBSERVATIONS) for _ in range(41)]
    rows[0][1, 12] = 0.0025  # 100 x .0025 periods later
    lines = ('joints = ["RF_HAA"]', "hold = {LF_KFE = -1.0, RH_KFE = 1.5}",
             'wander = {joints = ["RH_KFE", "LH_HAA"], amplitude = 0.1, period_s = 0.8}')  # fmt: skip
    _, actions = seen_by(rows, '{term = "gravity"}', *lines)
    targets = (actions * anymal.action_scale).numpy() + anymal.default_joint_pos
    expected = np.tile(anymal.default_joint_pos, (41, 1))
    expected[:, [2, 11]] = -1.0, 1.5
    periods = 100.0 * np.arange(1, 13) @ anymal.default_joint_pos + np.arange(41) / 40
    expected[:, [11, 6]] += 0.1 * np.sin(2 * math.pi * (periods[:, None] + [0.0, 0.618]))
    np.testing.assert_allclose(targets[:, 0], expected, atol=1e-3)
    np.testing.assert_allclose(targets[:31, 1], targets[10:, 0], atol=1e-3)


def test_actions_in_numbers(anymal, seen_by):
    outputs = iter(torch.tensor([[1.0, 9.0], [2.0, -9.0], [3.0, 1.0]]))
    seen, actions = seen_by(
        [torch.zeros(1, OBSERVATIONS)] * 3, '{term = "last_action"}',
        'joints = ["RF_HAA", "LF_KFE"]', "default = [0.1, -0.5]", "action_scale = [0.25, 2.0]",
        "action_clip = [[-100, 100], [-4, 4]]", "action_delay_steps = 1",
        output=lambda rows, n: next(outputs).expand(len(rows), n),
    )  # fmt: skip
    np.testing.assert_array_equal(seen[:, 0], [[0, 0], [1, 4], [2, -4]])  # within its limits, not delayed
    targets = actions[:, 0] * anymal.action_scale + torch.tensor(anymal.default_joint_pos)
    expected = np.tile(anymal.default_joint_pos, (3, 1))
    expected[:, 3], expected[:, 2] = [0.1, 0.1 + 0.25, 0.1 + 0.5], [-0.5, -0.5 + 8.0, -0.5 - 8.0]  # of a step before
    np.testing.assert_allclose(targets, expected, atol=1e-5)


@pytest.mark.parametrize(
    ("layout", "expected"),
    [  # gravity and angular velocity of steps 1 and 2: 1 2 and 10 20, each in three columns
        ('length = 3, newest = "first", by = "row", fill = "zeros"', [2, 20, 1, 10, 0, 0]),
        ('length = 3, newest = "last", by = "row", fill = "zeros"', [0, 0, 1, 10, 2, 20]),
        ('length = 3, newest = "first", by = "term", fill = "first"', [2, 1, 1, 20, 10, 10]),
        ('length = 3, newest = "last", by = "term", fill = "first"', [1, 1, 2, 10, 10, 20]),
        ('length = 1, newest = "last", by = "term", fill = "zeros"', [1, 2, 20]),  # gravity has a past of its own
    ],
)
def test_the_past_is_laid_out_as_described(seen_by, layout, expected):
    steps = [torch.zeros(1, OBSERVATIONS) for _ in range(2)]
    for k, row in enumerate(steps):
        row[0, 6:9], row[0, 3:6] = k + 1.0, 0.25 * 10 * (k + 1.0)
    longer = ", history = 2" if "length = 1" in layout else ""
    terms = f'{{term = "gravity"{longer}}}, {{term = "ang_vel"}}'
    seen, _ = seen_by(steps, terms, f"history = {{{layout}}}")
    np.testing.assert_array_equal(seen[1, 0], np.repeat(expected, 3))


@pytest.mark.filterwarnings("ignore:.torch.jit")
@pytest.mark.parametrize(
    ("layout", "line", "seen"),  # of 12 columns
    [('"last", by = "row"', "", 12), ('"first", by = "term"', "", 12), ('"last", by = "row"', "", 6),
     ('"first", by = "row"', "encoder_first = true", 6)],
)  # fmt: skip
def test_an_encoder_sees_the_observation_and_the_policy_that_or_the_present(
    tmp_path, anymal, describe, layout, line, seen
):
    policy, encoder = torch.nn.Linear(seen + 2, ACTIONS), torch.nn.Linear(12, 2)
    for name, network in (("weights.pt", policy), ("encoder.pt", encoder)):
        torch.jit.script(network).save(str(tmp_path / name))
    lines = (f'history = {{length = 2, fill = "zeros", newest = {layout}}}', 'encoder = "encoder.pt"', line)
    path = describe('{term = "gravity"}, {term = "command", scale = [2, 2, 0.25]}', *lines)
    assert ControllerSpec.parse(path).files == (path, tmp_path / "weights.pt", tmp_path / "encoder.pt")
    rows = rows_of(5)
    now, zeros = rows[:, 6:12], torch.zeros(5, 6)  # the step before the episode
    parts = {"last": [zeros, now], "first": [now, zeros]}[layout.split('"')[1]]
    if "term" in layout:
        parts = [now[:, :3], zeros[:, :3], now[:, 3:], zeros[:, 3:]]
    with torch.inference_mode():
        whole = torch.cat(parts, dim=1)
        inputs = [whole if seen == 12 else now, encoder(whole)]
        action = policy(torch.cat(inputs[::-1] if line else inputs, dim=1))
        torch.testing.assert_close(load_policy(path, anymal, "cpu")(rows), action, rtol=1e-4, atol=1e-5)
    torch.jit.script(torch.nn.Linear(12, 3)).save(str(tmp_path / "encoder.pt"))
    with pytest.raises(ValueError, match="encoder returns 3 columns"):
        load_policy(path, anymal, "cpu")


@pytest.fixture
def remembering(tmp_path, describe):
    """A description with all that a controller can remember."""
    terms = '{term = "gravity"}, {term = "joint_vel"}, {term = "last_action"}, {term = "clock", period_s = 0.5}'
    save_checkpoint(tmp_path / "weights.pt", rsl_rl_actor(3 * 29, ACTIONS).state_dict())
    return describe(terms, 'history = {length = 3, newest = "last", by = "term", fill = "first"}',
                    "action_delay_steps = 1")  # fmt: skip


@pytest.fixture(params=["perceptron", "lstm", "script"])
def network(request, tmp_path, remembering):
    """Its weights: a perceptron, an LSTM, or an LSTM exported for one robot."""
    actor = recurrent_actor(3 * 29)
    if request.param == "lstm":
        save_checkpoint(tmp_path / "weights.pt", actor.state_dict())
    elif request.param == "script":
        torch.jit.script(actor.as_jit().eval()).save(str(tmp_path / "weights.pt"))


@pytest.mark.filterwarnings("ignore:.torch.jit")
@pytest.mark.usefixtures("network")
def test_an_episode_depends_on_its_own_rows_alone(anymal, remembering, device):
    """Robots that begin at different times, through the runner: on a GPU it captures the controller with its reset."""
    prepare_torch(device)
    policy = load_policy(remembering, anymal, device)
    assert policy.graph_safe
    steps, robots = rows_of(12, 5), np.arange(5)
    runner, observation, action, begins = runner_on(policy, steps[0].numpy(), device)
    together = []
    for k, rows in enumerate(steps):
        observation.assign(rows.numpy())
        begins.assign(k % (robots + 3) == 0)
        runner()
        together.append(action.numpy().copy())
    alone = load_policy(remembering, anymal, "cpu")
    near = {"rtol": 0.0, "atol": 0.0} if device == "cpu" else {"rtol": 2e-3, "atol": 5e-3}  # TF32
    for robot in robots:
        for k, rows in enumerate(steps):
            if k % (robot + 3) == 0:
                alone.reset(torch.ones(1, dtype=torch.bool))
            np.testing.assert_allclose(together[k][robot], alone(rows[robot : robot + 1])[0].numpy(), **near)


def test_weights_that_do_not_fit_a_description_are_named(tmp_path, anymal, describe):
    for width, line, weights, named in (
        (3, 'activation = "elu"', "weights.pt", r"controller\.toml: activation .*weights\.pt"),
        (6, "", "weights.pt", r"weights\.pt' .*6 columns.*controller\.toml \(gravity 3\) .* 3"),
        (3, "", "gone.pt", r"controller\.toml: policy .*gone\.pt"),
    ):
        torch.jit.script(torch.nn.Linear(width, ACTIONS)).save(str(tmp_path / "weights.pt"))
        with pytest.raises(ValueError, match=named):
            load_policy(describe('{term = "gravity"}', line, policy=weights), anymal, "cpu")


@pytest.mark.filterwarnings("ignore:.torch.jit")
def test_joints_that_a_network_never_moves_are_named(tmp_path, anymal, describe):
    layer = torch.nn.Linear(3, ACTIONS)
    layer.weight.data[[0, 2]] = 0.0
    torch.jit.script(layer).save(str(tmp_path / "weights.pt"))
    with pytest.warns(UserWarning, match=r"weights\.pt' never moves LF_HAA, LF_KFE$"):
        load_policy(describe('{term = "gravity"}'), anymal, "cpu")


def test_it_is_its_file_and_its_weights_wherever_they_lie(tmp_path, anymal, remembering):
    assert ControllerSpec.parse(remembering).files == (remembering, tmp_path / "weights.pt")
    assert not ControllerSpec.parse(remembering).runs_code  # a run goes on without its name
    digest = controller_hash(remembering)
    pytest.importorskip("ray")
    from qd.workers.ray_workers import PackedCode

    elsewhere = PackedCode.of(str(remembering)).unpacked(tmp_path / "elsewhere")
    now, moved = (load_policy(path, anymal, "cpu")(rows_of(4)) for path in (remembering, elsewhere))
    assert controller_hash(elsewhere) == digest and torch.equal(now, moved)


@pytest.mark.parametrize(
    ("terms", "line", "named"),
    [
        ('{term = "height"}', "", r"observation\[0\]\.term .*scan.* height"),
        ('{term = "gravity", scal = 1}', "", r"observation\[0\] \(gravity\).* scal.* scale"),
        ('{term = "gravity"}, {term = "clock"}', "", r"observation\[1\] \(clock\).*period_s"),
        ('{term = "command", scale = [1, 2]}', "", r"observation\[0\]\.scale .*3.* 2"),
        ('{term = "gravity", scale = "a"}', "", r"observation\[0\] \(gravity\): .*scale"),
        ('{term = "gravity"}', "crossing = {speed = 0.5}", "crossing.* action_clip"),
        ('{term = "gravity"}', 'model_file = "dog.xml"', "robot"),
        ('{term = "gravity"}', 'history = {length = 2, newest = "new"}', r"history\.newest"),
        ('{term = "gravity"}', 'joints = ["LF_HAA", "LF_TOE"]', "joints.*LF_TOE"),
        ('{term = "clock", period_s = 1, order = "tan"}', "", r"observation\[0\] \(clock\).*order.* 'tan'"),
        ('{term = "scan", order = "x fastest", offset = [1, 2]}', "", r"\(scan\).*offset"),
        ('{term = "heading"}, {term = "contacts"}', "", r"senses = \[.*contacts.*pose"),
        ('{term = "rpy", axes = "roll yaw"}', "", r"senses = \[.pose"),
        ('{term = "rpy", axes = "up"}', "", r"\(rpy\).*axes"),
        ('{term = "quat"}', "", r"\(quat\).*order"),
        ('{term = "gravity"}', "hold = {LF_HAA = 1.0}", "hold .*LF_HAA"),
        ('{term = "gravity"}', "hold = {LF_TOE = 1.0}", "hold .*LF_TOE"),
        ('{term = "gravity"}', 'wander = {joints = ["TOE"], amplitude = 1, period_s = 1}', r"wander\.joints .*TOE"),
        ('{term = "gravity"}', "action_scale = [1, 2]", "action_scale .*12.* 2"),
        ('{term = "gravity"}', "action_scale = nan", "action_scale"),
        ('{term = "gravity"}', "history = {length = 2}", "newest|by|fill"),
        ('{term = "gravity", history = 2}', "", "history"),
        ('{term = "scan", order = "x fastest", x = [0.05], y = [0, 0.1]}', "",
         r"scan_x = \[0\.05\] and scan_y = \[0\.0, 0\.1\]"),
        ('{term = "gravity"}', "", r"87 observations.*\(gravity 3\) has 3 observations"),
        ('{term = "gravity", clip = [1, 0]}', "", r"observation\[0\]\.clip"),
        ('{term = "gravity"}', "action_clip = -1", "action_clip"),
        ('{term = "command", limit = [1, -1, 1]}', "", r"observation\[0\]\.limit"),
        ("", "", "observation"),
        ("[" * 5000, "", "TOML"),
    ],
)  # fmt: skip
def test_what_is_not_understood_is_named(anymal, remembering, describe, terms, line, named):
    with pytest.raises(ValueError, match=rf"(?s)controller\.toml.*{named}|{named}"):
        load_policy(describe(terms, line), anymal, "cpu")
