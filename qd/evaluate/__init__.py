"""What a controller is worth: terrain sets, crossings, tables."""
