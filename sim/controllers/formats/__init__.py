"""Files of controllers, one format a module: networks that are loaded, and sources that are imported with a robot."""
