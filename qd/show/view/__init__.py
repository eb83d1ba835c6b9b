"""An archive in the browser: its elites, their terrains, and the robot that crosses them."""
