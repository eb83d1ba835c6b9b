"""A user's controller of other layer sizes is fine-tuned, exported and evaluated by the documented commands alone."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tests.train.starts import write_actor

ROOT = Path(__file__).parents[2]


def run(*words: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "faultline", *words, "--robot", "anymal"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_from_a_file_of_the_user_to_the_tables(tmp_path, published):
    mine, tuned = write_actor(tmp_path / "mine.pt", hidden=(24, 20, 16)), tmp_path / "tuned"
    archive = ("--archive", str(published / "anymal" / "archive"))
    sizes = ("--num-envs", "8", "--terrains", "4", "--recipe.swap-every", "1", "--iterations", "2")
    said = run("finetune", "--policy", str(mine), "--device", "cpu", "--run-dir", str(tuned), *archive, *sizes)
    assert "Fine-tuning 'anymal' on 4 terrains at a time (generated): 8 robots on cpu, 2 iterations" in said
    state = torch.load(tuned / "policy.pt", weights_only=True)["actor_state_dict"]
    assert [state[f"mlp.{k}.weight"].shape[0] for k in (0, 2, 4, 6)] == [24, 20, 16, 12]

    controllers = (f"mine={mine}", f"C-G={tuned / 'policy.pt'}", f"C-G@onnx={tuned / 'policy.onnx'}")
    out = tmp_path / "tables.json"
    sizes = ("--sets", "generated", "--terrains", "2", "--episodes", "1", "--device", "cpu")
    run("evaluate", "--policies", *controllers, *archive, "--out", str(out), *sizes)
    tables = json.loads(out.read_text())
    for measure in ("success", "goal"):
        row = tables[measure]["generated"]
        assert list(row) == ["mine", "C-G", "C-G@onnx"]
        assert row["C-G"] == row["C-G@onnx"]
    assert tables["goal"]["generated"]["mine"] == 0.0  # random layers do not cross
