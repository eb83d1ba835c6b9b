"""A run of the search: its settings, directory and checkpoint, and how it is resumed."""
