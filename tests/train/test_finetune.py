"""Fine-tuning: what it starts from, which terrains it trains on and exchanges, what it leaves, and how it goes on."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from qd.archive import write_archive
from qd.evaluate.marks import marks_of, recorded_marks
from qd.evaluate.sets import split_elites
from sim.files.atomic import to_json
from sim.files.command import run_command
from sim.policy.loaders import load_policy
from sim.policy.spec import controller_hash
from sim.robots.find import get_robot
from sim.spaces import registry as spaces
from tests.builders import fresh_values
from tests.sim.spaces.spaces import move, write_ridges
from tests.train.archives import make_archive
from tests.train.starts import PPO, make_places, write_actor, write_bad_starts
from train import finetune as module
from train.cfg import LARGE, SPECIALIST, FinetuneCfg, RunCfg
from train.commands import Finetune
from train.finetune import FineTuning, elites_of, finetune, train_specialist
from train.ppo import training
from train.ppo.checkpoint import read_checkpoint, read_start
from train.ppo.learner import Learner
from train.ppo.ppo import CapturedPPO
from train.task.task import CommandTask

ROBOT = get_robot("anymal")
ON_CPU = RunCfg(device="cpu")


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    return make_places(tmp_path_factory.mktemp("finetune"))


def cfg_of(places, **changes):
    """Small settings; what a recipe has is given by its own names."""
    base = FinetuneCfg.of(ROBOT)
    of_recipe = {field.name for field in fields(base.recipe)} & changes.keys()
    recipe = {"swap_every": 2, "critic_iterations": 1} | {name: changes.pop(name) for name in of_recipe}
    values = {
        "policy": str(places / "start.pt"), "archive": (str(places / "archive"),), "num_envs": 6, "terrains": 4,
        "iterations": 3, "ppo": replace(PPO, hidden_dims=(512, 256, 128)), "recipe": replace(base.recipe, **recipe),
    }  # fmt: skip
    return replace(base, **values | changes)


def begun(places, **changes):
    """A fine-tuning that has not iterated yet."""
    cfg = cfg_of(places, **changes)
    start = module._read_start(ROBOT, cfg)
    cfg = replace(cfg, ppo=replace(cfg.ppo, hidden_dims=start.hidden_dims))
    return FineTuning(
        ROBOT, cfg, places / "none", device="cpu", settings={}, saved=None, elites=elites_of(ROBOT, cfg), start=start
    )


def actor_of(path):
    return torch.load(path, weights_only=True)["actor_state_dict"]


@pytest.fixture(scope="module")
def finished(places, device):
    """A run of three iterations: its critic learned alone in the first, terrains were exchanged before the third."""
    run = RunCfg(device=device, export=places / "out" / "tuned.pt")
    exchanged, exchange = [], CommandTask.exchange

    def watched(task, tiles):
        exchanged.append(int(task.counter))
        exchange(task, tiles)
        np.testing.assert_array_equal(task.sim.bank.heights.numpy(), tiles.heights)
        assert (task.episode_steps == 0).all()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CommandTask, "exchange", watched)
        assert finetune(ROBOT, cfg_of(places), places / "run", run) == places / "run" / "policy.pt"
    assert len(exchanged) == 1
    return places / "run"


def test_a_run_leaves_a_controller_and_its_record(places, finished):
    policy, start = (load_policy(places / name, ROBOT, "cpu") for name in ("out/tuned.pt", "start.pt"))
    rows = torch.randn(5, 235)
    assert 1e-6 < (policy(rows) - start(rows)).abs().max() < 0.1  # it learned, and is still what it came from
    torch.testing.assert_close(
        load_policy(finished / "policy.onnx", ROBOT, "cpu")(rows), policy(rows), atol=1e-5, rtol=1e-5
    )
    record = json.loads((places / "out" / "tuned.train.json").read_text())
    for key in ("command", "commit", "sources_sha256", "device", "versions", "seed", "date", "wall_s", "pieces"):
        assert key in record, key
    settings = record["settings"]
    assert (settings["mix"], settings["terrains"], settings["recipe"]["draw"]) == ("generated", 4, "learnable")
    (elites,) = settings["elites"]
    assert (elites["elites"], elites["trained_on"], elites["validation"]) == (10, 7, 1)
    assert settings["ppo"]["hidden_dims"] == [16, 8] and settings["task"]["crosses"]
    assert record["env_steps"] == 3 * 4 * 6 and record["critic_iterations"] == 1
    archive = make_archive(10)
    train = marks_of(archive.genes[split_elites(archive).train])
    assert recorded_marks(str(finished / "policy.pt")) == set(train) == set(record["trained_on"])


def test_it_goes_on_with_the_same_terrains_and_leaves_what_is_over(places, finished):
    before = read_checkpoint(finished / "checkpoint.pt")
    assert finetune(ROBOT, cfg_of(places), finished, ON_CPU) == finished / "policy.pt"
    assert read_checkpoint(finished / "checkpoint.pt")["progress"] == before["progress"]
    assert run_command(Finetune, ["--resume", str(finished), "--device", "cpu", "--iterations", "4"], name="x") == 0
    later = read_checkpoint(finished / "checkpoint.pt")
    assert later["iter"] == 4 and later["mix"]["rows"] == before["mix"]["rows"]
    assert later["settings"] == {**before["settings"], "iterations": 4}


def test_the_critic_learns_alone_first(places):
    run, states = places / "alone", []
    for iterations in (1, 2):
        finetune(ROBOT, cfg_of(places, iterations=iterations), run, ON_CPU)
        states.append(actor_of(run / "policy.pt"))
    start = {key: value.half() if value.ndim > 1 else value for key, value in actor_of(places / "start.pt").items()}
    assert all(value.equal(start[key]) and value.dtype == start[key].dtype for key, value in states[0].items())
    assert not any(value.equal(start[key]) for key, value in states[1].items())


def test_the_controller_is_the_mean_of_the_last_actors(places, monkeypatch):
    run, actors, iterate = places / "mean", [], Learner.iterate

    def remembered(learner):
        step = iterate(learner)
        actors.append(learner.actor_state())
        return step

    monkeypatch.setattr(Learner, "iterate", remembered)
    cfg = cfg_of(places, iterations=4, critic_iterations=0, ppo=replace(PPO, average=0.5))
    finetune(ROBOT, cfg, run, ON_CPU)
    assert json.loads((run / "policy.train.json").read_text())["averaged"] == 2
    last = actor_of(run / "checkpoint.pt")
    for key, value in actor_of(run / "policy.pt").items():
        assert last[key].equal(actors[3][key])  # a training goes on from the last one
        assert torch.allclose(value.float(), (actors[2][key] + actors[3][key]) / 2, rtol=1e-3, atol=1e-6), key
    finetune(ROBOT, replace(cfg, iterations=10), run, ON_CPU)  # the last half are others now
    assert json.loads((run / "policy.train.json").read_text())["averaged"] == 5


def test_an_actor_that_has_not_learned_yet_is_not_in_the_mean(places):
    tuned = begun(places, iterations=4, critic_iterations=3, ppo=replace(PPO, average=1.0))
    assert tuned.averaged_from == 3


def test_a_critic_that_comes_along_is_taken_and_the_first_steps_are_small(places):
    path = write_actor(places / "with_critic.pt", critic=True)
    tuned = begun(places, policy=str(path))
    assert tuned.facts()["critic_iterations"] == 0
    expected = torch.load(path, weights_only=True)["critic_state_dict"]
    assert all(value.equal(expected[key]) for key, value in tuned.learner.alg.critic.state_dict().items())
    tuned.before_iteration()
    assert float(tuned.learner.alg._lr) == pytest.approx(1e-4)
    assert tuned.task.episode_steps.tolist() == [0] * 6  # whole: clocks set forward would end some before their time


def test_it_begins_with_the_noise_of_another_controller(places):
    noisy = write_actor(places / "noisy.pt", **{"distribution.std_param": torch.full((12,), 0.7)})
    assert begun(places, policy=str(noisy)).learner.noise_std == pytest.approx(0.7)
    quiet = begun(places, policy=str(noisy), noise_of=str(places / "start.pt"))
    assert quiet.learner.noise_std == pytest.approx(0.3)
    assert quiet.learner.actor_state()["mlp.0.weight"].equal(actor_of(noisy)["mlp.0.weight"])


@pytest.mark.parametrize(("iterations", "alone"), [(1, 0), (3, 1), (10, 5), (99, 49), (1200, 50)])
def test_left_out_the_critic_alone_has_at_most_half_of_the_iterations(iterations, alone, places):
    assert module._critic_iterations(cfg_of(places, critic_iterations=None, iterations=iterations)) == alone


def test_a_normaliser_becomes_part_of_the_first_layer(places):
    normaliser = {"obs_normalizer._mean": torch.randn(1, 235), "obs_normalizer._std": torch.rand(1, 235) + 0.5}
    path = write_actor(places / "normalised.pt", **normaliser)
    torch.save({"actor_state_dict": read_start(path, ROBOT).actor}, places / "folded.pt")
    rows = torch.randn(5, 235)
    expected = load_policy(path, ROBOT, "cpu")(rows)
    torch.testing.assert_close(load_policy(places / "folded.pt", ROBOT, "cpu")(rows), expected, atol=1e-5, rtol=1e-5)


def test_weights_that_half_precision_does_not_hold_are_written_as_they_are(places):
    learner = begun(places).learner
    learner.alg.get_policy().state_dict()["mlp.0.weight"][0, 0] = 70_000.0
    training.write_controller(places / "large.pt", learner, {})
    state = actor_of(places / "large.pt")
    assert state["mlp.0.weight"][0, 0] == 70_000.0 and state["mlp.2.weight"].dtype == torch.float16


def test_numbers_that_are_not_finite_stop_it_and_keep_the_last_checkpoint(places, monkeypatch):
    run = places / "nan"
    finetune(ROBOT, cfg_of(places, iterations=1), run, ON_CPU)
    kept = (run / "checkpoint.pt").read_bytes()
    monkeypatch.setattr(CapturedPPO, "update", lambda alg: {"value": float("nan")})
    with pytest.raises(FloatingPointError, match="learning-rate"):
        finetune(ROBOT, cfg_of(places, iterations=2), run, ON_CPU)
    assert (run / "checkpoint.pt").read_bytes() == kept


def test_it_goes_on_with_equal_settings_alone(places, finished):
    kept = (finished / "checkpoint.pt").read_bytes()
    cfg = cfg_of(places, iterations=9)
    heavier = replace(cfg.task, rewards=replace(cfg.task.rewards, termination=-1.0))
    for changes, field in (
        ({"seed": 5}, "seed"), ({"swap_every": 3}, "recipe.swap_every"), ({"task": heavier}, "rewards.termination"),
        ({"iterations": 2}, "iterations"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=field):
            finetune(ROBOT, cfg_of(places, **{"iterations": 9, **changes}), finished, ON_CPU)
    with pytest.raises(ValueError, match="finetune"):
        training.read_saved(finished, "train", "anymal")
    assert (finished / "checkpoint.pt").read_bytes() == kept


def test_it_needs_neither_the_first_controller_nor_the_archives_place_to_go_on(places):
    start, archive, moved, run = (places / name for name in ("gone.pt", "gone.npz", "moved.npz", "moving"))
    start.write_bytes((places / "start.pt").read_bytes())
    write_archive(archive, make_archive(10))
    cfg = cfg_of(places, policy=str(start), archive=(str(archive),), iterations=1)
    finetune(ROBOT, cfg, run, ON_CPU)
    start.unlink()
    archive.rename(moved)
    longer = replace(cfg, archive=(str(moved),), iterations=2)
    finetune(ROBOT, longer, run, ON_CPU)
    write_archive(moved, make_archive(10, seed=1))  # as many others
    with pytest.raises(ValueError, match="elites"):
        finetune(ROBOT, replace(longer, iterations=3), run, ON_CPU)


def test_several_archives_are_trained_on_in_equal_shares(places):
    for name, count, seed in (("one", 10, 0), ("two", 30, 1)):
        write_archive(places / f"{name}.npz", make_archive(count, seed=seed))
    mix = begun(places, archive=(str(places / "one.npz"), str(places / "two.npz"))).mix
    assert [len(part) for part in mix.genes] == [7, 22]  # of 10 and 30 are 2 and 6 in the test, 1 and 2 for validation
    drawn = np.concatenate([rows_of_swap(mix, number) for number in range(400)])
    assert 0.4 < (drawn < 7).mean() < 0.6


def rows_of_swap(mix, number):
    """Elites of an exchange, without their terrains."""
    mix.swap = number
    return mix._draw_rows()


def test_what_one_archive_holds_out_is_not_trained_on_from_another(places):
    write_archive(places / "same.npz", make_archive(30, seed=1))
    write_archive(places / "part.npz", (whole := make_archive(30, seed=1)).rows(np.arange(20)))
    split = split_elites(whole)
    held_out = whole.genes[np.concatenate([split.test, split.validation])]
    elites = elites_of(ROBOT, cfg_of(places, archive=(str(places / "same.npz"), str(places / "part.npz"))))
    assert not set(marks_of(held_out)) & {mark for part in elites.genes for mark in marks_of(part)}


def write_courses(path, ground=""):
    space = spaces.get_space(f"course{ground}")
    write_archive(path, replace(make_archive(10), space=space.name, genes=space.hard_random(10, 3)))
    return str(path)


def test_archives_of_two_terrain_spaces_are_trained_on_together(places):
    both = (str(places / "archive"), write_courses(places / "course.npz"))
    cfg, run = cfg_of(places, archive=both, iterations=1), places / "two-spaces"
    finetune(ROBOT, cfg, run, ON_CPU)
    saved = read_checkpoint(run / "checkpoint.pt")
    assert saved["settings"]["spaces"] == ["super_gaussian", "course"] and len(saved["trained_on"]) == 14
    finetune(ROBOT, replace(cfg, iterations=2), run, ON_CPU)


def test_a_space_of_ones_own_runs_only_where_it_is_named(places, tmp_path, monkeypatch):
    ridges, run = write_ridges(tmp_path / "mine"), tmp_path / "run"
    cfg = cfg_of(places, mix="hard-random", archive=(), space=ridges, iterations=1)
    finetune(ROBOT, cfg, run, ON_CPU)
    monkeypatch.setattr(spaces, "_loaded", [])  # as in a program that has just begun
    assert Finetune.defaults(["--resume", str(run)]).space is None
    with pytest.raises(ValueError, match="spaces"):
        finetune(ROBOT, replace(cfg, space=None, iterations=2), run, ON_CPU)
    finetune(ROBOT, replace(cfg, space=move(ridges, tmp_path / "elsewhere"), iterations=2), run, ON_CPU)


@pytest.fixture(scope="module")
def searched(places):
    """A run of a search whose controller fails 8 of its 10 elites in fresh episodes."""
    archive, run = make_archive(10), places / "searched"
    fresh = replace(fresh_values(archive), goal_rate=np.array([0.1] * 8 + [0.9] * 2))
    digest = controller_hash(places / "start.pt")
    run.mkdir()
    write_archive(run / "archive.npz", replace(archive, fresh=fresh, policy_sha256=digest))
    config = {"settings": {"policy": str(places / "start.pt")}, "iterations": 3, "device": "cpu", "sessions": []}
    (run / "config.json").write_bytes(to_json(config))
    return run


def test_which_elites_are_trained_on(places, searched, monkeypatch):
    genes, archive = make_archive(10).genes, (str(searched),)
    train = set(marks_of(genes[split_elites(make_archive(10)).train]))
    for only, count in (("all", 10), ("failing", 8)):
        marks = {
            held: set(marks_of(elites_of(ROBOT, cfg_of(places, archive=archive, only=only, held_out=held)).genes[0]))
            for held in (True, False)
        }
        assert marks[False] == set(marks_of(genes[:count]))
        assert marks[True] == train & marks[False]
    elites = elites_of(ROBOT, cfg_of(places, archive=archive, only="failing"))
    assert elites.goal_rate is not None and set(elites.goal_rate) == {0.1}
    monkeypatch.setattr("qd.evaluate.paper.TRAINING_ELITES", 4)
    monkeypatch.setattr("qd.evaluate.paper.TERRAINS", {"anymal": 2})
    counts = [elites_of(ROBOT, cfg_of(places, archive=archive, held_out=held)).about[0] for held in (True, False)]
    assert [about["trained_on"] for about in counts] == [4, 10]  # all are more than both parts of a split


def test_a_specialist_trains_on_all_that_the_searched_controller_fails(places, searched):
    flags = ["--specialist", str(searched), "--num-envs", "6", "--terrains", "4", "--device", "cpu"]
    small = ["--ppo.steps-per-env", "4", "--ppo.epochs", "1"]
    for iterations in ("1", "2"):  # the same command goes on
        assert run_command(Finetune, [*flags, *small, "--iterations", iterations], name="finetune") == 0
    path = searched / "certifiers" / "specialist.pt"
    record = json.loads(path.with_suffix(".train.json").read_text())
    assert record["iterations"] == 2 and len(record["pieces"]) == 2 and record["seed"] == 7
    assert set(record["trained_on"]) == recorded_marks(str(path)) == set(marks_of(make_archive(10).genes[:8]))
    assert record["settings"]["policy"] == str(places / "start.pt")
    assert controller_hash(path) == controller_hash(searched / "specialist" / "policy.pt")
    other = replace(FinetuneCfg.specialist(ROBOT), policy=str(write_actor(places / "other.pt", hidden=(8, 8))))
    with pytest.raises(ValueError, match="searched"):
        train_specialist(ROBOT, searched, other, ON_CPU)
    with pytest.raises(ValueError, match="run_dir"):
        replace(Finetune.defaults(flags), specialist=searched, run_dir=places / "x").execute()


@pytest.mark.parametrize(
    ("robot", "paper"),  # Esquerre-Pourtere et al., the numbers of fine-tuning
    [("cassie", (600, 100, 200, 3000)), ("anymal", (1500, 500, 400, 1200))],
)
def test_on_a_gpu_the_sizes_are_the_papers(robot, paper):
    def sizes(cfg):
        return cfg.num_envs, cfg.terrains, cfg.recipe.swap_every, cfg.iterations

    cfg = FinetuneCfg.of(get_robot(robot))
    assert sizes(cfg.sized(get_robot(robot), "cuda:0")) == paper
    assert sizes(cfg.sized(get_robot(robot), "cuda:0", **LARGE)) == (8192, 2000, *paper[2:])
    assert sizes(cfg.sized(get_robot(robot), "cuda:0", **SPECIALIST)) == (8192, 2000, paper[2], 1000)
    given = replace(cfg, terrains=70, recipe=replace(cfg.recipe, swap_every=7))
    assert sizes(given.sized(get_robot(robot), "cuda:0", **LARGE)) == (8192, 70, 7, paper[3])


def test_what_is_left_out_is_the_robots_own_recipe():
    for name, tracking in (("anymal", 6.0), ("cassie", 4.0)):
        flags, tuning = Finetune.defaults(["--robot", name]), get_robot(name).tuning
        expected = replace(get_robot(name).training.rewards, termination=-200.0, tracking_lin_vel=tracking)
        assert flags.task.rewards == expected and flags.task.crosses
        assert (flags.recipe.draw, flags.task.start_spread) == (tuning.draw, tuning.start_spread) == ("learnable", 8.0)
        assert (flags.ppo.entropy, flags.ppo.average) == (tuning.entropy, tuning.average)
        assert (flags.ppo.steps_per_env, flags.ppo.desired_kl) == (24, 0.005)


@pytest.mark.parametrize(
    ("flags", "field"),
    [
        (["--robot", "spot"], "spot"),
        (["--archive", "{dir}/nowhere"], "nowhere"),
        (["--archive", "{dir}/cassie.npz"], "cassie"),
        (["--archive", "{dir}/empty.npz"], "at least 5 elites"),
        (["--mix", "hand-crafted", "--archive", "{dir}/archive"], "archive"),
        (["--ground", "friction"], "ground"),
        (["--recipe.only", "failing"], "fresh episodes"),
        (["--task.start-spread", "11"], "start_spread"),
        (["--policy", "{dir}/nowhere.pt"], "nowhere.pt"),
        (["--policy", "{dir}/script.pt"], "rsl_rl checkpoint"),
        (["--policy", "{dir}/std_nan.pt"], "std_param"),
        (["--policy", "{dir}/std_negative.pt"], "std_param"),
        (["--policy", "{dir}/std_short.pt"], "std_param"),
        (["--policy", "{dir}/critic_other.pt"], "critic_state_dict"),
        (["--policy", "{dir}/critic_none.pt"], "critic_state_dict"),
        (["--policy", "{dir}/critic_nan.pt"], "critic_state_dict"),
        (["--terrains", "1"], "terrains"),
        (["--terrains", "30", "--num-envs", "6"], "num_envs"),
        (["--task.rewards.termination", "inf"], "termination"),
        (["--num-envs", "-1"], "num_envs"),
        (["--ppo.mini-batches", "0"], "mini_batches"),
        (["--export", "tuned.onnx"], "export"),
        (["--max-seconds", "0"], "max_seconds"),
        (["--resume", "{dir}/nowhere"], "nowhere"),
    ],
)
def test_errors_come_before_any_work(flags, field, places, monkeypatch, capsys):
    write_archive(places / "cassie.npz", make_archive(10, robot="cassie"))
    write_archive(places / "empty.npz", make_archive(0))
    write_bad_starts(places)
    torch.jit.script(torch.nn.Linear(235, 12)).save(places / "script.pt")
    monkeypatch.setattr(training, "CommandTask", None)  # building anything would fail with another error
    monkeypatch.chdir(places)
    given = ["--device", "cpu", *(flag.format(dir=places) for flag in flags)]
    if not {"--archive", "--resume"} & set(flags):
        given += ["--archive", str(places / "archive")]
    assert run_command(Finetune, given, name="finetune") == 2
    assert field in capsys.readouterr().err.splitlines()[-1]
    assert not (places / "runs").exists()
