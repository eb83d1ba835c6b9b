"""The second simulator: the same crossings in plain MuJoCo C."""
