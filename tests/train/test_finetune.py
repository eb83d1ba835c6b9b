"""Fine-tuning: what it starts from, which terrains it trains on, what it leaves, how it goes on; described ones."""

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from qd.evaluate.sets import hash_elites, read_trained_on, split_elites
from qd.faults.searches import controllers_in
from qd.search.archive import write_archive
from sim.controllers.described import read_controller
from sim.controllers.loaders import load_policy
from sim.controllers.spec import controller_hash
from sim.files.command import run_command
from sim.mujoco_c.crossing import cross_in_mujoco_c, draw_starts
from sim.robots.find import get_robot
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS
from sim.terrains.spaces import registry as spaces
from tests.builders import fresh_values, make_archive, write_run
from tests.sim.dogs import write_toml
from tests.sim.terrains.spaces.spaces import write_ridges
from tests.train.conftest import PPO, begun, layers, write_actor
from train.cfg import FinetuneCfg, RunCfg
from train.commands import FinetuneCommand
from train.finetune import find_training_elites, finetune, train_specialist
from train.ppo import training
from train.ppo.checkpoint import STD, read_checkpoint, read_start
from train.task.task import CommandTask

ROBOT = get_robot("anymal")
ON_CPU = RunCfg(device="cpu")


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    """A folder with an archive of ten elites and a controller."""
    folder = tmp_path_factory.mktemp("finetune")
    write_run(folder / "archive", make_archive(10))
    write_actor(folder / "start.pt")
    return folder


def cfg_of(places, **changes):
    """Small settings; what a recipe has is given by its own names."""
    base = FinetuneCfg.of(ROBOT)
    of_recipe = {field.name for field in fields(base.recipe)} & changes.keys()
    recipe = {"swap_every": 2} | {name: changes.pop(name) for name in of_recipe}
    values = {
        "policy": str(places / "start.pt"), "archive": (str(places / "archive"),), "num_envs": 6, "terrains": 4,
        "iterations": 3, "ppo": replace(PPO, hidden_dims=(512, 256, 128)), "recipe": replace(base.recipe, **recipe),
    }  # fmt: skip
    return replace(base, **values | changes)


def actor_of(path):
    return torch.load(path, weights_only=True)["actor_state_dict"]


@pytest.fixture(scope="module")
def finished(places, device):
    """A run of three iterations: its critic learned alone in the first, terrains were exchanged before the third."""
    exchanged, exchange = [], CommandTask.exchange

    def watched(task, tiles):
        exchanged.append(int(task.counter))
        exchange(task, tiles)
        np.testing.assert_array_equal(task.sim.bank.heights.numpy(), tiles.heights)
        assert (task.episode_steps == 0).all()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CommandTask, "exchange", watched)
        policy = finetune(ROBOT, cfg_of(places), places / "run", RunCfg(device=device, export=places / "tuned.pt"))
    assert policy == places / "run" / "policy.pt" and len(exchanged) == 1
    return places / "run"


def test_a_run_leaves_a_controller_and_its_record(places, finished):
    policy, start = (load_policy(places / name, ROBOT, "cpu") for name in ("tuned.pt", "start.pt"))
    rows = torch.randn(5, 235)
    assert 1e-6 < (policy(rows) - start(rows)).abs().max() < 0.1  # it learned, and is still what it came from
    onnx = load_policy(finished / "policy.onnx", ROBOT, "cpu")
    torch.testing.assert_close(onnx(rows), policy(rows), atol=1e-5, rtol=1e-5)
    record = json.loads((places / "tuned.train.json").read_text())
    settings = record["settings"]
    (elites,) = settings["elites"]
    assert (elites["elites"], elites["trained_on"], elites["validation"]) == (10, 7, 1)
    assert settings["ppo"]["hidden_dims"] == [16, 8] and settings["task"]["crosses"]
    assert record["env_steps"] == 3 * 4 * 6 and record["critic_iterations"] == 1
    archive = make_archive(10)
    train = hash_elites(archive.genes[split_elites(archive).train])
    assert read_trained_on(str(finished / "policy.pt")) == set(train) == set(record["trained_on"])


def test_it_goes_on_with_the_same_terrains_by_equal_settings_alone(places, finished):
    before = read_checkpoint(finished / "checkpoint.pt")
    with pytest.raises(ValueError, match="swap_every"):
        finetune(ROBOT, cfg_of(places, iterations=9, swap_every=3), finished, ON_CPU)
    (finished / "policy.onnx").unlink()  # as where a kill came before it
    finetune(ROBOT, cfg_of(places), finished, ON_CPU)  # it is over
    assert (finished / "policy.onnx").exists()
    assert read_checkpoint(finished / "checkpoint.pt")["progress"] == before["progress"]
    flags = ["--resume", str(finished), "--device", "cpu", "--iterations", "4"]
    assert run_command(FinetuneCommand, flags, name="x") == 0
    later = read_checkpoint(finished / "checkpoint.pt")
    assert later["iter"] == 4 and later["mix"]["rows"] == before["mix"]["rows"]
    assert later["settings"] == {**before["settings"], "iterations": 4}


def test_the_critic_learns_alone_first(places):
    noisy = write_actor(places / "noisy.pt", **{STD: torch.full((12,), 0.7)})
    cfg, run, states = cfg_of(places, policy=str(noisy), noise_of=str(places / "start.pt")), places / "alone", []
    for iterations in (1, 2):
        cfg = replace(cfg, iterations=iterations, recipe=replace(cfg.recipe, critic_iterations=1))
        finetune(ROBOT, cfg, run, ON_CPU)
        states.append(actor_of(run / "policy.pt"))
    start = {key: value.half() if value.ndim > 1 else value for key, value in actor_of(noisy).items()}
    start[STD] = torch.full((12,), 0.3)  # the noise of another controller
    assert all(value.equal(start[key]) and value.dtype == start[key].dtype for key, value in states[0].items())
    assert not any(value.equal(start[key]) for key, value in states[1].items())


def test_the_controller_is_the_mean_of_the_last_actors(places):
    cfg, run = cfg_of(places, iterations=2, critic_iterations=0, ppo=replace(PPO, average=0.5)), places / "mean"
    for iterations, averaged in ((2, 1), (6, 3)):  # in a longer training the last half are others
        finetune(ROBOT, replace(cfg, iterations=iterations), run, ON_CPU)
        assert json.loads((run / "policy.train.json").read_text())["averaged"] == averaged
    last, mean = (actor_of(run / name)["mlp.0.bias"] for name in ("checkpoint.pt", "policy.pt"))
    assert 0 < (last - mean).abs().max() < 0.01  # a training goes on from the last


def test_a_critic_that_comes_along_is_taken_and_the_first_steps_are_small(places):
    path = write_actor(places / "with_critic.pt", critic=True)
    tuned = begun(ROBOT, cfg_of(places, policy=str(path)), places)
    assert tuned.critic_iterations == 0
    expected = torch.load(path, weights_only=True)["critic_state_dict"]
    assert all(value.equal(expected[key]) for key, value in tuned.learner.alg.critic.state_dict().items())
    tuned.before_iteration()
    assert float(tuned.learner.alg.optimizer.param_groups[0]["lr"]) == pytest.approx(1e-4)
    assert tuned.task.episode_steps.tolist() == [0] * 6  # whole: clocks set forward would end some before their time


def test_what_no_critic_and_no_half_precision_can_hold(places):
    tuned = begun(ROBOT, cfg_of(places, iterations=1200, ppo=replace(PPO, average=1.0)), places)
    assert tuned.critic_iterations == tuned.averaged_from == 50  # before that the actor is what it was
    tuned.learner.alg.get_policy().state_dict()["mlp.0.weight"][0, 0] = 70_000.0
    training.write_controller(places / "large.pt", tuned.learner, {})
    state = actor_of(places / "large.pt")
    assert state["mlp.0.weight"][0, 0] == 70_000.0 and state["mlp.2.weight"].dtype == torch.float16


def test_a_normaliser_becomes_part_of_the_first_layer(places):
    normaliser = {"obs_normalizer._mean": torch.randn(1, 235), "obs_normalizer._std": torch.rand(1, 235) + 0.5}
    path = write_actor(places / "normalised.pt", **normaliser)
    torch.save({"activation": "elu", "actor_state_dict": read_start(path, ROBOT).actor}, places / "folded.pt")
    rows = torch.randn(5, 235)
    expected = load_policy(path, ROBOT, "cpu")(rows)
    torch.testing.assert_close(load_policy(places / "folded.pt", ROBOT, "cpu")(rows), expected, atol=1e-5, rtol=1e-5)


def test_it_goes_on_without_the_first_controller_and_from_an_archive_that_moved(places):
    start, archive, moved, run = (places / name for name in ("gone.pt", "gone.npz", "moved.npz", "moving"))
    start.write_bytes((places / "start.pt").read_bytes())
    write_archive(archive, make_archive(10))
    cfg = cfg_of(places, policy=str(start), archive=(str(archive),), iterations=1)
    finetune(ROBOT, cfg, run, ON_CPU)
    start.unlink()
    archive.rename(moved)
    longer = replace(cfg, archive=(str(moved),), iterations=2)
    finetune(ROBOT, longer, run, ON_CPU)
    saved = (run / "checkpoint.pt").read_bytes()
    write_archive(moved, make_archive(10, seed=1))  # as many others
    with pytest.raises(ValueError, match="elites"):
        finetune(ROBOT, replace(longer, iterations=3), run, ON_CPU)
    assert (run / "checkpoint.pt").read_bytes() == saved


def test_archives_are_trained_on_together_but_for_what_any_of_them_holds_out(places):
    course = spaces.get_space("course")
    whole = make_archive(30, seed=1)
    of_courses = replace(make_archive(10), space="course", genes=course.hard_random(10, 3))
    made = {"same": whole, "part": whole.rows(np.arange(20)), "course": of_courses}
    for name, archive in made.items():
        write_archive(places / f"{name}.npz", archive)
    elites = find_training_elites(ROBOT, cfg_of(places, archive=tuple(str(places / f"{name}.npz") for name in made)))
    assert [space.name for space in elites.spaces] == ["super_gaussian", "super_gaussian", "course"]
    assert len(elites.genes[2]) == 7  # two of ten are in the test and one validates
    split = split_elites(whole)
    held_out = set(hash_elites(whole.genes[np.concatenate([split.test, split.validation])]))
    assert not any(held_out & set(hash_elites(part)) for part in elites.genes)


def test_a_space_of_ones_own_runs_only_where_it_is_named(places, tmp_path, monkeypatch):
    ridges, run = write_ridges(tmp_path / "mine"), tmp_path / "run"
    cfg = cfg_of(places, mix="hard-random", archive=(), space=ridges, iterations=1)
    finetune(ROBOT, cfg, run, ON_CPU)
    monkeypatch.setattr(spaces, "LOADED", [])  # as in a program that has just begun
    assert FinetuneCommand.defaults(["--resume", str(run)]).space is None
    with pytest.raises(ValueError, match="spaces"):
        finetune(ROBOT, replace(cfg, space=None, iterations=2), run, ON_CPU)
    finetune(ROBOT, replace(cfg, space=write_ridges(tmp_path / "elsewhere"), iterations=2), run, ON_CPU)


@pytest.fixture(scope="module")
def searched(places):
    """A run of a search whose controller fails 8 of its 10 elites in fresh episodes."""
    archive = make_archive(10)
    fresh = replace(fresh_values(archive), goal_rate=np.array([0.1] * 8 + [0.9] * 2))
    archive = replace(archive, fresh=fresh, policy_sha256=controller_hash(places / "start.pt"))
    return write_run(places / "searched", archive, {"policy": str(places / "start.pt")})


def test_which_elites_are_trained_on(places, searched):
    genes, archive = make_archive(10).genes, (str(searched),)
    train = set(hash_elites(genes[split_elites(make_archive(10)).train]))
    for only, count in (("all", 10), ("failing", 8)):
        cfgs = [cfg_of(places, archive=archive, only=only, held_out=held_out) for held_out in (False, True)]
        whole, held = (find_training_elites(ROBOT, cfg).genes[0] for cfg in cfgs)
        assert set(hash_elites(whole)) == set(hash_elites(genes[:count]))
        assert set(hash_elites(held)) == train & set(hash_elites(whole))
    elites = find_training_elites(ROBOT, cfg_of(places, archive=archive, only="failing"))
    assert elites.goal_rate is not None and set(elites.goal_rate) == {0.1}
    made = make_archive(10)
    write_archive(places / "crossed.npz", replace(made, fresh=replace(fresh_values(made), goal_rate=np.ones(10))))
    unjudged = write_run(places / "unjudged", made)
    own = replace(ROBOT, settings_file=Path("/mine/robot.toml"))
    for robot, named in ((ROBOT, ""), (own, "--robot /mine/robot.toml ")):
        with pytest.raises(ValueError, match=f"`faultline judge {named}--run {unjudged}`"):
            find_training_elites(robot, cfg_of(places, archive=(str(unjudged),), only="failing"))
    with pytest.raises(ValueError, match="elites to train on"):
        find_training_elites(ROBOT, cfg_of(places, archive=(str(places / "crossed.npz"),), only="failing"))


@pytest.mark.slow
def test_a_specialist_trains_on_all_that_the_searched_controller_fails(places, searched):
    flags = ["--specialist", str(searched), "--num-envs", "6", "--terrains", "4", "--device", "cpu"]
    small = ["--ppo.steps-per-env", "4", "--ppo.epochs", "1"]
    for iterations in ("1", "2"):  # the same command goes on
        assert run_command(FinetuneCommand, [*flags, *small, "--iterations", iterations], name="finetune") == 0
    path = searched / "certifiers" / "specialist.pt"
    record = json.loads(path.with_suffix(".train.json").read_text())
    assert record["iterations"] == 2 and len(record["pieces"]) == 2 and record["seed"] == 7
    assert set(record["trained_on"]) == set(hash_elites(make_archive(10).genes[:8]))
    assert record["settings"]["policy"] == str(places / "start.pt")
    assert controller_hash(path) == controller_hash(searched / "specialist" / "policy.pt")
    other = replace(FinetuneCfg.specialist(ROBOT), policy=str(write_actor(places / "other.pt", hidden=(8, 8))))
    with pytest.raises(ValueError, match="searched"):
        train_specialist(ROBOT, searched, other, ON_CPU)
    with pytest.raises(ValueError, match="run_dir"):
        replace(FinetuneCommand.defaults(flags), specialist=searched, run_dir=places / "x").execute()


@pytest.mark.parametrize(
    ("robot", "paper", "tracking"),  # Esquerre-Pourtere et al., the numbers of fine-tuning
    [("cassie", (600, 100, 200, 3000), 4.0), ("anymal", (1500, 500, 400, 1200), 6.0)],
)
def test_what_is_left_out_is_the_robots_own_recipe_and_on_a_gpu_of_the_papers_sizes(robot, paper, tracking):
    def sizes(cfg, **on_cuda):
        cfg = cfg.sized(get_robot(robot), "cuda:0", **on_cuda)
        return cfg.num_envs, cfg.terrains, cfg.recipe.swap_every, cfg.iterations

    cfg = FinetuneCfg.of(get_robot(robot))
    assert sizes(cfg) == paper
    given = replace(cfg, terrains=70, recipe=replace(cfg.recipe, swap_every=7))
    assert sizes(given, num_envs=8192) == (8192, 70, 7, paper[3])
    flags = FinetuneCommand.defaults(["--robot", robot])
    assert (flags.task, flags.ppo, flags.recipe) == (cfg.task, cfg.ppo, cfg.recipe)
    assert (cfg.task.rewards.termination, cfg.task.rewards.tracking_lin_vel) == (-200.0, tracking)
    assert (cfg.task.crosses, cfg.recipe.draw, cfg.task.start_spread) == (True, "learnable", 8.0)


@pytest.mark.parametrize(
    ("flags", "field"),
    [
        (["--mix", "hand-crafted", "--archive", "{dir}/archive"], "archive"),
        (["--recipe.only", "failing"], "fresh episodes"),
        (["--policy", "{dir}/script.pt"], "script.pt"),
        (["--policy", "{dir}/std.pt"], "std_param"),
        (["--policy", "{dir}/critic.pt"], "critic_state_dict"),
        (["--terrains", "1"], "terrains"),
        (["--terrains", "30", "--num-envs", "6"], "num_envs"),
        (["--export", "tuned.onnx"], "export"),
    ],
)
def test_errors_come_before_any_work(flags, field, places, monkeypatch, capsys):
    write_actor(places / "std.pt", **{STD: torch.full((12,), -1.0)})
    write_actor(places / "critic.pt", critic=True, critic_hidden=(3,))
    torch.jit.script(torch.nn.Linear(235, 12)).save(places / "script.pt")
    monkeypatch.setattr(training, "CommandTask", None)  # building anything would fail with another error
    monkeypatch.chdir(places)
    given = ["--device", "cpu", *(flag.format(dir=places) for flag in flags)]
    if "--archive" not in flags:
        given += ["--archive", str(places / "archive")]
    assert run_command(FinetuneCommand, given, name="finetune") == 2
    assert field in capsys.readouterr().err.splitlines()[-1]
    assert not (places / "runs").exists()


TERMS = """observation = [
  {term = "ang_vel", scale = 0.25, clip = 4.0}, {term = "gravity"}, {term = "joint_pos", clip = [-1.0, 2.0]},
  {term = "last_action"}, {term = "clock", period_s = 0.5},
]
history = {length = 3, newest = "last", by = "term", fill = "first"}
action_scale = [0.2, 0.3, 0.2, 0.3]
action_clip = 2.0
action_delay_steps = 1
joints = ["HR_knee", "FL_hip", "FL_knee", "FR_hip"]
"""
COLUMNS = 3 * (3 + 3 + 4 + 4 + 2)


@pytest.fixture(scope="module")
def dog(tmp_path_factory):
    """The dog with a described controller beside it, whose network is TorchScript."""
    torch.manual_seed(0)
    file = write_toml(tmp_path_factory.mktemp("described") / "dog")
    torch.jit.script(layers(COLUMNS, 16, 8, 4, between=torch.nn.SiLU)).save(file.with_name("net.pt"))
    file.with_name("controller.toml").write_text(f'policy = "net.pt"\n{TERMS}')
    return get_robot(str(file))


def dog_cfg(dog, **changes):
    values = {"mix": "hard-random", "num_envs": 6, "terrains": 4, "iterations": 1, "ppo": PPO}
    return replace(FinetuneCfg.of(dog), **values | changes)


def test_the_actor_begins_as_the_controller(dog, tmp_path):
    tuned = begun(dog, dog_cfg(dog), tmp_path)
    policy, env, alg = load_policy(dog.policy_file, dog, "cpu"), tuned.learner.env, tuned.learner.alg
    assert alg.get_policy().state_dict()[STD].tolist() == pytest.approx([0.3] * 4)
    observations, ends, done = env.get_observations(), 0, []
    step = env.task.step
    env.task.step = lambda action: (done.append(action.clone()), step(action))
    with torch.inference_mode():
        for k in range(60):
            policy.reset(env.task.episode_steps == 0)
            expected = policy(env.task.observation.clone())
            if k == 30:
                env.task.episode_steps[:3] = env.task.max_episode_steps - 1  # these end; the others go on
            observations, _, dones, _ = env.step(alg.actor(observations))
            torch.testing.assert_close(done[-1], expected, rtol=1e-5, atol=1e-5)
            ends += int(dones.sum())
    assert ends >= 3 and np.unique(torch.stack(done).numpy()).size > 100


def test_it_learns_goes_on_and_crosses(dog, tmp_path, capsys):
    run, on_cpu = tmp_path / "run", RunCfg(device="cpu", export=tmp_path / "panel" / "mine.pt")
    for iterations in (2, 3):
        described = finetune(dog, dog_cfg(dog, iterations=iterations), run, on_cpu)
    assert f"written to {described} and" in capsys.readouterr().out
    assert described == run / "controller.toml" and read_checkpoint(run / "checkpoint.pt")["iter"] == 3
    before = read_controller(dog.policy_file)
    assert read_controller(described) == replace(before, policy="policy.pt", activation="swish")
    assert controllers_in(tmp_path / "panel") == {"mine": str(tmp_path / "panel" / "mine.toml")}
    start, after, copy = (load_policy(path, dog, "cpu") for path in
                          (dog.policy_file, described, tmp_path / "panel" / "mine.toml"))  # fmt: skip
    rows = torch.randn(5, COLUMNS)
    assert 1e-6 < (after.network(rows) - start.network(rows)).abs().max() < 0.1
    torch.testing.assert_close(copy.network(rows), after.network(rows))
    flat = np.zeros((NUM_ROWS, NUM_COLS), np.float32)
    brief = replace(dog, max_duration_s=0.2)
    assert not cross_in_mujoco_c(brief, after, flat, draw_starts(brief, flat, 2, 3)).invalid.any()
    (tmp_path / "further").mkdir()
    # As a hardening does: with its critic.
    further = begun(dog, dog_cfg(dog, policy=str(run / "checkpoint.pt")), tmp_path / "further")
    expected = read_checkpoint(run / "checkpoint.pt")["critic_state_dict"]
    assert all(value.equal(expected[key]) for key, value in further.learner.alg.critic.state_dict().items())
    assert further.learner.env.controller.activation == "swish"


def test_other_networks_are_refused(dog, tmp_path):
    limited = torch.nn.Sequential(torch.nn.Hardtanh(-9.0, 9.0), *layers(COLUMNS, 16, 8, 4))
    torch.jit.script(limited).save(tmp_path / "limited.pt")
    (tmp_path / "controller.toml").write_text(f'policy = "limited.pt"\n{TERMS}')
    with pytest.raises(ValueError, match="finetune needs a network of plain layers"):
        read_start(tmp_path / "controller.toml", dog)
