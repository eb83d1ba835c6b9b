"""Robots: settings, model, controller, penalty scales, training; the shipped ones and a user's own."""
