"""Files of controllers: networks that are loaded, and sources that are imported with a robot, by who writes them."""
