"""What is shown of a run: figures, replay, film, report and viewer."""
