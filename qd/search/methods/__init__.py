"""Methods of search, one file each: where new terrains come from."""
