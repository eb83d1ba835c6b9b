"""The fine-tuning command: what it starts from, exchanges, resuming, what it leaves behind, and errors."""

import json
import shlex
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from qd.archive import FaultCounts, write_archive
from qd.evaluate.marks import marks_of, recorded_marks
from qd.evaluate.sets import split_elites
from sim.files.atomic import locked
from sim.files.command import run_command
from sim.files.settings import from_builtins
from sim.policy.loaders import load_policy
from sim.robots.find import get_robot
from sim.robots.training import TuningCfg
from sim.spaces import registry as spaces
from tests.builders import fresh_values
from tests.sim.spaces.spaces import move, write_ridges
from tests.train.archives import make_archive
from tests.train.starts import PPO, make_places, write_actor, write_bad_starts
from train import tuning
from train.finetune import Finetune
from train.ppo.learner import Learner, read_checkpoint
from train.ppo.ppo import CapturedPPO
from train.ppo.run import CommandTask, check_resumed, read_saved, sizes_of

ROBOT = get_robot("anymal")


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    return make_places(tmp_path_factory.mktemp("finetune"))


def config(places, **changes):
    values = {
        "policy": places / "start.pt", "archive": (places / "archive" / "archive.npz",), "device": "cpu", "num_envs": 6,
        "terrains": 4, "swap_every": 2, "iterations": 3, "critic_iterations": 1, "rows": 3, "ppo": PPO, **changes,
    }  # fmt: skip
    return Finetune(**{"rewards": Finetune.defaults([]).rewards, **values})


def resumed(run, device="cpu", **changes):
    """The command that goes on with a run."""
    return replace(Finetune.defaults(["--resume", str(run)]), device=device, **changes)


def finetune(flags):
    return flags.execute()


def job_of(flags):
    return tuning.job_of(flags, 0.0)


@pytest.fixture(scope="module")
def finished(places, device):
    assert finetune(config(places, run_dir=places / "run", export=places / "out" / "tuned.pt", device=device)) == 0
    return places / "run"


def test_a_run_leaves_a_controller_and_its_record(places, finished):
    policy = load_policy(places / "out" / "tuned.pt", ROBOT, "cpu")
    start = load_policy(places / "start.pt", ROBOT, "cpu")
    rows = torch.randn(5, 235)
    assert 1e-6 < (policy(rows) - start(rows)).abs().max() < 0.1  # it learned, and is still what it came from
    record = json.loads((places / "out" / "tuned.train.json").read_text())
    for key in ("command", "commit", "device", "versions", "seed", "date", "wall_s", "settings", "pieces"):
        assert key in record, key
    settings = record["settings"]
    assert settings["mix"] == {"mix": "generated", "terrains": 4, "swap_every": 2, "draw": "learnable"}
    assert (settings["archive"]["elites"], settings["archive"]["trained_on"]) == (10, 7)
    assert settings["archive"]["validation"] == 1
    assert settings["ppo"]["hidden_dims"] == [16, 8] and settings["task"]["crosses"]
    assert record["env_steps"] == 3 * 4 * 6
    same = load_policy(finished / "policy.onnx", ROBOT, "cpu")
    torch.testing.assert_close(same(rows), policy(rows), atol=1e-5, rtol=1e-5)


def test_the_controller_is_the_mean_of_the_last_actors(places, monkeypatch):
    assert Finetune.defaults([]).ppo.average == 0.2
    run, actors, iterate = places / "mean", [], Learner.iterate

    def remembered(learner):
        step = iterate(learner)
        actors.append(learner.actor_state())
        return step

    monkeypatch.setattr(Learner, "iterate", remembered)
    flags = config(places, run_dir=run, iterations=4, critic_iterations=0, ppo=replace(PPO, average=0.5))
    assert finetune(flags) == 0
    assert json.loads((run / "policy.train.json").read_text())["averaged"] == 2
    written = torch.load(run / "policy.pt", weights_only=True)["actor_state_dict"]
    last = torch.load(run / "checkpoint.pt", weights_only=True)["actor_state_dict"]
    for key, value in written.items():
        assert last[key].equal(actors[3][key])  # a training goes on from the last one
        assert torch.allclose(value.float(), (actors[2][key] + actors[3][key]) / 2, rtol=1e-3, atol=1e-6), key
    counts = []
    for iterations in (10, 11):  # the last ones are others, also where the run was in the middle of them
        assert finetune(resumed(run, iterations=iterations)) == 0
        counts.append(json.loads((run / "policy.train.json").read_text())["averaged"])
    assert counts == [5, 1]


def test_an_actor_that_has_not_learned_yet_is_not_in_the_mean(places, capsys):
    run, ppo = places / "whole", replace(PPO, average=1.0)
    assert finetune(config(places, run_dir=run, iterations=4, critic_iterations=1, ppo=ppo)) == 0
    assert json.loads((run / "policy.train.json").read_text())["averaged"] == 3
    assert "Controller (the mean of the last 3 actors) and training record" in capsys.readouterr().out


def test_without_the_packages_for_onnx_it_says_how_to_make_the_file(places, finished, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "sim.policy.export", None)
    run = places / "without"
    assert finetune(config(places, run_dir=run, iterations=1)) == 0
    assert f"export-policy --robot anymal --policy {run / 'policy.pt'}" in capsys.readouterr().out
    assert not (run / "policy.onnx").exists()


def test_the_critic_learns_alone_first(places):
    states = []
    for iterations in (1, 2):
        run = places / f"alone{iterations}"
        assert finetune(config(places, run_dir=run, iterations=iterations, critic_iterations=1)) == 0
        states.append(torch.load(run / "policy.pt", weights_only=True)["actor_state_dict"])
    start = torch.load(places / "start.pt", weights_only=True)["actor_state_dict"]
    start = {key: value.half() if value.ndim > 1 else value for key, value in start.items()}  # as is exported
    assert all(value.equal(start[key]) and value.dtype == start[key].dtype for key, value in states[0].items())
    assert not any(value.equal(start[key]) for key, value in states[1].items())


def test_weights_that_half_precision_does_not_hold_are_exported_as_they_are(places):
    run = places / "large"
    state = torch.load(places / "start.pt", weights_only=True)
    state["actor_state_dict"]["mlp.0.weight"][0, 0] = 70_000.0
    torch.save(state, places / "large.pt")
    assert finetune(config(places, run_dir=run, policy=places / "large.pt", iterations=1, critic_iterations=1)) == 0
    there = torch.load(run / "policy.pt", weights_only=True)["actor_state_dict"]
    assert there["mlp.0.weight"][0, 0] == 70_000.0 and there["mlp.2.weight"].dtype == torch.float16


def test_a_critic_that_comes_along_is_taken(places):
    path = write_actor(places / "with_critic.pt", critic=True)
    job = job_of(config(places, policy=path, run_dir=places / "none"))
    assert job.settings["critic_iterations"] == 0
    tuned = tuning.FineTuning(job)
    expected = torch.load(path, weights_only=True)["critic_state_dict"]
    assert all(value.equal(expected[key]) for key, value in tuned.learner.alg.critic.state_dict().items())
    assert float(tuned.learner.alg._lr) == pytest.approx(1e-3)
    tuned.before_iteration()
    assert float(tuned.learner.alg._lr) == pytest.approx(1e-4)  # a trained actor's first steps are small here too


def test_it_begins_with_the_noise_of_another_controller_where_that_is_asked_for(places):
    noisy = write_actor(places / "noisy.pt", critic=True, **{"distribution.std_param": torch.full((12,), 0.7)})
    run, flags = places / "quiet", {"policy": noisy, "noise_of": places / "start.pt", "iterations": 1}
    tuned = tuning.FineTuning(job_of(config(places, run_dir=run, **flags)))
    assert tuned.learner.noise_std == pytest.approx(0.3)
    assert tuned.learner.actor_state()["mlp.0.weight"].equal(
        torch.load(noisy, weights_only=True)["actor_state_dict"]["mlp.0.weight"]
    )
    assert finetune(config(places, run_dir=run, **flags)) == 0
    assert json.loads((run / "policy.train.json").read_text())["settings"]["noise_of"] == str(places / "start.pt")
    assert finetune(resumed(run, iterations=2)) == 0
    with pytest.raises(ValueError, match=r"noise_of"):
        job_of(resumed(run, iterations=3, noise_of=noisy))
    own = config(places, run_dir=places / "own_noise", policy=noisy, noise_of=ROBOT.policy_file, iterations=1)
    assert job_of(own).settings["noise_of"] == "shipped"  # not where it lies on this machine
    assert finetune(own) == 0 and finetune(resumed(places / "own_noise", iterations=2)) == 0
    plain = tuning.FineTuning(job_of(config(places, run_dir=places / "none", policy=noisy)))
    assert plain.learner.noise_std == pytest.approx(0.7)


@pytest.mark.parametrize(("iterations", "alone"), [(1, 0), (3, 1), (10, 5), (99, 49), (1200, 50)])
def test_left_out_the_critic_alone_has_at_most_half_of_the_iterations(iterations, alone, places):
    job = job_of(config(places, critic_iterations=None, iterations=iterations, run_dir=places / "none"))
    assert job.settings["critic_iterations"] == alone


def test_it_ends_with_the_command_that_compares(places, capsys):
    run = places / "a run"
    assert finetune(config(places, run_dir=run, iterations=1, split_seed=3)) == 0
    line = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("Next, see what it did:"))
    words = shlex.split(line.partition("  ")[2])
    assert words[1:] == [
        "evaluate", "--robot", "anymal", "--policies", f"base={places / 'start.pt'}", f"tuned={run / 'policy.pt'}",
        "--archive", str(places / "archive" / "archive.npz"), "--split-seed", "3",
    ]  # fmt: skip


def test_it_says_where_the_controller_will_stay_as_it_is(places, capsys):
    assert finetune(config(places, run_dir=places / "stays", iterations=1, critic_iterations=1)) == 0
    assert "learns alone for the first 1 iterations: the controller stays as it is" in capsys.readouterr().out
    assert finetune(resumed(places / "stays", iterations=2)) == 0
    assert "stays as it is" not in capsys.readouterr().out


def test_every_episode_is_whole(places):
    # With clocks set forward, some would end by the clock without having had the time to cross.
    task = tuning.FineTuning(job_of(config(places, run_dir=places / "none"))).task
    assert task.episode_steps.tolist() == [0] * 6


def test_a_normaliser_becomes_part_of_the_first_layer(places):
    normaliser = {"obs_normalizer._mean": torch.randn(1, 235), "obs_normalizer._std": torch.rand(1, 235) + 0.5}
    path = write_actor(places / "normalised.pt", **normaliser)
    actor = job_of(config(places, policy=path, run_dir=places / "none")).start.actor
    torch.save({"actor_state_dict": actor}, places / "folded.pt")
    rows = torch.randn(5, 235)
    expected = load_policy(path, ROBOT, "cpu")(rows)
    torch.testing.assert_close(load_policy(places / "folded.pt", ROBOT, "cpu")(rows), expected, atol=1e-5, rtol=1e-5)


def test_rewards_may_be_weighted_otherwise_and_stay_so_after_a_resume(places):
    own = job_of(config(places, run_dir=places / "own")).task.rewards
    assert own == replace(ROBOT.training.rewards, termination=-200.0, tracking_lin_vel=6.0)
    run = places / "careful"
    careful = replace(ROBOT.training.rewards, termination=-100.0, tracking_ang_vel=2.0)
    assert finetune(config(places, run_dir=run, rewards=careful)) == 0
    assert job_of(resumed(run)).task.rewards == careful
    with pytest.raises(ValueError, match=r"termination \(-100.0 there, -1.0 wanted\).*2.0 there, 0.5 wanted"):
        job_of(resumed(run, rewards=replace(careful, termination=-1.0, tracking_ang_vel=0.5)))


def test_it_says_which_rewards_weigh_otherwise_than_the_robots_own(places, capsys):
    own = ROBOT.training.rewards
    finetune(config(places, run_dir=places / "weights", iterations=1))
    expected = f"Rewards: tracking_lin_vel=6, termination=-200 (the robot's own: {own.tracking_lin_vel:g}, "
    assert f"{expected}{own.termination:g})\n" in capsys.readouterr().out
    finetune(config(places, run_dir=places / "own_weights", iterations=1, rewards=own))
    assert "Rewards: the robot's own\n" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        ({"num_envs": "x"}, "num_envs must be a whole number or None, got 'x'"),
        ({"iterations": 2.5}, "iterations must be a whole number or None, got 2.5"),
        ({"seed": True}, "seed must be a whole number, got True"),
        ({"mix": {"draw": 3}}, "draw must be"),
        ({"mix": {"terrains": -1}}, "terrains must be at least 1"),
        ({"ppo": {"gamma": "all"}}, "gamma must be"),
    ],
)
def test_a_damaged_setting_of_the_resumed_run_is_named(damage, message, finished, tmp_path):
    content = torch.load(finished / "checkpoint.pt", weights_only=True)
    content["extra"]["settings"] |= damage
    torch.save(content, tmp_path / "checkpoint.pt")
    with pytest.raises(ValueError, match=f"checkpoint.pt is damaged.*{message}"):
        resumed(tmp_path)


@pytest.mark.parametrize(
    ("robot", "paper"),  # Esquerre-Pourtere et al., the numbers of fine-tuning
    [("cassie", (600, 100, 200, 3000)), ("anymal", (1500, 500, 400, 1200)), ("mine", (1500, 500, 400, 1200))],
)
def test_on_a_gpu_the_sizes_are_the_papers(robot, paper):
    sizes = sizes_of(Finetune.defaults([]), tuning.paper_sizes(robot), {}, device="cuda:0")
    assert tuple(sizes[name] for name in ("num_envs", "terrains", "swap_every", "iterations")) == paper
    given = replace(Finetune.defaults([]), swap_every=7)
    assert sizes_of(given, tuning.paper_sizes(robot), {}, device="cuda:0")["swap_every"] == 7


def test_terrains_are_exchanged_when_due(places, monkeypatch, device):
    seen = []
    exchange = CommandTask.exchange

    def watched(task, tiles):
        seen.append(int(task.counter))
        exchange(task, tiles)
        np.testing.assert_array_equal(task.sim.bank.heights.numpy(), tiles.heights)
        assert (task.episode_steps == 0).all()

    monkeypatch.setattr(CommandTask, "exchange", watched)
    finetune(config(places, run_dir=places / "swaps", iterations=5, swap_every=2, device=device))
    assert len(seen) == 2  # before iterations 3 and 5
    assert seen[1] - seen[0] == 2 * 4 + 1  # two iterations of 4 steps, and the restart's own


def test_resume_needs_the_directory_alone_and_goes_on_with_the_same_terrains(finished, places, device):
    state = read_checkpoint(finished / "checkpoint.pt", "anymal")["extra"]["mix"]
    assert finetune(resumed(finished, device, run_dir=places / "longer", iterations=4)) == 0
    later = read_checkpoint(places / "longer" / "checkpoint.pt", "anymal")
    assert later["iter"] == 4 and later["extra"]["mix"]["rows"] == state["rows"]
    before = read_checkpoint(finished / "checkpoint.pt", "anymal")["extra"]["settings"]
    assert later["extra"]["settings"] == {**before, "iterations": 4}


def rows_of_swap(mix, number):
    """Elites of an exchange, without their terrains."""
    mix.swap = number
    return mix._draw_rows()


def test_several_archives_are_trained_on_together(places):
    for name, count, seed in (("one", 10, 0), ("two", 30, 1)):
        write_archive(places / f"{name}.npz", make_archive(count, seed=seed))
    both = (places / "one.npz", places / "two.npz")
    job = job_of(config(places, archive=both, run_dir=places / "none"))
    # Of 10 and 30 elites 2 and 6 are in the test, 1 and 2 for validation.
    assert [len(part) for part in job.mix.genes] == [7, 22]
    drawn = np.concatenate([rows_of_swap(job.mix, k) for k in range(400)])
    assert 0.4 < (drawn < 7).mean() < 0.6  # in equal shares, though the second has three times as many
    assert job.settings["shares"] == "equal" and job.settings["archive"]["path"] == [str(path) for path in both]
    assert job.settings["archive"]["trained_on"] == [7, 22] and job.settings["archive"]["validation"] == [1, 2]
    by_size = job_of(config(places, archive=both, shares="size", run_dir=places / "none"))
    drawn = np.concatenate([rows_of_swap(by_size.mix, k) for k in range(400)])
    assert 0.2 < (drawn < 7).mean() < 0.4  # one in four of them, though those that are drawn come back less


def test_what_one_archive_holds_out_is_not_trained_on_from_another(places):
    write_archive(places / "same.npz", make_archive(30, seed=1))
    write_archive(places / "part.npz", (whole := make_archive(30, seed=1)).rows(np.arange(20)))
    split = split_elites(whole)
    held_out = whole.genes[np.concatenate([split.test, split.validation])]
    job = job_of(config(places, archive=(places / "same.npz", places / "part.npz"), run_dir=places / "none"))
    assert not set(marks_of(held_out)) & set(job.trained_on)


def write_courses(path, ground: str = "") -> None:
    space = spaces.get_space(f"course{ground}")
    write_archive(path, replace(make_archive(10), space=space.name, genes=space.hard_random(10, 3)))


def test_archives_of_two_terrain_spaces_are_trained_on_together(places):
    write_courses(places / "course.npz")
    both, run = (places / "archive" / "archive.npz", places / "course.npz"), places / "two-spaces"
    assert finetune(config(places, archive=both, run_dir=run, iterations=1)) == 0
    job = job_of(resumed(run, iterations=2))
    assert [(space.name, len(part)) for space, part in zip(job.mix.spaces, job.mix.genes, strict=True)] == [
        ("super_gaussian", 7),
        ("course", 7),
    ]
    assert job.settings["archive"]["space"] == ["super_gaussian", "course"] and "space" not in job.settings
    assert len(job.trained_on) == 14 and job.flags.archive == both
    assert finetune(resumed(run, iterations=2)) == 0
    alone = job_of(config(places, archive=both[1:], run_dir=places / "none"))
    assert alone.settings["space"] == "course" and "space" not in alone.settings["archive"]


def test_a_training_on_several_archives_goes_on(places):
    write_archive(places / "second.npz", make_archive(12, seed=2))
    both = (places / "archive" / "archive.npz", places / "second.npz")
    run = places / "several"
    assert finetune(config(places, archive=both, run_dir=run, iterations=1)) == 0
    assert resumed(run).archive == both
    assert finetune(resumed(run, iterations=2)) == 0
    write_archive(places / "second.npz", make_archive(12, seed=3))
    with pytest.raises(ValueError, match=r"archive.elites_sha256 \(.*put an archive that has changed back"):
        finetune(resumed(run, iterations=3))


def test_resume_needs_neither_the_first_controller_nor_the_archives_place(places):
    start, archive, moved, run = (places / name for name in ("gone.pt", "gone.npz", "moved.npz", "moving"))
    start.write_bytes((places / "start.pt").read_bytes())
    write_archive(archive, make_archive(10))
    finetune(config(places, policy=start, archive=(archive,), run_dir=run, iterations=1))
    start.unlink()
    archive.rename(moved)
    with pytest.raises(ValueError, match=r"no archive at .*gone.npz.*name it with --archive"):
        finetune(resumed(run, iterations=2))
    assert finetune(resumed(run, iterations=2, archive=(moved,))) == 0
    assert finetune(resumed(run, iterations=3)) == 0  # it remembers where they lie now
    write_archive(moved, make_archive(10, seed=1))  # as many others
    with pytest.raises(ValueError, match=r"archive.elites_sha256 \(.*put an archive that has changed back"):
        finetune(resumed(run, iterations=4))


def test_fewer_iterations_than_are_done_are_refused(finished):
    before = (finished / "policy.pt").stat().st_mtime_ns
    with pytest.raises(ValueError, match="has done 3 iterations already: give at least as many in all"):
        finetune(resumed(finished, iterations=2))
    assert (finished / "policy.pt").stat().st_mtime_ns == before


def test_the_training_of_a_base_is_left_to_its_own_command(finished, places):
    run = places / "base"
    run.mkdir()
    content = torch.load(finished / "checkpoint.pt", weights_only=True)
    del content["extra"]["mix"], content["extra"]["settings"]["mix"]
    torch.save(content, run / "checkpoint.pt")
    (run / "config.json").write_text('{"task": {}}')
    with pytest.raises(ValueError, match=r"training of a base controller.*go on with .*train --robot anymal --resume"):
        finetune(resumed(run, iterations=4))
    with pytest.raises(ValueError, match=r"is a fine-tuning: go on with .*finetune --robot anymal --resume"):
        read_saved(finished, ROBOT, "train")


def test_a_run_directory_takes_one_training_at_a_time(finished):
    before = (finished / "checkpoint.pt").read_bytes()
    with locked(finished, "busy"), pytest.raises(ValueError, match="another training works in"):
        finetune(resumed(finished, iterations=4))
    assert (finished / "checkpoint.pt").read_bytes() == before


def test_a_resume_of_other_settings_is_refused(finished, places):
    before = (finished / "checkpoint.pt").read_bytes()
    with pytest.raises(ValueError, match=r"was begun with other settings .*mix.swap_every \(2 there, 3 wanted\)"):
        finetune(resumed(finished, swap_every=3))
    with pytest.raises(ValueError, match=r"was begun with other settings .*seed \(0 there, 5 wanted\)"):
        finetune(resumed(finished, seed=5))
    assert (finished / "checkpoint.pt").read_bytes() == before


def test_numbers_that_are_not_finite_stop_it_and_keep_the_last_checkpoint(places, finished, monkeypatch):
    run = places / "nan"
    finetune(config(places, run_dir=run, iterations=2))
    kept = (run / "checkpoint.pt").read_bytes()
    monkeypatch.setattr(CapturedPPO, "update", lambda alg: {"value": float("nan")})
    with pytest.raises(FloatingPointError, match=r"losses are not finite.*the last checkpoint is kept in"):
        finetune(resumed(run, iterations=3))
    assert (run / "checkpoint.pt").read_bytes() == kept


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--robot", "spot"], "unknown robot 'spot'"),
        (["--archive", "{dir}/nowhere"], "archive --robot anymal` and name it with --archive"),
        (["--archive", "{dir}/cassie.npz"], "the archive must be of robot 'anymal', got one of 'cassie'"),
        (["--archive", "{dir}/empty.npz"], "needs at least 5 elites, got 0"),
        (["--mix", "hand-crafted", "--archive", "{dir}/archive"], "takes no terrains from an archive"),
        (["--mix", "hard-random", "--draw", "failing"], "draw failing chooses among elites"),
        (["--mix", "hard-random", "--only", "failing"], "mix hard-random has no elites: leave --only"),
        (["--only", "failing"], "must have fresh episodes of its elites, which say what fails, got none"),
        (
            ["--only", "uncertified", "--archive", "{dir}/fresh.npz"],
            "crossed by certifiers, got 10 of 10 that were not",
        ),
        (["--task", "commands", "--start-spread", "2"], "start_spread needs task crossing, got task commands with 2 m"),
        (["--start-spread", "11"], "start_spread must be at least 0 and at most 10, got 11.0"),
        (["--policy", "{dir}/nowhere.pt"], "no such file"),
        (["--policy", "{dir}/narrow.pt"], "maps 100 observations to 12 actions"),
        (["--policy", "{dir}/script.pt"], "a fine-tuning starts from an rsl_rl checkpoint"),
        (["--policy", "{dir}/std_nan.pt"], "must be 12 numbers above 0, got tensor([nan"),
        (["--policy", "{dir}/std_negative.pt"], "must be 12 numbers above 0, got tensor([-1."),
        (["--policy", "{dir}/std_short.pt"], "must be 12 numbers above 0, got tensor([0.3000, 0.3000])"),
        (
            ["--policy", "{dir}/critic_other.pt"],
            "must have the actor's hidden layers [16, 8], 235 inputs and one output",
        ),
        (
            ["--policy", "{dir}/critic_none.pt"],
            "must have the actor's hidden layers [16, 8], 235 inputs and one output",
        ),
        (["--policy", "{dir}/critic_nan.pt"], "has weights that are not finite"),
        (["--terrains", "1"], "terrains must be at least 2"),
        (["--terrains", "30", "--num-envs", "6"], "num_envs must be at least as many as terrains, 30, got 6"),
        (["--rewards.termination", "inf"], "rewards.termination must be a finite number, got inf"),
        (["--swap-every", "0"], "swap_every must be at least 1, got 0"),
        (["--num-envs", "0"], "num_envs must be at least 1, got 0"),
        (["--iterations", "-1"], "iterations must be at least 1, got -1"),
        (["--ppo.mini-batches", "0"], "ppo.mini_batches must be at least 1"),
        (["--export", "tuned.onnx"], "export must be a file named *.pt, got tuned.onnx: faultline export-policy"),
        (["--rows", "0"], "rows must be at least 1, got 0"),
        (["--max-seconds", "0"], "max_seconds must be above 0, got 0.0"),
        (["--save-every-s", "-1"], "save_every_s must be at least 0, got -1.0"),
        (["--seed", "-1"], "seed must be at least 0, got -1"),
        (["--resume", "{dir}/nowhere"], "no checkpoint at"),
    ],
)
def test_errors_come_before_any_work_in_one_line(flags, message, places, monkeypatch, capsys):
    write_archive(places / "cassie.npz", make_archive(10, robot="cassie"))
    write_archive(places / "empty.npz", make_archive(0))
    write_archive(places / "fresh.npz", replace(make_archive(10), fresh=fresh_values(make_archive(10))))
    state = torch.load(places / "start.pt", weights_only=True)["actor_state_dict"]
    state["mlp.0.weight"] = state["mlp.0.weight"][:, :100]
    torch.save({"actor_state_dict": state}, places / "narrow.pt")
    write_bad_starts(places)
    torch.jit.script(torch.nn.Linear(235, 12)).save(places / "script.pt")
    monkeypatch.setattr("train.ppo.run.CommandTask", None)  # building anything would fail with another error
    monkeypatch.chdir(places)
    given = ["--device", "cpu", *(flag.format(dir=places) for flag in flags)]
    if "--archive" not in flags and not {"hand-crafted", "hard-random"} & set(flags) and "--resume" not in flags:
        given += ["--archive", str(places / "archive" / "archive.npz")]
    assert run_command(Finetune, given, name="finetune") == 2
    lines = capsys.readouterr().err.splitlines()
    (error,) = [line for line in lines if "names no hash" not in line]  # a warning of archives made by hand
    assert message in error and error.startswith("error: ")


@pytest.fixture(scope="module")
def judged(places):
    """Ten elites: 2 are crossed in fresh episodes; of the other 8 a certifier crosses the first 3."""
    archive = make_archive(10)
    fresh = replace(fresh_values(archive), goal_rate=np.array([0.1] * 8 + [0.9] * 2))
    outcomes = np.array([[[20, 0, 0, 0]]] * 3 + [[[0, 20, 0, 0]]] * 5 + [[[0, 0, 0, 0]]] * 2)
    counts = replace(
        FaultCounts.none_of(10), certifiers=("C-G",), certifier_sha256=("a" * 64,), certifier_outcomes=outcomes,
        certifier_resolved_outcomes=outcomes * (outcomes[:, :, :1] > 0),
    )  # fmt: skip
    write_archive(places / "judged.npz", replace(archive, fresh=fresh, faults=counts))
    return places / "judged.npz", archive


def test_which_elites_are_trained_on(places, judged):
    path, archive = judged
    kinds = {"all": range(10), "failing": range(8), "certified": range(3), "uncertified": range(3, 8)}
    for only, expected in kinds.items():
        job = job_of(config(places, archive=(path,), only=only, held_out=False, run_dir=places / "none"))
        rows = [int(np.flatnonzero((archive.genes == genes).all(axis=1))[0]) for genes in job.mix.genes[0]]
        assert sorted(rows) == list(expected), only
        held = job_of(config(places, archive=(path,), only=only, run_dir=places / "none"))
        kept = {genes.tobytes() for genes in held.mix.genes[0]}
        train = {archive.genes[row].tobytes() for row in split_elites(archive).train}
        assert kept == train & {genes.tobytes() for genes in job.mix.genes[0]}
    assert job.settings["archive"]["only"] == "uncertified" and job.settings["archive"]["held_out"] is False
    learnable = job_of(config(places, archive=(path,), only="failing", draw="learnable", run_dir=places / "none"))
    assert learnable.mix.success().tolist() == [0.1] * learnable.mix.num_elites


def test_all_elites_are_more_than_both_parts_of_a_split(places, monkeypatch):
    """A split takes 750 and 300 of a large archive; here 4 and 2 of ten."""
    monkeypatch.setattr("qd.evaluate.paper.TRAINING_ELITES", 4)
    monkeypatch.setattr("qd.evaluate.paper.TERRAINS", {"anymal": 2})
    archive = make_archive(10)
    write_archive(places / "ten.npz", archive)
    own = {"archive": (places / "ten.npz",), "run_dir": places / "none"}
    marks = {held: marks_of(job_of(config(places, held_out=held, **own)).mix.genes[0]) for held in (True, False)}
    assert len(marks[True]) == 4 and sorted(marks[False]) == sorted(marks_of(archive.genes))


def test_what_is_left_out_is_the_robots_own_recipe(places, monkeypatch):
    weights = Finetune.defaults(["--robot", "cassie"]).rewards
    assert (weights.tracking_lin_vel, weights.termination, weights.orientation) == (4.0, -200.0, -1.0)
    assert Finetune.defaults([]).rewards.tracking_lin_vel == 6.0
    for name in ("anymal", "cassie"):
        ppo, own = Finetune.defaults(["--robot", name]).ppo, get_robot(name).tuning
        assert (ppo.entropy, ppo.average, ppo.steps_per_env) == (own.entropy, own.average, 24)

    def recipe(**changes):
        settings = job_of(config(places, run_dir=places / "none", **changes)).settings
        return settings["mix"]["draw"], settings["task"]["start_spread"]

    assert recipe() == ("learnable", 8.0)
    own = replace(ROBOT, tuning=TuningCfg(draw="failing", start_spread=2.0))
    monkeypatch.setattr(tuning, "get_robot", lambda spec: own)
    assert recipe() == ("failing", 2.0)
    assert recipe(draw="uniform", start_spread=0.0) == ("uniform", 0.0)
    assert recipe(mix="hard-random", archive=()) == ("uniform", 2.0)
    assert recipe(task="commands") == ("failing", 0.0)


def test_a_specialist_trains_on_what_nobody_crosses_from_along_the_way_and_goes_on(places, judged, capsys):
    run, (path, _) = places / "specialist", judged
    own = {"only": "uncertified", "held_out": False, "start_spread": 8.0, "draw": "learnable", "iterations": 2}
    assert finetune(config(places, archive=(path,), run_dir=run, **own)) == 0
    assert f"certify --robot anymal --run {places} --by S={run / 'policy.pt'}" in capsys.readouterr().out
    settings = json.loads((run / "policy.train.json").read_text())["settings"]
    assert settings["task"]["start_spread"] == 8.0 and settings["archive"]["trained_on"] == 5
    flags = resumed(run, iterations=3)
    assert (flags.only, flags.held_out, flags.start_spread, flags.draw) == ("uncertified", False, 8.0, "learnable")
    assert finetune(flags) == 0
    with pytest.raises(ValueError, match=r"begun with other settings .*start_spread \(8.0 there, 2.0 wanted\)"):
        job_of(resumed(run, iterations=3, start_spread=2.0))


def test_a_run_of_before_actors_were_averaged_goes_on_without(places, finished):
    saved = read_saved(finished, ROBOT, "finetune")
    settings = job_of(config(places, run_dir=places / "none")).settings
    older = {**settings, "ppo": {key: value for key, value in settings["ppo"].items() if key != "average"}}
    old = {**saved, "extra": {**saved["extra"], "settings": older}}
    assert check_resumed(config(places), old, settings) == []
    assert from_builtins(Finetune, Finetune.begun(ROBOT, older), "a training").ppo.average == 0.0


def test_a_run_of_before_starts_were_spread_goes_on(places, finished):
    saved = read_saved(finished, ROBOT, "finetune")
    settings = job_of(config(places, start_spread=0.0, run_dir=places / "none")).settings
    older = {**settings, "task": {key: value for key, value in settings["task"].items() if key != "start_spread"}}
    old = {**saved, "extra": {**saved["extra"], "settings": older}}
    assert check_resumed(config(places), old, settings) == []
    assert Finetune.begun(ROBOT, older)["start_spread"] == 0.0


def test_a_run_of_before_there_was_a_validation_part_goes_on_with_its_elites(places, monkeypatch):
    run, archive = places / "before-validation", make_archive(10)
    with monkeypatch.context() as before:
        before.setattr("train.tuning._keeps_validation", lambda saved: False)
        assert finetune(config(places, run_dir=run, iterations=1)) == 0
    split = split_elites(archive)
    old = sorted(marks_of(archive.genes[np.concatenate([split.train, split.validation])]))
    assert len(old) == 8 and recorded_marks(str(run / "policy.pt")) == set(old)
    job = job_of(resumed(run, iterations=2))
    assert job.trained_on == old and "validation" not in job.settings["archive"]
    assert finetune(resumed(run, iterations=2)) == 0
    assert set(job_of(config(places, run_dir=places / "none")).trained_on) < set(old)


def test_a_training_in_a_space_of_ones_own_goes_on_only_with_it(places, tmp_path, monkeypatch):
    ridges = write_ridges(tmp_path / "mine")
    own = {"mix": "hard-random", "archive": (), "space": ridges, "iterations": 1, "run_dir": tmp_path / "run"}
    assert finetune(config(places, **own)) == 0
    monkeypatch.setattr(spaces, "_loaded", [])  # as in a program that has just begun
    with pytest.raises(ValueError, match=r"which is code: name it again \(--space .*space.py:Ridges\)"):
        job_of(resumed(tmp_path / "run", iterations=2))
    there = move(ridges, tmp_path / "elsewhere")
    job = job_of(resumed(tmp_path / "run", iterations=2, space=there))
    assert job.mix.spaces[0].name == there and job.settings["space"] == ridges
    with pytest.raises(ValueError, match=r"begun with other settings .*space"):
        job_of(resumed(tmp_path / "run", iterations=2, space="course"))
