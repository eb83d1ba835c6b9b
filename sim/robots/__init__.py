"""Robots: settings, model, controller, penalty scales, training; those shipped and those of one's own."""
