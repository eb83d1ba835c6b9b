"""Controllers as black boxes: what a user names becomes a batch of observation rows to a batch of actions."""
