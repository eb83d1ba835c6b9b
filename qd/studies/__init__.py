"""Studies: several searches beside each other, and what they say of a setting."""
