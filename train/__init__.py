"""PPO on rough terrain: the command-following task, the base controller, and what it is worth."""
