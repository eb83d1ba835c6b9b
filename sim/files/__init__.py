"""What every room shares: atomic files, provenance, intervals, and how commands begin and end."""
