"""PPO: rsl_rl's algorithm, its runs, checkpoints and speed."""
